"""A fault campaign: what is planted, and what a flight with a fault came to. Pure: the flights are flown elsewhere.

A row is a flight's, as `companion faults --json` prints it; the keys are described in docs/faults.md.
"""

from __future__ import annotations

import csv
import itertools
import math
from bisect import bisect_left
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from companion.config.vehicle import Vehicle
from companion.model.types import Event, Outcome, PhaseKind, SafetyAction, Vec3
from companion.sitl_config.faults import KINDS, PHASES, FaultKind, FlightPhase

Row = dict[str, Any]

COLUMNS = (
    "fault", "phase", "size", "unit", "duration_s", "outcome", "detected_s", "event", "reacted_s", "action", "worst_tilt_deg",
    "min_height_m", "min_slack_m", "drift_m", "caught", "problems", "events", "error",
)  # fmt: skip
GOOD = ("completed", "landed")
TAUT_N = 0.5
"""More than this is no noise of the contact solver."""
STOPPING_S = 1.0
OUTWARD_M = 0.15
"""So much further from the anchor, this long after the reaction, is a way outward."""
HARD_M_S = 1.8
"""Whoever comes down faster than this has not landed but fallen."""
NEAR_FLOOR_M = 0.1
_PULLS_BY_ITSELF: frozenset[FaultKind] = frozenset({"tether_taut", "tether_snag"})


@dataclass(frozen=True, slots=True)
class Variant:
    """One fault of a campaign, wherever it is planted."""

    kind: FaultKind
    size: float | None = None
    """None: the kind has none."""
    duration_s: float | None = None
    """None: for good."""

    @property
    def phases(self) -> tuple[FlightPhase, ...]:
        """Where it is planted."""
        return KINDS[self.kind].phases

    @property
    def shown(self) -> tuple[float | None, str]:
        """What the column `size` shows, and its unit: the size, or of a kind without one how long it lasts."""
        if KINDS[self.kind].size is not None:
            return self.size, KINDS[self.kind].unit
        return self.duration_s, "s"

    def fault(self, phase: FlightPhase) -> dict[str, Any]:
        """As an entry of `world.faults`."""
        found: dict[str, Any] = {"kind": self.kind, "phase": phase}
        if self.size is not None:
            found["size"] = self.size
        if self.duration_s is not None:
            found["duration_s"] = self.duration_s
        return found

    def text(self) -> str:
        """For people: `mocap_loss 0.5 s`."""
        size, unit = self.shown
        words = [self.kind] + ([f"{size:g} {unit}".strip()] if size is not None else [])
        if self.duration_s is not None and KINDS[self.kind].size is not None:
            words.append(f"for {self.duration_s:g} s")
        return " ".join(words)


def _durations(kind: FaultKind, *durations_s: float | None) -> list[Variant]:
    return [Variant(kind, None, duration_s) for duration_s in durations_s]


def _sizes(kind: FaultKind, *sizes: float, duration_s: float | None = None) -> list[Variant]:
    return [Variant(kind, size, duration_s) for size in sizes]


VARIANTS: tuple[Variant, ...] = (
    *_durations("mocap_loss", 0.05, 0.1, 0.2, 0.5, 1.0, 2.0, 5.0, None),
    *_durations("mocap_occluded", 0.1, None),
    *_sizes("mocap_jump", 0.08, 0.3),
    *_sizes("mocap_jump", 1.0, duration_s=0.05),
    *_sizes("mocap_drag", 1.0),
    *_sizes("mocap_swap", 1.0),
    *_sizes("mocap_swap", 0.6, duration_s=0.08),
    *_durations("mocap_freeze", 0.08, None),
    *_sizes("mocap_latency", 0.05, 0.2),
    *_sizes("mocap_rate", 60.0, 5.0),
    *_durations("link_loss", 0.1, 0.5, None),
    *_sizes("link_delay", 0.03, 0.15),
    *_sizes("autopilot_reboot", 2.0),
    *_durations("offboard_refused", None),
    *_durations("arming_refused", None),
    *_durations("servo_loss", 0.05, None),
    *_durations("servo_overload", None),
    *_sizes("servo_hot", 70.0, 85.0),
    *_sizes("servo_angle", 10.0, 40.0),
    *_sizes("bus_noise", 0.1, 0.6),
    *_durations("force_loss", 0.2, None),
    *_durations("force_stuck", None),
    *_sizes("force_bias", 2.0, 10.0),
    *_sizes("motor_weak", 0.1, 0.4),
    *_sizes("battery_sag", 2.0, 4.0),
    *_sizes("gust", 4.0, duration_s=2.0),
    *_sizes("gust", 8.0, duration_s=0.7),
    *_sizes("tether_taut", 0.05, 0.15),
    *_sizes("tether_snag", 0.05, 0.3),
    *_durations("tether_cut", None),
    *_sizes("payload_missed", 0.4),
    *_sizes("payload_double", 0.2),
    *_durations("payload_dropped", None),
    *_sizes("payload_heavy", 0.6),
    *_durations("disk_full", None),
    *_sizes("clock_step", 5.0),
    *_durations("stall_loop", 0.06, None),
    *_durations("hold_gil", None),
    *_durations("stop_flight", 0.08, None),
    *_durations("kill_flight", None),
    *_durations("kill_recorder", None),
    *_durations("kill_guardian", None),
    *_sizes("pilot_takeover", 3.0),
)
"""What a campaign flies, each in every phase of its kind."""

WIRES: tuple[tuple[Variant, FlightPhase], ...] = (
    (Variant("mocap_loss", None, 0.1), "line"),
    (Variant("mocap_loss"), "line"),
    (Variant("mocap_jump", 0.3), "return"),
    (Variant("mocap_drag", 1.0), "line"),
    (Variant("mocap_swap", 1.0), "catch"),
    (Variant("mocap_freeze"), "line"),
    (Variant("mocap_latency", 0.2), "return"),
    (Variant("link_loss"), "catch"),
    (Variant("link_delay", 0.03), "line"),
    (Variant("offboard_refused"), "return"),
    (Variant("arming_refused"), "ground"),
    (Variant("servo_loss"), "catch"),
    (Variant("servo_overload"), "return"),
    (Variant("bus_noise", 0.1), "takeoff"),
    (Variant("force_loss"), "catch"),
    (Variant("motor_weak", 0.1), "line"),
    (Variant("battery_sag", 4.0), "return"),
    (Variant("tether_snag", 0.05), "line"),
    (Variant("payload_heavy", 0.6), "catch"),
    (Variant("disk_full"), "line"),
    (Variant("kill_recorder"), "line"),
    (Variant("kill_guardian"), "takeoff"),
    (Variant("kill_flight"), "catch"),
    (Variant("stall_loop"), "return"),
    (Variant("pilot_takeover", 3.0), "line"),
)
"""What `--wires` flies over real wires."""


def variants_of(kinds: Sequence[str], phases: Sequence[str]) -> list[tuple[Variant, FlightPhase]]:
    """What is to be flown in the fast loop, in the order of the table; nothing named means all that a campaign plants."""
    return [
        (variant, phase)
        for variant in VARIANTS
        for phase in PHASES
        if (not kinds or variant.kind in kinds)
        and (not phases or phase in phases)
        and (phase in variant.phases or (kinds and phases))
    ]


# -- what came of it ---------------------------------------------------------------------------------------------------


@dataclass(frozen=True, slots=True)
class Point:
    """Where the machine truly was."""

    t_s: float
    """On the flight clock."""
    position_world_m: Vec3
    tilt_rad: float
    slack_m: float
    """Of the tether as long as it was."""
    tension_n: float


@dataclass(frozen=True, slots=True)
class Tick:
    """What the companion did."""

    t_s: float
    kind: PhaseKind
    action: SafetyAction
    reference_world_m: Vec3 | None


@dataclass(frozen=True, slots=True)
class Flown:
    """A flight with a fault."""

    outcome: str
    """As in summary.json."""
    begun_s: float | None
    """When the fault began; None: it never did."""
    course: Sequence[Point]
    ticks: Sequence[Tick]
    events: Sequence[Event]
    """The guardian's as well."""
    stands: bool
    """Low, and the rotors stand."""
    caught: bool
    error: str | None = None
    """What ended the flight from within."""


def row_of(variant: Variant, phase: FlightPhase, flown: Flown, vehicle: Vehicle) -> Row:
    """What a flight came to."""
    begun_s = flown.begun_s
    outcome = "landed" if flown.outcome == "aborted" and flown.stands else flown.outcome
    impact_m_s = _impact_m_s(flown.course, vehicle.airframe.ground_clearance_m)
    if impact_m_s > HARD_M_S:
        outcome = Outcome.CRASHED.value
    over_s = _over_s(flown.ticks)
    since = [event for event in flown.events if begun_s is not None and begun_s - 1e-6 <= event.t_s <= over_s]
    named = next((event for event in since if event.id in KINDS[variant.kind].named_by), None)
    reacted = next((event for event in since if event.action.rank >= SafetyAction.HOLD.rank), None)
    gave_up = next((event for event in since if event.action.rank >= SafetyAction.RETRACT.rank), None)
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
        "min_slack_m": min(point.slack_m for point in course) if course else None,
        "drift_m": _drift_m(flown, course, gave_up) if outcome != "refused" else None,
        "caught": flown.caught,
        "problems": [],
        "events": list(dict.fromkeys(event.id for event in since)),
        "error": flown.error,
    }
    row["problems"] = _problems(row, variant, phase, course, gave_up, vehicle)
    return row


def _impact_m_s(course: Sequence[Point], standing_m: float) -> float:
    """The fastest that it sank just above the floor."""
    fastest = 0.0
    for before, after in itertools.pairwise(course):
        if after.position_world_m[2] < standing_m + NEAR_FLOOR_M and after.t_s > before.t_s:
            sink_m_s = (before.position_world_m[2] - after.position_world_m[2]) / (after.t_s - before.t_s)
            fastest = max(fastest, sink_m_s)
    return fastest


def _over_s(ticks: Sequence[Tick]) -> float:
    """From here on the machine stands after its flight: what is told then is no answer to anything."""
    flew = False
    for tick in ticks:
        flew = flew or tick.kind not in (PhaseKind.GROUND, PhaseKind.DONE)
        if flew and tick.kind is PhaseKind.DONE:
            return tick.t_s
    return math.inf


def _after(begun_s: float | None, event: Event | None) -> float | None:
    return None if begun_s is None or event is None else round(event.t_s - begun_s, 4)


def _min_height_m(flown: Flown, course: Sequence[Point]) -> float | None:
    """Least height while the machine was to be up: from the fault, or the end of the take-off, until it was to come down."""
    up = [
        tick.t_s for tick in flown.ticks if tick.kind is PhaseKind.FLIGHT and tick.action.rank < SafetyAction.LAND.rank
    ]
    if not up or not course:
        return None
    heights = [point.position_world_m[2] for point in course if up[0] <= point.t_s <= up[-1]]
    return min(heights, default=None)


def _drift_m(flown: Flown, course: Sequence[Point], gave_up: Event | None) -> float | None:
    """Horizontal: from where it gave up to where it stands; of a mission that went on, the most that it was off its way."""
    if not course:
        return None
    if gave_up is not None:
        times = [point.t_s for point in course]
        at = course[min(len(course) - 1, bisect_left(times, gave_up.t_s))]
        return math.dist(at.position_world_m[:2], course[-1].position_world_m[:2])
    times = [tick.t_s for tick in flown.ticks]
    worst: float | None = None
    for point in course:
        k = bisect_left(times, point.t_s - 1e-6)
        reference = flown.ticks[k].reference_world_m if k < len(times) else None
        if reference is not None:
            worst = max(worst or 0.0, math.dist(point.position_world_m[:2], reference[:2]))
    return worst


def _problems(
    row: Row, variant: Variant, phase: FlightPhase, course: Sequence[Point], gave_up: Event | None, vehicle: Vehicle
) -> list[str]:
    """What must not be."""
    found = []
    if row["outcome"] not in GOOD and not (row["outcome"] == "refused" and phase == "ground"):
        found.append(str(row["outcome"]))
    if row["error"] is not None:
        found.append("error of its own")
    if not course and phase != "ground":
        found.append("the fault never began")
    if variant.kind not in _PULLS_BY_ITSELF and any(point.tension_n > TAUT_N for point in course):
        found.append("tether taut by its own motion")
    elif variant.kind == "tether_taut" and gave_up is not None and _outward_m(course, gave_up) > OUTWARD_M:
        found.append("outward on a taut tether")
    if any(_outside(point.position_world_m, vehicle) for point in course):
        found.append("left the geofence")
    return found


def _outward_m(course: Sequence[Point], gave_up: Event) -> float:
    """How much further from the anchor it went once it had time to stop."""
    slack = [point.slack_m for point in course if point.t_s >= gave_up.t_s + STOPPING_S]
    return slack[0] - min(slack) if slack else 0.0


def _outside(position_m: Vec3, vehicle: Vehicle) -> bool:
    room, inset_m = vehicle.room, vehicle.airframe.radius_m - vehicle.safety.geofence_tolerance_m
    (x, y, z), spans = position_m, (room.x_m, room.y_m)
    sideways = any(
        not low + inset_m <= value <= high - inset_m for value, (low, high) in zip((x, y), spans, strict=True)
    )
    return sideways or z > room.z_m[1]


def good(row: Row) -> bool:
    """Nothing happened that must not."""
    return not row["problems"]


def outcomes(rows: Sequence[Row]) -> dict[str, int]:
    """How many of each."""
    found: dict[str, int] = {}
    for row in rows:
        found[row["outcome"]] = found.get(row["outcome"], 0) + 1
    return found


def summary(rows: Sequence[Row]) -> dict[str, Any]:
    """The campaign in a few numbers."""

    def most(key: str, pick: Callable[[list[float]], float]) -> float | None:
        values = [row[key] for row in rows if row[key] is not None]
        return pick(values) if values else None

    return {
        "flights": len(rows),
        "faults": len({(row["fault"], row["size"], row["duration_s"]) for row in rows}),
        "outcomes": outcomes(rows),
        "bad": sum(not good(row) for row in rows),
        "worst_tilt_deg": most("worst_tilt_deg", max),
        "min_height_m": most("min_height_m", min),
        "min_slack_m": most("min_slack_m", min),
    }


def write_csv(rows: Sequence[Row], path: Path) -> None:
    """One line per flight; lists with spaces between."""
    with open(path, "w", newline="", encoding="utf-8") as file:
        writer = csv.writer(file)
        writer.writerow(COLUMNS)
        for row in rows:
            values = [row[key] for key in COLUMNS]
            writer.writerow(["; ".join(v) if isinstance(v, list) else "" if v is None else v for v in values])
