"""Before arming, checks whether the contact phases of a mission can be flown: the tool, its way, and reserves for the force. No I/O."""

from __future__ import annotations

import math
from collections.abc import Iterator

from companion.config.mission import Approach, Mission, Press
from companion.config.vehicle import Vehicle
from companion.control.arm_model import manipulator_of
from companion.control.thrust import attitude_from_roll_pitch_yaw, roll_pitch_from_force
from companion.mission.plan import Plan
from companion.mission.segments import Segment
from companion.model.constants import GRAVITY_M_S2
from companion.model.frames import quat_conjugate, quat_rotate
from companion.model.types import Reference, Vec3
from companion.safety.governor import SafeSet

AHEAD_M = 0.05
"""Smallest distance by which the tool must reach beyond the rotors."""
TRACKING_M = 0.05
"""Distance from the limits of room and tether at the end of an approach, which is slow."""
TILT_RESERVE_DEG = 5.0
TORQUE_SHARE_MAX = 0.85
"""Largest fraction of a joint's torque limit that gravity and the contact force may need. At the limit the arm gives way."""
FORCE_SHARE_MAX = 0.6
"""Largest wanted force as a fraction of `safety.contact_force_max_n`: an overshoot of 50 % passes."""


def contact_problems(mission: Mission, vehicle: Vehicle, plan: Plan) -> Iterator[tuple[Segment, str]]:
    """Return each segment that cannot be flown, with the reason and the advice."""
    direction: Vec3 = (0.0, 0.0, 0.0)
    for segment in plan.segments:
        if segment.repetition > 1:
            continue
        phase = mission.phases[segment.index]
        if isinstance(phase, Approach):
            length = math.hypot(*phase.direction)
            x, y, z = phase.direction
            direction = (x / length, y / length, z / length)
            yield from (
                (segment, text) for text in _approach(vehicle, plan.reference(segment.start_s), direction, phase)
            )
        elif isinstance(phase, Press):
            reference = plan.reference(segment.start_s)
            yield from ((segment, text) for text in _force(vehicle, reference, direction, phase.force_n))


def _approach(vehicle: Vehicle, reference: Reference, direction: Vec3, phase: Approach) -> Iterator[str]:
    if vehicle.tool is None or vehicle.has_net:
        yield f"touches a surface, but vehicle '{vehicle.name}' has no rod or brush (tool.kind); add one to the vehicle file"
        return
    x, y, z = quat_rotate(
        (math.cos(0.5 * reference.yaw_rad), 0.0, 0.0, math.sin(0.5 * reference.yaw_rad)),
        manipulator_of(vehicle).net_body_m(reference.arm_rad),
    )
    nx, ny, nz = direction
    body_m = math.hypot(nx, ny) * vehicle.airframe.radius_m
    ahead_m = nx * x + ny * y + nz * z - body_m
    if ahead_m < AHEAD_M:
        yield (
            f"approaches with the tip {ahead_m:.2f} m beyond the rotors (minimum {AHEAD_M:g} m); stretch the arm in the direction of "
            "the approach, or turn the vehicle"
        )
    px, py, pz = reference.position_world_m
    way_m = phase.distance_max_m
    far = (px + way_m * nx, py + way_m * ny, pz + way_m * nz)
    safe = SafeSet(vehicle)
    beyond_m = max(safe.breach_walls_m(far), safe.breach_tether_m(far)) + TRACKING_M
    if beyond_m > 0.0:
        yield (
            f"may move to ({far[0]:.2f}, {far[1]:.2f}, {far[2]:.2f}) m if it touches nothing, {beyond_m:.2f} m beyond what room and "
            f"tether allow with a margin of {TRACKING_M:g} m; lower distance_max_m or begin nearer to the surface"
        )


def _force(vehicle: Vehicle, reference: Reference, direction: Vec3, force_n: float) -> Iterator[str]:
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
    attitude = attitude_from_roll_pitch_yaw(*roll_pitch_from_force(thrust, reference.yaw_rad), reference.yaw_rad)
    manipulator, arm_rad = manipulator_of(vehicle), reference.arm_rad
    felt = quat_rotate(quat_conjugate(attitude), (-force_n * nx, -force_n * ny, -force_n * nz))
    torques = manipulator.joint_torque_from_force(arm_rad, felt)
    gravity = manipulator.gravity_torque_nm(arm_rad, attitude)
    for joint, (t, g, limit_nm) in enumerate(zip(torques, gravity, vehicle.joint_torque_limits_nm, strict=True), 1):
        if abs(g - t) > TORQUE_SHARE_MAX * limit_nm:
            yield (
                f"needs {abs(g - t):.2f} N m of joint {joint} to press with {force_n:g} N (limit {TORQUE_SHARE_MAX * limit_nm:.2f} "
                f"N m: {TORQUE_SHARE_MAX:g} of its torque); lower force_n, or hold the tip nearer to the shoulder's height"
            )
