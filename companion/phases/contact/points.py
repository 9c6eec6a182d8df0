"""Touches the points of a surface and finds the plane through them: a phase `probe`, and an approach that turns to the surface. Pure.

Shift in front of a point, approach, hold the light force of the touch while the tip's position is averaged, move back; after the last
point a probe is over, and an approach turns to the surface and begins again along its normal.
"""

from __future__ import annotations

import math

from msgspec.structs import replace

from companion.mission.air import Air
from companion.model.algebra import dot
from companion.model.constants import GRAVITY_M_S2
from companion.model.contact import ContactMode, ContactState, FoundSurface, TouchedPoint
from companion.model.types import Vec3
from companion.phases.contact import force as c
from companion.phases.contact.surface import TILT_MAX_RAD, axes, plane, tool_turn_rad, turn_to
from companion.phases.contact.way import Way, back_from_point_m


def seeks_points(contact: ContactState, way: Way) -> bool:
    """Return whether points of the surface are still to be touched."""
    return len(contact.points) < len(way.points)


def begun(air: Air, way: Way) -> ContactState:
    """Return the state at the beginning of a contact."""
    return c.begun(air.t_s, way.direction_world, _shift_per_n(air, way.direction_world, ahead_m(air)))


def weighed(air: Air, contact: ContactState, way: Way) -> ContactState:
    """Return the state after the force without contact was averaged: approach, or first shift to a point."""
    if seeks_points(contact, way):
        return _towards_point(air, contact, way)
    return c.entered(contact, air.t_s, ContactMode.APPROACH)


def touching(air: Air, contact: ContactState, way: Way) -> ContactState:
    """Return the state after one tick at a point: the light force is held, and the tip's position averaged."""
    dt_s, t_s = air.dt_s, air.t_s
    contact = c.pressed(contact, dt_s, way.touch_n, way.touch_n)
    felt = c.touches(contact, way.touch_n)
    contact = c.timed(contact, dt_s, not felt)
    if contact.beyond_s >= c.LOST_S:  # gusts have feigned a touch
        return c.entered(replace(contact, samples=0), t_s, ContactMode.LOST)
    tip = air.tip_world_m()
    if t_s - contact.since_s < c.TOUCH_SETTLE_S or not felt or tip is None:
        return contact
    contact = c.averaged(contact, tip)
    if t_s - contact.since_s < c.TOUCH_SETTLE_S + c.TOUCH_MEAN_S:
        return contact
    point = TouchedPoint(t_s, contact.mean_tip_m, contact.mean_force_n)
    contact = replace(contact, points=(*contact.points, point), samples=0)
    if not seeks_points(contact, way):
        surface = plane(
            [point.tip_world_m for point in contact.points], contact.direction_world, air.vehicle.tip_radius_m
        )
        contact = replace(contact, surface=surface)
    return c.entered(contact, t_s, ContactMode.BACK)


def moving_back(air: Air, contact: ContactState, way: Way) -> ContactState | None:
    """Return the state after one tick on the way back from a point; None if the touched points lie on no plausible plane."""
    dt_s, t_s = air.dt_s, air.t_s
    more = seeks_points(contact, way)
    if not more and contact.surface is None:
        return None
    if not more and not way.presses:
        return c.entered(contact, t_s, ContactMode.LEAVE)
    least_m = max(0.0, contact.touched_offset_m - back_from_point_m(way)) if more else 0.0
    if contact.push_n > 0.0:
        return c.released(contact, dt_s)
    contact = c.moved(contact, dt_s, -c.SHIFT_M_S, least_m)
    if contact.offset_m > least_m:
        return contact
    contact = replace(contact, touches=0)
    if more:
        return _towards_point(air, contact, way)
    assert contact.surface is not None
    return _towards_surface(air, contact, contact.surface)


def shifting(air: Air, contact: ContactState, way: Way) -> ContactState:
    """Return the state after one tick of a shift."""
    contact = c.shifted(contact, air.dt_s, c.SHIFT_M_S)
    if not c.is_shifted(contact):
        return contact
    mode = ContactMode.APPROACH if seeks_points(contact, way) else ContactMode.TARE
    return c.entered(contact, air.t_s, mode)


def beside_m(air: Air, contact: ContactState) -> float:
    """Return the distance of the tip from its reference, across the direction of the press, m; 0 if it is unknown."""
    tip = air.tip_world_m()
    if tip is None:
        return 0.0
    reference = c.along(air.plan_reference(), contact)
    x, y, z = air.manipulator.net_body_m(reference.arm_rad)
    cos, sin = math.cos(reference.yaw_rad), math.sin(reference.yaw_rad)
    level = (cos * x - sin * y, sin * x + cos * y, z)
    tilted, at = contact.tilting_n, reference.position_world_m
    dx, dy, dz = (p - q - a + tilted * s for p, q, a, s in zip(tip, at, level, contact.tip_per_n_m, strict=True))
    along_m = c.along_m(contact, (dx, dy, dz))
    return math.sqrt(max(0.0, dx * dx + dy * dy + dz * dz - along_m * along_m))


def steep(contact: ContactState) -> str:
    """Return why the touched points are refused."""
    most_deg = math.degrees(TILT_MAX_RAD)
    return (
        f"the {len(contact.points)} touched points lie on a plane that is tilted by more than {most_deg:.0f} deg from the approach; "
        "moving back"
    )


def _towards_point(air: Air, contact: ContactState, way: Way) -> ContactState:
    (r, u), (right, up) = way.points[len(contact.points)], axes(contact.direction_world)
    to_m = (r * right[0] + u * up[0], r * right[1] + u * up[1], r * right[2] + u * up[2])
    return c.entered(replace(contact, shift=c.shift_to(contact, to_m, 0.0, 0.0)), air.t_s, ContactMode.SHIFT)


def _towards_surface(air: Air, contact: ContactState, surface: FoundSurface) -> ContactState:
    """Return the state that turns to the surface: the tip then points along the normal at the place where the way straight ahead meets
    the surface, as far from it as before.
    """
    reference = air.plan_reference()
    n, (mx, my, mz) = contact.direction_world, surface.normal_world
    into = (-mx, -my, -mz)
    turn_rad = turn_to(surface, reference.yaw_rad) - reference.yaw_rad
    tool_rad = tool_turn_rad(air.vehicle, air.manipulator, reference.arm_rad, n, into)
    before, after = ahead_m(air), ahead_m(air, turn_rad, tool_rad)
    (qx, qy, qz), (px, py, pz), (bx, by, bz) = surface.point_world_m, reference.position_world_m, before
    way_m = dot((qx - (px + bx), qy - (py + by), qz - (pz + bz)), into) / dot(n, into)
    x, y, z = (way_m * (a - b) + old - new for a, b, old, new in zip(n, into, before, after, strict=True))
    return c.entered(
        replace(
            contact,
            direction_world=into,
            tip_per_n_m=_shift_per_n(air, into, after),
            shift=c.shift_to(contact, (x, y, z), turn_rad, tool_rad),
            free_m=way_m - c.FREE_M,
        ),
        air.t_s,
        ContactMode.SHIFT,
    )


def _shift_per_n(air: Air, direction: Vec3, ahead_m: Vec3) -> Vec3:
    return c.tip_per_n_m(direction, ahead_m, air.vehicle.airframe.mass_kg * GRAVITY_M_S2)


def ahead_m(air: Air, turn_rad: float = 0.0, tool_rad: float = 0.0) -> Vec3:
    """Return the tip relative to the body's origin in the plan's reference, turned by these angles, world frame, with the vehicle
    level.
    """
    reference = air.plan_reference()
    x, y, z = air.manipulator.net_body_m((*reference.arm_rad[:-1], reference.arm_rad[-1] + tool_rad))
    cos, sin = math.cos(reference.yaw_rad + turn_rad), math.sin(reference.yaw_rad + turn_rad)
    return (cos * x - sin * y, sin * x + cos * y, z)
