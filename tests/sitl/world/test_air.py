"""The gusts of the room: an Ornstein-Uhlenbeck force and torque with the RMS and the correlation time of the section `air`."""

from __future__ import annotations

import math

import numpy as np
import pytest

from companion.sitl_config.effects.air import Air as AirConfig
from companion.sitl_config.loader import load_sitl
from companion.sitl_config.world import World as WorldConfig
from sitl.world.effects.air import Air
from sitl.world.ornstein_uhlenbeck import OrnsteinUhlenbeck
from tests.sitl.plants import OneMachine
from tests.support import CATCH

VEHICLE = load_sitl(CATCH).vehicle
HOVER = OneMachine(VEHICLE, WorldConfig(), (0.0, 0.0), 0.0, (1.7, 1.0)).machine.weight_n
"""Weight and thrust in these tests, N."""


def test_the_process_has_unit_rms_and_forgets_exponentially() -> None:
    period_s, correlation_s = 0.01, 0.05
    process = OrnsteinUhlenbeck(2, correlation_s, period_s, 1, 13)
    values = np.array([process.step() for _ in range(25_000)]).reshape(-1, 6)
    np.testing.assert_allclose(np.sqrt((values**2).mean(axis=0)), 1.0, atol=0.04)
    for lag in (1, 5, 10):
        correlation = (values[lag:] * values[:-lag]).mean()
        assert correlation == pytest.approx(math.exp(-lag * period_s / correlation_s), abs=0.02)
    between = np.corrcoef(values.T)[~np.eye(6, dtype=bool)]
    assert np.abs(between).max() < 0.05


def air(**settings: float) -> Air:
    world = OneMachine(VEHICLE, WorldConfig(air=AirConfig(on=True, **settings)), (0.0, 0.0), 0.0, (1.7, 1.0))
    (effect,) = world.machine.effects
    assert isinstance(effect, Air)
    return effect


def gusts(seed: int, rotor_command: float, steps: int = 2000) -> np.ndarray:
    """Force and torque on the base in a world without drag, in every tenth step."""
    config = WorldConfig(payload_kg=0.0, seed=seed, air=AirConfig(on=True, correlation_time_s=0.02, floor_increase=0.0))
    world = OneMachine(VEHICLE, config, (0.0, 0.0), 0.0, (1.7, 1.0))
    base = world.model.body("base").id
    rows = []
    for step in range(steps):
        world.fly((rotor_command,) * 4, (0.0, 0.0), drag=False)
        if step >= 200 and step % 10 == 0:
            rows.append(
                world.data.xfrc_applied[base] / (sum(world.machine.rotor_thrust_n) / world.machine.weight_n or 1.0)
            )
    return np.array(rows)


def test_force_and_torque_on_the_base_have_the_rms_of_the_section() -> None:
    loads = np.concatenate([gusts(seed, 0.2) for seed in range(3)])  # 20 % of the thrust: the vehicle stands
    rms = np.sqrt((loads**2).mean(axis=0))
    np.testing.assert_allclose(rms[:3], AirConfig().force_rms_n, rtol=0.12)
    np.testing.assert_allclose(rms[3:5], AirConfig().torque_rms_nm, rtol=0.12)
    assert rms[5] == 0.0
