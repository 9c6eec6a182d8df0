"""Contact with a surface: the offset of the reference along the direction of an approach, and the force with which to press. Pure.

The plan is the motion in front of the surface and a function of time alone. What depends on the measured force is one record,
`ContactState`, which `machine` advances in every tick. It adds two quantities to the plan's reference: an offset along
the direction, until the surface is touched, and from then on the push, a force on the base (`Reference.push_world_n`, the desired force
F_d of the paper on the rows of the base). The push is the wanted force plus the integral of the force error; the position reference
rests at the place of the touch, so that the stiffness of the control law limits how far the vehicle moves if the surface gives way.
"""

from __future__ import annotations

import math

from msgspec.structs import replace

from companion.model.contact import ContactMode, ContactShift, ContactState
from companion.model.frames import wrap_rad
from companion.model.types import Joints, Reference, Vec3

TARE_S = 1.0
"""Time at rest before the approach, in which the force without contact is averaged."""
ACCELERATION_M_S2 = 0.1
STOP_M_S2 = 0.05
"""Deceleration of the offset after a touch."""
TARE_OBSERVED_S = 3.0
"""The same without a force sensor, where gusts of some tenths of a second are part of the force."""
TOUCH_S, TOUCH_OBSERVED_S = 0.015, 0.2
"""Time for which the force must exceed the touch's threshold, with and without a force sensor."""
LOST_SHARE, LOST_S = 0.3, 1.0
"""Contact is lost when the force is below this fraction of the touch's threshold for this time."""
WAIT_S = 0.5
"""Time at rest after contact was lost."""
SLOWEST_M_S = 0.02
"""Speed of the approach after contact was lost."""
BEYOND_M = 0.10
"""Distance beyond the last touch within which the surface is sought again."""
TOUCHES_MAX = 3
"""Number of touches in one contact at which the vehicle leaves, because it bounces."""
PRESS_RAMP_S = 1.5
"""Time in which the wanted force rises."""
FORCE_RATE_PER_S = 1.5
"""Rate at which the push removes the force error. Above the bandwidth of the attitude loop, about 5 rad/s, the force would swing."""
CORRECTION_SHARE, CORRECTION_N = 0.5, 2.0
"""Bound of the integral: this fraction of the wanted force, and this force."""
RELEASE_S = 0.7
"""Planned time for the release of the force."""
RELEASE_N_S, RELEASE_FAST_N_S = 15.0, 40.0
"""Rates at which the push ends, as planned and after a failure."""
TILT_S = 0.2
"""Time constant with which the reference follows the tilt that the push causes."""
TURNED_RAD = math.radians(5.0)
"""Yaw error from which the vehicle leaves: the tool slips along the surface, and its force, far ahead of the rotors, turns the vehicle
further. The rotors' yaw torque is too small to turn it back under the force.
"""
TURNED_LIGHTLY_RAD = math.radians(15.0)
"""The same while light touches find the normal of the surface: until then it may be tilted, and slippery."""
ASTRAY_M = 0.08
"""Position error along the direction from which the vehicle leaves: something blocks it that the force sensor does not measure, or it
pushes against nothing. In simulated laboratories with a healthy sensor the error stayed below 0.03 m.
"""
BESIDE_M = 0.05
"""Distance of the pressing tip from its reference, across the press, from which a warning is reported."""
DISAGREEMENT_S = 0.1
"""Time constant of the comparison of the measured force with the one that the vehicle's motion shows, and the time for which they must
disagree.
"""
BACK_M = (0.2, 0.4)
"""Smallest and largest way back from the surface before a landing without the core."""
_ARRIVED_M = 0.0002
_NO_FORCE: Vec3 = (0.0, 0.0, 0.0)

TOUCH_SETTLE_S, TOUCH_MEAN_S = 0.4, 0.5
"""Time from the touch of a point until the tip's position is averaged, and for which it is averaged."""
SHIFT_M_S = 0.1
"""Speed of moves that are not towards an unknown surface."""
FREE_M = 0.08
"""Distance from a known surface up to which an approach is as fast."""


def begun(t_s: float, direction_world: Vec3, tip_per_n_m: Vec3) -> ContactState:
    """Return the state at the beginning of an approach."""
    return ContactState(
        mode=ContactMode.TARE,
        since_s=t_s,
        direction_world=direction_world,
        offset_m=0.0,
        rate_m_s=0.0,
        acceleration_m_s2=0.0,
        bias_n=0.0,
        force_n=0.0,
        beyond_s=0.0,
        wanted_n=0.0,
        correction_n=0.0,
        push_n=0.0,
        tilting_n=0.0,
        tip_per_n_m=tip_per_n_m,
        touches=0,
        touched_offset_m=0.0,
        failed=False,
    )


def along(reference: Reference, contact: ContactState) -> Reference:
    """Return the reference with the contact's offset and push."""
    (x, y, z), (vx, vy, vz), (ax, ay, az) = (
        reference.position_world_m,
        reference.velocity_world_m_s,
        reference.acceleration_world_m_s2,
    )
    nx, ny, nz = contact.direction_world
    d, v, a, push = contact.offset_m, contact.rate_m_s, contact.acceleration_m_s2, contact.push_n
    if contact.touches:
        # The push tilts the vehicle, and the tool with it: this shift keeps the tip in place.
        (sx, sy, sz), tilting = contact.tip_per_n_m, contact.tilting_n
        rate = (push - tilting) / TILT_S
        x, y, z = x + tilting * sx, y + tilting * sy, z + tilting * sz
        vx, vy, vz = vx + rate * sx, vy + rate * sy, vz + rate * sz
    slide = None
    if contact.slide_world_n != _NO_FORCE:
        # The arm also holds what the sensor is to read while the wanted force acts; together both remain the base's force.
        (sx, sy, sz), wanted = contact.slide_world_n, contact.wanted_n + contact.bias_n - contact.unseen_n
        slide = (sx + wanted * nx, sy + wanted * ny, sz + wanted * nz)
        push -= wanted
    yaw, yaw_rate, shift = reference.yaw_rad, reference.yaw_rate_rad_s, contact.shift
    arm, arm_rate, arm_acceleration = reference.arm_rad, reference.arm_rate_rad_s, reference.arm_acceleration_rad_s2
    if shift.length_m > 0.0:
        (fx, fy, fz), (tx, ty, tz), turn = shift.from_m, shift.to_m, shift.to_yaw_rad - shift.from_yaw_rad
        share, rate = shift.way_m / shift.length_m, shift.rate_m_s / shift.length_m
        change = shift.acceleration_m_s2 / shift.length_m
        sx, sy, sz = tx - fx, ty - fy, tz - fz
        x, y, z = x + fx + share * sx, y + fy + share * sy, z + fz + share * sz
        vx, vy, vz = vx + rate * sx, vy + rate * sy, vz + rate * sz
        ax, ay, az = ax + change * sx, ay + change * sy, az + change * sz
        yaw = wrap_rad(yaw + shift.from_yaw_rad + share * turn)
        yaw_rate += rate * turn
        if (tool := shift.to_tool_rad - shift.from_tool_rad) != 0.0 or shift.to_tool_rad != 0.0:
            arm = _last(arm, shift.from_tool_rad + share * tool)
            arm_rate, arm_acceleration = _last(arm_rate, rate * tool), _last(arm_acceleration, change * tool)
    return replace(
        reference,
        position_world_m=(x + d * nx, y + d * ny, z + d * nz),
        velocity_world_m_s=(vx + v * nx, vy + v * ny, vz + v * nz),
        acceleration_world_m_s2=(ax + a * nx, ay + a * ny, az + a * nz),
        yaw_rad=yaw,
        yaw_rate_rad_s=yaw_rate,
        arm_rad=arm,
        arm_rate_rad_s=arm_rate,
        arm_acceleration_rad_s2=arm_acceleration,
        push_world_n=(push * nx, push * ny, push * nz) if contact.touches else None,
        slide_world_n=slide,
        steer_rad=contact.steer_rad or None,
    )


def _last(values: Joints, more: float) -> Joints:
    """Return the values with an addition to that of the last joint."""
    return (*values[:-1], values[-1] + more)


def tip_per_n_m(direction_world: Vec3, tip_world_m: Vec3, weight_n: float) -> Vec3:
    """Return by how much the reference must move per push, m/N, so that the tip stays where it is while the push tilts the vehicle.

    The thrust is weight e_z + push n, so the vehicle turns by push / weight about e_z x n, for small angles.

    Args:
        direction_world: direction n of the push, a unit vector.
        tip_world_m: the tip relative to the body's origin, world frame, with the vehicle level.
        weight_n: weight of the vehicle.
    """
    (nx, ny, _), (x, y, z) = direction_world, tip_world_m
    level = nx * x + ny * y
    return (-z * nx / weight_n, -z * ny / weight_n, level / weight_n)


def way_back_m(contact: ContactState) -> Vec3:
    """Return the way back from the surface before a landing without the core: to where the approach began, within `BACK_M`."""
    (nx, ny, nz), (least_m, most_m) = contact.direction_world, BACK_M
    d = min(most_m, max(least_m, contact.offset_m))
    return (-d * nx, -d * ny, -d * nz)


def measured(
    contact: ContactState,
    dt_s: float,
    force_world_n: Vec3 | None,
    disturbance_world_n: Vec3 | None,
    disagreement_max_n: float,
    tare_s: float = TARE_S,
) -> ContactState:
    """Return the state with this tick's force. During the tare, the force is averaged; no force counts as none.

    Args:
        contact: state of the last tick.
        dt_s: time since the last tick.
        force_world_n: force on the tool.
        disturbance_world_n: force on the vehicle that its motion shows, to compare the force with; None to compare with nothing.
        disagreement_max_n: `safety.contact_disagreement_n`.
        tare_s: duration of the tare.
    """
    against_n = -_along(contact.direction_world, force_world_n or _NO_FORCE)
    contact = replace(contact, tilting_n=contact.tilting_n + dt_s / TILT_S * (contact.push_n - contact.tilting_n))
    if contact.mode is ContactMode.TARE:
        contact = replace(contact, bias_n=contact.bias_n + 3.0 * dt_s / tare_s * (against_n - contact.bias_n))
    contact = replace(contact, force_n=against_n - contact.bias_n + contact.unseen_n)
    if disturbance_world_n is None:
        return contact
    unlike_n = -_along(contact.direction_world, disturbance_world_n) - against_n
    mean_n, disagreement_n, unopposed_n = contact.disagreement_bias_n, contact.disagreement_n, contact.unopposed_n
    if contact.mode is ContactMode.TARE:
        return replace(contact, disagreement_bias_n=mean_n + 3.0 * dt_s / tare_s * (unlike_n - mean_n))
    shown_n = sensed_n(contact) + unlike_n - mean_n
    disagreement_n += dt_s / DISAGREEMENT_S * (unlike_n - mean_n - disagreement_n)
    unopposed_n += dt_s / DISAGREEMENT_S * (contact.push_n - shown_n - unopposed_n)
    # A gust towards the surface acts like a push against nothing; a push below the limit cannot exceed it, and with a gust the
    # sensor measures more than the push.
    pushes = contact.push_n > max(disagreement_max_n, sensed_n(contact)) and unopposed_n > disagreement_max_n
    holds = disagreement_n > disagreement_max_n or pushes
    return replace(
        contact,
        disagreement_n=disagreement_n,
        unopposed_n=unopposed_n,
        disagreed_s=contact.disagreed_s + dt_s if holds else 0.0,
    )


def along_m(contact: ContactState, vector: Vec3) -> float:
    """Return the part of a vector along the direction of the approach."""
    return _along(contact.direction_world, vector)


def _along(direction: Vec3, vector: Vec3) -> float:
    (nx, ny, nz), (x, y, z) = direction, vector
    return x * nx + y * ny + z * nz


def timed(contact: ContactState, dt_s: float, holds: bool) -> ContactState:
    """Return the state with the time for which a condition has held."""
    return replace(contact, beyond_s=contact.beyond_s + dt_s if holds else 0.0)


def moved(contact: ContactState, dt_s: float, rate_m_s: float, least_m: float = 0.0) -> ContactState:
    """Return the state with the offset moved by one tick, its rate changing towards `rate_m_s`.

    On its way back the offset stops at `least_m`: the rate falls with the root of the remaining way.
    """
    before = contact.rate_m_s
    if rate_m_s < 0.0:
        rate_m_s = -min(-rate_m_s, _stopping_m_s(contact.offset_m - least_m))
    most = (ACCELERATION_M_S2 if rate_m_s != 0.0 else STOP_M_S2) * dt_s
    rate = min(before + most, max(before - most, rate_m_s))
    offset_m = contact.offset_m + 0.5 * dt_s * (before + rate)
    if rate_m_s < 0.0 and offset_m < least_m + _ARRIVED_M:
        return replace(contact, offset_m=least_m, rate_m_s=0.0, acceleration_m_s2=0.0)
    return replace(contact, offset_m=offset_m, rate_m_s=rate, acceleration_m_s2=(rate - before) / dt_s)


def _stopping_m_s(left_m: float) -> float:
    """Return the speed from which a move stops within the way that is left."""
    return math.sqrt(2.0 * 0.8 * ACCELERATION_M_S2 * max(0.0, left_m))


def shift_to(contact: ContactState, to_m: Vec3, to_yaw_rad: float, to_tool_rad: float) -> ContactShift:
    """Return the move from where the present one has ended, or has stopped, to a position, a yaw and a turn of the last joint relative
    to the plan.
    """
    shift = contact.shift
    share = shift.way_m / shift.length_m if shift.length_m > 0.0 else 1.0
    (fx, fy, fz), (tx, ty, tz) = shift.from_m, shift.to_m
    at_m = (fx + share * (tx - fx), fy + share * (ty - fy), fz + share * (tz - fz))
    yaw_rad = shift.from_yaw_rad + share * (shift.to_yaw_rad - shift.from_yaw_rad)
    tool_rad = shift.from_tool_rad + share * (shift.to_tool_rad - shift.from_tool_rad)
    turn_rad = wrap_rad(to_yaw_rad - yaw_rad)
    return ContactShift(
        from_m=at_m,
        to_m=to_m,
        from_yaw_rad=yaw_rad,
        to_yaw_rad=yaw_rad + turn_rad,
        from_tool_rad=tool_rad,
        to_tool_rad=to_tool_rad,
        length_m=max(math.dist(at_m, to_m), abs(turn_rad), abs(to_tool_rad - tool_rad)),
    )


def shifted(contact: ContactState, dt_s: float, speed_m_s: float) -> ContactState:
    """Return the state with its move advanced by one tick; with speed 0 the move brakes."""
    shift = contact.shift
    left_m = shift.length_m - shift.way_m
    before, most = shift.rate_m_s, ACCELERATION_M_S2 * dt_s
    rate = min(before + most, max(before - most, min(speed_m_s, _stopping_m_s(left_m))))
    way_m = shift.way_m + 0.5 * dt_s * (before + rate)
    if left_m < _ARRIVED_M or way_m > shift.length_m:
        way_m, rate = shift.length_m, 0.0
    acceleration = (rate - before) / dt_s if rate != 0.0 else 0.0
    return replace(contact, shift=replace(shift, way_m=way_m, rate_m_s=rate, acceleration_m_s2=acceleration))


def is_shifted(contact: ContactState) -> bool:
    """Return whether the present move has ended."""
    return contact.shift.way_m >= contact.shift.length_m


def averaged(contact: ContactState, tip_world_m: Vec3) -> ContactState:
    """Return the state with one more sample of the touched point."""
    count = contact.samples + 1
    (mx, my, mz), (x, y, z), force_n = contact.mean_tip_m, tip_world_m, contact.mean_force_n
    return replace(
        contact,
        samples=count,
        mean_tip_m=(mx + (x - mx) / count, my + (y - my) / count, mz + (z - mz) / count),
        mean_force_n=force_n + (contact.force_n - force_n) / count,
    )


def sensed_n(contact: ContactState) -> float:
    """Return the force that the sensor measures, without what only the vehicle's motion shows, N."""
    return contact.force_n - contact.unseen_n


def touches(contact: ContactState, touch_n: float) -> bool:
    """Return whether the measured force shows that the tool still touches the surface."""
    return sensed_n(contact) > LOST_SHARE * touch_n


def pressed(contact: ContactState, dt_s: float, touch_n: float, force_n: float) -> ContactState:
    """Return the state after one tick of pressing: the offset comes to rest and the force follows its ramp from the touch's.

    Args:
        contact: state in mode PRESS.
        dt_s: time since the last tick.
        touch_n: threshold of the touch, where the ramp begins.
        force_n: force at the ramp's end.
    """
    wanted_n, correction_n = contact.wanted_n, contact.correction_n
    if not touches(contact, touch_n):  # nothing winds up, and the offset creeps on until the surface is touched again
        contact = moved(contact, dt_s, SLOWEST_M_S)
    else:
        contact = moved(contact, dt_s, 0.0)
        rate = abs(force_n - touch_n) / PRESS_RAMP_S * dt_s
        wanted_n = min(wanted_n + rate, max(wanted_n - rate, force_n))
        most = CORRECTION_SHARE * force_n + CORRECTION_N
        correction_n += FORCE_RATE_PER_S * dt_s * (wanted_n - contact.force_n)
        correction_n = min(most, max(-most, correction_n))
    push_n = max(0.0, wanted_n - touch_n + correction_n)
    return replace(contact, wanted_n=wanted_n, correction_n=correction_n, push_n=push_n)


def released(contact: ContactState, dt_s: float) -> ContactState:
    """Return the state with less push; at rest."""
    contact = moved(contact, dt_s, 0.0)
    rate_n_s = RELEASE_FAST_N_S if contact.failed else RELEASE_N_S
    return replace(contact, wanted_n=0.0, correction_n=0.0, push_n=max(0.0, contact.push_n - rate_n_s * dt_s))


def entered(contact: ContactState, t_s: float, mode: ContactMode, *, failed: bool = False) -> ContactState:
    """Return the state at the beginning of a mode."""
    return replace(
        contact, mode=mode, since_s=t_s, beyond_s=0.0, wanted_n=0.0, correction_n=0.0, failed=contact.failed or failed
    )
