"""Faults of the flight, recorder and guardian processes, injected from outside, and their effect on PX4."""

from __future__ import annotations

import contextlib
import math
import os
import resource
import signal
from collections.abc import Collection, Iterator
from pathlib import Path
from typing import Any, Literal

from companion.model.frames import tilt_rad
from companion.model.types import Vec3
from companion.sitl_config.faults import FaultKind
from sitl.autopilot.modes import NavState

FlightFaultKind = Literal["kill_flight", "stop_flight", "hold_gil", "stall_loop"]
SIGNALS: dict[FlightFaultKind, signal.Signals] = {
    "kill_flight": signal.SIGKILL,
    "stop_flight": signal.SIGSTOP,
    "hold_gil": signal.SIGUSR1,  # sitl/faults/hang
    "stall_loop": signal.SIGUSR2,
}
STALL_VARIABLE = "COMPANION_SITL_STALL_S"
"""Environment variable for sitl/faults/hang: duration of the event loop's stall."""
OTHER_PROCESS_FAULTS: tuple[FaultKind, ...] = ("kill_recorder", "kill_guardian", "disk_full")
INJECT_RETRY_S = 0.2
"""Time between two searches for the target process of a fault."""
_VISION_WINDOW_S = 2.0
_SAMPLE_S = 0.01


def environment(kinds: set[str], stall_s: float | None = None) -> dict[str, str]:
    """Return the environment variables that the flight process needs for these kinds of faults.

    Args:
        stall_s: duration of the event loop's stall; None if it never ends.
    """
    if not kinds & {"hold_gil", "stall_loop"}:
        return {}
    hooks = str(Path(__file__).parent / "hang")
    found = {"PYTHONPATH": os.pathsep.join(filter(None, (hooks, os.environ.get("PYTHONPATH"))))}
    return found if stall_s is None else {**found, STALL_VARIABLE: str(stall_s)}


def inject_process_fault(kind: FaultKind, flight_pid: int) -> bool:
    """Inject a fault of the recorder or the guardian; return False if that process does not exist yet.

    Args:
        kind: kill_recorder, kill_guardian or disk_full.
        flight_pid: pid of the flight process, which is the recorder's parent and the guardian's sibling.
    """
    module = "companion.guardian" if kind == "kill_guardian" else "companion.recorder.main"
    parent = os.getppid() if kind == "kill_guardian" else flight_pid
    found = (pid for pid in _children(parent) if module in _command(pid))
    pid = next((pid for pid in found if parent == flight_pid or _config(pid) == _config(flight_pid)), None)
    if pid is None:
        return False
    with contextlib.suppress(ProcessLookupError):
        if kind == "disk_full":
            # Its files can no longer grow, so its writes fail as on a full disk. Other processes are not affected.
            _, hard = resource.prlimit(pid, resource.RLIMIT_FSIZE)
            resource.prlimit(pid, resource.RLIMIT_FSIZE, (1, hard))
        else:
            os.kill(pid, signal.SIGKILL)
    return True


def _children(parent: int) -> Iterator[int]:
    for entry in Path("/proc").iterdir():
        with contextlib.suppress(OSError, ValueError, IndexError):
            # The name, in brackets, may contain any character.
            if int((entry / "stat").read_text().rpartition(")")[2].split()[1]) == parent:
                yield int(entry.name)


def _command(pid: int) -> list[str]:
    with contextlib.suppress(OSError):
        return Path(f"/proc/{pid}/cmdline").read_text().split("\0")
    return []


def _config(pid: int) -> str | None:
    """Return the file of a process's configuration, which those of one vehicle share; None if its command line names none."""
    words = _command(pid)
    return words[words.index("--config") + 1] if "--config" in words else None


class ProcessFaults:
    """Injects one fault into the flight process, records PX4's inputs and the motion; also faults of recorder and guardian."""

    def __init__(self) -> None:
        self.pid: int | None = None
        """Pid of the flight process, which the launcher sends; None until then."""
        self.kind: FlightFaultKind | None = None
        self._t_s = 0.0
        self._start_m: Vec3 = (0.0, 0.0, 0.0)
        self._position_m: Vec3 = (0.0, 0.0, 0.0)
        self._setpoint_s: float | None = None
        self._vision_count: int | None = None
        self._vision_s = 0.0
        self._vision_gap_s = 0.0
        self._vision_back_s: float | None = None
        self._land_s: float | None = None
        self._disarmed_s: float | None = None
        self._worst_tilt_rad = 0.0
        self._due_s = -math.inf
        self._injected: set[FaultKind] = set()
        self._inject_due_s = 0.0

    def start_over(self) -> None:
        """Continue at the start of world time."""
        self._inject_due_s = 0.0

    def inject(self, kind: FlightFaultKind, t_s: float, position_m: Vec3, vision_count: int | None) -> bool:
        """Signal the flight process; return False if a fault was already injected or the pid is not known.

        Args:
            vision_count: vision poses that PX4 received so far, or None if that is not observable.
        """
        if self.kind is not None or self.pid is None:
            return False
        with contextlib.suppress(ProcessLookupError):
            os.kill(self.pid, SIGNALS[kind])
        self.kind = kind
        self._t_s = self._vision_s = t_s
        self._start_m = self._position_m = position_m
        self._vision_count = vision_count
        return True

    def inject_others(self, active: Collection[FaultKind], t_s: float) -> None:
        """Inject each due fault of the recorder and the guardian once, and resume the flight process when its SIGSTOP fault ends."""
        due = [kind for kind in OTHER_PROCESS_FAULTS if kind in active and kind not in self._injected]
        if due and self.pid is not None and t_s >= self._inject_due_s:
            self._inject_due_s = t_s + INJECT_RETRY_S
            self._injected.update(kind for kind in due if inject_process_fault(kind, self.pid))
        if self.kind == "stop_flight" and "stop_flight" not in active and "stop_flight" not in self._injected:
            self._injected.add("stop_flight")
            self.resume()

    def resume(self) -> None:
        """Continue a process that was stopped for a limited time."""
        if self.kind == "stop_flight" and self.pid is not None:
            with contextlib.suppress(ProcessLookupError):
                os.kill(self.pid, signal.SIGCONT)

    def watch(
        self,
        t_s: float,
        setpoint_at_s: float | None,
        vision_count: int | None,
        nav_state: NavState | None,
        armed: bool,
    ) -> bool:
        """Record the autopilot's state after a step; an argument is None if it is not observable.

        Returns:
            Whether `sample` is due.
        """
        if self.kind is None or self._disarmed_s is not None:
            return False
        if setpoint_at_s is not None and setpoint_at_s > self._t_s and self._land_s is None:
            self._setpoint_s = setpoint_at_s
        if vision_count != self._vision_count:
            self._vision_count = vision_count
            gap_s = t_s - self._vision_s
            if gap_s > self._vision_gap_s and self._vision_s - self._t_s < _VISION_WINDOW_S:
                self._vision_gap_s, self._vision_back_s = gap_s, t_s
            self._vision_s = t_s
        if self._land_s is None and nav_state is NavState.LAND:
            self._land_s = t_s
        if not armed:
            self._disarmed_s = t_s
            return True
        if t_s < self._due_s:
            return False
        self._due_s = t_s + _SAMPLE_S
        return True

    def sample(self, position_m: Vec3, attitude_wxyz: tuple[float, float, float, float]) -> None:
        """Record the position (world frame) and the attitude of the vehicle."""
        self._position_m = position_m
        self._worst_tilt_rad = max(self._worst_tilt_rad, tilt_rad(attitude_wxyz))

    def report(self) -> dict[str, Any] | None:
        """Return the report on the fault, or None if there was none; times in s after it, None for what never happened."""
        if self.kind is None:
            return None

        def since(t_s: float | None) -> float | None:
            return None if t_s is None else round(t_s - self._t_s, 4)

        seen = self._vision_count is not None
        moved = [b - a for a, b in zip(self._start_m, self._position_m, strict=True)]
        return {
            "kind": self.kind,
            "t_s": self._t_s,
            "start_m": list(self._start_m),
            "last_setpoint_s": (since(self._setpoint_s) or 0.0) if seen else None,
            "vision_gap_s": round(self._vision_gap_s, 4) if seen else None,
            "vision_back_s": since(self._vision_back_s),
            "land_s": since(self._land_s),
            "disarmed_s": since(self._disarmed_s),
            "drift_m": math.hypot(moved[0], moved[1]),
            "worst_tilt_deg": math.degrees(self._worst_tilt_rad),
        }
