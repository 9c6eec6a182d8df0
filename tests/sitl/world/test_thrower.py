"""The scatter of a person's throws."""

from __future__ import annotations

import math

import numpy as np
import pytest

from companion.model.types import Vec3
from companion.sitl_config.effects.thrower import Thrower as ThrowerConfig
from sitl.world.effects.thrower import Thrower

POINT: Vec3 = (0.9, -0.07, 0.7)
VELOCITY: Vec3 = (-2.0, 0.15, 2.9)
FLIGHT_S = 0.45
EXACT = ThrowerConfig(on=True, speed_error=0.0, direction_error_deg=0.0, release_error_m=0.0, prediction_error_s=0.0)


def test_a_person_without_errors_throws_exactly() -> None:
    point, velocity = Thrower(EXACT, 1).release(POINT, VELOCITY, FLIGHT_S)
    assert point == POINT
    assert velocity == pytest.approx(VELOCITY, rel=1e-12)


def test_each_throw_is_drawn_anew_and_the_seed_repeats_them() -> None:
    first, again, other = (Thrower(ThrowerConfig(on=True), seed) for seed in (1, 1, 2))
    throws = [first.release(POINT, VELOCITY, FLIGHT_S) for _ in range(3)]
    assert throws == [again.release(POINT, VELOCITY, FLIGHT_S) for _ in range(3)]
    assert len(set(throws)) == 3
    assert other.release(POINT, VELOCITY, FLIGHT_S) not in throws


def test_the_arrival_scatters_as_speed_and_direction_do() -> None:
    thrower = Thrower(ThrowerConfig(on=True), 1)
    draws = [thrower.release(POINT, VELOCITY, FLIGHT_S) for _ in range(2000)]
    points, velocities = (np.array(column) for column in zip(*draws, strict=True))
    error = points + velocities * FLIGHT_S - (np.array(POINT) + np.array(VELOCITY) * FLIGHT_S)
    path_m = math.hypot(*VELOCITY) * FLIGHT_S
    along = np.array(VELOCITY) / math.hypot(*VELOCITY)
    aside = np.cross([0.0, 0.0, 1.0], along)
    aside /= np.linalg.norm(aside)
    assert np.std(error @ along) == pytest.approx(0.02 * path_m, rel=0.1)
    assert np.std(error @ aside) == pytest.approx(math.radians(1.3) * path_m, rel=0.1)
    assert np.std(error @ np.cross(along, aside)) == pytest.approx(math.radians(1.3) * path_m, rel=0.1)
    assert np.linalg.norm(error.mean(axis=0)) < 0.005
    assert np.std(points, axis=0) == pytest.approx([0.05] * 3, rel=0.1)


def test_the_scatter_multiplies_every_error() -> None:
    skilled, careless = (Thrower(ThrowerConfig(on=True, scatter=scatter), 1) for scatter in (1.0, 1e-3))
    assert careless.prediction_error_s() == pytest.approx(1e-3 * skilled.prediction_error_s())
    release, small = (np.array(thrower.release(POINT, VELOCITY, FLIGHT_S)) for thrower in (skilled, careless))
    exact = np.array((POINT, VELOCITY))
    assert np.abs(small - exact).max() < 2e-3 * np.abs(release - exact).max()
