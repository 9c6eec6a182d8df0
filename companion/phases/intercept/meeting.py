"""Motion of the vehicle to a meeting point, and the choice of that point. Pure.

A motion is a quintic in each axis: the minimum-jerk segment from position, velocity and acceleration to an end of which any part may be
free (Mueller, Hehn and D'Andrea, IEEE T-RO 31, 2015). Every limit is convex: the box, the safe set of the governor, also for the place
where the vehicle would come to rest, the cone of the tilt, and the balls of speed, acceleration, thrust and jerk. A polynomial lies in
the convex hull of its Bernstein coefficients, so a motion whose few coefficients respect the limits respects them at all times.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from typing import Final

from companion.config.mission import Limits
from companion.config.vehicle import Vehicle
from companion.model.codec import Record
from companion.model.constants import GRAVITY_M_S2
from companion.model.types import Vec3
from companion.phases.intercept.ball import Point
from companion.safety.governor import SafeSet
from companion.safety.stop import StopModel

SHARE: Final = 0.98
"""Fraction of the limits of speed, acceleration and jerk that is used: the governor compares differences between ticks with them."""
TILT_RESERVE_RAD: Final = math.radians(2.0)
"""Tilt that is left to the control law."""
STOP_LEAST_S: Final = 0.5
"""Shortest duration of a stop."""
TILT_S: Final = 0.1
"""Time constant of each of the two lags with which the tilt follows the reference's acceleration."""
SWING_S2_M: Final = 0.18
"""Displacement of the net per lagging acceleration and distance below the body: more than 1 / 9.81, because the arm gives way."""
FOLLOWS_S: Final = 0.07
RISES_S: Final = 0.02
"""Time by which the body follows the reference, horizontally and vertically. These four were identified in the fast loop."""
LEAST_S: Final = 0.15
"""Shortest duration of a motion to a meeting; in less time, the net hardly moves."""
MISS_M: Final = 0.05
"""Distance from the net's centre at which a ball is still caught."""
ASIDE: Final = 3.0
"""Effort of a horizontal displacement compared with that of a vertical one, which needs no tilt."""
SHARES = (1.0, 0.8, 0.6, 0.4, 0.2)
"""Fractions of the net's displacement that are tried one after the other."""
FACING: Final = 0.3
"""Smallest cosine between the net's opening and the direction that the ball comes from."""
ASKEW_M_S2: Final = 2.0
"""Effort of a ball that comes from the side, beyond that of one that comes straight."""
KEPT_M_S2: Final = 0.3
"""Effort by which another meeting must be better than the planned one."""
PIECES: Final = 3
"""Number of pieces of a motion that are compared with the limits: the coefficients of a short piece are close to the curve."""
TRIED_MAX: Final = 6
"""Number of meetings that are compared with the limits, those of the least effort first."""


class State(Record, frozen=True):
    """Motion of the reference at one instant, world frame."""

    position_m: Vec3
    velocity_m_s: Vec3
    acceleration_m_s2: Vec3
    jerk_m_s3: Vec3 = (0.0, 0.0, 0.0)


class Motion(Record, frozen=True):
    """A quintic in each axis from a state; `alpha`, `beta` and `gamma` are snap's rate, snap and jerk at its start."""

    start_s: float
    duration_s: float
    begin: State
    alpha: Vec3
    beta: Vec3
    gamma: Vec3

    @property
    def end_s(self) -> float:
        """Return the flight clock at the end."""
        return self.start_s + self.duration_s

    def at(self, t_s: float) -> State:
        """Return the state at a time; after the end, that of the end."""
        h, p, v, a = (
            min(t_s, self.end_s) - self.start_s,
            self.begin.position_m,
            self.begin.velocity_m_s,
            self.begin.acceleration_m_s2,
        )
        (x, vx, ax, jx), (y, vy, ay, jy), (z, vz, az, jz) = [
            _axis(h, p[k], v[k], a[k], self.gamma[k], self.beta[k], self.alpha[k]) for k in range(3)
        ]
        return State((x, y, z), (vx, vy, vz), (ax, ay, az), (jx, jy, jz))


def _axis(
    h: float, p: float, v: float, a: float, gamma: float, beta: float, alpha: float
) -> tuple[float, float, float, float]:
    return (
        p + h * (v + h * (a / 2.0 + h * (gamma / 6.0 + h * (beta / 24.0 + h * alpha / 120.0)))),
        v + h * (a + h * (gamma / 2.0 + h * (beta / 6.0 + h * alpha / 24.0))),
        a + h * (gamma + h * (beta / 2.0 + h * alpha / 6.0)),
        gamma + h * (beta + h * alpha / 2.0),
    )


def motion_to(t_s: float, begin: State, duration_s: float, position_m: Vec3 | None) -> Motion:
    """Return the minimum-jerk motion to rest.

    Args:
        t_s: start on the flight clock.
        begin: state at the start.
        duration_s: duration.
        position_m: position at the end; None if it is free.
    """
    h = duration_s
    found = []
    for k in range(3):
        v0, a0 = begin.velocity_m_s[k], begin.acceleration_m_s2[k]
        faster = -v0 - h * a0
        if position_m is None:
            found.append((0.0, (-12.0 * faster - 6.0 * h * a0) / h**3, (6.0 * faster + 2.0 * h * a0) / h**2))
            continue
        beyond = position_m[k] - begin.position_m[k] - h * (v0 + 0.5 * h * a0)
        found.append(
            (
                (720.0 * beyond - 360.0 * h * faster - 60.0 * h * h * a0) / h**5,
                (-360.0 * beyond + 168.0 * h * faster + 24.0 * h * h * a0) / h**4,
                (60.0 * beyond - 24.0 * h * faster - 3.0 * h * h * a0) / h**3,
            )
        )
    return _motion(t_s, begin, h, found)


def shift_of_net(t_s: float, begin: State, lag: Lag, duration_s: float, drop_m: float, shift_m: Vec3) -> Motion:
    """Return the minimum-jerk motion at whose end the net has moved by `shift_m`, world frame.

    The net follows the body, which follows the reference `FOLLOWS_S` later, and swings against the tilt, which follows the horizontal
    acceleration through the lags of `Lag`. Both are linear in the coefficients of the jerk: min of the integral of jerk^2 with one
    linear condition per axis. In a short time, the motion tilts away from the ball and swings the net to it.

    Args:
        t_s: start on the flight clock.
        begin: state at the start.
        lag: lagging acceleration at the start.
        duration_s: time until the net is to be there.
        drop_m: distance of the net below the body's origin.
        shift_m: displacement of the net from where it hangs below `begin.position_m` at rest.
    """
    h, fade = duration_s, math.exp(-duration_s / TILT_S)
    found = []
    for k in range(3):
        swing, follows_s = (SWING_S2_M * drop_m, FOLLOWS_S) if k < 2 else (0.0, RISES_S)
        v0, a0 = begin.velocity_m_s[k], begin.acceleration_m_s2[k]
        # Responses of the two lags to 1, t, t^2 / 2 and t^3 / 6.
        y0 = 1.0 - fade
        y1 = h - TILT_S * y0
        y2 = 0.5 * h * h - TILT_S * y1
        y3 = h * h * h / 6.0 - TILT_S * y2
        z0 = 1.0 - fade * (1.0 + h / TILT_S)
        z1 = y1 - TILT_S * z0
        z2 = y2 - TILT_S * z1
        z3 = y3 - TILT_S * z2
        f0 = h**3 / 6.0 - follows_s * h**2 / 2.0 - swing * z1
        f1 = h**4 / 24.0 - follows_s * h**3 / 6.0 - swing * z2
        f2 = h**5 / 120.0 - follows_s * h**4 / 24.0 - swing * z3
        still = fade * (lag.second_m_s2[k] + lag.first_m_s2[k] * h / TILT_S) + a0 * z0
        free = h * (v0 + 0.5 * h * a0) - follows_s * (v0 + h * a0) - swing * still
        # The inverse of the matrix of integrals of the products of 1, t and t^2 / 2.
        g0 = 9.0 * f0 / h - 36.0 * f1 / h**2 + 60.0 * f2 / h**3
        g1 = -36.0 * f0 / h**2 + 192.0 * f1 / h**3 - 360.0 * f2 / h**4
        g2 = 60.0 * f0 / h**3 - 360.0 * f1 / h**4 + 720.0 * f2 / h**5
        share = (shift_m[k] - free) / (f0 * g0 + f1 * g1 + f2 * g2)
        found.append((share * g2, share * g1, share * g0))
    return _motion(t_s, begin, h, found)


def _motion(t_s: float, begin: State, duration_s: float, found: list[tuple[float, float, float]]) -> Motion:
    (ax, bx, gx), (ay, by, gy), (az, bz, gz) = found
    return Motion(t_s, duration_s, begin, (ax, ay, az), (bx, by, bz), (gx, gy, gz))


class Lag(Record, frozen=True):
    """The reference's acceleration after one and after two first-order lags of `TILT_S`: how the tilt follows it."""

    first_m_s2: Vec3 = (0.0, 0.0, 0.0)
    second_m_s2: Vec3 = (0.0, 0.0, 0.0)

    def after(self, dt_s: float, acceleration_m_s2: Vec3) -> Lag:
        """Return the lags after a tick with this acceleration."""
        share = dt_s / TILT_S
        (x, y, z), (u, v, w), (a, b, c) = self.first_m_s2, self.second_m_s2, acceleration_m_s2
        x, y, z = x + share * (a - x), y + share * (b - y), z + share * (c - z)
        return Lag((x, y, z), (u + share * (x - u), v + share * (y - v), w + share * (z - w)))


class Bounds:
    """Limits of a motion; all are convex.

    Args:
        vehicle: thrust, tilt, mass and stopping distance.
        limits: speed, acceleration, jerk and thrust limits of the mission.
        safe: the governor's safe set.
        home_m: centre of the box, world frame.
        box_m: half sizes of the box in which the reference stays.
    """

    def __init__(self, vehicle: Vehicle, limits: Limits, safe: SafeSet, home_m: Vec3, box_m: Vec3) -> None:
        airframe = vehicle.airframe
        self._safe, self._stop, self._home_m, self._box_m = safe, StopModel(vehicle.safety), home_m, box_m
        self._speed_m_s = SHARE * limits.speed_max_m_s
        self.acceleration_m_s2 = SHARE * limits.acceleration_max_m_s2
        self._jerk_m_s3 = SHARE * limits.jerk_max_m_s3
        self._thrust_m_s2 = (
            limits.thrust_share_max * airframe.thrust_max_n / (airframe.mass_kg + airframe.payload_max_kg)
        )
        self._slope = math.tan(math.radians(airframe.tilt_max_deg) - TILT_RESERVE_RAD)

    def in_box(self, p: Vec3) -> bool:
        """Return whether a position of the body's origin is in the box."""
        (x, y, z), (hx, hy, hz), (bx, by, bz) = p, self._home_m, self._box_m
        return abs(x - hx) <= bx and abs(y - hy) <= by and abs(z - hz) <= bz

    def admit(self, m: Motion) -> bool:
        """Return whether a motion respects every limit at all times, and leaves room to stop at all times."""
        h = m.duration_s / PIECES
        for k in range(PIECES):
            begin, b, c = m.at(m.start_s + k * h), _plus(m.beta, m.alpha, k * h), m.alpha
            if not self._admits_piece(Motion(m.start_s, h, begin, c, b, begin.jerk_m_s3)):
                return False
        return True

    def _admits_piece(self, m: Motion) -> bool:
        """Return whether the Bernstein coefficients of a motion respect every limit."""
        h = m.duration_s
        jerks = [m.gamma, _plus(m.gamma, m.beta, 0.5 * h), _plus(_plus(m.gamma, m.beta, h), m.alpha, 0.5 * h * h)]
        pushes = _integrated(m.begin.acceleration_m_s2, jerks, h / 3.0)
        if not all(math.hypot(*a) <= self.acceleration_m_s2 and self._can_push(a) for a in pushes):
            return False
        speeds = _integrated(m.begin.velocity_m_s, pushes, h / 4.0)
        fastest = max([math.hypot(*v) for v in speeds])
        if fastest > self._speed_m_s or not all(math.hypot(*j) <= self._jerk_m_s3 for j in jerks):
            return False
        places = _integrated(m.begin.position_m, speeds, h / 5.0)
        # The velocity in the coefficients of degree 5.
        raised = [_plus(_scaled(speeds[max(0, k - 1)], 0.2 * k), speeds[min(4, k)], 1.0 - 0.2 * k) for k in range(6)]
        stop_s, safe = self._stop.time_s(fastest), self._safe
        return all(
            self.in_box(p) and safe.holds(p) and safe.holds(_plus(p, v, stop_s))
            for p, v in zip(places, raised, strict=True)
        )

    def _can_push(self, a: Vec3) -> bool:
        """Return whether tilt and thrust allow an acceleration."""
        up = a[2] + GRAVITY_M_S2
        return math.hypot(a[0], a[1]) <= self._slope * up and math.hypot(a[0], a[1], up) <= self._thrust_m_s2

    def stop(self, t_s: float, begin: State) -> Motion:
        """Return a stop whose acceleration is half of what the mission allows, or less."""
        needed = max(math.hypot(*begin.velocity_m_s) * 1.5, math.hypot(*begin.acceleration_m_s2) * STOP_LEAST_S)
        duration_s = max(STOP_LEAST_S, needed / (0.5 * self.acceleration_m_s2))
        return motion_to(t_s, begin, duration_s, None)


class Meeting(Record, frozen=True):
    """Where and when the net meets the ball, and the motion to get there."""

    point: Point
    """The ball."""
    motion: Motion


def meeting(
    t_s: float,
    now: State,
    lag: Lag,
    path: list[Point],
    net_m: Vec3,
    opening: Vec3,
    bounds: Bounds,
    clears: Callable[[Motion], bool],
    kept_s: float | None,
) -> Meeting | None:
    """Return the meeting with the least effort that respects every limit, on the way there and in the stop after it; None if there is
    none. If the net cannot come to the ball, it comes as near as the limits allow, at least to `MISS_M`.

    Args:
        t_s: flight clock.
        now: motion of the reference now.
        lag: its lagging acceleration.
        path: the ball's predicted path.
        net_m: the net's centre relative to the body's origin of the level vehicle, world frame.
        opening: unit vector out of the net's opening, world frame.
        bounds: the limits.
        clears: whether the ball's path keeps clear of the rotors during a motion.
        kept_s: time of the meeting that was planned before, which is kept unless another one is clearly better.
    """
    found: list[tuple[float, Point, Vec3]] = []
    (x, y, z), (ox, oy, oz) = now.position_m, opening
    for point in path:
        h, (bx, by, bz), (ux, uy, uz) = point.t_s - t_s, point.position_m, point.velocity_m_s
        shift = (bx - net_m[0] - x, by - net_m[1] - y, bz - net_m[2] - z)
        facing = -(ox * ux + oy * uy + oz * uz) / math.hypot(ux, uy, uz)
        if h < LEAST_S or facing < FACING or not bounds.in_box(_plus(now.position_m, shift, 1.0)):
            continue
        effort = math.hypot(ASIDE * shift[0], ASIDE * shift[1], shift[2]) / (h * h) + ASKEW_M_S2 * (1.0 - facing)
        if kept_s is not None and abs(point.t_s - kept_s) < 1e-6:
            effort -= KEPT_M_S2
        found.append((effort, point, shift))
    found.sort(key=_effort)
    for _, point, shift in found[:TRIED_MAX]:
        away_m = math.hypot(*shift)
        for share in SHARES:
            if (1.0 - share) * away_m > MISS_M:
                break
            motion = shift_of_net(t_s, now, lag, point.t_s - t_s, -net_m[2], _scaled(shift, share))
            if bounds.admit(motion) and bounds.admit(bounds.stop(point.t_s, motion.at(point.t_s))) and clears(motion):
                return Meeting(point, motion)
    return None


def _effort(candidate: tuple[float, Point, Vec3]) -> float:
    return candidate[0]


def _integrated(first: Vec3, rates: list[Vec3], h: float) -> list[Vec3]:
    """Return the Bernstein coefficients of an integral from those of the integrand, with `h` the duration divided by the degree."""
    sums = [first]
    for rate in rates:
        sums.append(_plus(sums[-1], rate, h))
    return sums


def _plus(a: Vec3, b: Vec3, k: float) -> Vec3:
    return (a[0] + k * b[0], a[1] + k * b[1], a[2] + k * b[2])


def _scaled(a: Vec3, k: float) -> Vec3:
    return (k * a[0], k * a[1], k * a[2])
