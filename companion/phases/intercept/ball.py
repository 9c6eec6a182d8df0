"""Follows single markers and predicts the one that falls freely. Pure.

Markers have no identity: each candidate takes the nearest marker within its gate in every frame, and a marker that no candidate takes
begins a new one. A candidate's filter estimates position, velocity and the acceleration beyond free fall, with the same covariance on
all three axes. That acceleration is the test: a marker that stands still or is moved by a hand does not fall, so it is no ball. For the
prediction of a ball, it is known to be about 0.
"""

from __future__ import annotations

import math
from typing import Final

from msgspec.structs import replace

from companion.model.codec import Record
from companion.model.constants import GRAVITY_M_S2
from companion.model.markers import MARKERS_MAX, MarkerFrame
from companion.model.types import Vec3

NOISE_M: Final = 0.0015
"""Standard deviation of a marker's position: below 2 mm in motion (Merriaux et al., Sensors 17, 1591, 2017)."""
SPEED_M_S: Final = 4.0
"""Standard deviation of the velocity of a marker that was seen once."""
EXTRA_M_S2: Final = 20.0
"""Standard deviation of the acceleration beyond free fall of a marker that was seen once: a hand's."""
EXTRA_WALK: Final = 30.0
"""Growth of its variance, (m/s^2)^2/s: the filter remembers about 60 ms, so that a ball is found soon after it leaves the hand."""
BALL_WALK: Final = 1.0
"""The same for a ball, which goes on falling: all that was seen of it counts."""
FALLS_M_S2: Final = 0.3
"""Standard deviation of a ball's acceleration beyond free fall: errors of the drag parameter, spin, and air moved by the rotors."""
JUDGED_M_S2: Final = 1.0
"""Acceleration beyond free fall that a ball may have in addition to the filter's uncertainty."""
SURE_M_S2: Final = 2.5
"""Standard deviation below which that acceleration is judged."""
FAST_M_S: Final = 3.5
"""Speed above which a marker is judged earlier: a hand that swings it so fast accelerates it by more than the test allows."""
FAST_SURE_M_S2: Final = 15.0
"""Standard deviation below which the acceleration of such a marker is judged."""
FALLS_FRAMES: Final = 3
"""Number of consecutive frames in which a marker must fall to be a ball."""
GATE: Final = 5.0
"""Largest distance of a marker from its prediction, in standard deviations."""
COAST_S: Final = 0.06
"""Time after which a candidate that is not seen any more is dropped."""
BALL_COAST_S: Final = 0.25
"""The same for a ball, which hides behind the net or the vehicle."""
HORIZON_S: Final = 1.5
"""Longest time for which a ball's path is predicted."""
STEP_S: Final = 0.01
"""Time between the points of a predicted path."""


class Candidate(Record, frozen=True):
    """A marker that is followed from frame to frame; the covariance is that of each axis."""

    t_s: float
    """Time of the state, on the flight clock: mid-exposure of the newest frame."""
    seen_s: float
    """Mid-exposure of the newest frame in which it was seen."""
    position_m: Vec3
    velocity_m_s: Vec3
    extra_m_s2: Vec3
    """Acceleration beyond free fall."""
    pp: float
    pv: float
    vv: float
    pb: float
    vb: float
    bb: float
    falls: int = 0
    """Number of consecutive frames in which it has fallen freely."""

    @property
    def is_ball(self) -> bool:
        """Return whether it has fallen freely for long enough."""
        return self.falls >= FALLS_FRAMES


class Point(Record, frozen=True):
    """A point of a ball's predicted path."""

    t_s: float
    position_m: Vec3
    velocity_m_s: Vec3
    sigma_m: float
    """Standard deviation of the position on each axis."""


def begun(t_s: float, position_m: Vec3) -> Candidate:
    """Return the candidate of a marker that was seen once."""
    still = (0.0, 0.0, 0.0)
    return Candidate(
        t_s,
        t_s,
        position_m,
        still,
        still,
        NOISE_M * NOISE_M,
        0.0,
        SPEED_M_S * SPEED_M_S,
        0.0,
        0.0,
        EXTRA_M_S2 * EXTRA_M_S2,
    )


def followed(candidates: tuple[Candidate, ...], frame: MarkerFrame, drag_per_m: float) -> tuple[Candidate, ...]:
    """Return the candidates after a frame, the longest followed first; at most `MARKERS_MAX`.

    Args:
        candidates: those of the frame before.
        frame: the new frame.
        drag_per_m: drag of the ball, as in `fall_m_s2`.
    """
    t_s, left = frame.exposed_s, [marker.position_world_m for marker in frame.markers]
    kept: list[Candidate] = []
    for before in candidates:
        candidate = advanced(before, t_s, drag_per_m)
        at = candidate.position_m
        nearest, least_m2 = None, GATE * GATE * (candidate.pp + NOISE_M * NOISE_M)
        for position_m in left:
            dx, dy, dz = position_m[0] - at[0], position_m[1] - at[1], position_m[2] - at[2]
            if dx * dx + dy * dy + dz * dz < least_m2:
                nearest, least_m2 = position_m, dx * dx + dy * dy + dz * dz
        if nearest is not None:
            left.remove(nearest)
            kept.append(_judged(_seen(candidate, nearest)))
        elif t_s - candidate.seen_s <= (BALL_COAST_S if candidate.is_ball else COAST_S):
            kept.append(candidate)
    kept += [begun(t_s, position_m) for position_m in left[: max(0, MARKERS_MAX - len(kept))]]
    return tuple(kept)


def advanced(c: Candidate, t_s: float, drag_per_m: float) -> Candidate:
    """Return a candidate advanced to a later time without a measurement."""
    h = t_s - c.t_s
    if h <= 0.0:
        return c
    (bx, by, bz), (vx, vy, vz), (px, py, pz) = c.extra_m_s2, c.velocity_m_s, c.position_m
    ax, ay, az = fall_m_s2((vx, vy, vz), drag_per_m)
    ax, ay, az, half = ax + bx, ay + by, az + bz, 0.5 * h * h
    x = c.pp + h * c.pv + half * c.pb
    y = c.pv + h * c.vv + half * c.vb
    z = c.pb + h * c.vb + half * c.bb
    w = c.vb + h * c.bb
    return Candidate(
        t_s,
        c.seen_s,
        (px + h * vx + half * ax, py + h * vy + half * ay, pz + h * vz + half * az),
        (vx + h * ax, vy + h * ay, vz + h * az),
        c.extra_m_s2,
        x + h * y + half * z,
        y + h * z,
        c.vv + h * (c.vb + w),
        z,
        w,
        c.bb + (BALL_WALK if c.is_ball else EXTRA_WALK) * h,
        c.falls,
    )


def _seen(c: Candidate, position_m: Vec3) -> Candidate:
    """Return a candidate after the measurement of its position."""
    s = c.pp + NOISE_M * NOISE_M
    kp, kv, kb = c.pp / s, c.pv / s, c.pb / s
    (px, py, pz), (vx, vy, vz), (bx, by, bz) = c.position_m, c.velocity_m_s, c.extra_m_s2
    ex, ey, ez = position_m[0] - px, position_m[1] - py, position_m[2] - pz
    return Candidate(
        c.t_s,
        c.t_s,
        (px + kp * ex, py + kp * ey, pz + kp * ez),
        (vx + kv * ex, vy + kv * ey, vz + kv * ez),
        (bx + kb * ex, by + kb * ey, bz + kb * ez),
        c.pp - kp * c.pp,
        c.pv - kp * c.pv,
        c.vv - kv * c.pv,
        c.pb - kp * c.pb,
        c.vb - kv * c.pb,
        c.bb - kb * c.pb,
        c.falls,
    )


def _judged(c: Candidate) -> Candidate:
    """Return a candidate with the number of frames in which it has fallen freely."""
    sigma = math.sqrt(c.bb)
    x, y, z = c.extra_m_s2
    most = JUDGED_M_S2 + (4.0 if c.is_ball else 2.5) * sigma
    sure = FAST_SURE_M_S2 if math.hypot(*c.velocity_m_s) > FAST_M_S else SURE_M_S2
    falls = sigma < sure and x * x + y * y + z * z < most * most
    if not falls and c.falls == 0:
        return c
    return replace(c, falls=c.falls + 1 if falls else 0)


def falling(c: Candidate) -> Candidate:
    """Return a ball's candidate with the knowledge that its acceleration beyond free fall is 0, give or take `FALLS_M_S2`."""
    s = c.bb + FALLS_M_S2 * FALLS_M_S2
    kp, kv, kb = c.pb / s, c.vb / s, c.bb / s
    (px, py, pz), (vx, vy, vz), (bx, by, bz) = c.position_m, c.velocity_m_s, c.extra_m_s2
    return Candidate(
        c.t_s,
        c.seen_s,
        (px - kp * bx, py - kp * by, pz - kp * bz),
        (vx - kv * bx, vy - kv * by, vz - kv * bz),
        (bx - kb * bx, by - kb * by, bz - kb * bz),
        c.pp - kp * c.pb,
        c.pv - kp * c.vb,
        c.vv - kv * c.vb,
        c.pb - kp * c.bb,
        c.vb - kv * c.bb,
        c.bb - kb * c.bb,
        c.falls,
    )


def path(c: Candidate, until_s: float, floor_m: float, drag_per_m: float) -> list[Point]:
    """Return a ball's predicted path at whole multiples of `STEP_S` on the flight clock.

    Args:
        c: the ball's candidate.
        until_s: end of the path.
        floor_m: height at which it ends earlier.
        drag_per_m: as in `fall_m_s2`.
    """
    c = falling(c)
    points: list[Point] = []
    t_s, p, v = c.t_s, c.position_m, c.velocity_m_s
    number = math.floor(t_s / STEP_S)
    while p[2] > floor_m:
        number += 1
        if number * STEP_S > until_s:
            break
        p, v = carried(p, v, c.extra_m_s2, number * STEP_S - t_s, drag_per_m)
        t_s = number * STEP_S
        points.append(Point(t_s, p, v, _sigma_m(c, t_s - c.t_s)))
    return points


def predicted(c: Candidate, t_s: float, drag_per_m: float) -> Point:
    """Return the point of a ball's path at one time."""
    c = falling(c)
    p, v, left_s = c.position_m, c.velocity_m_s, t_s - c.t_s
    steps = max(1, math.ceil(left_s / STEP_S))
    for _ in range(steps):
        p, v = carried(p, v, c.extra_m_s2, left_s / steps, drag_per_m)
    return Point(t_s, p, v, _sigma_m(c, left_s))


def carried(p: Vec3, v: Vec3, extra_m_s2: Vec3, h: float, drag_per_m: float) -> tuple[Vec3, Vec3]:
    """Return position and velocity after a short time `h`, by the midpoint rule."""
    (vx, vy, vz), (bx, by, bz), half = v, extra_m_s2, 0.5 * h
    ax, ay, az = fall_m_s2(v, drag_per_m)
    mx, my, mz = vx + half * (ax + bx), vy + half * (ay + by), vz + half * (az + bz)
    ax, ay, az = fall_m_s2((mx, my, mz), drag_per_m)
    return (
        (p[0] + h * mx, p[1] + h * my, p[2] + h * mz),
        (vx + h * (ax + bx), vy + h * (ay + by), vz + h * (az + bz)),
    )


def fall_m_s2(v: Vec3, drag_per_m: float) -> Vec3:
    """Return the acceleration of a ball in free fall: gravity, and drag of `drag_per_m` times the speed squared."""
    vx, vy, vz = v
    k = drag_per_m * math.sqrt(vx * vx + vy * vy + vz * vz)
    return (-k * vx, -k * vy, -k * vz - GRAVITY_M_S2)


def _sigma_m(c: Candidate, h: float) -> float:
    half = 0.5 * h * h
    return math.sqrt(
        max(0.0, c.pp + 2.0 * h * c.pv + h * h * c.vv + 2.0 * half * c.pb + 2.0 * half * h * c.vb + half * half * c.bb)
    )
