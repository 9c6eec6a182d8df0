"""Applies the safety state to the flight: updates the supervisor and reacts when its action escalates. Pure."""

from __future__ import annotations

from dataclasses import replace
from typing import Final

from companion.core.phase_tick import PhaseFailed, leave
from companion.core.transition import Transition
from companion.mission.bar_landing import landing_with_bar
from companion.mission.plan import landing_from
from companion.mission.retract import inward_only, retract_from
from companion.model import flight_stage as seq
from companion.model.flight_stage import ROTORS_MAY_START, Stage
from companion.model.team import Grip
from companion.model.types import OperatorCommand, Outcome, PhaseKind, Reference, SafetyAction, Vec3
from companion.safety import notices
from companion.safety.notices import EventDefinition
from companion.safety.rules import OPERATOR_ABORT, OPERATOR_LAND, OPERATOR_RESUME, PARTNER_HOLDS, RULES
from companion.safety.supervisor import update

HOLD_ABOVE_M = 0.3
"""Margin over standing height below which the vehicle lands instead of holding."""
_BY_OPERATOR = (OPERATOR_LAND, OPERATOR_ABORT, notices.TAKEOFF_CANCELLED.id)
_PILOT_FLIES = frozenset(rule.id for rule in RULES if rule.pilot_flies)
_EXPIRED = {
    notices.HOLD_EXPIRED.id: (notices.HOLD_EXPIRED, "no command ended the hold in time; landing"),
    notices.RETRACT_EXPIRED.id: (notices.RETRACT_EXPIRED, "the retract took too long; landing here"),
}
# Looking up members of an enum costs time in every tick.
_HOLD: Final = SafetyAction.HOLD
_RETRACT: Final = SafetyAction.RETRACT
_COMMANDED_HOLD: Final = OperatorCommand.HOLD


def supervise(t: Transition) -> None:
    """Update the supervisor with this tick's events, and react to its new action."""
    i, state = t.i, t.state
    if i.command is _COMMANDED_HOLD and state.stage in seq.BEFORE_LIFT:
        _hold_on_ground(t)
    action = state.supervisor.action
    if action is _RETRACT and state.course is not None and state.course.left_s(i.t_s) <= 0.0:
        t.report(notices.RETRACT_DONE, "retract complete; landing")
    if t.events or action is _HOLD or action is _RETRACT:
        _escalate(t)


def _escalate(t: Transition) -> None:
    before, events, standing = t.state.supervisor, t.events, None
    if before.action is _HOLD and any(event.id == OPERATOR_RESUME for event in events):
        standing = t.o.standing
        if (
            standing is None and t.state.grip is Grip.CARRYING
        ):  # the phase ends the hold, at one instant with the other vehicle
            t.change(supervisor=replace(before, cause=PARTNER_HOLDS))
            before, events = t.state.supervisor, [event for event in events if event.id != OPERATOR_RESUME]
    after = update(before, events, t.i.t_s, t.parameters.times, standing)
    if after.cause == PARTNER_HOLDS:  # with a cause of its own, this vehicle, too, is to be resumed by the operator
        own = (event.id for event in events if event.action is _HOLD and event.id != PARTNER_HOLDS)
        after = replace(after, cause=next(own, PARTNER_HOLDS))
    if after is not before:
        t.change(supervisor=after)
    if after.action is before.action:
        if standing is not None:
            t.report(notices.RESUME_REFUSED, standing)
        return
    if after.cause in _EXPIRED:
        t.report(*_EXPIRED[after.cause])
    if after.action.rank > before.action.rank:
        _react(t)
    elif t.state.course is not None:  # the operator has ended the hold
        t.change(course=t.state.course.resume(t.i.t_s))
        t.resumed = True


def _react(t: Transition) -> None:
    """React to an escalated action."""
    state, action = t.state, t.state.supervisor.action
    if action.rank < _HOLD.rank:
        return
    if state.stage in seq.BEFORE_ARMING and t.o.airborne:
        t.finish(Outcome.ABORTED)
        t.enter_landing(seq.flown_by_pilot(t.i.status), float("-inf"))
    elif state.stage in seq.BEFORE_LIFT:
        if action.rank >= SafetyAction.LAND.rank:
            t.stand_down(Outcome.ABORTED if state.supervisor.cause in _BY_OPERATOR else Outcome.REFUSED)
    elif state.pilot_flies:
        return
    elif action is SafetyAction.TERMINATE:
        t.finish(Outcome.CRASHED)
        t.enter(Stage.AUTOPILOT_LAND, flipped=True)
    elif action is SafetyAction.AUTOPILOT_LAND:
        pilot_flies = state.supervisor.cause in _PILOT_FLIES
        # A landing by PX4 that has begun goes on; only a pilot ends it.
        if state.stage in seq.LIFTING and (pilot_flies or state.stage is not Stage.AUTOPILOT_LAND):
            t.finish(Outcome.ABORTED)
            t.enter(Stage.AUTOPILOT_LAND, pilot_flies=pilot_flies)
    elif state.stage is Stage.SPOOL:
        t.finish(Outcome.ABORTED)
        # The ramp down begins at the thrust that spooling up has reached.
        t.change(touchdown=replace(state.touchdown, relief=state.vertical_scale(t.i.t_s)))
        t.enter(Stage.TOUCHDOWN)
    elif state.stage is Stage.MISSION:
        if action is _HOLD:
            _hold(t)
        elif action is _RETRACT:
            _retract(t)
        else:
            _land(t)


def _hold_on_ground(t: Transition) -> None:
    """Cancel the take-off. A flight that waits for its start continues to wait."""
    waits = t.parameters.waits_for_start and t.state.stage in (Stage.WAIT, Stage.READY)
    if not waits and not t.state.armed_by_others:
        asked = t.state.stage is Stage.ARM
        where = f"PX4 was asked to arm: {ROTORS_MAY_START}" if asked else "the vehicle stays on the ground"
        t.report(notices.TAKEOFF_CANCELLED, f"hold commanded before take-off; {where}")


def _hold(t: Transition) -> None:
    """Come to rest and stay. A landing continues, and near the floor the vehicle lands instead."""
    course, t_s = t.state.course, t.i.t_s
    if course is None or course.segment(t_s).kind is PhaseKind.LANDING:
        return
    if course.reference(t_s).position_world_m[2] < t.parameters.clearance_m + HOLD_ABOVE_M:
        land_instead(t, "too low to hold; landing")
    else:
        t.change(course=course.hold(t_s))
        try:
            leave(t)
        except PhaseFailed as failure:
            land_instead(t, str(failure), notices.PHASE_FAILED)


def _retract(t: Transition) -> None:
    now, course, tether = t.o.reference, t.state.course, t.parameters.vehicle.tether
    assert tether is not None, "only a tether's rule requests a retract"
    if now is None or course is None or course.segment(t.i.t_s).kind is PhaseKind.LANDING:
        land_instead(t, "already landing; no retract")
        return
    if t.state.bar is not None:
        land_instead(t, "another vehicle holds the same bar; no retract")
        return
    if _faces_the_anchor(t):
        land_instead(t, "the surface is between vehicle and anchor; no retract")
        return
    t.leave_mission(
        retract_from(
            now.position_world_m,
            now.velocity_world_m_s,
            now.yaw_rad,
            t.i.arm.angle_rad if t.i.arm is not None else now.arm_rad,
            t.parameters.fold_rad,
            t.parameters.vehicle,
            tether,
            _before_surface_m(t, now),
        )
    )


def _faces_the_anchor(t: Transition) -> bool:
    """Return whether the way to the anchor leads towards the surface that the tool may touch."""
    now, into, tether = t.o.reference, t.state.expected.into_world, t.parameters.vehicle.tether
    if now is None or into is None or tether is None:
        return False
    (nx, ny, _), (x, y, _), (ax, ay, _) = into, now.position_world_m, tether.anchor_world_m
    return nx * (ax - x) + ny * (ay - y) > 0.0


def _before_surface_m(t: Transition, now: Reference) -> Vec3 | None:
    """Return the position in front of the surface that the tool may touch; None if it touches none."""
    back_m = t.state.expected.back_m
    if back_m is None:
        return None
    (x, y, z), (bx, by, bz) = now.position_world_m, back_m
    return (x + bx, y + by, z + bz)


def land_instead(t: Transition, text: str, notice: EventDefinition = notices.NO_ROOM_TO_STAY) -> None:
    """Land for a reason that the monitors do not know, and report it."""
    t.report(notice, text)
    land_now(t)


def land_now(t: Transition) -> None:
    """Land because of an event that is reported already, and that the monitors do not know."""
    t.change(supervisor=update(t.state.supervisor, t.events, t.i.t_s, t.parameters.times))
    _land(t)


def _land(t: Transition) -> None:
    """Stop from the last reference, fold the arm and descend; move back from a surface first."""
    now, p = t.o.reference, t.parameters
    if now is None:  # the controller has not flown yet
        t.finish(Outcome.ABORTED)
        t.enter(Stage.AUTOPILOT_LAND)
        return
    if t.state.bar is not None:
        plan, opens_s = landing_with_bar(
            now,
            _allowed_velocity(t, now),
            t.state.bar.stands_m,
            p.manipulator,
            p.fold_rad,
            p.vehicle.safety.land_speed_m_s,
            p.vehicle,
        )
        t.leave_mission(plan)
        t.change(opens_s=t.i.t_s + opens_s)
        return
    t.leave_mission(
        landing_from(
            now.position_world_m,
            _allowed_velocity(t, now),
            now.yaw_rad,
            t.i.arm.angle_rad if t.i.arm is not None else now.arm_rad,
            p.fold_rad,
            p.vehicle.safety.land_speed_m_s,
            p.vehicle,
            _before_surface_m(t, now),
        )
    )


def _allowed_velocity(t: Transition, now: Reference) -> Vec3:
    """Return the start velocity of a stop, m/s, without its outward and upward parts while the tether pulls."""
    tether, state = t.parameters.vehicle.tether, t.o.tether
    if tether is not None and state is not None and (state.taut or state.snagged):
        return inward_only(now.velocity_world_m_s, now.position_world_m, tether.anchor_world_m)
    return now.velocity_world_m_s
