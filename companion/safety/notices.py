"""Events that the state machine and the core report themselves, without a rule in `companion.safety.rules`.

Each is one row; docs/internals/safety.md is generated from them. Ids are stable because logs, summaries and users' scripts contain
them.
"""

from __future__ import annotations

from dataclasses import dataclass

from companion.model.types import SafetyAction, Severity


@dataclass(frozen=True, slots=True)
class EventDefinition:
    """One row of the table."""

    id: str
    severity: Severity
    action: SafetyAction
    """Action requested from the supervisor; the state machine does everything else."""
    when: str
    """When the event is reported, and what follows."""


_INFO, _WARNING, _CRITICAL = Severity.INFO, Severity.WARNING, Severity.CRITICAL
_NOMINAL, _WARN, _LAND, _PX4_LANDS = (
    SafetyAction.NOMINAL,
    SafetyAction.WARN,
    SafetyAction.LAND,
    SafetyAction.AUTOPILOT_LAND,
)

INPUTS_MISSING = EventDefinition(
    "inputs_missing", _CRITICAL, _NOMINAL, "a device delivered nothing within 15 s: the flight is refused"
)
VISION_NOT_FUSED = EventDefinition(
    "vision_not_fused", _CRITICAL, _NOMINAL,
    "PX4's position or yaw does not agree with motion capture (0.10 m, 8 deg): the flight is refused",
)  # fmt: skip
ESTIMATE_UNSTEADY = EventDefinition(
    "estimate_unsteady", _CRITICAL, _NOMINAL,
    "PX4's estimate has not been near motion capture and steady for 1 s (0.05 m, 5 deg on average; 0.02 m, 2 deg of "
    "drift), or the vehicle has not stood still (0.02 m): the flight is refused",
)  # fmt: skip
START_REFUSED = EventDefinition(
    "start_refused",
    _CRITICAL,
    _NOMINAL,
    "the vehicle's pose is not the mission's start, or is not any more once PX4 has armed: the flight is refused",
)
OFFBOARD_REFUSED = EventDefinition(
    "offboard_refused", _CRITICAL, _NOMINAL, "PX4 did not enter OFFBOARD within 8 s: the flight is refused"
)
ARMING_REFUSED = EventDefinition(
    "arming_refused", _CRITICAL, _NOMINAL, "PX4 did not arm within 10 s: the flight is refused"
)
NOT_READY = EventDefinition(
    "not_ready", _WARNING, _NOMINAL,
    "a flight that waits for its start has lost its inputs, its estimate or its start position; it waits until they return",
)  # fmt: skip
START_DECLINED = EventDefinition(
    "start_declined", _WARNING, _NOMINAL, "`start` was commanded before the flight was ready; the text gives the reason"
)
TAKEOFF_CANCELLED = EventDefinition(
    "takeoff_cancelled", _INFO, _LAND,
    "HOLD was commanded before take-off: the flight is aborted. A flight that waits for its start continues to wait",
)  # fmt: skip
RESUME_REFUSED = EventDefinition(
    "resume_refused", _WARNING, _NOMINAL,
    "RESUME was commanded while the cause of the hold persisted; the text names the cause",
)  # fmt: skip
TAKEOFF = EventDefinition("takeoff", _INFO, _NOMINAL, "the plan begins")
CATCH = EventDefinition("catch", _INFO, _NOMINAL, "a payload was caught")
PAYLOAD_LEFT = EventDefinition(
    "payload_left", _INFO, _NOMINAL,
    "no weight in the net for 0.5 s, not in free fall: the net is empty, ready for the next catch",
)  # fmt: skip
IMPEDANCE_SCALED = EventDefinition(
    "impedance_scaled", _INFO, _NOMINAL,
    "the optimisation in flight (`controller.online`) has changed the target impedance by 5 % or more, or undone its changes",
)  # fmt: skip
PHASE_FAILED = EventDefinition(
    "phase_failed", _CRITICAL, _LAND, "the code of a phase raised an exception: the phase ends, and the vehicle lands"
)
TOUCHED = EventDefinition("touched", _INFO, _NOMINAL, "the tool touched the surface that the mission approaches")
CONTACT_INTERRUPTED = EventDefinition(
    "contact_interrupted", _WARNING, _WARN,
    "no force for 1 s while pressing: the vehicle waits 0.5 s and approaches the surface again",
)  # fmt: skip
CONTACT_LOST = EventDefinition(
    "contact_lost", _WARNING, _WARN,
    "the surface was not found again within 0.1 m of where it was touched, the force is not measured any more, "
    "`contact_disagreement_n` of the push act against nothing for 0.1 s, or the vehicle is 0.08 m ahead of its reference: the vehicle "
    "moves back, and the mission continues as aborted",
)  # fmt: skip
CONTACT_DISAGREES = EventDefinition(
    "contact_disagrees", _WARNING, _WARN,
    "for 0.1 s the contact force that thrust, tilt and acceleration show exceeds the measured one by `contact_disagreement_n`, or the "
    "vehicle is 0.08 m behind its reference although no touch was measured: the vehicle moves back, and the mission continues as "
    "aborted",
)  # fmt: skip
CONTACT_BOUNCE = EventDefinition(
    "contact_bounce", _WARNING, _WARN,
    "the surface was touched three times in one contact: the vehicle moves back, and the mission continues as aborted",
)  # fmt: skip
CONTACT_BESIDE = EventDefinition(
    "contact_beside", _WARNING, _WARN,
    "the tool touched more than 5 cm beside the point of the mission, or slipped there: judged when the force is reached and when it "
    "ends; the mission continues",
)  # fmt: skip
CONTACT_SLIPPED = EventDefinition(
    "contact_slipped", _WARNING, _WARN,
    "the yaw error exceeded 5 deg while approaching or pressing (15 deg while light touches find the surface's normal), because the "
    "tool slips along the surface: the vehicle moves back, and the mission continues as aborted",
)  # fmt: skip
CONTACT_STUCK = EventDefinition(
    "contact_stuck", _WARNING, _WARN,
    "for 0.5 s the tip of a slide is 0.05 m behind its reference or ahead of it, because the tool is caught on the surface or friction "
    "exceeds `friction_max`: the vehicle moves back, and the mission continues as aborted",
)  # fmt: skip
SURFACE_MISSING = EventDefinition(
    "surface_missing", _WARNING, _WARN,
    "nothing was touched within `distance_max_m`, or the touched points lie on a plane tilted by more than 30 deg: the vehicle moves "
    "back, and the mission continues as aborted",
)  # fmt: skip
BAR_LET_GO = EventDefinition(
    "bar_let_go", _CRITICAL, _LAND,
    "a vehicle that lands opens its clamp: the bar stands, it is low enough and the other vehicle does not land with this one, or it "
    "pulls harder than `bar_let_go_n`",
)  # fmt: skip
TOUCHDOWN = EventDefinition("touchdown", _INFO, _NOMINAL, "the vehicle is on the ground")
NO_TOUCHDOWN = EventDefinition(
    "no_touchdown", _CRITICAL, _PX4_LANDS, "no touchdown 5 s after the plan's end: PX4 lands"
)
DISARM_REFUSED = EventDefinition(
    "disarm_refused", _CRITICAL, _NOMINAL,
    "PX4 did not disarm within 8 s, or left OFFBOARD before it was disarmed: PX4 lands. If the vehicle had not "
    "lifted, the crew is asked to disarm it, and the guardian takes over",
)  # fmt: skip
AUTOPILOT_LANDING = EventDefinition("autopilot_landing", _CRITICAL, _PX4_LANDS, "progress of the landing by PX4")
GATE = EventDefinition("gate", _WARNING, _WARN, "the gate rejected or limited a command")
HOLD_EXPIRED = EventDefinition(
    "hold_expired", _CRITICAL, _LAND, "a HOLD lasted longer than `hold_max_s`: the vehicle lands"
)
RETRACT_EXPIRED = EventDefinition(
    "retract_expired", _CRITICAL, _LAND, "a RETRACT lasted longer than `retract_max_s`: the vehicle lands where it is"
)
RETRACT_DONE = EventDefinition("retract_done", _INFO, _LAND, "RETRACT complete: the vehicle lands")
NO_ROOM_TO_STAY = EventDefinition(
    "no_room_to_stay",
    _CRITICAL,
    _LAND,
    "a HOLD less than 0.3 m above standing height, or a RETRACT during a landing or towards the surface that the tool touches: the "
    "vehicle lands",
)

NOTICES: tuple[EventDefinition, ...] = (
    INPUTS_MISSING, VISION_NOT_FUSED, ESTIMATE_UNSTEADY, START_REFUSED, OFFBOARD_REFUSED, ARMING_REFUSED, NOT_READY, START_DECLINED,
    TAKEOFF_CANCELLED, RESUME_REFUSED, TAKEOFF, CATCH, PAYLOAD_LEFT, IMPEDANCE_SCALED, PHASE_FAILED, TOUCHED, CONTACT_INTERRUPTED,
    CONTACT_LOST, CONTACT_DISAGREES, CONTACT_BOUNCE, CONTACT_BESIDE, CONTACT_SLIPPED, CONTACT_STUCK, SURFACE_MISSING, BAR_LET_GO,
    TOUCHDOWN, NO_TOUCHDOWN, DISARM_REFUSED, AUTOPILOT_LANDING, GATE, HOLD_EXPIRED, RETRACT_EXPIRED, RETRACT_DONE, NO_ROOM_TO_STAY,
)  # fmt: skip
