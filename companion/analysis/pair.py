"""How well two vehicles carry a bar: the figures of a team's summary."""

from __future__ import annotations

import bisect
import math
from collections.abc import Iterator, Mapping, Sequence
from statistics import median
from typing import Any

from companion.analysis.log import FlightLog
from companion.model.codec import Record
from companion.model.frames import quat_rotate
from companion.model.outputs import Outputs
from companion.model.team import Grip
from companion.model.types import Quat, Vec3

_NEAR_S = 0.05
"""Longest time from a tick to the sample of the bar with which it is compared."""


class BarSample(Record, frozen=True):
    """True state of the bar at a time of the world."""

    t_s: float
    frame: int
    """Number of the newest motion-capture frame, which relates the clock of the world to that of a log."""
    position_world_m: Vec3
    attitude_wxyz: Quat
    pulls_world_n: tuple[Vec3, Vec3]
    """Force of each clamp on its handle, the left one first."""
    gripped: bool
    """Whether both clamps hold their handles."""


class BarTruth(Record, frozen=True):
    """True course of the bar in a flight."""

    samples: tuple[BarSample, ...]
    let_go_m: float | None
    """Largest height above its stand from which the bar has fallen or was let go; None if it was never let go."""


def bar_errors(at: Vec3, attitude: Quat, pulls_world_n: Sequence[Vec3], planned_m: Vec3) -> tuple[float, float, float]:
    """Return the distance of the bar from its planned place in m, its tilt in rad (positive with the left end up), and the force in N
    that stretches it.

    Args:
        at: true centre, world frame.
        attitude: true attitude; x points to the left end.
        pulls_world_n: force of each clamp on its handle, the left one first.
        planned_m: planned centre, world frame.
    """
    along = quat_rotate(attitude, (1.0, 0.0, 0.0))
    # The force that stretches the bar: half the difference of what its ends are pulled with, outwards.
    internal_n = 0.5 * sum(
        sign * sum(a * b for a, b in zip(pull, along, strict=True))
        for sign, pull in zip((1, -1), pulls_world_n, strict=True)
    )
    return math.dist(at, planned_m), math.asin(max(-1.0, min(1.0, along[2]))), internal_n


FIGURES = {
    "bar_p_rms_m": ("bar, position error", "mm RMS", 1e3),
    "bar_tilt_rms_deg": ("bar, tilt", "deg RMS", 1.0),
    "internal_force_rms_n": ("force that stretches the bar", "N RMS", 1.0),
    "share": ("left vehicle's share", "of the weight", 1.0),
    "let_go": ("let go", "m above its stand", 1.0),
}
"""Names, units and scales in which the figures of `summary.json` are shown."""


def figure_texts(team: Mapping[str, float | None]) -> list[tuple[str, str]]:
    """Return the name and the text of each figure."""
    shown = [(name, team[key], unit, scale) for key, (name, unit, scale) in FIGURES.items()]
    return [(name, "–" if value is None else f"{scale * value:.2f} {unit}") for name, value, unit, scale in shown]


class PairFigures:
    """Collects the errors of the bar at the times at which both vehicles carry it."""

    def __init__(self) -> None:
        self._squares = [0.0, 0.0, 0.0]
        """Sums of squares of the place error, the tilt and the internal force."""
        self._count = 0
        self._lifts = [0.0, 0.0]
        """Sums of what each vehicle lifts."""

    def add(self, at: Vec3, attitude: Quat, pulls_world_n: Sequence[Vec3], planned_m: Vec3) -> None:
        """Add the state of the bar at one time; arguments as for `bar_errors`."""
        for n, value in enumerate(bar_errors(at, attitude, pulls_world_n, planned_m)):
            self._squares[n] += value * value
        for machine, pull in enumerate(pulls_world_n):
            self._lifts[machine] += pull[2]
        self._count += 1

    def report(self, let_go_m: float | None) -> dict[str, float | None]:
        """Return the figures of `summary.json`; None where the bar was never carried."""
        place = tilt = internal = share = None
        if self._count:
            place, tilt, internal = (math.sqrt(square / self._count) for square in self._squares)
            tilt, share = math.degrees(tilt), self._lifts[0] / sum(self._lifts)
        return {
            "bar_p_rms_m": place,
            "bar_tilt_rms_deg": tilt,
            "internal_force_rms_n": internal,
            "share": share,
            "let_go": let_go_m,
        }


def carries(outputs: Outputs) -> bool:
    """Return whether a vehicle carries its end of the bar in this tick."""
    return outputs.carry is not None and outputs.team is not None and outputs.team.grip is Grip.CARRYING


def figures_of(truth: BarTruth | None, left: FlightLog | None, right: FlightLog | None) -> dict[str, Any]:
    """Return the figures of a flight over the wires; None where they are not known.

    Args:
        truth: what the world recorded; None if it recorded nothing.
        left: log of the vehicle at the left end; None if there is none.
        right: log of the other vehicle; None if there is none.
    """
    figures = PairFigures()
    if truth is not None and left is not None and right is not None:
        for sample, planned_m in carried(truth, Course(left, truth), Course(right, truth)):
            figures.add(sample.position_world_m, sample.attitude_wxyz, sample.pulls_world_n, planned_m)
    return figures.report(None if truth is None else truth.let_go_m)


class Course:
    """A log by the time of the world."""

    def __init__(self, log: FlightLog, truth: BarTruth) -> None:
        offset_s = 0.0 if log.clock == "simulated" else _offset_s(log, truth)
        self.log = log
        self.times_s = [inputs.t_s - offset_s for inputs in log.inputs]

    def index(self, t_s: float) -> int | None:
        """Return the index in the log of the tick before a time of the world; None where the log has none near it."""
        index = bisect.bisect_right(self.times_s, t_s + 1e-6) - 1
        return None if index < 0 or t_s - self.times_s[index] > _NEAR_S else index


def carried(truth: BarTruth, left: Course, right: Course) -> Iterator[tuple[BarSample, Vec3]]:
    """Yield the true states of the bar at the times at which both vehicles carry it, each with its planned centre, world frame."""
    for sample in truth.samples:
        ours, theirs = left.index(sample.t_s), right.index(sample.t_s)
        if not sample.gripped or ours is None or theirs is None:
            continue
        outputs = left.log.outputs[ours]
        if outputs.carry is not None and carries(outputs) and carries(right.log.outputs[theirs]):
            yield sample, outputs.carry.centre_world_m


def _offset_s(log: FlightLog, truth: BarTruth) -> float:
    """Return the flight clock at world time 0, by the motion-capture frames that both have seen."""
    arrived_s = {inputs.mocap.frame_number: inputs.mocap.stamp_s for inputs in log.inputs if inputs.mocap is not None}
    offsets_s = [arrived_s[each.frame] - each.t_s for each in truth.samples if each.frame in arrived_s]
    return median(offsets_s) if offsets_s else 0.0
