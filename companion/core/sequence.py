"""The stages of one flight: each defines what it waits for, what it requests from PX4, and its timeout. Pure."""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping
from typing import Final

from companion.core.phase_tick import PhaseFailed, advance_phase
from companion.core.reactions import land_instead, land_now
from companion.core.readiness import misplaced, ready, refuse, refuse_start, wait
from companion.core.transition import Transition
from companion.mission.active_plan import ActiveTrajectory
from companion.model import flight_stage as seq
from companion.model.best_pose import best_pose, pose_used_s
from companion.model.flight_stage import Stage
from companion.model.types import (
    AutopilotRequest,
    AutopilotStatus,
    Outcome,
    PhaseKind,
    SafetyAction,
    Severity,
)
from companion.safety import notices, rules
from companion.safety.autopilot_landing import FLIPPED, KILLED, TIPPED
from companion.safety.device_rules import PILOT_TOOK_OVER
from companion.safety.px4 import DISARMED_ABOVE_M
from companion.safety.rules import CRASHED
from companion.safety.touchdown import MOCAP_FRESH_S

ARMED_SHOWN_S = 1.5
"""PX4's HEARTBEAT reports once a second whether it is armed: for this time after a request to arm, and until the next HEARTBEAT,
"not armed" may be outdated."""
NO_TOUCHDOWN_S: Final = 5.0
"""Time after the plan's end within which touchdown must be detected; otherwise PX4 lands."""
_NONE: Final = AutopilotRequest.NONE


def may_be_armed(status: AutopilotStatus | None, t_s: float, requested_s: float) -> bool:
    """Return whether PX4 is armed, or may be: arming was requested at `requested_s`, and no later HEARTBEAT says that it is not."""
    if seq.is_armed(status):
        return True
    heard_s = -math.inf if status is None else status.heartbeat_stamp_s
    return requested_s > -math.inf and (t_s - requested_s <= ARMED_SHOWN_S or heard_s <= requested_s)


def advance(t: Transition) -> AutopilotRequest:
    """Advance the sequence and return the request of the current stage."""
    i, state = t.i, t.state
    assert state.entered_s is not None
    if (pose_s := pose_used_s(i)) is not None:
        t.pose_s = pose_s
    return _STAGES[state.stage](t, i.t_s - state.entered_s)


# -- on the ground -------------------------------------------------------------------------------------------------


def _offboard(t: Transition, elapsed_s: float) -> AutopilotRequest:
    # After a landing PX4 is in OFFBOARD already, but it arms only on a stream of setpoints.
    if seq.in_offboard(t.i.status) and elapsed_s > seq.STREAM_BEFORE_OFFBOARD_S:
        t.enter(Stage.ARM)
    elif elapsed_s > seq.OFFBOARD_TIMEOUT_S:
        refuse(t, notices.OFFBOARD_REFUSED, "PX4 did not enter OFFBOARD")
    elif elapsed_s > seq.STREAM_BEFORE_OFFBOARD_S:
        return AutopilotRequest.OFFBOARD
    return _NONE


def _arm(t: Transition, elapsed_s: float) -> AutopilotRequest:
    t_s = t.i.t_s
    if seq.is_armed(t.i.status):
        assert t.state.plan is not None
        if problems := misplaced(t):  # since the start was commanded
            refuse_start(t, problems)
            return _NONE
        t.change(course=ActiveTrajectory(t.state.plan, t_s + seq.SPOOL_S))
        t.enter(Stage.SPOOL)
    elif elapsed_s > seq.ARM_TIMEOUT_S:
        refuse(t, notices.ARMING_REFUSED, "PX4 did not arm")
    else:
        t.change(arm_requested_s=t_s)
        return AutopilotRequest.ARM
    return _NONE


def _stand_down(t: Transition, elapsed_s: float) -> AutopilotRequest:
    i = t.i
    if not may_be_armed(i.status, i.t_s, t.state.arm_requested_s):
        t.enter(Stage.DONE)
    elif not _left_to_pilot(t) and elapsed_s > seq.DISARM_TIMEOUT_S:
        text = "PX4 did not disarm: its rotors may be turning; disarm it by the pilot's switch or from a ground station"
        t.report(notices.DISARM_REFUSED, text)
        t.enter(Stage.DONE)
    elif t.state.stage is Stage.STAND_DOWN:
        t.change(rotor_stop=t.state.rotor_stop.update(i))
        return AutopilotRequest.DISARM if t.state.rotor_stop.may_disarm else _NONE
    return _NONE


# -- with the rotors lifting ---------------------------------------------------------------------------------------


def _spool(t: Transition, elapsed_s: float) -> AutopilotRequest:
    if elapsed_s >= seq.SPOOL_S:
        assert t.state.plan is not None
        t.change(mission_start_s=t.i.t_s, course=ActiveTrajectory(t.state.plan, t.i.t_s))
        t.enter(Stage.MISSION)
        t.report(notices.TAKEOFF, "take-off")
    return _NONE


def _fly(t: Transition, _: float) -> AutopilotRequest:
    if t.parameters.acts and not t.state.aborting:
        before = len(t.events)
        try:
            advance_phase(t)
            if any(event.action.rank >= SafetyAction.LAND.rank for event in t.events[before:]):
                land_now(t)
                return _NONE
        except PhaseFailed as failure:
            land_instead(t, str(failure), notices.PHASE_FAILED)
            return _NONE
    i, course, vehicle = t.i, t.state.course, t.i.vehicle
    assert course is not None
    plan_s = course.pace(i.t_s)[0]
    if vehicle is not None and course.plan.segment(plan_s).kind is PhaseKind.LANDING:
        reference_m = course.reference(i.t_s).position_world_m[2]
        touchdown = t.state.touchdown.update(
            i.t_s, vehicle, best_pose(i), reference_m, t.o.thrust_share, seq.on_ground(i.status)
        )
        t.change(touchdown=touchdown)
        if touchdown.certain:
            t.report(notices.TOUCHDOWN, "touchdown")
            t.finish(Outcome.COMPLETED)
            t.enter(Stage.TOUCHDOWN)
            return _NONE
    if course.plan.duration_s - plan_s < -NO_TOUCHDOWN_S:
        t.report(notices.NO_TOUCHDOWN, f"no touchdown detected {NO_TOUCHDOWN_S:g} s after the plan's end; PX4 lands")
        t.finish(Outcome.ABORTED)
        t.enter(Stage.AUTOPILOT_LAND)
    return _NONE


def _touchdown(t: Transition, elapsed_s: float) -> AutopilotRequest:
    if elapsed_s >= seq.TOUCHDOWN_RAMP_S:
        t.enter(Stage.DISARM)
    return _NONE


def _disarm(t: Transition, elapsed_s: float) -> AutopilotRequest:
    i = t.i
    if not seq.is_armed(i.status):
        t.enter(Stage.DONE)
        return _NONE
    if _left_to_pilot(t):
        return _NONE
    stop = t.state.rotor_stop.update(i)
    t.change(rotor_stop=stop)
    if stop.overturned:
        _crash(t, FLIPPED if stop.flipped else TIPPED)
        return AutopilotRequest.FORCE_DISARM
    if elapsed_s > seq.DISARM_TIMEOUT_S or not seq.in_offboard(i.status):
        text = "PX4 did not disarm" if seq.in_offboard(i.status) else "PX4 left OFFBOARD before it was disarmed"
        t.report(notices.DISARM_REFUSED, text)
        t.finish(Outcome.ABORTED)
        t.enter(Stage.AUTOPILOT_LAND)
        return _NONE
    if seq.on_ground(i.status):
        return AutopilotRequest.DISARM if stop.may_disarm else _NONE
    return AutopilotRequest.FORCE_DISARM if stop.may_force else _NONE


def _autopilot_land(t: Transition, _: float) -> AutopilotRequest:
    assert t.state.landing is not None
    i = t.i
    if (seq.is_killed(i.status) or _disarmed_in_view(t)) and i.vehicle is not None:
        if i.vehicle.position_world_m[2] > t.parameters.clearance_m + DISARMED_ABOVE_M:
            t.finish(Outcome.CRASHED)  # without rotors it falls
    landing, step = t.state.landing.step(i, t.o.late_pose)
    t.change(landing=landing, zero_thrust=step.zero_thrust)
    if landing.overturned and t.state.outcome is not Outcome.CRASHED:
        _crash(t, step.text or TIPPED)
    elif step.text is not None:
        touchdown = step.text == "touchdown"
        t.report(notices.AUTOPILOT_LANDING, step.text, Severity.INFO if touchdown else Severity.CRITICAL)
    if step.ended:
        if not step.landed and t.state.outcome is not Outcome.CRASHED:
            t.change(outcome=Outcome.LOST)
        t.enter(Stage.DONE)
    return step.request


def _disarmed_in_view(t: Transition) -> bool:
    """Return whether PX4 reports that it is disarmed and fresh poses show the vehicle above the floor: without them
    PX4's height may be wrong. Not while a pilot flies, who may land on anything.
    """
    i, pose, used_s = t.i, best_pose(t.i), pose_used_s(t.i)
    if i.status is None or i.status.armed or t.state.pilot_flies or pose is None or used_s is None:
        return False
    high = pose.position_world_m[2] > t.parameters.clearance_m + DISARMED_ABOVE_M
    return high and i.t_s - used_s < MOCAP_FRESH_S


def _done(_: Transition, __: float) -> AutopilotRequest:
    return _NONE


def _left_to_pilot(t: Transition) -> bool:
    """Return whether a pilot took over, or stopped the rotors by the kill switch, before PX4 was disarmed. From then on nothing is
    sent, and the pilot disarms.
    """
    if not seq.flown_by_pilot(t.i.status):
        return False
    if seq.is_killed(t.i.status):
        rule_id, text = rules.KILLED, KILLED
    else:
        rule_id = PILOT_TOOK_OVER
        text = "a pilot took over before PX4 was disarmed; the companion sends nothing from now on"
    if not any(event.id == rule_id for event in t.events):
        t.report_rule(rule_id, SafetyAction.AUTOPILOT_LAND, text)
    t.finish(Outcome.ABORTED)
    t.enter(Stage.AUTOPILOT_LAND, pilot_flies=True)
    return True


def _crash(t: Transition, text: str) -> None:
    """Report a crash, unless the rule with the same id has already done so."""
    if t.state.outcome is not Outcome.CRASHED:
        t.report_rule(CRASHED, SafetyAction.TERMINATE, text)
        t.finish(Outcome.CRASHED)


_STAGES: Final[Mapping[Stage, Callable[[Transition, float], AutopilotRequest]]] = {
    Stage.WAIT: wait,
    Stage.READY: ready,
    Stage.OFFBOARD: _offboard,
    Stage.ARM: _arm,
    Stage.SPOOL: _spool,
    Stage.MISSION: _fly,
    Stage.TOUCHDOWN: _touchdown,
    Stage.DISARM: _disarm,
    Stage.AUTOPILOT_LAND: _autopilot_land,
    Stage.STAND_DOWN: _stand_down,
    Stage.DONE: _done,
}
