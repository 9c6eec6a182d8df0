"""Resolves the phase of a fault to the time at which the mission reaches that phase."""

from __future__ import annotations

import math
from typing import Any

from companion.mission.phase import phases_of
from companion.mission.plan import Plan
from companion.mission.segments import Segment
from companion.model.flight_stage import SPOOL_S
from companion.model.types import PhaseKind
from companion.sitl_config.faults import CONTACT_PHASES, Fault, FaultKind, FlightPhase
from companion.sitl_config.loader import SitlConfig

ARMED_SEEN_S = 1.0
"""Time from arming to the heartbeat that shows it, the next one after that at which the companion commanded it."""
AFTER_CATCH_S = 0.1
"""Time from the catch to a fault in phase "catch"."""
REBOOT_ON_GROUND_S = 1.3
"""World time of a PX4 reboot in phase "ground": after PX4's first boot."""
INTO_DETACH_S = 0.3
"""Time from the end of the press or slide to a fault in phase "detach"."""
_ALONG_M = 0.3
_EARLY_IN_LINE, _MIDDLE = 0.35, 0.5
_FROM_START: frozenset[FaultKind] = frozenset({"payload_missed", "payload_heavy"})


class FaultError(Exception):
    """The mission has no phase of the kind that a fault names; the text is one line for the user."""


def with_fault_times(config: SitlConfig) -> SitlConfig:
    """Return the configuration with each fault's phase resolved to a time, and with `payload_kg` taken from a `payload_heavy` fault, if
    there is one.

    Raises:
        FaultError: the mission has no such phase.
    """
    faults = config.world.faults
    if not faults:
        return config
    changes: dict[str, Any] = {"faults": tuple(_timed(fault, config) for fault in faults)}
    heavy = next((fault for fault in faults if fault.kind == "payload_heavy"), None)
    if heavy is not None:
        changes["payload_kg"] = heavy.magnitude
    return config.model_copy(update={"world": config.world.model_copy(update=changes)})


def _timed(fault: Fault, config: SitlConfig) -> Fault:
    if fault.kind in _FROM_START or fault.phase == "ground":
        t_s = REBOOT_ON_GROUND_S if fault.kind == "autopilot_reboot" else 0.0
        return fault.model_copy(update={"after": "start", "t_s": t_s, "phase": None})
    if fault.phase is None:
        return fault
    if fault.phase in CONTACT_PHASES:
        t_s = round(_into_press_s(fault.phase, config), 3)
        return fault.model_copy(update={"after": "press" if t_s else "touch", "t_s": t_s, "phase": None})
    if fault.phase == "catch" and config.world.payload_kg > 0:
        return fault.model_copy(update={"after": "catch", "t_s": AFTER_CATCH_S, "phase": None})
    t_s = round(ARMED_SEEN_S + SPOOL_S + _plan_time_s(fault.phase, config), 3)
    return fault.model_copy(update={"after": "arming", "t_s": t_s, "phase": None})


def _into_press_s(phase: FlightPhase, config: SitlConfig) -> float:
    """Return the time since press or slide began: in its middle, or just after it; 0 for the first touch, which may come earlier."""
    phases, before_or_after = phases_of(config.mission), {"touch", "detach"}
    pressing_s = [
        segment.end_s - segment.start_s
        for segment in Plan.build(config.mission, config.vehicle).segments
        if phases[segment.index].presses and phase in before_or_after | {phases[segment.index].type}
    ]
    if not pressing_s:
        text = f"world.faults: mission '{config.mission.name}' has no phase '{phase}'; give t_s instead of the phase"
        raise FaultError(text)
    return {"touch": 0.0, "detach": pressing_s[0] + INTO_DETACH_S}.get(phase, _MIDDLE * pressing_s[0])


def _plan_time_s(phase: FlightPhase, config: SitlConfig) -> float:
    """Return the time since the start of the plan. "line" and "catch" are in the first sideways segment, "return" in the last one."""
    plan = Plan.build(config.mission, config.vehicle)

    def way_m(segment: Segment) -> float:
        begin, end = plan.reference(segment.start_s), plan.reference(segment.end_s)
        return math.dist(begin.position_world_m[:2], end.position_world_m[:2])

    def within(segments: list[Segment], index: int, share: float) -> float:
        if not segments:
            raise FaultError(
                f"world.faults: mission '{config.mission.name}' has no phase '{phase}'; give t_s instead of the phase"
            )
        segment = segments[index]
        return segment.start_s + share * (segment.end_s - segment.start_s)

    def of(kind: PhaseKind) -> list[Segment]:
        return [segment for segment in plan.segments if segment.kind is kind]

    if phase == "takeoff":
        return within(of(PhaseKind.TAKEOFF), 0, _MIDDLE)
    if phase == "landing":
        return within(of(PhaseKind.LANDING), -1, _MIDDLE)
    lines = [segment for segment in of(PhaseKind.FLIGHT) if way_m(segment) > _ALONG_M]
    if phase == "return":
        return within(lines[1:], -1, _MIDDLE)
    return within(lines, 0, _MIDDLE if phase == "catch" else _EARLY_IN_LINE)
