"""Handling in the simulated world, and wrongly configured motion-capture servers."""

from __future__ import annotations

import pytest

from companion.config.document import ConfigError
from companion.sitl_config.loader import load_world
from tests.preflight.hand_rig import Standing, world


def test_the_hand_is_away_while_the_rotors_are_armed() -> None:
    rig = Standing(world("handling=true"))
    for _ in rig.samples(4.0 + 3.0):
        pass
    plant = rig.plant
    assert plant.truth.position_world_m[2] > 0.5
    while plant.t_s < 4.0 + 4.0:
        plant.step(True)
    assert plant.truth.position_world_m[2] < 0.35


def test_axes_that_name_one_twice_are_refused() -> None:
    with pytest.raises(ConfigError, match="each of x, y and z once"):
        load_world(['world.mocap_axes=["x","-x","z"]'])
