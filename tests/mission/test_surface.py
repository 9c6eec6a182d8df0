"""The plane through touched points."""

from __future__ import annotations

import math
from random import Random

import pytest

from companion.model.types import Vec3
from companion.phases.contact.surface import plane

AHEAD: Vec3 = (1.0, 0.0, 0.0)


def touched(lean: float, noise_m: float, seed: int = 1) -> list[Vec3]:
    """Return 3 x 3 points 12 cm apart on a wall at x = 1.5 m, farther away by `lean` times their height."""
    draw = Random(seed)
    return [
        (1.5 + lean * 0.12 * row + draw.gauss(0.0, noise_m), 0.12 * column, 1.0 + 0.12 * row)
        for row in (-1, 0, 1)
        for column in (-1, 0, 1)
    ]


def test_the_plane_through_exact_points() -> None:
    found = plane(touched(0.2, 0.0), AHEAD, 0.0)
    assert found is not None
    assert found.point_world_m == pytest.approx((1.5, 0.0, 1.0))
    length = math.hypot(1.0, 0.2)
    assert found.normal_world == pytest.approx((-1.0 / length, 0.0, 0.2 / length))


def test_the_radius_of_the_tip_is_added_along_the_normal() -> None:
    found = plane(touched(0.0, 0.0), AHEAD, 0.02)
    assert found is not None
    assert found.point_world_m == pytest.approx((1.52, 0.0, 1.0))


@pytest.mark.parametrize("feigned", [0, 4, 8])
def test_a_touch_that_a_gust_feigned_in_front_of_the_surface_is_left_out(feigned: int) -> None:
    for seed in range(20):
        points = touched(0.1, 0.001, seed)
        x, y, z = points[feigned]
        points[feigned] = (x - 0.015, y, z)
        found = plane(points, AHEAD, 0.0)
        assert found is not None
        (px, py, pz), (nx, ny, nz) = found.point_world_m, found.normal_world
        assert abs(px + (py * ny + (pz - 1.0) * nz) / nx - 1.5) < 0.0014
        true = (-1.0 / math.hypot(1.0, 0.1), 0.0, 0.1 / math.hypot(1.0, 0.1))
        assert math.degrees(math.acos(min(1.0, nx * true[0] + ny * true[1] + nz * true[2]))) < 1.2


def test_points_behind_the_others_stay() -> None:
    """Nothing feigns a touch behind a surface: it is not flat."""
    points = touched(0.0, 0.0)
    x, y, z = points[4]
    points[4] = (x + 0.018, y, z)
    found = plane(points, AHEAD, 0.0)
    assert found is not None
    assert found.point_world_m[0] == pytest.approx(1.502)


def test_three_points_all_count() -> None:
    found = plane([(1.5, -0.1, 1.0), (1.48, 0.1, 1.0), (1.5, 0.0, 1.2)], AHEAD, 0.0)
    assert found is not None
    assert found.point_world_m[0] == pytest.approx((1.5 + 1.48 + 1.5) / 3.0)


def test_a_plane_that_is_too_steep_is_rejected() -> None:
    assert plane(touched(0.7, 0.0), AHEAD, 0.0) is None
    assert plane([(1.5, 0.0, 1.0), (1.5, 0.1, 1.0), (1.5, 0.2, 1.0)], AHEAD, 0.0) is None
