"""Motion of the reference while a ball is met, and its limits. Pure.

Every tick ends in a state from which a stop respects every limit; otherwise the vehicle pushes less, brakes, or stops as it would have
in the tick before.

A stop is a quintic in each axis: the minimum-jerk segment from position, velocity and acceleration (Mueller, Hehn and D'Andrea, IEEE
T-RO 31, 2015). Every limit is convex: the box, the safe set of the governor, also for the place where the vehicle would come to rest,
the cone of the tilt, and the balls of speed, acceleration, thrust and jerk. A polynomial lies in the convex hull of its Bernstein
coefficients, so a motion whose few coefficients respect the limits respects them at all times.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator
from typing import Final

from companion.config.mission import Limits
from companion.config.vehicle import Vehicle
from companion.model.algebra import scaled
from companion.model.codec import Record
from companion.model.constants import GRAVITY_M_S2
from companion.model.types import Vec3
from companion.phases.intercept.lag import Lag
from companion.safety.governor import SafeSet
from companion.safety.stop import StopModel

SHARE: Final = 0.98
"""Fraction of the limits of speed, acceleration and jerk that is used: the governor compares differences between ticks with them."""
TILT_RESERVE_RAD: Final = math.radians(5.0)
"""Tilt that is left to the control law, which pulls the lagging body after the reference."""
STOP_LEAST_S: Final = 0.5
"""Shortest duration of a stop."""
PIECES: Final = 3
"""Number of pieces of a motion that are compared with the limits: the coefficients of a short piece are close to the curve."""
OVERSHOOT: Final = 1.4
"""Speed of the body, as a multiple of the reference's, for which there is room to stop: vertically, and if its lags are not known."""
LOOK_S, LOOKS = 0.04, 9
"""Times after the start of a stop at which there must be room for the lagging body to stop: it goes on after the reference."""
BRAKE_M_S2: Final = 2.0
"""Deceleration that is tried after the wanted acceleration, half of it, and what is vertical of it."""


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
        h, s = min(t_s, self.end_s) - self.start_s, self.begin
        axes = zip(s.position_m, s.velocity_m_s, s.acceleration_m_s2, self.gamma, self.beta, self.alpha, strict=True)
        (x, vx, ax, jx), (y, vy, ay, jy), (z, vz, az, jz) = [_axis(h, *axis) for axis in axes]
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
    (ax, bx, gx), (ay, by, gy), (az, bz, gz) = found
    return Motion(t_s, h, begin, (ax, ay, az), (bx, by, bz), (gx, gy, gz))


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
        self.speed_m_s = SHARE * limits.speed_max_m_s
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

    def admit(self, m: Motion, lag: Lag | None = None) -> bool:
        """Return whether a motion respects every limit at all times, and leaves room to stop at all times.

        Args:
            m: the motion.
            lag: lagging acceleration at its start; None to allow for `OVERSHOOT` instead.
        """
        overshoot = OVERSHOOT if lag is None else 1.0
        # If the coefficients of the whole respect the limits, so do those of its pieces.
        within = self._admits_piece(m, overshoot) or all(self._admits_piece(piece, overshoot) for piece in _pieces(m))
        return within and (lag is None or self._can_stop(m, lag))

    def _can_stop(self, m: Motion, lag: Lag) -> bool:
        """Return whether the body that lags behind a motion could stop within the safe set at all times."""
        for k in range(LOOKS):
            s = m.at(m.start_s + k * LOOK_S)
            lag = lag.after(LOOK_S, s.acceleration_m_s2) if k else lag
            (x, y), (u, w), (px, py, pz) = lag.body_m(), lag.body_m_s(s.acceleration_m_s2), s.position_m
            vx, vy, vz = s.velocity_m_s
            vx, vy, vz = vx + u, vy + w, vz + (OVERSHOOT - 1.0) * vz
            stop_s = self._stop.time_s(math.hypot(vx, vy, vz))
            if not self._safe.holds((px + x + stop_s * vx, py + y + stop_s * vy, pz + stop_s * vz)):
                return False
        return True

    def _admits_piece(self, m: Motion, overshoot: float) -> bool:
        """Return whether the Bernstein coefficients of a motion respect every limit."""
        h, s = m.duration_s, m.begin
        axes = zip(s.position_m, s.velocity_m_s, s.acceleration_m_s2, m.gamma, m.beta, m.alpha, strict=True)
        (xs, vxs, axs, jxs), (ys, vys, ays, jys), (zs, vzs, azs, jzs) = [_coefficients(h, *axis) for axis in axes]
        most = self.acceleration_m_s2
        for a in zip(axs, ays, azs, strict=True):
            if math.hypot(*a) > most or not self._can_push(a):
                return False
        fastest = max(map(math.hypot, vxs, vys, vzs))
        if fastest > self.speed_m_s or max(map(math.hypot, jxs, jys, jzs)) > self._jerk_m_s3:
            return False
        stop_s, safe = overshoot * self._stop.time_s(overshoot * fastest), self._safe
        (x, y, z), (bx, by, bz) = self._home_m, self._box_m
        if max(xs) - x > bx or x - min(xs) > bx or max(ys) - y > by or y - min(ys) > by:
            return False
        if max(zs) - z > bz or z - min(zs) > bz:
            return False
        xs, ys, zs = xs + _stops(xs, vxs, stop_s), ys + _stops(ys, vys, stop_s), zs + _stops(zs, vzs, stop_s)
        low, high = (min(xs), min(ys), min(zs)), (max(xs), max(ys), max(zs))
        return safe.holds_all(low, high) or all(map(safe.holds, zip(xs, ys, zs, strict=True)))

    def _can_push(self, a: Vec3) -> bool:
        """Return whether tilt and thrust allow an acceleration."""
        up = a[2] + GRAVITY_M_S2
        return math.hypot(a[0], a[1]) <= self._slope * up and math.hypot(a[0], a[1], up) <= self._thrust_m_s2

    def pushed(self, t_s: float, now: State, dt_s: float, push_m_s2: Vec3, lag: Lag | None = None) -> State | None:
        """Return the state a tick later with an acceleration as near to the wanted one as the limits allow; None if only the stop from
        this state respects them.
        """
        (x, y, z), (vx, vy, vz) = push_m_s2, now.velocity_m_s
        share = -BRAKE_M_S2 / (math.hypot(vx, vy, vz) or 1.0)
        brake = (share * vx, share * vy, share * vz)
        tried = [push_m_s2, (0.5 * x, 0.5 * y, 0.5 * z), (0.0, 0.0, z), (brake[0], brake[1], z), brake]
        for push in tried:
            after = self._after(now, dt_s, self.within(push))
            if self.admit(self.stop(t_s, after), lag):
                return after
        return None

    def pushes(
        self, t_s: float, now: State, push_m_s2: Callable[[float], Vec3], step_s: float, count: int
    ) -> list[Vec3]:
        """Return the accelerations that the limits leave of the wanted ones, in steps from now on."""
        found: list[Vec3] = []
        braking: Motion | None = None
        for k in range(count):
            begin_s = t_s + k * step_s
            after = self.pushed(begin_s, now, step_s, push_m_s2(begin_s + 0.5 * step_s))
            if after is not None:
                braking, now = None, after
            else:
                braking = braking or self.stop(begin_s, now)
                now = braking.at(begin_s + step_s)
            found.append(now.acceleration_m_s2)
        return found

    def within(self, a: Vec3) -> Vec3:
        """Return the acceleration within the limits of size and tilt."""
        a = scaled(a, min(1.0, self.acceleration_m_s2 / max(1e-9, math.hypot(*a))))
        aside = min(1.0, 0.999 * self._slope * (a[2] + GRAVITY_M_S2) / max(1e-9, math.hypot(a[0], a[1])))
        return (aside * a[0], aside * a[1], a[2])

    def _after(self, s: State, dt_s: float, push_m_s2: Vec3) -> State:
        """Return the state after a tick whose constant jerk, within its limit, leads to an acceleration."""
        j = scaled(_plus(push_m_s2, s.acceleration_m_s2, -1.0), 1.0 / dt_s)
        j = scaled(j, min(1.0, self._jerk_m_s3 / max(1e-9, math.hypot(*j))))
        v, a = s.velocity_m_s, s.acceleration_m_s2
        return State(
            _plus(_plus(_plus(s.position_m, v, dt_s), a, dt_s**2 / 2.0), j, dt_s**3 / 6.0),
            _plus(_plus(v, a, dt_s), j, dt_s**2 / 2.0),
            _plus(a, j, dt_s),
            j,
        )

    def stop(self, t_s: float, begin: State) -> Motion:
        """Return a stop that needs half of the acceleration that the mission allows if the reference does not accelerate, or less."""
        duration_s = max(STOP_LEAST_S, 3.0 * math.hypot(*begin.velocity_m_s) / self.acceleration_m_s2)
        return motion_to(t_s, begin, duration_s, None)


def _pieces(m: Motion) -> Iterator[Motion]:
    h = m.duration_s / PIECES
    for k in range(PIECES):
        begin = m.at(m.start_s + k * h)
        yield Motion(m.start_s, h, begin, m.alpha, _plus(m.beta, m.alpha, k * h), begin.jerk_m_s3)


def _coefficients(
    h: float, p: float, v: float, a: float, gamma: float, beta: float, alpha: float
) -> tuple[list[float], list[float], list[float], list[float]]:
    """Return the Bernstein coefficients of position, velocity, acceleration and jerk along one axis."""
    jerks = [gamma, gamma + 0.5 * h * beta, gamma + h * beta + 0.5 * h * h * alpha]
    pushes = _integrated(a, jerks, h / 3.0)
    speeds = _integrated(v, pushes, h / 4.0)
    return _integrated(p, speeds, h / 5.0), speeds, pushes, jerks


def _integrated(first: float, rates: list[float], h: float) -> list[float]:
    """Return the Bernstein coefficients of an integral from those of the integrand, with `h` the duration divided by the degree."""
    sums = [first]
    for rate in rates:
        first += h * rate
        sums.append(first)
    return sums


def _stops(places: list[float], speeds: list[float], stop_s: float) -> list[float]:
    """Return the coefficients of the places that a velocity brings a motion to in a time: first, the velocity in those of degree 5."""
    a, b, c, d, e = speeds
    raised = (
        a,
        0.2 * a + 0.8 * b,
        0.4 * b + 0.6 * c,
        0.6 * c + 0.4 * d,
        0.8 * d + 0.2 * e,
        e,
    )
    return [place + stop_s * speed for place, speed in zip(places, raised, strict=True)]


def _plus(a: Vec3, b: Vec3, k: float) -> Vec3:
    return (a[0] + k * b[0], a[1] + k * b[1], a[2] + k * b[2])
