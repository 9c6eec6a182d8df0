"""The force-torque sensor of the simulated world, in the fast loop and over its wire."""

from __future__ import annotations

import math
from typing import Any

import numpy as np
import pytest

from companion.io.force_torque import rft
from companion.model.types import Vec3
from companion.sitl_config.effects.force_sensor import ForceSensor as Config
from companion.sitl_config.loader import load_sitl
from sitl.fast.loop import FastFlight
from sitl.force_torque import ForceTorqueServer, overloaded, quantised
from sitl.plant import Plant
from sitl.world.effects.force_sensor import ForceSensor
from tests.sitl.plants import plant_of
from tests.support import SHORT_CATCH

FORCE_N, TORQUE_NM = (8.0, -3.0, 5.0), (0.3, 0.2, -0.4)
PERFECT = Config(
    on=True,
    resolution_n=0.0,
    resolution_nm=0.0,
    cross_talk=0.0,
    mounting_rpy_deg=(0.0, 0.0, 0.0),
    drift_n_per_min=(0.0, 0.0, 0.0),
    temperature_drift_n_per_k=(0.0, 0.0, 0.0),
)


def sensor(seed: int = 1, **changes: Any) -> ForceSensor:
    return ForceSensor(PERFECT.model_copy(update=changes), seed)


def first_reading(seed: int = 1, **changes: Any) -> list[float]:
    """The filter begins with its first input, so that a first reading has no lag."""
    force_n, torque_nm = sensor(seed, **changes).measure(0.0, FORCE_N, TORQUE_NM)
    return [*force_n, *torque_nm]


def test_a_turned_sensor_reads_the_wrench_in_its_own_axes() -> None:
    quarter = first_reading(mounting_rpy_deg=(0.0, 0.0, 90.0))
    assert quarter == pytest.approx([-3.0, -8.0, 5.0, 0.2, -0.3, -0.4], abs=1e-12)
    tilted = first_reading(mounting_rpy_deg=(2.0, 0.0, 0.0))
    c, s = math.cos(math.radians(2.0)), math.sin(math.radians(2.0))
    assert tilted[:3] == pytest.approx([8.0, -3.0 * c + 5.0 * s, 5.0 * c + 3.0 * s], abs=1e-12)


def test_cross_talk_is_a_share_of_the_capacities_and_the_seed_draws_it() -> None:
    columns = []
    for axis in range(6):
        load = [0.0] * 6
        load[axis] = capacity = 200.0 if axis < 3 else 4.0
        (fx, fy, fz), (tx, ty, tz) = load[:3], load[3:]
        force_n, torque_nm = sensor(cross_talk=0.03).measure(0.0, (fx, fy, fz), (tx, ty, tz))
        reading = np.array([*force_n, *torque_nm])
        assert reading[axis] == pytest.approx(capacity)
        columns.append(np.delete(reading / np.repeat((200.0, 4.0), 3), axis))
    shares = np.abs(columns)
    assert 0.02 < shares.max() <= 0.03
    assert shares.min() < 0.01
    assert first_reading(1, cross_talk=0.03) == first_reading(1, cross_talk=0.03)
    assert first_reading(1, cross_talk=0.03) != first_reading(2, cross_talk=0.03)


def test_the_zero_drifts_with_time_and_with_the_warm_up() -> None:
    drifting = sensor(drift_n_per_min=(0.3, 0.0, 0.0), temperature_drift_n_per_k=(0.0, 0.0, -0.1), warm_up_k=10.0)
    none = (0.0, 0.0, 0.0)
    assert drifting.measure(0.0, none, none) == (none, none)
    after_s = 300.0
    force_n, torque_nm = drifting.measure(after_s, none, none)
    warm_n = -0.1 * 10.0 * (1.0 - math.exp(-1.0))
    assert force_n == pytest.approx((1.5, 0.0, warm_n), abs=1e-9)
    assert torque_nm == pytest.approx((0.02 * 1.5, 0.0, 0.02 * warm_n), abs=1e-9)


@pytest.mark.parametrize("period_s", [0.002, 0.005])
def test_a_step_passes_a_first_order_low_pass(period_s: float) -> None:
    filtered = sensor(filter_hz=10.0)
    none = (0.0, 0.0, 0.0)
    filtered.measure(0.0, none, none)
    for k in range(1, round(0.02 / period_s) + 1):
        force_n, _ = filtered.measure(k * period_s, (1.0, 0.0, 0.0), none)
    assert force_n[0] == pytest.approx(1.0 - math.exp(-math.tau * 10.0 * 0.02))


def test_readings_come_in_steps_of_the_resolution() -> None:
    force_n, torque_nm = sensor(resolution_n=0.2, resolution_nm=0.008).rounded((0.31, -0.09, 5.0), (0.013, 0.0, -0.3))
    assert force_n == pytest.approx((0.4, 0.0, 5.0))
    assert torque_nm == pytest.approx((0.016, 0.0, -0.304))


@pytest.mark.parametrize(
    "wrench", [((1.2345, -0.011, 3.0), (0.00026, -1.23456, 0.0)), ((0.0, -201.0, 0.0), (0.0, 4.1, 0.0))]
)
def test_the_fast_loop_reads_the_counts_of_the_wire(wrench: tuple[Vec3, Vec3]) -> None:
    server = ForceTorqueServer()
    server.set_wrench(*wrench)
    measured = server._measure()
    arrived = rft.decode_wrench(rft.encode_wrench(rft.Command.START, measured)[1:])
    assert quantised(*wrench) == (arrived.force_n, arrived.torque_nm)
    assert overloaded(*wrench) is bool(arrived.overload_bits)


def quiet(*overrides: str) -> Plant:
    config = load_sitl(SHORT_CATCH, overrides=("world.force_noise_n=0", "world.force_bias_n=[0,0,0]", *overrides))
    return plant_of(config)


def test_the_scale_multiplies_what_both_loops_read() -> None:
    plain, scaled = quiet(), quiet("world.force_scale=1.05")
    for true, read in zip(plain.force_torque(), scaled.force_torque(), strict=True):
        assert any(true)
        assert read == pytest.approx([1.05 * value for value in true])
    config = load_sitl(
        SHORT_CATCH, overrides=("world.force_scale=1.05", "world.force_noise_n=0", "world.force_bias_n=[0,0,40]")
    )
    sample = FastFlight(config).run(limit_s=0.55).inputs[-1].force
    assert sample is not None
    assert sample.force_sensor_n[2] == pytest.approx(42.0, abs=1.0)
