"""Reads a flight from a real PX4's own log (ULog): modes, arming, and arrival times of messages at PX4.

PX4's clock begins with `sitl.px4.hil_link.CLOCK_ORIGIN_S` at its first sample: times here are world times. Needs `pyulog`.
"""

from __future__ import annotations

import importlib
import math
import struct
from collections.abc import Iterable
from dataclasses import dataclass
from itertools import groupby
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt

from companion.launcher.sitl_process import PX4_FOLDER
from sitl.px4.hil_link import CLOCK_ORIGIN_S, Px4Error

NAV_STATES = {
    0: "MANUAL", 1: "ALTCTL", 2: "POSCTL", 3: "MISSION", 4: "HOLD", 5: "RTL", 10: "ACRO", 12: "DESCEND", 13: "TERMINATION",
    14: "OFFBOARD", 15: "STABILIZED", 17: "TAKEOFF", 18: "LAND",
}  # fmt: skip
"""vehicle_status.nav_state."""
_ARMED = 2
"""vehicle_status.arming_state."""
_TOPICS = [
    "vehicle_status",
    "vehicle_visual_odometry",
    "vehicle_attitude_setpoint",
    "estimator_status",
    "vehicle_local_position",
]
_EVENT_WINDOW_S = 2.0

Array = npt.NDArray[np.float64]


@dataclass(frozen=True, slots=True)
class Change:
    """A change of PX4's mode or arming state."""

    t_s: float
    mode: str
    armed: bool
    failsafe: bool


@dataclass(frozen=True, slots=True)
class AfterFault:
    """PX4's reaction to a fault; times in s since the fault, None for a reaction that never happened."""

    last_setpoint_s: float | None
    """Last SET_ATTITUDE_TARGET before the longest pause, or before the mode changed."""
    vision_gap_s: float | None
    """Longest pause between two vision poses that begins within two seconds of the fault."""
    mode: str | None
    """First mode other than OFFBOARD."""
    mode_s: float | None
    failsafe_s: float | None
    """Time of PX4's own failsafe."""
    disarmed_s: float | None


@dataclass(frozen=True)
class Px4Log:
    """One flight as PX4 logged it; all times are world times in s."""

    changes: tuple[Change, ...]
    vision_s: Array
    setpoint_s: Array
    """Times of attitude setpoints: SET_ATTITUDE_TARGET in OFFBOARD, the position controller's in PX4's own modes."""
    estimate_s: Array
    position_ned_m: Array
    """vehicle_local_position, N x 3, at `estimate_s`."""
    parameters: dict[str, float | int]

    @staticmethod
    def read(path: Path, clock_begun_s: float = 0.0) -> Px4Log:
        """Read a ULog.

        Args:
            path: path of the log.
            clock_begun_s: world time at which PX4's clock began, `autopilot.clock_begun_s` of `summary.json`.

        Raises:
            Px4Error: pyulog or the file is missing, or the file is not the log of a flight.
        """
        try:
            ulog = importlib.import_module("pyulog")  # in the tests' extra, because a flight does not need it
        except ImportError:
            raise Px4Error("PX4's log: expected the package pyulog, found none; pip install '.[test]'") from None
        try:
            with open(path, "rb") as file:  # given a name, pyulog would leave a damaged file open
                log = ulog.ULog(file, _TOPICS)
        except (OSError, TypeError, ValueError, LookupError, struct.error, ulog.exceptions.ULogException) as error:
            raise Px4Error(f"{path}: expected a ULog of PX4, found something that cannot be read ({error})") from None
        topics = {data.name: data.data for data in log.data_list if data.multi_id == 0}
        missing = [name for name in ("vehicle_status", "vehicle_local_position") if name not in topics]
        if missing:
            raise Px4Error(f"{path}: expected the log of a flight, found no {missing[0]} in it")
        position = topics["vehicle_local_position"]
        origin_s = CLOCK_ORIGIN_S - clock_begun_s
        return Px4Log(
            changes=tuple(_changes(topics["vehicle_status"], origin_s)),
            vision_s=_times(topics.get("vehicle_visual_odometry"), origin_s),
            setpoint_s=_times(topics.get("vehicle_attitude_setpoint"), origin_s),
            estimate_s=_times(position, origin_s),
            position_ned_m=np.stack([np.asarray(position[axis], float) for axis in "xyz"], axis=1),
            parameters=dict(log.initial_parameters),
        )

    def after(self, fault_s: float) -> AfterFault:
        """Return PX4's reaction to a fault at this world time."""
        later = [change for change in self.changes if change.t_s > fault_s]
        left = next((change for change in later if change.mode != "OFFBOARD"), None)
        until_s = left.t_s if left is not None else math.inf
        failsafe = next((change for change in later if change.failsafe), None)
        disarmed = next((change for change in later if not change.armed), None)
        return AfterFault(
            last_setpoint_s=_last_before_pause(self.setpoint_s, fault_s, until_s),
            vision_gap_s=_longest_gap(self.vision_s, fault_s),
            mode=None if left is None else left.mode,
            mode_s=None if left is None else left.t_s - fault_s,
            failsafe_s=None if failsafe is None else failsafe.t_s - fault_s,
            disarmed_s=None if disarmed is None else disarmed.t_s - fault_s,
        )

    def modes(self) -> str:
        """Return the modes in order, such as `OFFBOARD, LAND`."""
        return ", ".join(mode for mode, _ in groupby(change.mode for change in self.changes if change.armed))


def newest(flight: Path) -> Path:
    """Return the newest PX4 log in a flight's folder; PX4 writes one at every start, and the last is the flight's.

    Raises:
        Px4Error: the folder has no log.
    """
    logs = sorted((flight / PX4_FOLDER / "log").rglob("*.ulg"), key=lambda path: path.stat().st_mtime_ns)
    if not logs:
        raise Px4Error(f"{flight}: expected a log of PX4 in {PX4_FOLDER}/log, found none; fly it with --sitl=px4")
    return logs[-1]


def _times(topic: dict[str, Any] | None, origin_s: float) -> Array:
    """Return the world times of a topic; `origin_s` is PX4's clock at world time 0."""
    if topic is None:
        return np.zeros(0)
    return np.asarray(topic["timestamp"], float) * 1e-6 - origin_s


def _changes(status: dict[str, Any], origin_s: float) -> Iterable[Change]:
    before: tuple[Any, ...] | None = None
    rows = zip(_times(status, origin_s), status["nav_state"], status["arming_state"], status["failsafe"], strict=True)
    for t_s, nav_state, arming_state, failsafe in rows:
        now = (int(nav_state), int(arming_state) == _ARMED, bool(failsafe))
        if now != before:
            before = now
            yield Change(float(t_s), NAV_STATES.get(now[0], str(now[0])), now[1], now[2])


def _last_before_pause(times_s: Array, fault_s: float, until_s: float) -> float | None:
    """Return the last time before the longest pause that begins within the window, relative to the fault."""
    inside = times_s[(times_s > fault_s - 0.1) & (times_s < min(until_s, fault_s + _EVENT_WINDOW_S))]
    if not len(inside):
        return None
    ends = np.append(inside[1:], min(until_s, fault_s + _EVENT_WINDOW_S))
    return float(inside[int(np.argmax(ends - inside))] - fault_s)


def _longest_gap(times_s: Array, fault_s: float) -> float | None:
    begins = times_s[:-1]
    chosen = (begins > fault_s - 0.1) & (begins < fault_s + _EVENT_WINDOW_S)
    return float(np.max(np.diff(times_s)[chosen])) if chosen.any() else None
