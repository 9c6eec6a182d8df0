"""Measures the delay of motion capture from taps on the airframe, by comparison with the IMU. Pure functions.

A tap moves the vehicle too little to differentiate motion capture twice: its noise of 0.2 mm gives 20 m/s^2 at 200 Hz. Therefore
the IMU is integrated. Around each tap the specific force is rotated into the world and integrated twice, the gyro once. Position
and rotation measured by motion capture are regressed on the result, shifted by a delay, and on a polynomial for slow changes:
initial values, gravity, bias, the sway of the hand. The residual is smallest at the delay; a parabola through the minimum resolves
it below the sample period, and its curvature gives the error. IMU samples are on the companion's clock, and poses are stamped on
arrival at the companion.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from itertools import pairwise
from typing import Final

import numpy as np
from numpy.typing import NDArray

from companion.model.constants import GRAVITY_M_S2
from companion.model.frames import quat_conjugate, quat_multiply, quat_rotate
from companion.model.types import Quat
from companion.preflight.hand_test.motion import ImuAt, PoseAt, mean_attitude, rotation_vector, turned

Floats = NDArray[np.float64]

DELAY_SPAN_S: Final = (-0.020, 0.150)
TAPS_MIN: Final = 5
STRENGTH_MIN_M_S2: Final = 1.5
"""Minimum peak of the specific force without its slow part."""
NOISE_FACTOR: Final = 7.0
"""Minimum ratio of a tap's strength to the IMU's noise."""
CORRELATION_MIN: Final = 0.5
TAP_ERROR_MAX_S: Final = 0.004
"""Largest standard error of a usable tap's delay."""
ERROR_MAX_S: Final = 0.0015
"""Largest accepted standard error of the result."""
BEFORE_S, AFTER_S = 0.08, 0.16
"""Window around a tap in which motion capture is compared."""
SETTLE_S: Final = 0.35
"""Time after a tap until all its data have arrived, delay included."""
APART_S: Final = 0.45
_SLOW_S: Final = 0.10
"""Half the width of the moving mean that separates the slow part."""
_COARSE_S, _FINE_S = 0.004, 0.0005
_POLYNOMIAL_POSITION, _POLYNOMIAL_ROTATION = 3, 1
_GRAVITY: Final = np.array([0.0, 0.0, GRAVITY_M_S2])


@dataclass(frozen=True, slots=True)
class Tap:
    """One tap as the IMU measured it."""

    t_s: float
    strength_m_s2: float


@dataclass(frozen=True, slots=True)
class TapDelay:
    """Delay of motion capture measured with one tap."""

    tap: Tap
    delay_s: float
    """Time from exposure, according to PX4's clock, to the arrival of the pose at the companion."""
    error_s: float
    """Standard error from the curvature of the residual."""
    correlation: float
    """Correlation without the slow part; 1 if the shifted IMU data match all of the motion."""
    problem: str
    """Why the tap is not used; empty if it is used."""


@dataclass(frozen=True, slots=True)
class Delay:
    """Delay of motion capture as the mean of all usable taps."""

    delay_s: float
    error_s: float
    """Standard error of the mean."""
    spread_s: float
    """Standard deviation from tap to tap."""
    used: tuple[TapDelay, ...]


def find_taps(imu: Sequence[ImuAt]) -> list[Tap]:
    """Return the taps in order of time: peaks of the specific force that are strong and `APART_S` from stronger ones."""
    if len(imu) < 100:
        return []
    t = np.array([sample.t_s for sample in imu])
    force = np.array([sample.force_m_s2 for sample in imu])
    fast = np.linalg.norm(force - _moving_mean(t, force), axis=1)
    quiet = float(np.median(fast))
    least = max(STRENGTH_MIN_M_S2, NOISE_FACTOR * quiet)
    taps: list[Tap] = []
    for index in np.argsort(-fast):
        at_s, strength = float(t[index]), float(fast[index])
        if strength < least:
            break
        if any(abs(at_s - tap.t_s) < APART_S for tap in taps):
            continue
        taps.append(Tap(at_s, strength))
    return sorted(taps, key=lambda tap: tap.t_s)


def measure_tap(tap: Tap, imu: Sequence[ImuAt], poses: Sequence[PoseAt], noise: tuple[float, float]) -> TapDelay:
    """Measure the delay from one tap.

    Args:
        imu: samples in order of time.
        poses: poses in order of arrival.
        noise: noise of motion capture per axis, one sigma, m and rad (`mocap_noise`).
    """
    low, high = DELAY_SPAN_S
    felt = [s for s in imu if tap.t_s - BEFORE_S - high - 0.05 <= s.t_s <= tap.t_s + AFTER_S - low + 0.05]
    seen = [p for p in poses if tap.t_s - BEFORE_S - 0.1 <= p.t_s <= tap.t_s + AFTER_S + high + 0.05]
    rest = [p for p in seen if p.t_s <= tap.t_s - 0.01]
    if len(felt) < 40 or len(rest) < 3 or len(seen) < 15:
        return _unusable(tap, "IMU samples are missing around the tap")
    course = _Course(felt, mean_attitude([pose.attitude for pose in rest[-12:]]))
    delay_s = 0.0
    for step_s, (first_s, last_s) in ((_COARSE_S, DELAY_SPAN_S), (_FINE_S, (0.0, 0.0))):
        if step_s == _FINE_S:
            first_s, last_s = delay_s - 2.0 * _COARSE_S, delay_s + 2.0 * _COARSE_S
        grid = np.arange(first_s, last_s + 0.5 * step_s, step_s)
        # The coarse search covers every possible delay, the fine one the neighbourhood of the best.
        centre_s = tap.t_s + (delay_s if step_s == _FINE_S else 0.0)
        until_s = centre_s + AFTER_S + (high if step_s == _COARSE_S else 0.0)
        window = [pose for pose in seen if centre_s - BEFORE_S <= pose.t_s <= until_s]
        if len(window) < 12:
            return _unusable(tap, "motion capture was lost around the tap")
        costs, nothing, free = course.costs(window, grid, noise)
        best = int(np.argmin(costs))
        if not 0 < best < len(grid) - 1:
            return _unusable(tap, "motion capture shows no similar motion", float(grid[best]))
        delay_s, curvature = _vertex(grid, costs, best)
    least = float(costs[best])
    correlation = math.sqrt(max(0.0, 1.0 - least / nothing)) if nothing > 0.0 else 0.0
    scatter = max(1.0, least / free)
    error_s = math.sqrt(2.0 * scatter / curvature) if curvature > 0.0 else math.inf
    problem = ""
    if correlation < CORRELATION_MIN:
        problem = f"too weak: the IMU data match too little of the motion that motion capture measured (correlation {correlation:.2f})"
    elif error_s > TAP_ERROR_MAX_S:
        problem = f"too weak: its time is known only to within {1e3 * error_s:.1f} ms"
    return TapDelay(tap=tap, delay_s=delay_s, error_s=error_s, correlation=correlation, problem=problem)


def _unusable(tap: Tap, problem: str, delay_s: float = 0.0) -> TapDelay:
    return TapDelay(tap=tap, delay_s=delay_s, error_s=math.inf, correlation=0.0, problem=problem)


def agreeing(taps: Sequence[TapDelay]) -> list[TapDelay]:
    """Return the usable taps whose delays agree."""
    good = [tap for tap in taps if not tap.problem]
    if not good:
        return []
    middle = float(np.median([tap.delay_s for tap in good]))
    scale = 1.4826 * float(np.median([abs(tap.delay_s - middle) for tap in good]))
    return [tap for tap in good if abs(tap.delay_s - middle) <= max(0.0015, 3.5 * scale)]


def combine(taps: Sequence[TapDelay]) -> Delay | str:
    """Return the mean delay of all usable taps that agree, or the reason why there is none."""
    good = agreeing(taps)
    if len(good) < TAPS_MIN:
        weak = [tap.problem for tap in taps if tap.problem]
        why = f"; {len(weak)} are unusable, the last: {weak[-1]}" if weak else ""
        return f"{len(good)} of {len(taps)} taps are usable, expected {TAPS_MIN}{why}"
    values = np.array([tap.delay_s for tap in good])
    spread_s = float(values.std(ddof=1))
    error_s = spread_s / math.sqrt(len(good))
    if error_s > ERROR_MAX_S:
        return (
            f"the taps differ by {1e3 * spread_s:.1f} ms (standard deviation), so the mean is known only to within "
            f"{1e3 * error_s:.1f} ms; expected {1e3 * ERROR_MAX_S:g} ms"
        )
    return Delay(float(values.mean()), error_s, spread_s, tuple(good))


def mocap_noise(poses: Sequence[PoseAt]) -> tuple[float, float]:
    """Return the noise per axis (one sigma, m and rad), estimated from third differences, which motion hardly affects.

    Args:
        poses: at least 20 consecutive poses.
    """
    p = np.array([pose.position_m for pose in poses])
    turns = np.array(
        [rotation_vector(quat_multiply(quat_conjugate(a.attitude), b.attitude)) for a, b in pairwise(poses)]
    )
    third, second = np.diff(p, 3, axis=0), np.diff(turns, 2, axis=0)
    # Third differences of white noise have a variance of 20; the median tolerates a few taps.
    sigma = [float(np.median(np.abs(values))) / 0.6745 / math.sqrt(20.0) for values in (third, second)]
    return max(sigma[0], 1e-6), max(sigma[1], 1e-6)


class _Course:
    """Position and rotation integrated from the IMU, at any time between its samples."""

    def __init__(self, imu: Sequence[ImuAt], start: Quat) -> None:
        self._start = start
        self._t = np.array([sample.t_s for sample in imu])
        q = start
        p, v, r = np.zeros(3), np.zeros(3), np.zeros(3)
        places, speeds, pulls = [p], [v], []
        turns, rates = [r], []
        for before, now in pairwise(imu):
            # A sample is the mean since the previous one, because PX4 integrates.
            dt = now.t_s - before.t_s
            half = turned(q, now.rate_rad_s, 0.5 * dt)
            a = np.array(quat_rotate(half, now.force_m_s2)) - _GRAVITY
            rate = np.array(quat_rotate(quat_multiply(quat_conjugate(start), half), now.rate_rad_s))
            pulls.append(a)
            rates.append(rate)
            p = p + v * dt + 0.5 * a * dt * dt
            v = v + a * dt
            r = r + rate * dt
            q = turned(q, now.rate_rad_s, dt)
            places.append(p)
            speeds.append(v)
            turns.append(r)
        self._p, self._v, self._a = np.array(places), np.array(speeds), np.array([*pulls, pulls[-1]])
        self._r, self._w = np.array(turns), np.array([*rates, rates[-1]])

    def costs(self, window: Sequence[PoseAt], delays: Floats, noise: tuple[float, float]) -> tuple[Floats, float, int]:
        """Return the residual for each delay in units of the noise, the residual without the IMU, and the degrees of freedom."""
        t = np.array([pose.t_s for pose in window])
        s = (t - t[0]) / (t[-1] - t[0])
        place = np.array([pose.position_m for pose in window])
        back = quat_conjugate(self._start)
        turn = np.array([rotation_vector(quat_multiply(back, pose.attitude)) for pose in window])
        slow_p, slow_r = _slow(s, _POLYNOMIAL_POSITION), _slow(s, _POLYNOMIAL_ROTATION)
        place, turn = (place - slow_p @ (slow_p.T @ place)) / noise[0], (turn - slow_r @ (slow_r.T @ turn)) / noise[1]
        nothing = float((place**2).sum() + (turn**2).sum())
        free = 3 * (len(t) - slow_p.shape[1]) + 3 * (len(t) - slow_r.shape[1]) - 3
        costs = []
        for delay_s in delays:
            p, r = self._at(t - delay_s)
            cost = 0.0
            for seen, felt, slow, sigma in ((place, p, slow_p, noise[0]), (turn, r, slow_r, noise[1])):
                fast = (felt - slow @ (slow.T @ felt)) / sigma
                power = float((fast**2).sum())
                share = float((fast * seen).sum()) / power if power > 0.0 else 0.0
                # The scales may differ slightly; the signs must agree.
                share = min(1.5, max(0.0, share))
                cost += float(((seen - share * fast) ** 2).sum())
            costs.append(cost)
        return np.array(costs), nothing, free

    def _at(self, t: Floats) -> tuple[Floats, Floats]:
        index = np.clip(np.searchsorted(self._t, t, side="right") - 1, 0, len(self._t) - 2)
        dt = (t - self._t[index])[:, None]
        return self._p[index] + self._v[index] * dt + 0.5 * self._a[index] * dt * dt, self._r[index] + self._w[
            index
        ] * dt


def _slow(s: Floats, degree: int) -> Floats:
    """Return orthonormal columns that span the polynomials up to that degree."""
    return np.linalg.qr(np.vander(2.0 * s - 1.0, degree + 1))[0]


def _vertex(grid: Floats, costs: Floats, best: int) -> tuple[float, float]:
    """Return the position of the minimum and the second derivative of the parabola through the lowest cost and its two neighbours."""
    step = float(grid[1] - grid[0])
    a, b, c = (float(costs[best + k]) for k in (-1, 0, 1))
    bend = a - 2.0 * b + c
    return float(grid[best]) + (0.5 * step * (a - c) / bend if bend > 0.0 else 0.0), bend / (step * step)


def _moving_mean(t: Floats, values: Floats) -> Floats:
    first, last = np.searchsorted(t, t - _SLOW_S), np.searchsorted(t, t + _SLOW_S, side="right")
    total = np.vstack([np.zeros(values.shape[1]), np.cumsum(values, axis=0)])
    mean: Floats = (total[last] - total[first]) / (last - first)[:, None]
    return mean
