"""Errors of the IMU against their closed forms."""

from __future__ import annotations

import math
import statistics
from typing import Any

import pytest

from companion.model.rotors import standard_layout
from companion.model.types import Vec3, Vec4
from companion.sitl_config.effects.imu import Imu
from companion.sitl_config.loader import load_sitl
from sitl.world.effects.imu import ImuErrors
from sitl.world.noise import noise
from tests.sitl.plants import plant_of
from tests.support import CATCH

G = 9.81
LAYOUT = standard_layout("quad_x", 0.325, 0.03)
NOTHING: dict[str, Any] = {
    "accel_bias_m_s2": (0.0, 0.0, 0.0),
    "accel_drift_m_s2": 0.0,
    "gyro_bias_deg_s": (0.0, 0.0, 0.0),
    "gyro_drift_deg_s": 0.0,
    "mount_rpy_deg": (0.0, 0.0, 0.0),
    "vibration_m_s2": 0.0,
    "gyro_vibration_deg_s": 0.0,
    "rotor_spread": 0.0,
    "rectification_m_s2": (0.0, 0.0, 0.0),
}
STILL: tuple[Vec3, Vec3] = ((0.0, 0.0, 0.0), (0.0, 0.0, G))
HOVER: Vec4 = (1.0, 1.0, 1.0, 1.0)
STOPPED: Vec4 = (0.0, 0.0, 0.0, 0.0)


def errors(interval_s: float = 0.004, **settings: Any) -> ImuErrors:
    return ImuErrors(Imu(on=True, **{**NOTHING, **settings}), interval_s, 1.0, LAYOUT)


def test_biases_appear_in_px4s_axes() -> None:
    config = load_sitl(CATCH, overrides=["world.gyro_noise_rad_s=0", "world.accel_noise_m_s2=0"])
    settings = {**NOTHING, "accel_bias_m_s2": (0.1, 0.2, 0.3), "gyro_bias_deg_s": (1.0, 2.0, 3.0)}
    world = config.world.model_copy(update={"imu": Imu(on=True, **settings)})
    samples = []
    for this in (config.world, world):
        plant = plant_of(config.model_copy(update={"world": this}))
        for _ in range(200):
            plant.step(False)
        samples.append(plant.sample_imu())
    ideal, real = samples
    accel = [b - a for a, b in zip(ideal.accel_frd_m_s2, real.accel_frd_m_s2, strict=True)]
    gyro = [math.degrees(b - a) for a, b in zip(ideal.gyro_frd_rad_s, real.gyro_frd_rad_s, strict=True)]
    assert accel == pytest.approx([0.1, -0.2, -0.3])
    assert gyro == pytest.approx([1.0, -2.0, -3.0])


def test_a_tilted_board_feels_gravity_sideways() -> None:
    pitch_rad = math.radians(0.5)
    _, (x, y, z) = errors(mount_rpy_deg=(0.0, 0.5, 0.0)).measure(STOPPED, *STILL)
    assert (x, y, z) == pytest.approx((-G * math.sin(pitch_rad), 0.0, G * math.cos(pitch_rad)))
    (p, q, r), _ = errors(mount_rpy_deg=(0.0, 0.0, 90.0)).measure(STOPPED, (1.0, 0.0, 0.0), (0.0, 0.0, G))
    assert (p, q, r) == pytest.approx((0.0, -1.0, 0.0), abs=1e-12)


@pytest.mark.parametrize("hz", [40.0, 130.0])
def test_a_sample_is_the_mean_of_the_vibration_since_the_last_one(hz: float) -> None:
    imu = errors(vibration_m_s2=6.0, gyro_vibration_deg_s=5.0, vibration_hz=hz)
    one: Vec4 = (1.0, 0.0, 0.0, 0.0)  # front right: y < 0, turns the body by -z
    shake, turn = 3.0, math.radians(2.5)
    for sample in range(5):
        (p, q, r), (x, y, z) = imu.measure(one, *STILL)
        phases = [math.tau * hz * (sample + (k + 0.5) / 1000) * 0.004 for k in range(1000)]
        forward, left, along = (
            statistics.fmean(values)
            for values in (map(math.cos, phases), (-math.sin(a) for a in phases), (math.cos(2 * a) for a in phases))
        )
        assert (x, y, z - G) == pytest.approx((shake * forward, shake * left, shake * along), abs=1e-4)
        assert (p, q, r) == pytest.approx((-turn * along, -turn * along, turn * left), abs=1e-5)


def test_the_drift_has_its_spread_and_forgets_with_its_time_constant() -> None:
    imu = errors(interval_s=0.1, accel_drift_m_s2=0.5, gyro_drift_deg_s=2.0, drift_time_s=10.0)
    imu.drift(noise(1, 11))
    accel, gyro = [], []
    for sample in range(100000):
        rates, force = imu.measure(STOPPED, *STILL)
        if sample % 25 == 0:
            accel.append(force[0])
            gyro.append(math.degrees(rates[1]))
    assert statistics.pstdev(accel) == pytest.approx(0.5, rel=0.1)
    assert statistics.pstdev(gyro) == pytest.approx(2.0, rel=0.1)
    assert statistics.correlation(accel[4:], accel[:-4]) == pytest.approx(math.exp(-1.0), abs=0.06)
