"""Detects that the computer is too busy for a flight, by the time that the flight's processes wait for a core.

When other programs occupy the cores, the symptoms resemble failing devices: answers arrive late or not at all. The scheduler's
statistics show the cause.
"""

from __future__ import annotations

import contextlib
from collections import deque
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

from companion.model.check_row import refusals
from companion.model.launcher_messages import FlightEvent, Message, PreflightDone, RefusedFlight, Status

WAIT_MAX = 0.15
"""Fraction of the time that a process may wait for a core before it responds too late."""
WAIT_LATE_MAX, LATE_S = 0.05, 0.005
"""The limit that replaces `WAIT_MAX` if ticks are late by `LATE_S` or more."""
WINDOW_S, SAMPLE_S = 3.0, 0.5
CAUSED_BY_LATENESS = frozenset({
    "mocap_lost", "mocap_too_late", "vehicle_state_lost", "heartbeat_lost", "offboard_left", "arm_lost",
    "force_lost", "loop_stalled", "tracking_error", "guardian_took_over",
    "mocap.rate", "mocap.latency", "mocap.lost", "px4.heartbeat", "px4.rates", "px4.lag", "px4.vision", "px4.steady",
    "arm.reads", "force.rate",
})  # fmt: skip
"""Landings and refusals that a busy computer may cause: ids of events and of preflight rows."""
ADVICE = "close other programs, or allow real-time priority (see docs/raspberry-pi.md, section Real time)"

CoreWaits = Mapping[int, float]
"""Time that each thread has waited for a core since its start, s, by thread id."""


@dataclass(frozen=True, slots=True)
class ProcessWait:
    """How long a process waited for a core."""

    process: str
    share: float
    """Waiting time of the thread that waited longest, as a fraction of the elapsed time, 0 to 1."""


def contention_message(waits: Sequence[ProcessWait], late_s: float) -> str | None:
    """Return one line for the operator if the computer is too busy, else None.

    Args:
        late_s: 99th percentile of the ticks' lateness, s; 0 before the first tick.
    """
    worst = max((wait.share for wait in waits), default=0.0)
    late = late_s >= LATE_S
    if worst < (WAIT_LATE_MAX if late else WAIT_MAX):
        return None
    figures = [f"{wait.process} waited {wait.share:.0%} of the time for a core".replace("%", " %") for wait in waits]
    figures += [f"ticks are {late_s * 1e3:.0f} ms late"] if late else []
    return f"this computer is too busy ({', '.join(figures)}); {ADVICE}"


def longest_wait(process: str, before: CoreWaits, now: CoreWaits, elapsed_s: float) -> ProcessWait:
    """Return the longest wait among the threads that existed during the whole interval."""
    waited_s = max((now[thread] - before[thread] for thread in before.keys() & now.keys()), default=0.0)
    return ProcessWait(process, waited_s / elapsed_s)


def read_core_waits(pid: int) -> CoreWaits:
    """Read the second field of /proc/PID/task/*/schedstat; empty if the process is gone or the kernel keeps no statistics."""
    found = {}
    with contextlib.suppress(OSError):
        for thread in Path(f"/proc/{pid}/task").iterdir():
            with contextlib.suppress(OSError, IndexError, ValueError):  # it has just ended
                found[int(thread.name)] = int((thread / "schedstat").read_text(encoding="ascii").split()[1]) * 1e-9
    return found


class CpuContention:
    """Samples the scheduling delays of a flight's processes and evaluates them when an event occurs that lateness may have caused.

    Args:
        read: returns the waits of one process's threads.
    """

    def __init__(self, pids: Mapping[str, int], read: Callable[[int], CoreWaits] = read_core_waits) -> None:
        self._pids = pids
        self._read = read
        self._samples: deque[tuple[float, dict[str, CoreWaits]]] = deque()
        self._late_s: deque[tuple[float, float]] = deque()
        self.message: str | None = None
        """The first contention message; None if the computer was not busy, or no such event occurred."""

    def sample(self, now_s: float) -> None:
        """Read the waits if `SAMPLE_S` has passed since the last sample. Call it often."""
        if self._samples and now_s - self._samples[-1][0] < SAMPLE_S:
            return
        self._samples.append((now_s, {name: self._read(pid) for name, pid in self._pids.items()}))
        while now_s - self._samples[0][0] > WINDOW_S:
            self._samples.popleft()

    def on_message(self, message: Message, now_s: float) -> str | None:
        """Process a message of the flight or the guardian; return the contention message when it is first known, else None."""
        if isinstance(message, Status):
            self._late_s.append((now_s, message.lateness_s))
            while now_s - self._late_s[0][0] > WINDOW_S:
                self._late_s.popleft()
        elif self.message is None and _late(message):
            self.message = contention_message(self._waits(now_s), self._late_p99_s())
            return self.message
        return None

    def _waits(self, now_s: float) -> list[ProcessWait]:
        if not self._samples:
            return []
        then_s, before = self._samples[0]
        elapsed_s = max(SAMPLE_S, now_s - then_s)
        newest = self._samples[-1][1]
        # A process that refuses the flight ends at once: its last sample counts then.
        return [
            longest_wait(name, before[name], self._read(pid) or newest[name], elapsed_s)
            for name, pid in self._pids.items()
        ]

    def _late_p99_s(self) -> float:
        late_s = sorted(late_s for _, late_s in self._late_s)
        return late_s[int(0.99 * (len(late_s) - 1))] if late_s else 0.0


def _late(message: Message) -> bool:
    match message:
        case FlightEvent():
            return message.id in CAUSED_BY_LATENESS and message.ends_flight
        case PreflightDone():
            return any(row.id in CAUSED_BY_LATENESS for row in refusals(message.rows))
        case RefusedFlight():
            return message.device_failed
    return False
