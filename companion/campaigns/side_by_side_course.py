"""What is drawn of a flight beside others, as arrays: the ticks need not be kept, so that six long logs fit into the memory of one."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Any

import numpy as np

from companion.analysis import metrics
from companion.analysis.log import Array, FlightLog
from companion.analysis.summary import effective_config
from companion.model.frames import quat_rotate
from companion.model.types import PhaseKind

_FLYING = (PhaseKind.TAKEOFF, PhaseKind.FLIGHT, PhaseKind.LANDING)


@dataclass(frozen=True)
class Course:
    """What is drawn of a flight: one row per kept tick, NaN where a value was not known. World ENU; times on the flight clock."""

    t_s: Array
    flying: metrics.Mask
    """From take-off to touch-down."""
    graded: metrics.Mask
    """The phases that the RMS figures are of."""
    e_p_m: Array
    """Norm of the position error, by mocap."""
    e_q_deg: Array
    e_alpha_deg: Array
    thrust_percent: Array
    rho: Array
    """NaN throughout for a law without one, which logs 0."""
    slack_m: Array
    flown_world_m: Array
    reference_world_m: Array
    lateness_s: Array
    """Of every recorded tick, also of those that are not kept."""
    catch: int | None
    """Row of the (first) catch."""
    takeoff_s: float | None
    """Of the take-off command."""


def slack_m(log: FlightLog) -> Array:
    """Tether length minus distance from the anchor to the attachment point, by mocap; NaN on the ground and where it is not known."""
    blank = np.full(len(log.inputs), np.nan)
    tether = (log.config.get("vehicle") or {}).get("tether")
    if not isinstance(tether, dict) or not {"anchor_world_m", "length_m"} <= tether.keys():
        return blank
    anchor, offset = tether["anchor_world_m"], tuple(tether.get("attachment_body_m", (0.0, 0.0, 0.0)))
    known = np.isfinite(log.columns.mocap_position_world_m[:, 0])
    for k, (i, o, _) in enumerate(log.rows()):
        if o.phase_kind in _FLYING and known[k] and i.mocap is not None:
            arm = quat_rotate(i.mocap.attitude_wxyz, offset)
            point = [p + a for p, a in zip(i.mocap.position_world_m, arm, strict=True)]
            blank[k] = float(tether["length_m"]) - math.dist(point, anchor)
    return blank


def course_of(log: FlightLog) -> Course:
    """What is drawn of a log."""
    if not log.inputs:
        none, three = np.empty(0), np.empty((0, 3))
        mask = np.empty(0, dtype=np.bool_)
        return Course(none, mask, mask, none, none, none, none, none, none, three, three, none, None, None)
    c = log.columns
    pre, post = metrics.flight_masks(log)
    rho = log.column(lambda i, o, s: o.control.rho if o.control else None)
    under_way = np.flatnonzero(c.mission_t_s > 0.0)
    takeoff_s = float(c.t_s[under_way[0]] - c.mission_t_s[under_way[0]]) if len(under_way) else None
    return Course(
        t_s=c.t_s,
        flying=np.array([o.phase_kind in _FLYING for o in log.outputs], dtype=np.bool_),
        graded=pre | post,
        e_p_m=_norm(metrics.position_error_m(log)),
        e_q_deg=np.degrees(_norm(metrics.attitude_error_rad(log))),
        e_alpha_deg=np.degrees(_norm(metrics.arm_error_rad(log))),
        thrust_percent=100.0 * log.column(lambda i, o, s: o.attitude.thrust if o.attitude else None),
        rho=rho if np.nan_to_num(rho).any() else np.full(len(rho), np.nan),
        slack_m=slack_m(log),
        flown_world_m=c.mocap_position_world_m,
        reference_world_m=c.reference_position_world_m,
        lateness_s=log.timing.lateness_s,
        catch=metrics.catch_index(log),
        takeoff_s=takeoff_s,
    )


def _norm(rows: Array) -> Array:
    out: Array = np.sqrt(np.sum(rows * rows, axis=1))
    return out


@dataclass(frozen=True)
class Flight:
    """One of the flights of a comparison."""

    letter: str
    name: str
    path: str
    """As the user named it."""
    digest: str
    """Of the file's bytes: the same log named twice is known by it."""
    summary: dict[str, Any]
    config: dict[str, Any]
    metadata: dict[str, dict[str, str]]
    course: Course

    @property
    def title(self) -> str:
        """For legends."""
        return f"{self.letter}  {self.name}: {self.summary['controller']} ({self.summary['preset']})"

    @property
    def completed(self) -> bool:
        """Whether the mission was."""
        return bool(self.summary["outcome"] == "completed")


def flight_of(letter: str, name: str, path: str, digest: str, log: FlightLog, summary: dict[str, Any]) -> Flight:
    """What a comparison needs of a flight; the ticks of the log are not kept."""
    return Flight(letter, name, path, digest, summary, effective_config(log, summary), log.metadata, course_of(log))
