"""Touches the points of a surface and finds the plane through them: a phase `probe`, and an approach that turns to the surface. Pure.

Shift in front of a point, approach, hold the light force of the touch while the tip's position is averaged, move back; after the last
point a probe is over, and an approach turns to the surface and begins again along its normal.
"""

from __future__ import annotations

import math

from msgspec.structs import replace

from companion.config.mission import Approach, Phase, Probe
from companion.core.transition import Transition
from companion.mission import contact as c
from companion.mission.surface import TILT_MAX_RAD, axes, plane, points_of, tool_turn_rad, turn_to
from companion.model.algebra import dot
from companion.model.best_pose import best_pose
from companion.model.constants import GRAVITY_M_S2
from companion.model.frames import quat_rotate
from companion.model.types import ContactMode, ContactState, FoundSurface, TouchedPoint, Vec3


def seeks_points(contact: ContactState, phase: Phase) -> bool:
    """Return whether points of the surface are still to be touched."""
    return len(contact.points) < len(points_of(phase))


def begun(t: Transition, phase: Approach | Probe) -> ContactState:
    """Return the state at the beginning of a contact."""
    nx, ny, nz = phase.direction
    length = math.hypot(nx, ny, nz)
    direction = (nx / length, ny / length, nz / length)
    return c.begun(t.i.t_s, direction, _shift_per_n(t, direction, ahead_m(t)))


def weighed(t: Transition, contact: ContactState, phase: Approach | Probe) -> ContactState:
    """Return the state after the force without contact was averaged: approach, or first shift to a point."""
    if seeks_points(contact, phase):
        return _towards_point(t, contact, phase)
    return c.entered(contact, t.i.t_s, ContactMode.APPROACH)


def touching(t: Transition, contact: ContactState, phase: Approach | Probe) -> ContactState:
    """Return the state after one tick at a point: the light force is held, and the tip's position averaged."""
    dt_s, t_s = t.o.dt_s, t.i.t_s
    contact = c.pressed(contact, t_s, dt_s, phase.touch_n, phase.touch_n)
    felt = c.touches(contact, phase.touch_n)
    contact = c.timed(contact, dt_s, not felt)
    if contact.beyond_s >= c.LOST_S:  # gusts have feigned a touch
        return c.entered(replace(contact, samples=0), t_s, ContactMode.LOST)
    tip = tip_world_m(t)
    if t_s - contact.since_s < c.TOUCH_SETTLE_S or not felt or tip is None:
        return contact
    contact = c.averaged(contact, tip)
    if t_s - contact.since_s < c.TOUCH_SETTLE_S + c.TOUCH_MEAN_S:
        return contact
    point = TouchedPoint(t_s, contact.mean_tip_m, contact.mean_force_n)
    contact = replace(contact, points=(*contact.points, point), samples=0)
    if not seeks_points(contact, phase):
        surface = plane(
            [point.tip_world_m for point in contact.points], contact.direction_world, t.parameters.vehicle.tip_radius_m
        )
        contact = replace(contact, surface=surface)
    return c.entered(contact, t_s, ContactMode.BACK)


def moving_back(t: Transition, contact: ContactState, phase: Approach | Probe) -> ContactState | None:
    """Return the state after one tick on the way back from a point; None if the touched points lie on no plausible plane."""
    dt_s, t_s = t.o.dt_s, t.i.t_s
    more = seeks_points(contact, phase)
    if not more and contact.surface is None:
        return None
    if not more and isinstance(phase, Probe):
        return c.entered(contact, t_s, ContactMode.LEAVE)
    least_m = max(0.0, contact.touched_offset_m - c.back_from_point_m(phase)) if more else 0.0
    if contact.push_n > 0.0:
        return c.released(contact, dt_s)
    contact = c.moved(contact, dt_s, -c.SHIFT_M_S, least_m)
    if contact.offset_m > least_m:
        return contact
    contact = replace(contact, touches=0)
    if more:
        return _towards_point(t, contact, phase)
    assert contact.surface is not None
    return _towards_surface(t, contact, contact.surface)


def shifting(t: Transition, contact: ContactState, phase: Approach | Probe) -> ContactState:
    """Return the state after one tick of a shift."""
    contact = c.shifted(contact, t.o.dt_s, c.SHIFT_M_S)
    if not c.is_shifted(contact):
        return contact
    mode = ContactMode.APPROACH if seeks_points(contact, phase) else ContactMode.WEIGH
    return c.entered(contact, t.i.t_s, mode)


def beside_m(t: Transition, contact: ContactState) -> float:
    """Return the distance of the tip from its reference, across the direction of the press, m; 0 if it is unknown."""
    tip, course = tip_world_m(t), t.state.course
    if tip is None or course is None:
        return 0.0
    reference = c.along(course.reference(t.i.t_s), contact)
    x, y, z = t.parameters.manipulator.net_body_m(reference.arm_rad)
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


def _towards_point(t: Transition, contact: ContactState, phase: Approach | Probe) -> ContactState:
    (r, u), (right, up) = points_of(phase)[len(contact.points)], axes(contact.direction_world)
    to_m = (r * right[0] + u * up[0], r * right[1] + u * up[1], r * right[2] + u * up[2])
    return c.entered(replace(contact, shift=c.shift_to(contact, to_m, 0.0, 0.0)), t.i.t_s, ContactMode.SHIFT)


def _towards_surface(t: Transition, contact: ContactState, surface: FoundSurface) -> ContactState:
    """Return the state that turns to the surface: the tip then points along the normal at the place where the way straight ahead meets
    the surface, as far from it as before.
    """
    assert t.state.course is not None
    reference = t.state.course.reference(t.i.t_s)
    n, (mx, my, mz) = contact.direction_world, surface.normal_world
    into = (-mx, -my, -mz)
    turn_rad = turn_to(surface, reference.yaw_rad) - reference.yaw_rad
    tool_rad = tool_turn_rad(t.parameters.vehicle, t.parameters.manipulator, reference.arm_rad, n, into)
    before, after = ahead_m(t), ahead_m(t, turn_rad, tool_rad)
    (qx, qy, qz), (px, py, pz), (bx, by, bz) = surface.point_world_m, reference.position_world_m, before
    way_m = dot((qx - (px + bx), qy - (py + by), qz - (pz + bz)), into) / dot(n, into)
    x, y, z = (way_m * (a - b) + old - new for a, b, old, new in zip(n, into, before, after, strict=True))
    return c.entered(
        replace(
            contact,
            direction_world=into,
            tip_per_n_m=_shift_per_n(t, into, after),
            shift=c.shift_to(contact, (x, y, z), turn_rad, tool_rad),
            free_m=way_m - c.FREE_M,
        ),
        t.i.t_s,
        ContactMode.SHIFT,
    )


def _shift_per_n(t: Transition, direction: Vec3, ahead_m: Vec3) -> Vec3:
    return c.tip_per_n_m(direction, ahead_m, t.parameters.vehicle.airframe.mass_kg * GRAVITY_M_S2)


def ahead_m(t: Transition, turn_rad: float = 0.0, tool_rad: float = 0.0) -> Vec3:
    """Return the tip relative to the body's origin in the plan's reference, turned by these angles, world frame, with the vehicle
    level.
    """
    course = t.state.course
    assert course is not None
    reference = course.reference(t.i.t_s)
    x, y, z = t.parameters.manipulator.net_body_m((*reference.arm_rad[:-1], reference.arm_rad[-1] + tool_rad))
    cos, sin = math.cos(reference.yaw_rad + turn_rad), math.sin(reference.yaw_rad + turn_rad)
    return (cos * x - sin * y, sin * x + cos * y, z)


def tip_world_m(t: Transition) -> Vec3 | None:
    """Return the measured position of the tip's centre, world frame; None if it is unknown."""
    pose, arm = best_pose(t.i), t.i.arm
    if pose is None or not pose.tracking_valid or arm is None:
        return None
    x, y, z = quat_rotate(pose.attitude_wxyz, t.parameters.manipulator.net_body_m(arm.angle_rad))
    px, py, pz = pose.position_world_m
    return (px + x, py + y, pz + z)
