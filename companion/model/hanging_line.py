"""Computes the shape of a slack line between two points, for drawings of the tether (world frame, z up, metres)."""

from __future__ import annotations

import math

from companion.model.types import Vec3

_POINTS = 13
_SAG_STEPS = 12
"""Number of bisection steps; the error of the sag is below 1/4000 of the line's length."""
_LEVEL_MIN_M = 0.02
"""Smallest horizontal distance between the ends with which the sag is computed."""


def hanging_line_m(anchor: Vec3, end: Vec3, length_m: float, floor_m: float | None = None) -> list[Vec3]:
    """Return 13 points of a line of a given length that sags in a parabola between two points.

    Points below the height `floor_m` are moved up to it. A line that is too short to connect the two points is drawn straight.
    """
    ax, ay, az = anchor
    dx, dy, dz = end[0] - ax, end[1] - ay, end[2] - az
    sag_m = _sag_m(math.hypot(dx, dy), dz, length_m)
    points: list[Vec3] = []
    for k in range(_POINTS):
        u = k / (_POINTS - 1)
        z = az + u * (dz - 4.0 * sag_m * (1.0 - u))
        if floor_m is not None and z < floor_m:
            z = floor_m
        points.append((ax + u * dx, ay + u * dy, z))
    return points


def _sag_m(level_m: float, rise_m: float, length_m: float) -> float:
    """Return how far the middle of the parabola lies below the middle of its chord.

    The parabola z(u) = rise u - 4 sag u (1 - u), u = 0 to 1 over the horizontal distance h, has the slopes m0 = (rise - 4 sag) / h and
    m1 = (rise + 4 sag) / h at its ends. Its length is h^2 / (8 sag) (F(m1) - F(m0)) with F(m) = (m sqrt(1 + m^2) + asinh m) / 2.
    """
    h = max(level_m, _LEVEL_MIN_M)
    if length_m * length_m <= h * h + rise_m * rise_m:
        return 0.0
    low, high = 0.0, length_m
    for _ in range(_SAG_STEPS):
        sag = 0.5 * (low + high)
        m0, m1 = (rise_m - 4.0 * sag) / h, (rise_m + 4.0 * sag) / h
        arc = (
            h * h / (16.0 * sag)
            * (m1 * math.sqrt(1.0 + m1 * m1) + math.asinh(m1) - m0 * math.sqrt(1.0 + m0 * m0) - math.asinh(m0))
        )  # fmt: skip
        if arc < length_m:
            low = sag
        else:
            high = sag
    return 0.5 * (low + high)
