"""Compares one motion of the carried vehicle as measured by PX4's IMU and by motion capture. Pure functions.

PX4's attitude is derived from motion capture and adds no information; the accelerometer and the gyro do. Gravity and the
accelerometer's bias are nearly constant over a motion of two seconds, so both velocities are compared after their mean and slope
are removed. The vehicle need not be perfectly at rest at both ends.
"""

from __future__ import annotations

import math
from bisect import bisect_left
from collections.abc import Sequence
from dataclasses import dataclass
from itertools import pairwise
from typing import Final, NamedTuple

from companion.model.algebra import dot, minus, plus, scaled
from companion.model.frames import quat_conjugate, quat_multiply, quat_normalize, quat_rotate
from companion.model.types import IDENTITY_QUAT, Quat, Vec3

GRID_S: Final = 0.02
GAP_MAX_S: Final = 0.3
"""Longest gap between samples with which a motion is still evaluated."""


class PoseAt(NamedTuple):
    """A pose from motion capture in which the body was tracked, with the configured up axis."""

    t_s: float
    position_m: Vec3
    attitude: Quat


class ImuAt(NamedTuple):
    """PX4's accelerometer and gyro, body FLU."""

    t_s: float
    force_m_s2: Vec3
    rate_rad_s: Vec3


class GapError(ValueError):
    """Samples are missing within a motion; the text names the source."""


@dataclass(frozen=True, slots=True)
class Motion:
    """One motion from rest to rest."""

    felt_m: Vec3
    """Displacement measured by the IMU, in the body frame at the start."""
    seen_m: Vec3
    """Displacement measured by motion capture, in the frame of its rigid body at the start."""
    seen_world_m: Vec3
    """Displacement measured by motion capture, in the stream's world."""
    response: Vec3
    """Displacement measured by motion capture, in its body frame, per metre of the IMU's displacement along `felt_m`: its length is
    the ratio of the scales, its direction should be that of `felt_m`.
    """
    felt_turn_rad: Vec3
    """Rotation vector measured by the gyro, in the body frame at the start."""
    seen_turn_rad: Vec3
    """Rotation vector measured by motion capture, in the frame of its rigid body at the start."""


def measure(
    poses: Sequence[PoseAt], imu: Sequence[ImuAt], start_s: float, end_s: float, gyro_bias_rad_s: Vec3
) -> Motion:
    """Measure a motion that begins and ends at rest, both with the IMU and with motion capture.

    Args:
        poses: poses in order of time, from before `start_s` until after `end_s`.
        imu: samples in order of time, from before `start_s` until after `end_s`.
        start_s: a time of rest before the motion.
        end_s: a time of rest after the motion.
        gyro_bias_rad_s: bias of the gyro, measured while the vehicle stood on the floor.

    Raises:
        GapError: samples are missing for longer than `GAP_MAX_S`.
    """
    count = int((end_s - start_s) / GRID_S)
    _no_gaps([pose.t_s for pose in poses], start_s, end_s, "motion capture lost the rigid body (markers covered?)")
    _no_gaps([sample.t_s for sample in imu], start_s, end_s, "no data from PX4's IMU")
    times = [start_s + GRID_S * k for k in range(count + 1)]
    velocity, turned = _felt(imu, times, gyro_bias_rad_s)
    places = _places(poses, times)
    first, last = _nearest(poses, start_s), _nearest(poses, times[-1])
    back = quat_conjugate(first.attitude)
    seen_world = minus(places[-1], places[0])
    paces = [quat_rotate(back, scaled(minus(b, a), 1.0 / GRID_S)) for a, b in pairwise(places)]
    felt_paces = [scaled(plus(a, b), 0.5) for a, b in pairwise(velocity)]
    felt = _travel(velocity)
    length = math.hypot(*felt)
    response = (0.0, 0.0, 0.0)
    if length > 1e-6:
        direction = scaled(felt, 1.0 / length)
        response = _response([dot(v, direction) for v in _detrended(felt_paces)], _detrended(paces))
    return Motion(
        felt_m=felt,
        seen_m=quat_rotate(back, seen_world),
        seen_world_m=seen_world,
        response=response,
        felt_turn_rad=rotation_vector(turned),
        seen_turn_rad=rotation_vector(quat_multiply(back, last.attitude)),
    )


def _felt(imu: Sequence[ImuAt], times: Sequence[float], bias: Vec3) -> tuple[list[Vec3], Quat]:
    """Integrate the specific force in the initial body frame, on the time grid; return the velocity and the total rotation."""
    index = max(0, bisect_left(imu, times[0], key=lambda sample: sample.t_s) - 1)
    now_s, q = times[0], IDENTITY_QUAT
    velocity: list[Vec3] = [(0.0, 0.0, 0.0)]
    v: Vec3 = (0.0, 0.0, 0.0)
    for until_s in times[1:]:
        while now_s < until_s - 1e-9:
            # A sample holds until the next one.
            while index + 1 < len(imu) and imu[index + 1].t_s <= now_s + 1e-9:
                index += 1
            next_s = imu[index + 1].t_s if index + 1 < len(imu) else math.inf
            step_s = min(until_s, next_s) - now_s
            rate = minus(imu[index].rate_rad_s, bias)
            half = turned(q, rate, 0.5 * step_s)
            v = plus(v, scaled(quat_rotate(half, imu[index].force_m_s2), step_s))
            q = turned(q, rate, step_s)
            now_s += step_s
        velocity.append(v)
    return velocity, q


def turned(q: Quat, rate_rad_s: Vec3, dt_s: float) -> Quat:
    """Return the attitude after a rotation at a constant body rate for `dt_s`."""
    angle = math.hypot(*rate_rad_s) * dt_s
    if angle < 1e-12:
        return q
    x, y, z = scaled(rate_rad_s, math.sin(0.5 * angle) / angle * dt_s)
    return quat_normalize(quat_multiply(q, (math.cos(0.5 * angle), x, y, z)))


def _places(poses: Sequence[PoseAt], times: Sequence[float]) -> list[Vec3]:
    """Return the positions on the grid, linearly interpolated between frames."""
    stamps = [pose.t_s for pose in poses]
    places = []
    for t_s in times:
        after = min(max(1, bisect_left(stamps, t_s)), len(poses) - 1)
        a, b = poses[after - 1], poses[after]
        share = (t_s - a.t_s) / (b.t_s - a.t_s) if b.t_s > a.t_s else 0.0
        places.append(plus(a.position_m, scaled(minus(b.position_m, a.position_m), min(1.0, max(0.0, share)))))
    return places


def _nearest(poses: Sequence[PoseAt], t_s: float) -> PoseAt:
    return min(poses, key=lambda pose: abs(pose.t_s - t_s))


def _travel(velocity: Sequence[Vec3]) -> Vec3:
    """Return the displacement of a velocity that is zero at both ends, with the linear growth due to gravity and bias removed."""
    count = len(velocity) - 1
    drift = scaled(velocity[-1], 1.0 / count)
    total: Vec3 = (0.0, 0.0, 0.0)
    for k, v in enumerate(velocity):
        total = plus(total, minus(v, scaled(drift, k)))
    return scaled(total, GRID_S)


def _detrended(values: Sequence[Vec3]) -> list[Vec3]:
    """Return the values minus their mean and slope, fitted to each axis by least squares."""
    count = len(values)
    middle = 0.5 * (count - 1)
    spread = sum((k - middle) ** 2 for k in range(count))
    columns = []
    for axis in range(3):
        column = [value[axis] for value in values]
        mean = sum(column) / count
        slope = sum((k - middle) * value for k, value in enumerate(column)) / spread
        columns.append([value - mean - slope * (k - middle) for k, value in enumerate(column)])
    return list(zip(*columns, strict=True))


def _response(along: Sequence[float], seen: Sequence[Vec3]) -> Vec3:
    power = sum(a * a for a in along)
    if power < 1e-9:
        return (0.0, 0.0, 0.0)
    x, y, z = (sum(a * value[axis] for a, value in zip(along, seen, strict=True)) / power for axis in range(3))
    return (x, y, z)


def _no_gaps(stamps: Sequence[float], start_s: float, end_s: float, what: str) -> None:
    inside = [start_s, *(stamp for stamp in stamps if start_s <= stamp <= end_s), end_s]
    gap_s = max(b - a for a, b in pairwise(inside))
    if gap_s > GAP_MAX_S:
        raise GapError(f"{what} for {gap_s:.1f} s of the move")


def rotation_vector(q: Quat) -> Vec3:
    """Return axis times angle (rad, at most pi) of a unit quaternion."""
    w, x, y, z = q if q[0] >= 0.0 else (-q[0], -q[1], -q[2], -q[3])
    sine = math.hypot(x, y, z)
    k = 2.0 * math.atan2(sine, w) / sine if sine > 1e-12 else 2.0
    return (k * x, k * y, k * z)


def mean_vector(values: Sequence[Vec3]) -> Vec3:
    """Return the mean of each component."""
    count = len(values)
    return (sum(v[0] for v in values) / count, sum(v[1] for v in values) / count, sum(v[2] for v in values) / count)


def mean_attitude(values: Sequence[Quat]) -> Quat:
    """Return the mean of attitudes that are close to each other."""
    first = values[0]
    signs = [1.0 if sum(a * b for a, b in zip(first, q, strict=True)) >= 0.0 else -1.0 for q in values]
    w, x, y, z = (sum(s * q[k] for s, q in zip(signs, values, strict=True)) for k in range(4))
    return quat_normalize((w, x, y, z))


def turned_rad(a: Quat, b: Quat) -> float:
    """Return the angle between two attitudes, rad."""
    return math.hypot(*rotation_vector(quat_multiply(quat_conjugate(a), b)))


def angle_rad(a: Vec3, b: Vec3) -> float:
    """Return the angle between two vectors, rad; pi if one of them is zero."""
    size = math.hypot(*a) * math.hypot(*b)
    return math.acos(max(-1.0, min(1.0, dot(a, b) / size))) if size > 1e-12 else math.pi
