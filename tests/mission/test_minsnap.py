"""Minimum-snap motion: smooth through its points, as the library has it, within its limits, in no more time than needed."""

from __future__ import annotations

import math

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from numpy.polynomial import Polynomial

from companion.mission.minsnap import (
    PEAK_ACCELERATION,
    PEAK_JERK,
    PEAK_SPEED,
    VehicleLimits,
    least_line_s,
    least_snap,
    route,
)
from companion.mission.reference import Curve, minimum_snap
from companion.model.types import Vec3

LIMITS = VehicleLimits(0.8, 1.0, 4.0)
limit = st.floats(0.2, 5.0)
limits_of_any_kind = st.builds(VehicleLimits, limit, limit, st.floats(0.5, 20.0))
length = st.floats(-3.0, 3.0)

costly = settings(max_examples=25)
"""One example solves and samples a whole path."""


@st.composite
def ways(draw: st.DrawFn) -> tuple[Vec3, ...]:
    """Three to six points, none where the one before it is."""
    points: list[Vec3] = [draw(st.tuples(length, length, length))]
    for _ in range(draw(st.integers(2, 5))):
        point = draw(st.tuples(length, length, length).filter(lambda p: math.dist(p, points[-1]) > 0.05))
        points.append(point)
    return tuple(points)


def curve(points_m: tuple[Vec3, ...], limits: VehicleLimits) -> Curve:
    way = route(points_m, limits)
    duration_s = way.knots[-1] * way.least_scale_s
    return Curve(
        start_s=1.0,
        duration_s=duration_s,
        scale_s=way.least_scale_s,
        knots=way.knots,
        pieces=way.pieces,
        end=points_m[-1],
    )


@costly
@given(ways(), limits_of_any_kind)
def test_a_path_passes_its_points_with_four_continuous_derivatives(
    points_m: tuple[Vec3, ...], limits: VehicleLimits
) -> None:
    way = route(points_m, limits)
    pieces = [[Polynomial(axis) for axis in piece] for piece in way.pieces]
    size = max(abs(np.array(way.pieces)).max(), 1.0)
    for index, piece in enumerate(pieces):
        share = way.knots[index + 1] - way.knots[index]
        assert [axis(0.0) for axis in piece] == pytest.approx(points_m[index])
        assert [axis(share) for axis in piece] == pytest.approx(points_m[index + 1], abs=1e-9 * size)
        if index + 1 < len(pieces):
            for order in range(1, 5):
                jump = [
                    axis.deriv(order)(share) - after.deriv(order)(0.0)
                    for axis, after in zip(piece, pieces[index + 1], strict=True)
                ]
                scale = 1.0 + max(abs(axis.deriv(order)(share)) for axis in piece) + size
                shortest = min(share, way.knots[index + 2] - way.knots[index + 1], 1.0)
                assert np.abs(jump).max() < 1e-6 * scale / shortest**order, (
                    "beyond the rounding of the waypoints' derivatives"
                )
    for end, at in ((pieces[0], 0.0), (pieces[-1], way.knots[-1] - way.knots[-2])):
        for order in range(1, 4):
            assert [axis.deriv(order)(at) for axis in end] == pytest.approx([0.0] * 3, abs=1e-6 * size)


@costly
@given(ways(), limits_of_any_kind)
def test_a_path_without_a_duration_uses_its_limits_and_keeps_them(
    points_m: tuple[Vec3, ...], limits: VehicleLimits
) -> None:
    flown = curve(points_m, limits)
    allowed = (limits.speed_max_m_s, limits.acceleration_max_m_s2, limits.jerk_max_m_s3)
    used = [0.0, 0.0, 0.0]
    for index in range(2000):
        sample = flown.at(flown.start_s + flown.duration_s * index / 2000)
        for order in range(3):
            used[order] = max(used[order], math.hypot(*sample[order + 1]) / allowed[order])
    assert max(used) <= 1.0
    assert max(used) >= 0.98, "slower than it must be"


@costly
@given(ways())
def test_a_path_is_the_one_that_minsnap_trajectories_finds(points_m: tuple[Vec3, ...]) -> None:
    # Here, not above: every worker reads this file, one needs the library, and SciPy with it.
    from minsnap_trajectories import Waypoint, generate_trajectory

    shares = tuple(0.3 + 0.17 * index for index in range(len(points_m) - 1))
    rest = np.zeros(3)
    at_rest = {"velocity": rest, "acceleration": rest, "jerk": rest}
    waypoints = [
        Waypoint(sum(shares[:k]), np.subtract(point, points_m[0]), **(at_rest if k in (0, len(shares)) else {}))
        for k, point in enumerate(points_m)
    ]
    found = generate_trajectory(waypoints, degree=7, idx_minimized_orders=4, num_continuous_orders=4).coefficients
    assert np.abs(least_snap(points_m, shares) - found).max() < 1e-6 * (1.0 + np.abs(found).max())


def test_peaks_of_a_line_are_as_stated() -> None:
    shapes = [minimum_snap(index / 20000) for index in range(20001)]
    peaks = [max(abs(shape[order]) for shape in shapes) for order in (1, 2, 3)]
    assert peaks == pytest.approx([PEAK_SPEED, PEAK_ACCELERATION, PEAK_JERK], rel=1e-6)


@pytest.mark.parametrize(
    ("distance_m", "limits", "duration_s"),
    [
        (2.0, VehicleLimits(0.5, 10.0, 100.0), PEAK_SPEED * 2.0 / 0.5),
        (2.0, VehicleLimits(10.0, 0.5, 100.0), math.sqrt(PEAK_ACCELERATION * 2.0 / 0.5)),
        (2.0, VehicleLimits(10.0, 10.0, 0.5), (PEAK_JERK * 2.0 / 0.5) ** (1 / 3)),
        (0.0, LIMITS, 0.2),
    ],
    ids=["speed", "acceleration", "jerk", "nowhere"],
)
def test_a_line_takes_what_its_tightest_limit_needs(
    distance_m: float, limits: VehicleLimits, duration_s: float
) -> None:
    assert duration_s <= least_line_s(distance_m, limits) + 1e-8 <= duration_s + 0.001


def test_time_is_allocated_by_need() -> None:
    """A short first leg and a long one: equal times would make the long one set the pace."""
    points: tuple[Vec3, ...] = ((-2.0, 0.0, 1.0), (-1.9, 0.05, 1.0), (1.5, 0.0, 1.0), (1.6, 0.2, 1.0))
    way = route(points, LIMITS)
    shares = [after - before for before, after in zip(way.knots, way.knots[1:], strict=False)]
    assert shares[1] > 2.0 * max(shares[0], shares[2])
    assert way.knots[-1] * way.least_scale_s < 9.0
