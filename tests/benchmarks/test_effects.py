"""The worlds of `benchmarks.effects`, and what it makes of the errors in them."""

from __future__ import annotations

import numpy as np
import pytest

from benchmarks.effects import EFFECTS, IDEAL, LABORATORY, MISSION, added_mm, order, with_effects
from companion.sitl_config.loader import load_sitl
from sitl.campaigns.flights import with_world


def test_each_effect_has_the_values_of_the_laboratory_and_all_together_are_the_laboratory() -> None:
    lab, ideal = load_sitl(MISSION, world="lab"), load_sitl(MISSION, world="ideal").world
    whole = with_world(lab, {"seed": 3, "payload_kg": 0.2}).world.model_dump()
    plain = ideal.model_dump() | {"seed": 3, "payload_kg": 0.2}
    for number in range(len(EFFECTS) + 1):
        effects = order(3)[:number]
        these = with_world(with_effects(lab, ideal, effects), {"seed": 3, "payload_kg": 0.2}).world.model_dump()
        assert these == plain | {key: whole[key] for effect in effects for key in EFFECTS[effect]}
    assert these == whole


def test_what_effects_add_is_found_in_every_order_and_adds_up_to_the_laboratory() -> None:
    true_mm = {effect: float(k * k) for k, effect in enumerate(EFFECTS)}
    seeds = [1, 2, 3, 4]
    errors = np.array([np.cumsum([10.0, *(true_mm[effect] for effect in order(seed))]) for seed in seeds])
    errors[0, 0] = np.nan
    found = added_mm(errors, seeds)
    assert {effect: found[effect][0] for effect in EFFECTS} == pytest.approx(true_mm)
    assert found[IDEAL] == pytest.approx((10.0, 0.0))
    assert found[LABORATORY][0] == pytest.approx(10.0 + sum(true_mm.values()))


def test_each_laboratory_has_an_order_of_its_own() -> None:
    assert sorted(order(1)) == sorted(order(2)) == sorted(EFFECTS)
    assert order(1) != order(2)
