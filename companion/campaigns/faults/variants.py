"""The faults that a campaign injects, one per flight. `companion.sitl_config.faults` defines the kinds of faults."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

from companion.sitl_config.faults import CONTACT_PHASES, KINDS, PHASES, FaultKind, FlightPhase


@dataclass(frozen=True, slots=True)
class Variant:
    """A fault of one kind and size, for any phase."""

    kind: FaultKind
    size: float | None = None
    """Size of the fault; None for a kind without a size."""
    duration_s: float | None = None
    """Duration of the fault; None if it lasts until the end of the flight."""

    @property
    def phases(self) -> tuple[FlightPhase, ...]:
        """The phases in which a campaign injects the fault."""
        return KINDS[self.kind].phases

    @property
    def shown(self) -> tuple[float | None, str]:
        """Value and unit in the column `size`: the size, or the duration if the kind has no size."""
        if KINDS[self.kind].size is not None:
            return self.size, KINDS[self.kind].unit
        return self.duration_s, "s"

    def fault(self, phase: FlightPhase) -> dict[str, Any]:
        """Return an entry of `world.faults`."""
        values = {"size": self.size, "duration_s": self.duration_s}
        return {"kind": self.kind, "phase": phase, **{key: known for key, known in values.items() if known is not None}}


def _durations(kind: FaultKind, *durations_s: float | None) -> list[Variant]:
    return [Variant(kind, None, duration_s) for duration_s in durations_s]


def _sizes(kind: FaultKind, *sizes: float, duration_s: float | None = None) -> list[Variant]:
    return [Variant(kind, size, duration_s) for size in sizes]


CHOSEN: tuple[Variant, ...] = (
    *_durations("mocap_loss", 0.05, 0.1, 0.2, 0.5, 1.0, 2.0, 5.0, None),
    *_durations("mocap_occluded", 0.1, None),
    *_sizes("mocap_jump", 0.08, 0.3),
    *_sizes("mocap_jump", 1.0, duration_s=0.05),
    *_sizes("mocap_swap", 1.0),
    *_sizes("mocap_swap", 0.6, duration_s=0.08),
    *_durations("mocap_freeze", 0.08, None),
    *_sizes("mocap_latency", 0.05, 0.2),
    *_sizes("mocap_network", 0.06, 0.1, 0.15, 0.18),
    *_sizes("mocap_rate", 60.0, 5.0),
    *_durations("link_loss", 0.1, 0.5, None),
    *_sizes("link_delay", 0.005, 0.015, 0.03, 0.04, 0.05, 0.07, 0.15),
    *_durations("servo_loss", 0.05, None),
    *_sizes("servo_hot", 70.0, 85.0),
    *_sizes("servo_angle", 10.0, 40.0),
    *_sizes("bus_noise", 0.1, 0.6),
    *_sizes("bus_delay", 0.002, 0.004, 0.006, 0.008, 0.01, 0.012),
    *_durations("force_loss", 0.2, None),
    *_sizes("force_bias", 2.0, 10.0),
    *_sizes("motor_weak", 0.1, 0.4),
    *_sizes("battery_sag", 2.0, 4.0),
    *_sizes("gust", 4.0, duration_s=2.0),
    *_sizes("gust", 8.0, duration_s=0.7),
    *_sizes("tether_taut", 0.05, 0.15),
    *_sizes("tether_snag", 0.05, 0.3),
    *_durations("stall_loop", 0.06, None),
    *_durations("stop_flight", 0.08, None),
)
"""Faults of the kinds that are not flown just once, with the default size and to the end of the flight."""

VARIANTS: tuple[Variant, ...] = tuple(
    variant
    for kind, about in KINDS.items()
    if about.phases != CONTACT_PHASES
    for variant in [chosen for chosen in CHOSEN if chosen.kind == kind] or [Variant(kind, about.default)]
)
"""Faults of a campaign in the fast loop, each in every phase of its kind."""

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
"""Faults of `--wires`, flown over the real protocols."""


CONTACT: tuple[Variant, ...] = (
    *_durations("mocap_loss", None),
    *_durations("link_loss", None),
    *_durations("force_loss", None),
    *_durations("force_stuck", None),
    *_sizes("force_bias", 3.0, -3.0),
    *_sizes("gust", 3.0, duration_s=2.0),
    *_durations("surface_gone", None),
    *_sizes("surface_slippery", 0.05),
    *_durations("tool_broken", None),
    *_durations("kill_flight", None),
)
"""Faults of a campaign in each phase of a contact with a surface."""

CONTACT_WIRES: tuple[tuple[Variant, FlightPhase], ...] = ((Variant("kill_flight"), "press"),)


def touches(phases: Sequence[str]) -> bool:
    """Return whether one of these phases is part of a contact with a surface."""
    return any(phase in CONTACT_PHASES for phase in phases)


def planned(kinds: Sequence[str], phases: Sequence[str], *, wires: bool = False) -> list[tuple[Variant, FlightPhase]]:
    """Return the faults to fly, in the order of the table.

    Args:
        kinds: requested kinds; empty for all.
        phases: requested phases; empty for all. If kinds and phases are both requested, each kind is flown in each phase, even in
            one that campaigns normally leave out.
    """
    if touches(phases):
        everything = list(CONTACT_WIRES) if wires else [(v, phase) for v in CONTACT for phase in CONTACT_PHASES]
    elif wires:
        everything = list(WIRES)
    else:
        asked = bool(kinds and phases)
        everything = [(v, phase) for v in VARIANTS for phase in PHASES if asked or phase in v.phases]
    return [
        (variant, phase)
        for variant, phase in everything
        if (not kinds or variant.kind in kinds) and (not phases or phase in phases)
    ]
