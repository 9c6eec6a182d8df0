"""Plans minimum-snap motion of the vehicle: straight lines of the shortest duration, and paths through several points without a stop.

Mellinger and Kumar 2011, Richter et al. 2016. A line from rest to rest is the septic `reference.minimum_snap`. A path is one
linear system for given times of the waypoints; this module also finds those times. The tests compare it with minsnap-trajectories.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from itertools import pairwise
from typing import TYPE_CHECKING

from companion.mission.reference import Septic
from companion.model.types import Vec3

if TYPE_CHECKING:
    import numpy as np
    from numpy.typing import NDArray

PEAK_SPEED = 2.1875
"""Largest f' of `minimum_snap`: 35 / 16, at half time."""
PEAK_ACCELERATION = 84.0 * math.sqrt(5.0) / 25.0
"""Largest |f''|."""
PEAK_JERK = 52.5
"""Largest |f'''|, at half time."""
LEAST_S = 0.2
"""Shortest duration of a line, however short the line is."""
TIME_STEP_S = 1e-3
"""Computed durations are rounded up to a multiple of this."""
_STEPS = (1.25, 1.12, 1.06, 1.03)
"""Factors by which the search for a shorter flight changes one piece's time, coarse ones first."""
_PIECES_FOR_TWO_PASSES = 12
_WORTH = 1e-4
"""A smaller relative gain is ignored, so that rounding errors do not decide."""
_SAMPLES = 150
_MARGIN = 1.001
"""Factor on the largest of `_SAMPLES` samples of a piece, so that the true peak between the samples is covered."""
_DECIMALS = 9
"""Decimal places to which velocities, accelerations and jerks at the waypoints are rounded, so that a replay on another computer,
whose linear algebra differs in the last bit, builds the same plan.
"""
_KNOWN_MAX = 32


@dataclass(frozen=True, slots=True)
class VehicleLimits:
    """Limits of the planned motion of the body's origin."""

    speed_max_m_s: float
    acceleration_max_m_s2: float
    jerk_max_m_s3: float


@dataclass(frozen=True, slots=True)
class Route:
    """A path through points in normalised time, in which a piece takes one unit on average."""

    knots: tuple[float, ...]
    pieces: tuple[tuple[Septic, Septic, Septic], ...]
    """Polynomials of x, y, z of each piece, m, in the time since its first knot."""
    least_scale_s: float
    """Smallest number of seconds per unit of normalised time at which no limit is exceeded."""


def least_line_s(distance_m: float, limits: VehicleLimits) -> float:
    """Return the shortest duration of a straight minimum-snap line from rest to rest, in whole milliseconds."""
    needed_s = max(
        PEAK_SPEED * distance_m / limits.speed_max_m_s,
        math.sqrt(PEAK_ACCELERATION * distance_m / limits.acceleration_max_m_s2),
        (PEAK_JERK * distance_m / limits.jerk_max_m_s3) ** (1.0 / 3.0),
        LEAST_S,
    )
    return _up(needed_s)


_known: dict[tuple[tuple[Vec3, ...], VehicleLimits], Route] = {}


def route(points_m: tuple[Vec3, ...], limits: VehicleLimits) -> Route:
    """Return the minimum-snap path through three or more points, at rest at the first and the last, without a stop at the others.

    The times of the pieces are varied one by one to find the shortest flight within the limits; the result is good, but not provably
    optimal. The search takes tens of milliseconds for a few points and a second for thirty. Results are cached, so a repeated call
    costs nothing in a control tick.

    Args:
        points_m: world frame; no two consecutive points are equal.
        limits: speed, acceleration and jerk, each as the length of the vector.
    """
    key = (points_m, limits)
    found = _known.get(key)
    if found is None:
        found = _solve(points_m, limits)
        while len(_known) >= _KNOWN_MAX:
            _known.pop(next(iter(_known)))
        _known[key] = found
    return found


def _solve(points_m: tuple[Vec3, ...], limits: VehicleLimits) -> Route:
    distances_m = [math.dist(a, b) for a, b in pairwise(points_m)]
    shares = _normalised([math.sqrt(distance) for distance in distances_m])
    best_s = _total_s(points_m, shares, limits)
    passes = 2 if len(shares) <= _PIECES_FOR_TWO_PASSES else 1
    for step in _STEPS:
        for _ in range(passes):
            for index in range(len(shares)):
                for factor in (step, 1.0 / step):
                    tried = _normalised([*shares[:index], shares[index] * factor, *shares[index + 1 :]])
                    total_s = _total_s(points_m, tried, limits)
                    if total_s < best_s * (1.0 - _WORTH):
                        best_s, shares = total_s, tried
                        break
    coefficients = least_snap(points_m, shares)
    return _rebuilt(points_m, shares, coefficients, _up(_needed_s(shares, coefficients, limits) * _MARGIN))


def _total_s(points_m: tuple[Vec3, ...], shares: tuple[float, ...], limits: VehicleLimits) -> float:
    """Return the duration of the whole path when it is flown as fast as the limits allow."""
    return _needed_s(shares, least_snap(points_m, shares), limits) * sum(shares)


def least_snap(points_m: tuple[Vec3, ...], shares: tuple[float, ...]) -> NDArray[np.float64]:
    """Return the path of least snap through the points, at rest at both ends, with `shares` as the durations of its pieces.

    Derivatives 4 to 6 are continuous at each inner point. This gives three equations per point, coupled to its neighbours: a
    block-tridiagonal system, solved in linear time, because the search evaluates hundreds.

    Returns:
        Coefficients [piece, power, axis] in the piece's own time, with the first point as origin.
    """
    import numpy as np

    points = np.asarray(points_m) - np.asarray(points_m[0])
    t = np.asarray(shares)
    count = len(shares)
    powers = np.arange(4)
    scale = t[:, None] ** powers  # of a state, in units of the piece's duration
    to_coefficients = np.array([septic(tuple(row[:4]), tuple(row[4:]), 1.0) for row in np.eye(8)]).T
    high = np.array([[math.perm(k, order) if k >= order else 0 for k in range(8)] for order in (4, 5, 6)], dtype=float)
    at_start = np.where(np.arange(8) == np.array([[4], [5], [6]]), high, 0.0) @ to_coefficients
    at_end = high @ to_coefficients
    states = np.zeros((count + 1, 4, 3))
    states[:, 0] = points
    # Forward elimination: x_i = given_i - after_i x_(i+1), x the velocity, acceleration and jerk at point i.
    after: list[NDArray[np.float64]] = [np.zeros((3, 3))]
    given: list[NDArray[np.float64]] = [np.zeros((3, 3))]
    order = np.arange(4, 7)[:, None]
    for i in range(1, count):
        left = at_end * np.tile(scale[i - 1], 2) / t[i - 1] ** order
        right = at_start * np.tile(scale[i], 2) / t[i] ** order
        lower, diagonal, upper = left[:, 1:4], left[:, 5:] - right[:, 1:4], -right[:, 5:]
        known = -left[:, :1] * points[i - 1] - (left[:, 4:5] - right[:, :1]) * points[i] + right[:, 4:5] * points[i + 1]
        solved = np.linalg.solve(diagonal - lower @ after[-1], np.hstack([upper, known - lower @ given[-1]]))
        after.append(solved[:, :3])
        given.append(solved[:, 3:])
    for i in range(count - 1, 0, -1):
        states[i, 1:] = given[i] - after[i] @ states[i + 1, 1:]
    ends = np.concatenate([states[:-1] * scale[:, :, None], states[1:] * scale[:, :, None]], axis=1)
    coefficients: NDArray[np.float64] = (to_coefficients @ ends) / (t[:, None] ** np.arange(8))[:, :, None]
    return coefficients


def _normalised(shares: Sequence[float]) -> tuple[float, ...]:
    """Return the pieces' times scaled to 1 on average and rounded to thousandths."""
    mean = sum(shares) / len(shares)
    return tuple(max(0.02, round(share / mean, 3)) for share in shares)


def _needed_s(shares: tuple[float, ...], coefficients: NDArray[np.float64], limits: VehicleLimits) -> float:
    """Return the number of seconds that one unit of normalised time must last so that no limit is exceeded."""
    import numpy as np

    allowed = (limits.speed_max_m_s, limits.acceleration_max_m_s2, limits.jerk_max_m_s3)
    times = np.asarray(shares)[:, None] * np.linspace(0.0, 1.0, _SAMPLES + 1)
    powers = times[:, :, None] ** np.arange(coefficients.shape[1])
    derivative = coefficients
    worst = 0.0
    for order, limit in enumerate(allowed, start=1):
        derivative = derivative[:, 1:] * np.arange(1, derivative.shape[1])[:, None]
        squares = ((powers[:, :, : derivative.shape[1]] @ derivative) ** 2).sum(axis=2)
        worst = max(worst, (math.sqrt(float(squares.max())) / limit) ** (1.0 / order))
    return worst


def _rebuilt(
    points_m: tuple[Vec3, ...], shares: tuple[float, ...], coefficients: NDArray[np.float64], scale_s: float
) -> Route:
    """Rebuild the polynomials from the rounded derivatives at the waypoints, so that consecutive pieces meet exactly."""
    rest = (0.0, 0.0, 0.0)
    inner = [
        tuple(
            (
                round(float(piece[1, axis]), _DECIMALS),
                round(2.0 * float(piece[2, axis]), _DECIMALS),
                round(6.0 * float(piece[3, axis]), _DECIMALS),
            )
            for axis in range(3)
        )
        for piece in coefficients[1:]
    ]
    states = [(rest, rest, rest), *inner, (rest, rest, rest)]
    knots = [0.0]
    pieces = []
    for index, share in enumerate(shares):
        knots.append(knots[-1] + share)
        x, y, z = (
            septic(
                (points_m[index][axis], *states[index][axis]),
                (points_m[index + 1][axis], *states[index + 1][axis]),
                share,
            )
            for axis in range(3)
        )
        pieces.append((x, y, z))
    return Route(tuple(knots), tuple(pieces), scale_s)


def septic(start: tuple[float, ...], end: tuple[float, ...], duration: float) -> Septic:
    """Return the polynomial of degree 7 with the given value and first three derivatives at 0 and at `duration`."""
    p0, v0, a0, j0 = start
    p1, v1, a1, j1 = end
    t = duration
    c2, c3 = a0 / 2.0, j0 / 6.0
    # What the end requires beyond the cubic that the start determines, in units of the piece's duration.
    dp = p1 - (p0 + t * (v0 + t * (c2 + t * c3)))
    dv = (v1 - (v0 + t * (a0 + t * j0 / 2.0))) * t
    da = (a1 - (a0 + t * j0)) * t * t
    dj = (j1 - j0) * t * t * t
    t4 = t * t * t * t
    return (
        p0,
        v0,
        c2,
        c3,
        (35.0 * dp - 15.0 * dv + 2.5 * da - dj / 6.0) / t4,
        (-84.0 * dp + 39.0 * dv - 7.0 * da + dj / 2.0) / (t4 * t),
        (70.0 * dp - 34.0 * dv + 6.5 * da - dj / 2.0) / (t4 * t * t),
        (-20.0 * dp + 10.0 * dv - 2.0 * da + dj / 6.0) / (t4 * t * t * t),
    )


def _up(duration_s: float) -> float:
    return math.ceil(duration_s / TIME_STEP_S - 1e-6) * TIME_STEP_S
