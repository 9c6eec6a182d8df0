"""Before arming, checks whether the contact phases of a mission can be flown: the tool, its way, and reserves for the force. No I/O."""

from __future__ import annotations

import math
from collections.abc import Iterator
from itertools import product

from companion.config.mission import Limits
from companion.config.vehicle import Vehicle
from companion.control.arm_model import manipulator_of
from companion.control.thrust import attitude_from_roll_pitch_yaw, roll_pitch_from_force
from companion.model.constants import GRAVITY_M_S2
from companion.model.frames import quat_conjugate, quat_rotate
from companion.model.types import Reference, Vec2, Vec3
from companion.phases.contact.sliding import Stroke
from companion.phases.contact.surface import axes, tool_turn_rad
from companion.phases.contact.way import Way
from companion.safety.governor import SafeSet

TURN_RAD = math.radians(15.0)
"""Turn to a surface for which the check leaves room."""
AHEAD_M = 0.05
"""Smallest distance by which the tool must reach beyond the rotors."""
TRACKING_M = 0.05
"""Distance from the limits of room and tether at the end of an approach, which is slow."""
FLOOR_M = 0.1
"""Smallest height above standing height at the end of a slide."""
TILT_RESERVE_DEG = 5.0
TORQUE_SHARE_MAX = 0.85
"""Largest fraction of a joint's torque limit that gravity and the contact force may need. At the limit the arm gives way."""
YAW_SHARE = 0.4
"""Fraction of the rotors' largest yaw torque at hover that the friction of a slide may need."""
FORCE_SHARE_MAX = 0.6
"""Largest wanted force as a fraction of `safety.contact_force_max_n`: an overshoot of 50 % passes."""


def way_problems(vehicle: Vehicle, reference: Reference, way: Way) -> Iterator[str]:
    """Check the tool and the room for its way to a surface."""
    if vehicle.tool is None or vehicle.has_net:
        yield f"touches a surface, but vehicle '{vehicle.name}' has no rod or brush (tool.kind); add one to the vehicle file"
        return
    x, y, z = quat_rotate(
        (math.cos(0.5 * reference.yaw_rad), 0.0, 0.0, math.sin(0.5 * reference.yaw_rad)),
        manipulator_of(vehicle).net_body_m(reference.arm_rad),
    )
    nx, ny, nz = way.direction_world
    body_m = math.hypot(nx, ny) * vehicle.airframe.radius_m
    ahead_m = nx * x + ny * y + nz * z - body_m
    if ahead_m < AHEAD_M:
        yield (
            f"approaches with the tip {ahead_m:.2f} m beyond the rotors (minimum {AHEAD_M:g} m); stretch the arm in the direction of "
            "the approach, or turn the vehicle"
        )
    far, beyond_m = _farthest(vehicle, reference, way)
    if beyond_m > 0.0:
        yield (
            f"may move to ({far[0]:.2f}, {far[1]:.2f}, {far[2]:.2f}) m if it touches nothing, {beyond_m:.2f} m beyond what room and "
            f"tether allow with a margin of {TRACKING_M:g} m; lower distance_max_m or begin nearer to the surface"
        )


def _farthest(vehicle: Vehicle, reference: Reference, way: Way, slid_m: Vec2 = (0.0, 0.0)) -> tuple[Vec3, float]:
    """Return the place that is farthest beyond room and tether, and by how much with the margin, m; `slid_m` is the way of the slides
    since the touch, right and up.
    """
    safe, (right, up) = SafeSet(vehicle), axes(way.direction_world)
    x, y, _ = manipulator_of(vehicle).net_body_m(reference.arm_rad)
    shift = [slid_m[0] * a + slid_m[1] * b for a, b in zip(right, up, strict=True)]
    found = []
    for px, py, pz in _corners(reference, way, math.hypot(x, y)):
        at = (px + shift[0], py + shift[1], pz + shift[2])
        found.append((at, max(safe.breach_walls_m(at), safe.breach_tether_m(at)) + TRACKING_M))
    return max(found, key=lambda place: place[1])


def slide_problems(
    vehicle: Vehicle, limits: Limits, reference: Reference, way: Way, stroke: Stroke, slid_m: Vec2
) -> Iterator[str]:
    """Check what the largest friction needs, joints, thrust and the rotors' yaw torque, and the room; `slid_m` is the way of the slides
    since the touch, right and up.
    """
    (right, up), length_m, airframe = axes(way.direction_world), math.hypot(*stroke.displacement_m), vehicle.airframe
    along = [
        (stroke.displacement_m[0] * a + stroke.displacement_m[1] * b) / length_m for a, b in zip(right, up, strict=True)
    ]
    most_n, weight_n = stroke.friction_max * stroke.force_n, airframe.mass_kg * GRAVITY_M_S2
    friction = (-most_n * along[0], -most_n * along[1], -most_n * along[2])
    yield from torque_problems(vehicle, reference, way, stroke.force_n, friction)
    most_share = limits.thrust_share_max * airframe.thrust_max_n
    if weight_n - friction[2] > most_share:
        yield (
            f"needs {weight_n - friction[2]:.1f} N of thrust to slide (limit {most_share:.1f} N: limits.thrust_share_max); lower "
            "force_n or friction_max"
        )
    x, y, _ = manipulator_of(vehicle).net_body_m(reference.arm_rad)
    needed_nm = math.hypot(x, y) * math.hypot(friction[0], friction[1])
    yaw_nm = YAW_SHARE * airframe.yaw_torque_per_thrust_m * weight_n
    if needed_nm > yaw_nm:
        least = stroke.friction_max * yaw_nm / needed_nm
        yield (
            f"needs {needed_nm:.2f} N m of yaw torque to slide sideways with friction up to {stroke.friction_max:g} (limit "
            f"{yaw_nm:.2f} N m: {YAW_SHARE:g} of what the rotors have at hover); slide up or down, or if the surface is slippery, set "
            f"friction_max to at most {least:.2f}"
        )
    low_m = reference.position_world_m[2] + slid_m[1] * up[2] - airframe.ground_clearance_m
    if low_m < FLOOR_M:
        yield f"ends {low_m:.2f} m above standing height (minimum {FLOOR_M:g} m); shorten displacement_m or begin higher"
    far, beyond_m = _farthest(vehicle, reference, way, slid_m)
    if beyond_m > 0.0:
        yield (
            f"may move to ({far[0]:.2f}, {far[1]:.2f}, {far[2]:.2f}) m, {beyond_m:.2f} m beyond what room and tether allow with a "
            f"margin of {TRACKING_M:g} m; shorten displacement_m or begin elsewhere"
        )


def _corners(reference: Reference, way: Way, ahead_m: float) -> Iterator[Vec3]:
    """Return the corners of the space in which the reference may move during an approach or a probe; `ahead_m` is the distance of the
    tip from the centre.
    """
    points = way.points
    across_m = max((abs(right) for right, _ in points), default=0.0)
    upwards_m = max((abs(up) for _, up in points), default=0.0)
    if points and way.presses:
        across_m = max(across_m, ahead_m * math.sin(TURN_RAD))
    right, up = axes(way.direction_world)
    sides_m = (way.distance_max_m,) if not points else (0.0, way.distance_max_m)
    for d, r, u in product(sides_m, (-across_m, across_m), (-upwards_m, upwards_m)):
        x, y, z = (
            p + d * n + r * a + u * b
            for p, n, a, b in zip(reference.position_world_m, way.direction_world, right, up, strict=True)
        )
        yield (x, y, z)


def force_problems(vehicle: Vehicle, direction: Vec3, force_n: float) -> Iterator[str]:
    """Check the limit of the force, and the tilt with which the vehicle presses."""
    airframe, most_n = vehicle.airframe, FORCE_SHARE_MAX * vehicle.safety.contact_force_max_n
    if force_n > most_n:
        yield (
            f"presses with {force_n:g} N (limit {most_n:.1f} N: {FORCE_SHARE_MAX:g} of safety.contact_force_max_n); lower force_n, or "
            "raise the limit in the vehicle file"
        )
    nx, ny, nz = direction
    thrust = (force_n * nx, force_n * ny, force_n * nz + airframe.mass_kg * GRAVITY_M_S2)
    tilt_deg = math.degrees(math.atan2(math.hypot(thrust[0], thrust[1]), thrust[2]))
    if tilt_deg > airframe.tilt_max_deg - TILT_RESERVE_DEG:
        yield (
            f"tilts by {tilt_deg:.1f} deg to press with {force_n:g} N (limit {airframe.tilt_max_deg - TILT_RESERVE_DEG:g} deg: "
            f"airframe.tilt_max_deg less {TILT_RESERVE_DEG:g} deg); lower force_n"
        )


def torque_problems(
    vehicle: Vehicle,
    reference: Reference,
    way: Way,
    force_n: float,
    friction: Vec3 = (0.0, 0.0, 0.0),
) -> Iterator[str]:
    """Check the torques that hold the arm against weight, force and friction; if the vehicle turns to the surface, also on tilted
    surfaces.
    """
    manipulator, direction = manipulator_of(vehicle), way.direction_world
    worst: dict[int, float] = {}
    for tilt_rad in (-TURN_RAD, 0.0, TURN_RAD) if way.points else (0.0,):
        into = _raised(direction, tilt_rad)
        nx, ny, nz = into
        *inner, last = reference.arm_rad
        arm_rad = (*inner, last + tool_turn_rad(vehicle, manipulator, reference.arm_rad, direction, into))
        thrust = (force_n * nx, force_n * ny, force_n * nz + vehicle.airframe.mass_kg * GRAVITY_M_S2)
        attitude = attitude_from_roll_pitch_yaw(*roll_pitch_from_force(thrust, reference.yaw_rad), reference.yaw_rad)
        fx, fy, fz = friction
        felt = quat_rotate(quat_conjugate(attitude), (fx - force_n * nx, fy - force_n * ny, fz - force_n * nz))
        torques = manipulator.joint_torque_from_force(arm_rad, felt)
        gravity = manipulator.gravity_torque_nm(arm_rad, attitude)
        for joint, (t, g) in enumerate(zip(torques, gravity, strict=True), 1):
            worst[joint] = max(worst.get(joint, 0.0), abs(g - t))
    for (joint, needed_nm), limit_nm in zip(worst.items(), vehicle.joint_torque_limits_nm, strict=True):
        if needed_nm > TORQUE_SHARE_MAX * limit_nm:
            rubs = f" against {math.hypot(*friction):.1f} N of friction" if any(friction) else ""
            advice = "slide downwards" if friction[2] < 0.0 else "hold the tip nearer to the shoulder's height"
            yield (
                f"needs {needed_nm:.2f} N m of joint {joint} to press with {force_n:g} N{rubs} (limit "
                f"{TORQUE_SHARE_MAX * limit_nm:.2f} N m: {TORQUE_SHARE_MAX:g} of its torque); lower force_n, or {advice}"
            )


def _raised(direction: Vec3, angle_rad: float) -> Vec3:
    """Return a direction raised by an angle; a vertical one is returned as it is."""
    x, y, z = direction
    level = math.hypot(x, y)
    if level < 1e-6 or angle_rad == 0.0:
        return direction
    elevation = math.atan2(z, level) + angle_rad
    return (x / level * math.cos(elevation), y / level * math.cos(elevation), math.sin(elevation))
