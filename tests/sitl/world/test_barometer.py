"""The barometer against its closed form: wake, drift and noise."""

from __future__ import annotations

import math
import statistics
from itertools import pairwise

import pytest

from companion.sitl_config.effects.barometer import Barometer as BarometerConfig
from sitl.world.effects.barometer import PERIOD_S, Barometer

HOVER_N, REST_M, FADE_M = 30.0, 0.3, 0.325
WAKE = BarometerConfig(on=True, hover_m=0.5, floor_m=-1.0, drift_m=0.0, noise_m=0.0)


def barometer(config: BarometerConfig) -> Barometer:
    return Barometer(config, HOVER_N, REST_M, FADE_M, 1)


@pytest.mark.parametrize(
    ("config", "height_m", "thrust_n", "expected_m"),
    [
        (BarometerConfig(), 1.0, HOVER_N, 1.0),
        (WAKE, REST_M, 0.0, REST_M),
        (WAKE, REST_M, HOVER_N, REST_M - 0.5),
        (WAKE, REST_M + FADE_M, HOVER_N, REST_M + FADE_M + 0.5 - math.exp(-1.0)),
        (WAKE, 10.0, 0.5 * HOVER_N, 10.25),
    ],
    ids=["off", "rotors-off", "on-the-floor", "one-arm-high", "high-with-half-thrust"],
)
def test_the_wake_moves_the_height(
    config: BarometerConfig, height_m: float, thrust_n: float, expected_m: float
) -> None:
    assert barometer(config).measure(height_m, thrust_n) == pytest.approx(expected_m, abs=1e-6)


def test_drift_and_noise_have_the_configured_size_and_start_again_at_zero() -> None:
    sensor = barometer(BarometerConfig(on=True, drift_m=0.5, drift_time_s=1.0, noise_m=0.1))
    first = sensor.measure(1.0, 0.0)
    errors = [sensor.measure(1.0, 0.0) - 1.0 for _ in range(round(2000.0 / PERIOD_S))]
    steps = [b - a for a, b in pairwise(errors)]
    assert statistics.pstdev(errors) == pytest.approx(math.hypot(0.5, 0.1), rel=0.1)
    assert statistics.pstdev(steps) == pytest.approx(math.sqrt(2 * 0.1**2 + 2 * 0.5**2 * PERIOD_S), rel=0.1)
    sensor.restart()
    assert sensor.measure(1.0, 0.0) == first
