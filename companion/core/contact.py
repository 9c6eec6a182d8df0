"""Drives the contact phases of a mission: what the measured force does to the contact state and to the plan's time. Pure.

The plan's time stands at the end of a phase until the phase's aim is reached, and jumps to its end when it is reached earlier: approach
until the touch, detach until the vehicle is back. After a failed contact the vehicle moves back first; the remaining phases of the same
contact are then skipped.
"""

from __future__ import annotations

import math

from msgspec.structs import replace

from companion.config.mission import Approach, Detach, Phase, Press, Probe, Slide
from companion.config.vehicle import OBSERVER
from companion.core import probing, sliding
from companion.core.transition import Transition
from companion.mission import contact as c
from companion.mission.segments import Segment
from companion.model.types import ContactMode, ContactState, ControlLog, Outcome, SafetyAction, Vec3
from companion.safety import notices
from companion.safety.notices import Notice

_BEFORE_END_S = 1e-6
_WEIGH, _APPROACH, _PRESS = ContactMode.WEIGH, ContactMode.APPROACH, ContactMode.PRESS
_SLIDE = ContactMode.SLIDE
_LOST, _BACK, _SHIFT = ContactMode.LOST, ContactMode.BACK, ContactMode.SHIFT
_LEAVE, _RETURN = ContactMode.LEAVE, ContactMode.RETURN
_MEASURING = (_APPROACH, _PRESS, _SLIDE, _LOST)


def advance_contact(t: Transition) -> None:
    """Advance the contact by one tick; called in every tick of the mission."""
    course, contact, t_s = t.state.course, t.state.contact, t.i.t_s
    assert course is not None
    segment = course.segment(t_s)
    phase = _phase(t, segment)
    if contact is None:
        if isinstance(phase, Approach | Probe) and not t.state.contact_over:
            t.change(contact=probing.begun(t, phase), contact_segment=segment)
        elif isinstance(phase, Approach | Press | Slide | Detach | Probe):
            t.change(course=course.moved_to(segment.end_s, t_s))
        elif t.state.contact_over:
            t.change(contact_over=False)
        return
    dt_s = t.o.dt_s
    limit_n = t.parameters.vehicle.safety.contact_disagreement_n
    weigh_s = c.WEIGH_OBSERVED_S if _observes(t) else c.WEIGH_S
    contact = c.measured(contact, dt_s, t.o.force_world_n, t.o.disturbance_world_n, limit_n, weigh_s)
    if not (isinstance(phase, Slide) and (contact.mode is _PRESS or contact.mode is _SLIDE)):
        contact = sliding.released(contact, dt_s)
    approach = _approach(t, segment)
    engaged = t.state.contact_segment
    assert engaged is not None
    if contact.mode is _LEAVE or contact.mode is _RETURN:
        _stay_in(t, engaged)
        contact = _left(contact, t_s, dt_s, phase.speed_m_s if isinstance(phase, Detach) else approach.speed_m_s)
        if contact.mode is _RETURN and c.is_shifted(contact):
            _end(t, contact, engaged)
            return
    elif not _is_force_known(t):
        contact = _failed(t, contact, notices.CONTACT_LOST, "the force is not measured any more; leaving the surface")
    elif contact.mode in _MEASURING and (found := _contradiction(t, contact)) is not None:
        contact = _failed(t, contact, found[0], f"{found[1]}; leaving the surface")
    elif contact.mode in _MEASURING and abs(t.o.yaw_error_rad) > _turn_max_rad(contact, approach):
        text = f"turned by {math.degrees(abs(t.o.yaw_error_rad)):.0f} deg while in contact: the tool slips; leaving the surface"
        contact = _failed(t, contact, notices.CONTACT_SLIPPED, text)
    elif contact.mode is _WEIGH:
        _stay_in(t, engaged)
        if t_s - contact.since_s >= weigh_s:
            contact = probing.weighed(t, contact, approach)
    elif contact.mode is _APPROACH:
        contact = _approached(t, contact, approach, dt_s)
    elif contact.mode is _SHIFT:
        _stay_in(t, engaged)
        contact = probing.shifting(t, contact, approach)
    elif contact.mode is _BACK:
        _stay_in(t, engaged)
        back = probing.moving_back(t, contact, approach)
        contact = back or _failed(t, contact, notices.SURFACE_MISSING, probing.steep(contact))
    elif contact.mode is _LOST:
        contact = c.released(c.shifted(contact, dt_s, 0.0), dt_s)
        if t_s - contact.since_s >= c.WAIT_S:
            contact = c.entered(contact, t_s, _APPROACH)
            if probing.seeks_points(contact, approach):
                contact = replace(contact, touches=0)
    elif probing.seeks_points(contact, approach):
        _stay_in(t, engaged)
        contact = probing.touching(t, contact, approach)
    elif isinstance(phase, Detach):
        _warn_if_beside(t, contact)
        contact = c.entered(contact, t_s, _LEAVE)
        t.change(contact_segment=segment)
    elif isinstance(phase, Press | Slide):
        if isinstance(phase, Press):
            rises = contact.wanted_n < phase.force_n
            contact = c.pressed(contact, t_s, dt_s, approach.touch_n, phase.force_n)
            if rises and contact.wanted_n >= phase.force_n:
                _warn_if_beside(t, contact)
        else:
            contact = _slid(t, sliding.begun(contact, phase) if segment != engaged else contact, phase, segment)
        contact = c.timed(contact, dt_s, not c.touches(contact, approach.touch_n))
        t.change(contact_segment=segment)
        if contact.beyond_s >= c.LOST_S:
            contact = _lost(t, contact)
    t.change(contact=contact)


def _slid(t: Transition, contact: ContactState, phase: Slide, segment: Segment) -> ContactState:
    """Return the state after one tick of a slide, whose end the plan's time awaits."""
    course, t_s = t.state.course, t.i.t_s
    assert course is not None
    contact = sliding.slid(t, contact, phase, _approach(t, segment))
    if contact.stuck_s >= sliding.STUCK_S:
        text = (
            f"the tip is {contact.lag_m:.3f} m behind its reference (limit {sliding.STUCK_M:g} m); leaving the surface"
        )
        return _failed(t, contact, notices.CONTACT_STUCK, text)
    if contact.mode is _SLIDE and c.is_shifted(contact):
        t.change(course=course.moved_to(segment.end_s, t_s))
        return replace(contact, mode=_PRESS)
    _stay_in(t, segment)
    return contact


def _turn_max_rad(contact: ContactState, approach: Approach | Probe) -> float:
    return c.TURNED_LIGHTLY_RAD if probing.seeks_points(contact, approach) else c.TURNED_RAD


def _warn_if_beside(t: Transition, contact: ContactState) -> None:
    if (off_m := probing.beside_m(t, contact)) > c.BESIDE_M:
        text = f"the tool presses {100 * off_m:.0f} cm beside the point of the mission (limit {100 * c.BESIDE_M:g} cm)"
        t.report(notices.CONTACT_BESIDE, text)


def _left(contact: ContactState, t_s: float, dt_s: float, speed_m_s: float) -> ContactState:
    """Return the state after one tick of leaving: release the force, move back, then return to the plan."""
    if contact.mode is _RETURN:
        return c.shifted(contact, dt_s, c.SHIFT_M_S)
    contact = c.shifted(contact, dt_s, 0.0)
    contact = c.released(contact, dt_s) if contact.push_n > 0.0 else c.moved(contact, dt_s, -speed_m_s)
    if contact.offset_m > 0.0 or contact.shift.rate_m_s > 0.0:
        return contact
    home = c.shift_to(contact, (0.0, 0.0, 0.0), 0.0, 0.0)
    return c.entered(replace(contact, shift=home, touches=0), t_s, _RETURN)


def _end(t: Transition, contact: ContactState, engaged: Segment) -> None:
    """End the contact. What is left of a contact that failed is skipped."""
    course, t_s = t.state.course, t.i.t_s
    assert course is not None
    if course.held and t.state.supervisor.action is not SafetyAction.HOLD:
        course = course.resume(t_s)
    if not contact.failed:
        course = course.moved_to(engaged.end_s, t_s)
    t.change(contact=None, contact_over=contact.failed, course=course)


def force_on_tool_n(log: ControlLog) -> Vec3:
    """Return the force on the tool that a tick of the control law measured or, without a force sensor, observed."""
    return log.force_ext_world_n if log.force_observed_world_n is None else log.force_observed_world_n


def _observes(t: Transition) -> bool:
    """Return whether the momentum observer is the source of the force."""
    return t.parameters.vehicle.force_source == OBSERVER


def _is_force_known(t: Transition) -> bool:
    """Return whether the force is observed, or measured and not older than `safety.force_timeout_s`: without it the approach would not
    end at the surface.
    """
    vehicle, force = t.parameters.vehicle, t.i.force
    if _observes(t):
        return True
    return force is not None and t.i.t_s - force.stamp_s <= vehicle.safety.force_timeout_s


def _contradiction(t: Transition, contact: ContactState) -> tuple[Notice, str] | None:
    """Return how the vehicle's motion contradicts the measured force or the push; None if it does not."""
    ahead_m, limit_n = c.along_m(contact, t.o.position_error_m), t.parameters.vehicle.safety.contact_disagreement_n
    if ahead_m < -c.ASTRAY_M:
        text = f"{-ahead_m:.2f} m behind the reference (limit {c.ASTRAY_M:g} m): something blocks the vehicle"
    elif ahead_m > c.ASTRAY_M:
        text = f"{ahead_m:.2f} m ahead of the reference (limit {c.ASTRAY_M:g} m): the vehicle pushes against nothing"
        return notices.CONTACT_LOST, text
    elif contact.disagreed_s < c.DISAGREEMENT_S:
        return None
    elif contact.disagreement_n <= limit_n:
        text = f"{contact.unopposed_n:.1f} N of the push act against nothing (limit {limit_n:g} N)"
        return notices.CONTACT_LOST, text
    else:
        sensed_n = c.sensed_n(contact)
        shown_n = sensed_n + contact.disagreement_n
        text = (
            f"the force sensor measures {sensed_n:.1f} N, the vehicle's motion shows {shown_n:.1f} N "
            f"(limit {limit_n:g} N apart)"
        )
    return notices.CONTACT_DISAGREES, text


def leave(t: Transition) -> None:
    """Leave the surface, because the flight is to hold."""
    contact = t.state.contact
    if contact is not None and contact.mode is not _LEAVE and contact.mode is not _RETURN:
        t.change(contact=c.entered(contact, t.i.t_s, _LEAVE, failed=True))


def _approached(t: Transition, contact: ContactState, approach: Approach | Probe, dt_s: float) -> ContactState:
    """Return the state after one tick of an approach, which a touch or the end of the way ends."""
    course, t_s, engaged = t.state.course, t.i.t_s, t.state.contact_segment
    assert course is not None and engaged is not None
    again = contact.touches > 0
    fast = not again and contact.offset_m < contact.free_m
    contact = c.moved(contact, dt_s, c.SLOWEST_M_S if again else c.SHIFT_M_S if fast else approach.speed_m_s)
    contact = c.timed(contact, dt_s, contact.force_n > approach.touch_n)
    if contact.beyond_s >= (c.TOUCH_OBSERVED_S if _observes(t) else c.TOUCH_S):
        touches = contact.touches + 1
        contact = replace(
            c.entered(contact, t_s, _PRESS),
            touches=touches,
            touched_offset_m=contact.offset_m,
            wanted_n=approach.touch_n,
        )
        t.report(notices.TOUCHED, f"touched the surface after {contact.offset_m:.3f} m")
        if probing.seeks_points(contact, approach):
            return contact
        if touches >= c.TOUCHES_MAX:
            return _failed(t, contact, notices.CONTACT_BOUNCE, f"touched the surface {touches} times; leaving it")
        # After an interruption the press begins anew.
        t.change(course=course.moved_to(engaged.start_s if again else engaged.end_s, t_s))
        return contact
    _stay_in(t, engaged)
    if again and contact.offset_m > contact.touched_offset_m + c.BEYOND_M:
        return _failed(t, contact, notices.CONTACT_LOST, "no surface where it was touched before; leaving it")
    if contact.offset_m >= approach.distance_max_m:
        text = f"no surface within {approach.distance_max_m:g} m of the approach; moving back"
        return _failed(t, contact, notices.SURFACE_MISSING, text)
    return contact


def _lost(t: Transition, contact: ContactState) -> ContactState:
    text = f"no contact for {c.LOST_S:g} s; approaching the surface again"
    t.report(notices.CONTACT_INTERRUPTED, text)
    return c.entered(contact, t.i.t_s, _LOST)


def _failed(t: Transition, contact: ContactState, notice: Notice, text: str) -> ContactState:
    t.report(notice, text)
    t.finish(Outcome.ABORTED)
    course = t.state.course
    assert course is not None
    t.change(course=course.hold(t.i.t_s))
    return c.entered(contact, t.i.t_s, _LEAVE, failed=True)


def _stay_in(t: Transition, engaged: Segment) -> None:
    """Keep the plan's time before the end of a phase."""
    course, t_s = t.state.course, t.i.t_s
    assert course is not None
    if not course.held and course.pace(t_s)[0] >= engaged.end_s - _BEFORE_END_S:
        t.change(course=course.moved_to(engaged.end_s - _BEFORE_END_S, t_s))


def _phase(t: Transition, segment: Segment) -> Phase | None:
    return t.parameters.config.mission.phases[segment.index] if segment.index >= 0 else None


def _approach(t: Transition, segment: Segment) -> Approach | Probe:
    """Return the approach or probe of the contact to which a segment belongs."""
    phases = t.parameters.config.mission.phases
    for index in range(segment.index, -1, -1):
        phase = phases[index]
        if isinstance(phase, Approach | Probe):
            return phase
    raise AssertionError("the mission file is checked: an approach comes first")
