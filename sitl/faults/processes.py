"""Faults of the flight process itself, planted from outside, and what PX4 saw of them by the world's clock."""

from __future__ import annotations

import contextlib
import math
import os
import resource
import signal
from collections.abc import Iterator
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
"""Of the environment, for sitl/faults/hang."""
_VISION_WINDOW_S = 2.0
_SAMPLE_S = 0.01


def environment(kinds: set[str], stall_s: float | None = None) -> dict[str, str]:
    """What the flight process's environment needs for these kinds of faults; `stall_s`: how long the loop stalls, None: for good."""
    if not kinds & {"hold_gil", "stall_loop"}:
        return {}
    hooks = str(Path(__file__).parent / "hang")
    found = {"PYTHONPATH": os.pathsep.join(filter(None, (hooks, os.environ.get("PYTHONPATH"))))}
    return found if stall_s is None else {**found, STALL_VARIABLE: str(stall_s)}


def strike(kind: FaultKind, flight_pid: int) -> bool:
    """A fault of the recorder or of the guardian; False: there is no such process.

    Args:
        kind: kill_recorder, kill_guardian or disk_full.
        flight_pid: of the flight process, whose child the recorder is, and whose sibling the guardian.
    """
    module = "companion.guardian" if kind == "kill_guardian" else "companion.recorder.main"
    parent = os.getppid() if kind == "kill_guardian" else flight_pid
    pid = next((pid for pid in _children(parent) if module in _command(pid)), None)
    if pid is None:
        return False
    with contextlib.suppress(ProcessLookupError):
        if kind == "disk_full":
            # No file of it may grow any more: its writes fail as on a full disk, and nobody else's do.
            _, hard = resource.prlimit(pid, resource.RLIMIT_FSIZE)
            resource.prlimit(pid, resource.RLIMIT_FSIZE, (1, hard))
        else:
            os.kill(pid, signal.SIGKILL)
    return True


def _children(parent: int) -> Iterator[int]:
    for entry in Path("/proc").iterdir():
        with contextlib.suppress(OSError, ValueError, IndexError):
            # The name, in brackets, may hold anything.
            if int((entry / "stat").read_text().rpartition(")")[2].split()[1]) == parent:
                yield int(entry.name)


def _command(pid: int) -> list[str]:
    with contextlib.suppress(OSError):
        return Path(f"/proc/{pid}/cmdline").read_text().split("\0")
    return []


class ProcessFaults:
    """Plants a fault once, then watches what still reaches PX4 and what the vehicle does."""

    def __init__(self) -> None:
        self.pid: int | None = None
        """Of the flight process; the launcher tells."""
        self.kind: FlightFaultKind | None = None
        """What was planted."""
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

    def plant(self, kind: FlightFaultKind, t_s: float, position_m: Vec3, vision_count: int | None) -> bool:
        """Do it to the flight process; False: done already, or there is no such process.

        Args:
            kind: which.
            t_s: world time.
            position_m: of the vehicle, world.
            vision_count: poses that PX4 has got so far; None: that is not to be seen from here.
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

    def let_go(self) -> None:
        """The end of a SIGSTOP that had one."""
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
        """After every step; True: `sample` wants to be called. What is None is not to be seen from here."""
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
        """Where the vehicle is."""
        self._position_m = position_m
        self._worst_tilt_rad = max(self._worst_tilt_rad, tilt_rad(attitude_wxyz))

    def report(self) -> dict[str, Any] | None:
        """Times in s since the fault, None for what never happened; None: no fault was planted."""
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
