"""The slack tether's pull against the equilibrium of a heavy line."""

from __future__ import annotations

import math

import mujoco
import numpy as np
import pytest

from companion.sitl_config.effects.tether_line import TetherLine as TetherLineConfig
from companion.sitl_config.loader import load_sitl
from companion.sitl_config.world import World as WorldConfig
from sitl.world.effects.tether_line import Hanging, hanging
from tests.sitl.plants import OneMachine, act, load
from tests.support import CATCH, tether_of

VEHICLE = load_sitl(CATCH).vehicle
ANCHOR = tether_of(VEHICLE).anchor_world_m
WEIGHT_N_M = 0.2


def ends_at_m(pull: Hanging, length_m: float) -> tuple[float, float]:
    """Horizontal and vertical distance that a line bridges whose upper end is pulled like this, by following it piece by piece."""
    pieces = 20_000
    along_m = (np.arange(pieces) + 0.5) * length_m / pieces
    down_n = np.where(along_m < length_m - pull.on_floor_m, pull.down_n - WEIGHT_N_M * along_m, 0.0)
    tension_n = np.hypot(pull.level_n, down_n)
    step_m = length_m / pieces
    return float((pull.level_n / tension_n).sum() * step_m), float((down_n / tension_n).sum() * step_m)


@pytest.mark.parametrize(
    ("level_m", "height_m", "length_m"), [(1.5, 1.0, 2.4), (1.5, 1.0, 1.9), (2.0, 2.0, 2.9), (2.0, 0.3, 2.1)]
)
def test_a_line_that_is_pulled_level_follows_the_catenary(level_m: float, height_m: float, length_m: float) -> None:
    pull = hanging(level_m, height_m, length_m, WEIGHT_N_M)
    assert ends_at_m(pull, length_m) == pytest.approx((level_m, height_m), abs=1e-3)
    hangs_m = length_m - pull.on_floor_m
    if pull.on_floor_m > 0.0:  # the whole hanging part is carried by the upper end
        assert pull.down_n == pytest.approx(WEIGHT_N_M * hangs_m)


def test_a_slack_line_hangs_straight_down_and_the_rest_weighs_nothing() -> None:
    assert hanging(1.2, 1.0, 3.0, WEIGHT_N_M) == pytest.approx((0.0, WEIGHT_N_M, 2.0))
    assert hanging(1.2, -0.1, 3.0, WEIGHT_N_M).down_n == 0.0


def with_line(height_m: float, velocity_m_s: tuple[float, float] = (0.0, 0.0), **settings: float) -> OneMachine:
    """A level world above (0.4, 0) whose effect has acted once."""
    config = WorldConfig(payload_kg=0.0, tether_line=TetherLineConfig(on=True, **settings))
    world = OneMachine(VEHICLE, config, (0.4, 0.0), 0.0, (1.7, 1.0))
    world.data.qpos[2] = height_m
    mujoco.mj_forward(world.model, world.data)
    world.machine.v[0:2] = velocity_m_s
    act(world)
    return world


def test_the_vehicle_carries_what_hangs() -> None:
    for height_m in (0.3, 1.0):
        expected = [0.0, 0.0, -0.016 * 9.80665 * height_m, 0.0, 0.0, 0.0]
        assert load(with_line(height_m, floor_friction=0.0), "base") == pytest.approx(expected, rel=1e-3, abs=1e-12)


def test_friction_on_the_floor_takes_energy_and_stays_below_that_of_the_dragged_half() -> None:
    for velocity in ((0.5, 0.0), (-0.3, 0.4), (0.0, -1.0)):
        fx, fy, *_ = load(with_line(1.0, velocity), "base")
        most_n = 0.3 * 0.016 * 9.81 * 0.5 * 2.0
        assert fx * velocity[0] + fy * velocity[1] < 0.0
        assert 0.9 * most_n < math.hypot(fx, fy) < most_n


def test_a_nearly_straight_line_pulls_towards_the_anchor_without_a_pull_that_counts_as_taut() -> None:
    world = with_line(1.0)
    x, y, z = world.machine.tether.attachment_world_m
    for slack_m in (0.05, 0.0, -0.05):
        world.machine.tether.length_m = math.dist((x, y, z), ANCHOR) + slack_m
        act(world)
        fx, fy, fz, *_ = load(world, "base")
        assert fx * (ANCHOR[1] - y) == pytest.approx(fy * (ANCHOR[0] - x)) and fy < 0.0 and fz < 0.0
        assert math.hypot(fx, fy, fz) < tether_of(VEHICLE).pull_min_n
    assert world.machine.truth().tether_tension_n == 0.0
