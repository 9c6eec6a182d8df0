"""The contact of a tool with a surface: what the measured force does to its state and to the plan's time. Pure.

The plan's time stands at the end of a phase until the phase's aim is reached, and jumps to its end when it is reached earlier: approach
until the touch, detach until the vehicle is back. After a failed contact the vehicle moves back first; the remaining phases of the same
contact are then skipped.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from typing import TypeAlias

from msgspec.structs import replace

from companion.config.vehicle import OBSERVER
from companion.mission.air import Air
from companion.model.contact import ContactMode, ContactState
from companion.phases.contact import force as c
from companion.phases.contact import points, sliding
from companion.phases.contact.sliding import Stroke
from companion.phases.contact.way import Way
from companion.safety import notices
from companion.safety.notices import EventDefinition

_WEIGH, _APPROACH, _PRESS = ContactMode.TARE, ContactMode.APPROACH, ContactMode.PRESS
_SLIDE = ContactMode.SLIDE
_LOST, _BACK, _SHIFT = ContactMode.LOST, ContactMode.BACK, ContactMode.SHIFT
_LEAVE, _RETURN = ContactMode.LEAVE, ContactMode.RETURN
_MEASURING = (_APPROACH, _PRESS, _SLIDE, _LOST)
Touching: TypeAlias = Callable[[Air, ContactState, Way], ContactState]
"""What a phase does in each tick in which the tool touches the surface."""


def advance(
    air: Air, contact: ContactState, way: Way, touching: Touching | None, leave_m_s: float, slides: bool
) -> ContactState | None:
    """Return the state after one tick; None when the contact is over.

    Args:
        air: the tick.
        contact: the state after the previous tick.
        way: the way to the surface.
        touching: what the present phase does while the tool touches the surface; None for one that only approaches it.
        leave_m_s: speed of the way back.
        slides: whether the present phase slides.
    """
    dt_s, t_s = air.dt_s, air.t_s
    tare_s = c.TARE_OBSERVED_S if _observes(air) else c.TARE_S
    contact = c.measured(
        contact,
        dt_s,
        air.o.force_world_n,
        air.o.disturbance_world_n,
        air.vehicle.safety.contact_disagreement_n,
        tare_s,
    )
    if not (slides and (contact.mode is _PRESS or contact.mode is _SLIDE)):
        contact = sliding.released(contact, dt_s)
    engaged = air.engaged
    if contact.mode is _LEAVE or contact.mode is _RETURN:
        air.stay(engaged)
        contact = _left(contact, t_s, dt_s, leave_m_s)
        if contact.mode is _RETURN and c.is_shifted(contact):
            air.skips_rest = contact.failed
            return None
    elif air.o.force_world_n is None:
        contact = _failed(air, contact, notices.CONTACT_LOST, "the force is not measured any more; leaving the surface")
    elif contact.mode in _MEASURING and (found := _contradiction(air, contact)) is not None:
        contact = _failed(air, contact, found[0], f"{found[1]}; leaving the surface")
    elif contact.mode in _MEASURING and abs(air.o.yaw_error_rad) > _turn_max_rad(contact, way):
        text = f"turned by {math.degrees(abs(air.o.yaw_error_rad)):.0f} deg while in contact: the tool slips; leaving the surface"
        contact = _failed(air, contact, notices.CONTACT_SLIPPED, text)
    elif contact.mode is _WEIGH:
        air.stay(engaged)
        if t_s - contact.since_s >= tare_s:
            contact = points.weighed(air, contact, way)
    elif contact.mode is _APPROACH:
        contact = _approached(air, contact, way, dt_s)
    elif contact.mode is _SHIFT:
        air.stay(engaged)
        contact = points.shifting(air, contact, way)
    elif contact.mode is _BACK:
        air.stay(engaged)
        back = points.moving_back(air, contact, way)
        contact = back or _failed(air, contact, notices.SURFACE_MISSING, points.steep(contact))
    elif contact.mode is _LOST:
        contact = c.released(c.shifted(contact, dt_s, 0.0), dt_s)
        if t_s - contact.since_s >= c.WAIT_S:
            contact = c.entered(contact, t_s, _APPROACH)
            if points.seeks_points(contact, way):
                contact = replace(contact, touches=0)
    elif points.seeks_points(contact, way):
        air.stay(engaged)
        contact = points.touching(air, contact, way)
    elif touching is not None:
        contact = touching(air, contact, way)
    return contact


def detached(air: Air, contact: ContactState) -> ContactState:
    """Return the state at the beginning of the way back."""
    _warn_if_beside(air, contact)
    air.engaged = air.segment
    return c.entered(contact, air.t_s, _LEAVE)


def pressed(air: Air, contact: ContactState, way: Way, force_n: float) -> ContactState:
    """Return the state after one tick of a press."""
    rises = contact.wanted_n < force_n
    contact = c.pressed(contact, air.dt_s, way.touch_n, force_n)
    if rises and contact.wanted_n >= force_n:
        _warn_if_beside(air, contact)
    return _kept(air, contact, way)


def slid(air: Air, contact: ContactState, way: Way, stroke: Stroke) -> ContactState:
    """Return the state after one tick of a slide, whose end the plan's time awaits."""
    if air.segment != air.engaged:
        contact = sliding.begun(contact, stroke)
    return _kept(air, _along(air, sliding.slid(air, contact, stroke, way.touch_n)), way)


def _along(air: Air, contact: ContactState) -> ContactState:
    if contact.stuck_s >= sliding.STUCK_S:
        text = (
            f"the tip is {contact.lag_m:.3f} m behind its reference (limit {sliding.STUCK_M:g} m); leaving the surface"
        )
        return _failed(air, contact, notices.CONTACT_STUCK, text)
    if contact.mode is _SLIDE and c.is_shifted(contact):
        air.move_to(air.segment.end_s)
        return replace(contact, mode=_PRESS)
    air.stay(air.segment)
    return contact


def _kept(air: Air, contact: ContactState, way: Way) -> ContactState:
    """Return the state with the time for which the tool has not touched the surface; after `LOST_S` the contact is lost."""
    air.engaged = air.segment
    contact = c.timed(contact, air.dt_s, not c.touches(contact, way.touch_n))
    if contact.beyond_s < c.LOST_S:
        return contact
    air.report(notices.CONTACT_INTERRUPTED, f"no contact for {c.LOST_S:g} s; approaching the surface again")
    return c.entered(contact, air.t_s, _LOST)


def _turn_max_rad(contact: ContactState, way: Way) -> float:
    return c.TURNED_LIGHTLY_RAD if points.seeks_points(contact, way) else c.TURNED_RAD


def _warn_if_beside(air: Air, contact: ContactState) -> None:
    if (off_m := points.beside_m(air, contact)) > c.BESIDE_M:
        text = f"the tool presses {100 * off_m:.0f} cm beside the point of the mission (limit {100 * c.BESIDE_M:g} cm)"
        air.report(notices.CONTACT_BESIDE, text)


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


def _observes(air: Air) -> bool:
    """Return whether the momentum observer is the source of the force."""
    return air.vehicle.force_source == OBSERVER


def _contradiction(air: Air, contact: ContactState) -> tuple[EventDefinition, str] | None:
    """Return how the vehicle's motion contradicts the measured force or the push; None if it does not."""
    ahead_m, limit_n = c.along_m(contact, air.o.position_error_m), air.vehicle.safety.contact_disagreement_n
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


def leave(contact: ContactState, t_s: float) -> ContactState:
    """Return the state in which the vehicle leaves the surface, because the flight is to hold."""
    if contact.mode is _LEAVE or contact.mode is _RETURN:
        return contact
    return c.entered(contact, t_s, _LEAVE, failed=True)


def _approached(air: Air, contact: ContactState, way: Way, dt_s: float) -> ContactState:
    """Return the state after one tick of an approach, which a touch or the end of the way ends."""
    t_s, engaged = air.t_s, air.engaged
    again = contact.touches > 0
    fast = not again and contact.offset_m < contact.free_m
    contact = c.moved(contact, dt_s, c.SLOWEST_M_S if again else c.SHIFT_M_S if fast else way.speed_m_s)
    contact = c.timed(contact, dt_s, contact.force_n > way.touch_n)
    if contact.beyond_s >= (c.TOUCH_OBSERVED_S if _observes(air) else c.TOUCH_S):
        touches = contact.touches + 1
        contact = replace(
            c.entered(contact, t_s, _PRESS),
            touches=touches,
            touched_offset_m=contact.offset_m,
            wanted_n=way.touch_n,
        )
        air.report(notices.TOUCHED, f"touched the surface after {contact.offset_m:.3f} m")
        if points.seeks_points(contact, way):
            return contact
        if touches >= c.TOUCHES_MAX:
            return _failed(air, contact, notices.CONTACT_BOUNCE, f"touched the surface {touches} times; leaving it")
        # After an interruption the press begins anew.
        air.move_to(engaged.start_s if again else engaged.end_s)
        return contact
    air.stay(engaged)
    if again and contact.offset_m > contact.touched_offset_m + c.BEYOND_M:
        return _failed(air, contact, notices.CONTACT_LOST, "no surface where it was touched before; leaving it")
    if contact.offset_m >= way.distance_max_m:
        text = f"no surface within {way.distance_max_m:g} m of the approach; moving back"
        return _failed(air, contact, notices.SURFACE_MISSING, text)
    return contact


def _failed(air: Air, contact: ContactState, notice: EventDefinition, text: str) -> ContactState:
    air.fail(notice, text)
    return c.entered(contact, air.t_s, _LEAVE, failed=True)
