"""The worlds of `benchmarks.effects`."""

from __future__ import annotations

import numpy as np
import pytest

from benchmarks.effects import EFFECTS, MISSION, NONE, costs_mm, with_effect
from companion.sitl_config.loader import load_sitl
from sitl.campaigns.flights import with_world


def test_each_effect_of_the_laboratory_acts_alone_with_the_values_of_the_same_seed() -> None:
    lab, ideal = load_sitl(MISSION, world="lab"), load_sitl(MISSION, world="ideal").world
    whole = with_world(lab, {"seed": 3}).world.model_dump()
    plain = ideal.model_dump() | {"seed": 3}
    assert with_world(with_effect(lab, ideal, NONE), {"seed": 3}).world.model_dump() == plain
    for effect, keys in EFFECTS.items():
        alone = with_world(with_effect(lab, ideal, effect), {"seed": 3}).world.model_dump()
        assert alone == plain | {key: whole[key] for key in keys}
    differs = {key for key in whole if whole[key] != plain[key]} - {"payload_kg"}
    assert differs == {key for keys in EFFECTS.values() for key in keys}


def test_the_cost_is_the_median_difference_from_the_ideal_flight_of_the_same_seed() -> None:
    after_mm = {NONE: (10.0, 20.0, 30.0, 40.0), "gusts": (11.0, 22.0, 33.0, np.nan)}
    flown = {
        ("a/b", effect, seed): (0.001 * seed, 1e-3 * value)
        for effect, values in after_mm.items()
        for seed, value in enumerate(values)
    }
    assert costs_mm(flown, "a/b", "gusts") == pytest.approx((0.0, 2.0, 3))
    assert costs_mm(flown, "a/b", NONE) == pytest.approx((1.5, 25.0, 4))
