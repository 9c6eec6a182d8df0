"""One flight of a side-by-side report: its summary and the arrays to draw. The ticks of its log are not kept in memory."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np

from companion.analysis import metrics
from companion.analysis.log import Array, FlightLog
from companion.analysis.summary import effective_config
from companion.model.types import PhaseKind

_FLYING = (PhaseKind.TAKEOFF, PhaseKind.FLIGHT, PhaseKind.LANDING)


@dataclass(frozen=True)
class Course:
    """Time series of a flight: one row per tick that was read, NaN where a value is unknown. World ENU; times on the flight clock."""

    t_s: Array
    flying: metrics.Mask
    """Ticks from take-off to touchdown."""
    graded: metrics.Mask
    """Ticks that the RMS errors cover."""
    e_p_m: Array
    """Norm of the position error, measured by motion capture."""
    e_q_deg: Array
    e_alpha_deg: Array
    thrust_percent: Array
    rho: Array
    """Switching gain; all NaN for a law without one, which logs 0."""
    slack_m: Array
    flown_world_m: Array
    reference_world_m: Array
    lateness_s: Array
    """Lateness of every recorded tick, whether kept or not."""
    catch: int | None
    """Row of the first catch."""
    takeoff_s: float | None
    """Time of the take-off command."""


def course_of(log: FlightLog) -> Course:
    """Return the time series of a log."""
    c = log.columns
    pre, post = metrics.flight_masks(log)
    e_alpha_deg = np.degrees(np.linalg.norm(metrics.arm_error_rad(log), axis=1))
    rho = log.column(lambda i, o, s: o.control.rho if o.control else None)
    under_way = np.flatnonzero(c.mission_t_s > 0.0)
    takeoff_s = float(c.t_s[under_way[0]] - c.mission_t_s[under_way[0]]) if len(under_way) else None
    return Course(
        t_s=c.t_s,
        flying=np.array([o.phase_kind in _FLYING for o in log.outputs], dtype=np.bool_),
        graded=pre | post,
        e_p_m=np.linalg.norm(metrics.position_error_m(log), axis=1),
        e_q_deg=np.degrees(np.linalg.norm(metrics.attitude_error_rad(log), axis=1)),
        e_alpha_deg=e_alpha_deg if log.joint_count else np.full(len(rho), np.nan),
        thrust_percent=100.0 * log.column(lambda i, o, s: o.attitude.thrust if o.attitude else None),
        rho=rho if np.nan_to_num(rho).any() else np.full(len(rho), np.nan),
        slack_m=metrics.slack_m(log),
        flown_world_m=c.mocap_position_world_m,
        reference_world_m=c.reference_position_world_m,
        lateness_s=log.timing.lateness_s,
        catch=metrics.catch_index(log),
        takeoff_s=takeoff_s,
    )


@dataclass(frozen=True)
class Flight:
    """One flight of the report."""

    letter: str
    name: str
    path: str
    """Log file as named by the user."""
    digest: str
    """SHA-256 of the log file; equal for the same log given twice."""
    summary: dict[str, Any]
    config: dict[str, Any]
    metadata: dict[str, dict[str, str]]
    course: Course

    @property
    def title(self) -> str:
        """Text for legends."""
        return f"{self.letter}  {self.name}: {self.summary['controller']} ({self.summary['preset']})"

    @property
    def completed(self) -> bool:
        """Whether the mission was completed."""
        return bool(self.summary["outcome"] == "completed")


def flight_of(letter: str, name: str, path: str, digest: str, log: FlightLog, summary: dict[str, Any]) -> Flight:
    """Return the flight of a log."""
    return Flight(
        letter=letter,
        name=name,
        path=path,
        digest=digest,
        summary=summary,
        config=effective_config(log, summary),
        metadata=log.metadata,
        course=course_of(log),
    )
