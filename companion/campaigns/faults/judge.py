"""Evaluates a flight with a fault: its outcome, the time to detection, and violations of safety requirements.

A row holds the results of one flight, as `companion faults --json` prints it; docs/internals/faults.md describes its keys.
"""

from __future__ import annotations

import itertools
import math
from bisect import bisect_left
from collections.abc import Iterable, Sequence
from dataclasses import dataclass

from companion.campaigns.faults.variants import Variant
from companion.campaigns.runner import Row
from companion.config.vehicle import Vehicle
from companion.model.outputs import Outputs
from companion.model.types import Event, Outcome, PhaseKind, SafetyAction, Vec3
from companion.sitl_config.faults import KINDS, FaultKind, FlightPhase

GOOD = ("completed", "landed")
TAUT_N = 0.5
"""Tension above which the tether is taut; smaller values are noise of the contact solver."""
STOPPING_S = 1.0
OUTWARD_M = 0.15
"""Limit of the outward motion on a taut tether, measured from `STOPPING_S` after the reaction."""
HARD_M_S = 1.8
"""Sink rate at the floor above which a landing counts as a crash."""
NEAR_FLOOR_M = 0.1
CONTACT_MEAN_S = 0.1
"""Time over which the contact force is averaged, as long as the supervisor's rule must hold."""
_PULLS_BY_ITSELF: frozenset[FaultKind] = frozenset({"tether_taut", "tether_snag"})


@dataclass(frozen=True, slots=True)
class Point:
    """The true state of the vehicle at one time."""

    t_s: float
    """Time on the flight clock."""
    position_world_m: Vec3
    tilt_rad: float
    slack_m: float | None
    """Slack of the tether with its configured length; None without a tether."""
    tension_n: float
    contact_n: float = 0.0
    """Force of a surface on the tip."""


@dataclass(frozen=True, slots=True)
class Tick:
    """Decision of the companion in one tick."""

    t_s: float
    kind: PhaseKind
    action: SafetyAction
    reference_world_m: Vec3 | None


def ticks_of(outputs: Iterable[Outputs]) -> list[Tick]:
    """Return the companion's decision in each tick of a flight."""
    return [
        Tick(o.t_s, o.phase_kind, o.action, o.reference.position_world_m if o.reference is not None else None)
        for o in outputs
    ]


@dataclass(frozen=True, slots=True)
class FaultFlight:
    """The record of a flight with a fault."""

    outcome: str
    """Outcome as in summary.json."""
    begun_s: float | None
    """Time at which the fault began, on the flight clock; None if it never began."""
    course: Sequence[Point]
    ticks: Sequence[Tick]
    events: Sequence[Event]
    landed: bool
    """Whether the vehicle ended on the floor with its rotors stopped."""
    caught: bool
    error: str | None = None
    """The exception that ended the flight; None if there was none."""


def row_of(variant: Variant, phase: FlightPhase, flown: FaultFlight, vehicle: Vehicle) -> Row:
    """Return the row of a flight."""
    begun_s = flown.begun_s
    outcome = "landed" if flown.outcome == "aborted" and flown.landed else flown.outcome
    impact_m_s = _impact_m_s(flown.course, vehicle.airframe.ground_clearance_m)
    if impact_m_s > HARD_M_S:
        outcome = Outcome.CRASHED.value
    over_s = _over_s(flown.ticks)
    since = [event for event in flown.events if begun_s is not None and begun_s - 1e-6 <= event.t_s <= over_s]
    named = next((event for event in since if event.id in KINDS[variant.kind].named_by), None)
    reacted = next((event for event in since if event.action.rank >= SafetyAction.HOLD.rank), None)
    abort = next((event for event in since if event.action.rank >= SafetyAction.RETRACT.rank), None)
    actions = [tick.action for tick in flown.ticks if begun_s is not None and begun_s <= tick.t_s <= over_s]
    actions += [event.action for event in since]
    course = [point for point in flown.course if begun_s is not None and point.t_s >= begun_s]
    size, unit = variant.shown
    row: Row = {
        "fault": variant.kind,
        "phase": phase,
        "size": size,
        "unit": unit,
        "duration_s": variant.duration_s,
        "outcome": outcome,
        "detected_s": _after(begun_s, named),
        "event": named.id if named is not None else None,
        "reacted_s": _after(begun_s, reacted),
        "action": max(actions, key=lambda action: action.rank, default=SafetyAction.NOMINAL).value,
        "worst_tilt_deg": math.degrees(max(point.tilt_rad for point in course)) if course else None,
        "min_height_m": _min_height_m(flown, course),
        "min_slack_m": min((point.slack_m for point in course if point.slack_m is not None), default=None),
        "drift_m": _drift_m(flown, course, abort) if outcome != "refused" else None,
        "contact_n": _contact_n(course),
        "caught": flown.caught,
        "problems": [],
        "events": list(dict.fromkeys(event.id for event in since)),
        "error": flown.error,
    }
    row["problems"] = _problems(row, variant, phase, course, abort, vehicle)
    return row


def _impact_m_s(course: Sequence[Point], standing_m: float) -> float:
    """Return the largest sink rate just above the floor."""
    fastest = 0.0
    for before, after in itertools.pairwise(course):
        if after.position_world_m[2] < standing_m + NEAR_FLOOR_M and after.t_s > before.t_s:
            sink_m_s = (before.position_world_m[2] - after.position_world_m[2]) / (after.t_s - before.t_s)
            fastest = max(fastest, sink_m_s)
    return fastest


def _over_s(ticks: Sequence[Tick]) -> float:
    """Return the time of the touchdown that ends the flight; later events are not a reaction to the fault."""
    flew = False
    for tick in ticks:
        flew = flew or tick.kind not in (PhaseKind.GROUND, PhaseKind.DONE)
        if flew and tick.kind is PhaseKind.DONE:
            return tick.t_s
    return math.inf


def _after(begun_s: float | None, event: Event | None) -> float | None:
    return None if begun_s is None or event is None else round(event.t_s - begun_s, 4)


def _min_height_m(flown: FaultFlight, course: Sequence[Point]) -> float | None:
    """Return the smallest height in planned flight: from the fault or the end of the take-off, whichever is later, to the landing."""
    up = [
        tick.t_s for tick in flown.ticks if tick.kind is PhaseKind.FLIGHT and tick.action.rank < SafetyAction.LAND.rank
    ]
    if not up or not course:
        return None
    heights = [point.position_world_m[2] for point in course if up[0] <= point.t_s <= up[-1]]
    return min(heights, default=None)


def _drift_m(flown: FaultFlight, course: Sequence[Point], abort: Event | None) -> float | None:
    """Return the horizontal distance from the abort to the landing, or the largest error of a mission that continued."""
    if not course:
        return None
    if abort is not None:
        times = [point.t_s for point in course]
        at = course[min(len(course) - 1, bisect_left(times, abort.t_s))]
        return math.dist(at.position_world_m[:2], course[-1].position_world_m[:2])
    times = [tick.t_s for tick in flown.ticks]
    worst: float | None = None
    for point in course:
        k = bisect_left(times, point.t_s - 1e-6)
        reference = flown.ticks[k].reference_world_m if k < len(times) else None
        if reference is not None:
            worst = max(worst or 0.0, math.dist(point.position_world_m[:2], reference[:2]))
    return worst


def _contact_n(course: Sequence[Point]) -> float | None:
    """Return the largest mean of the contact force over `CONTACT_MEAN_S`; None without a contact."""
    if not any(point.contact_n for point in course):
        return None
    largest_n, first, impulse_ns = 0.0, 0, 0.0
    spans_s = [0.0, *(b.t_s - a.t_s for a, b in itertools.pairwise(course))]
    for last, point in enumerate(course):
        impulse_ns += point.contact_n * spans_s[last]
        while point.t_s - course[first].t_s > CONTACT_MEAN_S:
            first += 1
            impulse_ns -= course[first].contact_n * spans_s[first]
        largest_n = max(largest_n, impulse_ns / CONTACT_MEAN_S)
    return largest_n


def _problems(
    row: Row, variant: Variant, phase: FlightPhase, course: Sequence[Point], abort: Event | None, vehicle: Vehicle
) -> list[str]:
    found = []
    if row["outcome"] not in GOOD and not (row["outcome"] == "refused" and phase == "ground"):
        found.append(str(row["outcome"]))
    if row["error"] is not None:
        found.append("internal error")
    if not course and phase != "ground":
        found.append("the fault never began")
    if variant.kind not in _PULLS_BY_ITSELF and any(point.tension_n > TAUT_N for point in course):
        found.append("pulled its tether taut by its own motion")
    elif variant.kind == "tether_taut" and abort is not None and _outward_m(course, abort) > OUTWARD_M:
        found.append("moved outward on a taut tether")
    force_max_n = vehicle.safety.contact_force_max_n
    if (row["contact_n"] or 0.0) > force_max_n:
        found.append(f"pressed with {row['contact_n']:.1f} N (limit {force_max_n:g} N)")
    if any(_outside(point.position_world_m, vehicle) for point in course):
        found.append("left the geofence")
    return found


def _outward_m(course: Sequence[Point], abort: Event) -> float:
    """Return by how much the distance from the anchor grows after the stopping time, m."""
    slack = [p.slack_m for p in course if p.t_s >= abort.t_s + STOPPING_S and p.slack_m is not None]
    return slack[0] - min(slack) if slack else 0.0


def _outside(position_m: Vec3, vehicle: Vehicle) -> bool:
    room, inset_m = vehicle.room, vehicle.airframe.radius_m - vehicle.safety.geofence_tolerance_m
    (x, y, z), spans = position_m, (room.x_m, room.y_m)
    sideways = any(
        not low + inset_m <= value <= high - inset_m for value, (low, high) in zip((x, y), spans, strict=True)
    )
    return sideways or z > room.z_m[1]


def good(row: Row) -> bool:
    """Return whether the flight has no problems."""
    return not row["problems"]
