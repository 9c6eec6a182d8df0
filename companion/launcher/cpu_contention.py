"""Is the computer too busy for a flight? Judged by how long its processes were ready to run and had no core.

A computer whose cores are taken by other programs looks like bad devices: answers come late or not at all. The scheduler knows better.
"""

from __future__ import annotations

import contextlib
from collections import deque
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from companion.model.rows import Level
from companion.model.types import SafetyAction, Severity

WAIT_MAX = 0.15
"""Share of the time: a process that waits longer than this for a core answers too late."""
WAIT_LATE_MAX, LATE_S = 0.05, 0.005
"""The same where ticks come a whole period late."""
WINDOW_S, SAMPLE_S = 3.0, 0.5
CAUSED_BY_LATENESS = frozenset({
    "mocap_lost", "mocap_too_late", "vehicle_state_lost", "heartbeat_lost", "offboard_left", "arm_lost",
    "force_lost", "loop_stalled", "tracking_error", "guardian_took_over",
    "mocap.rate", "mocap.latency", "mocap.lost", "px4.heartbeat", "px4.rates", "px4.lag", "px4.vision", "px4.steady",
    "arm.reads", "force.rate",
})  # fmt: skip
"""Landings and refusals that a busy computer may bring about: ids of events and of rows of the preflight."""
ADVICE = "close other programs, or permit real-time priority: docs/raspberry-pi.md, Real time"

Waited = Mapping[int, float]
"""By thread id: seconds for which it was ready to run and had no core, since it began."""


@dataclass(frozen=True, slots=True)
class CoreWait:
    """How long one process waited for a core."""

    process: str
    """In words."""
    share: float
    """Of the time, 0 to 1, of the thread that waited longest."""


def busy_line(waits: Sequence[CoreWait], late_s: float) -> str | None:
    """Return one line for the operator if the computer is too busy, else None.

    Args:
        waits: one for each process.
        late_s: 99th percentile of the ticks' lateness; 0 before the first tick.
    """
    worst = max((wait.share for wait in waits), default=0.0)
    late = late_s >= LATE_S
    if worst < (WAIT_LATE_MAX if late else WAIT_MAX):
        return None
    figures = [f"{wait.process} waited {wait.share:.0%} of the time for a core".replace("%", " %") for wait in waits]
    figures += [f"ticks are {late_s * 1e3:.0f} ms late"] if late else []
    return f"this computer is too busy ({', '.join(figures)}); {ADVICE}"


def core_wait(process: str, before: Waited, now: Waited, elapsed_s: float) -> CoreWait:
    """Return the longest wait of the threads that were there all the time."""
    waited_s = max((now[thread] - before[thread] for thread in before.keys() & now.keys()), default=0.0)
    return CoreWait(process, waited_s / elapsed_s)


def waited(pid: int) -> Waited:
    """Read /proc/PID/task/*/schedstat, second field; empty for a process that is gone, and on a kernel that does not count."""
    found = {}
    with contextlib.suppress(OSError):
        for thread in Path(f"/proc/{pid}/task").iterdir():
            with contextlib.suppress(OSError, IndexError, ValueError):  # it has just ended
                found[int(thread.name)] = int((thread / "schedstat").read_text(encoding="ascii").split()[1]) * 1e-9
    return found


class Crowding:
    """Watches the processes of one flight from outside and judges when something happens that lateness may have caused.

    Args:
        pids: by the process's name in words.
        read: the waits of one process's threads.
    """

    def __init__(self, pids: Mapping[str, int], read: Callable[[int], Waited] = waited) -> None:
        self._pids = pids
        self._read = read
        self._samples: deque[tuple[float, dict[str, Waited]]] = deque()
        self._late_s: deque[tuple[float, float]] = deque()
        self.line: str | None = None
        """What was judged at the first event or refused row that lateness may have caused; None: not busy, or no such event."""

    def sample(self, now_s: float) -> None:
        """Read the waits; to be called often, reads every `SAMPLE_S`."""
        if self._samples and now_s - self._samples[-1][0] < SAMPLE_S:
            return
        self._samples.append((now_s, {name: self._read(pid) for name, pid in self._pids.items()}))
        while now_s - self._samples[0][0] > WINDOW_S:
            self._samples.popleft()

    def take(self, message: Mapping[str, Any], now_s: float) -> str | None:
        """Take a message of flight or guardian; returns the line when it is first known."""
        kind = message.get("type")
        if kind == "status":
            self._late_s.append((now_s, message["lateness_ms"] * 1e-3))
            while now_s - self._late_s[0][0] > WINDOW_S:
                self._late_s.popleft()
        elif self.line is None and _late(message):
            self.line = busy_line(self._waits(now_s), self._late_p99_s())
            return self.line
        return None

    def _waits(self, now_s: float) -> list[CoreWait]:
        if not self._samples:
            return []
        then_s, before = self._samples[0]
        elapsed_s = max(SAMPLE_S, now_s - then_s)
        newest = self._samples[-1][1]
        # A process that refuses the flight ends at once: its last sample counts then.
        return [
            core_wait(name, before[name], self._read(pid) or newest[name], elapsed_s)
            for name, pid in self._pids.items()
        ]

    def _late_p99_s(self) -> float:
        late_s = sorted(late_s for _, late_s in self._late_s)
        return late_s[int(0.99 * (len(late_s) - 1))] if late_s else 0.0


def _late(message: Mapping[str, Any]) -> bool:
    if message.get("type") == "event":
        lands = SafetyAction(message["action"]).rank >= SafetyAction.LAND.rank
        return message["id"] in CAUSED_BY_LATENESS and (lands or message["severity"] == Severity.CRITICAL.value)
    if message.get("type") == "preflight":
        refused = (row for row in message["rows"] if not row["ok"] and row["level"] == Level.REFUSE.value)
        return any(row["id"] in CAUSED_BY_LATENESS for row in refused)
    return message.get("type") == "refused" and bool(message.get("device_failed"))
