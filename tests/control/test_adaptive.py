"""The corrected discrete law: signs, invariants, and what the paper's proof leans on."""

from __future__ import annotations

import math
from functools import partial

import pytest
from hypothesis import given
from hypothesis import strategies as st

from companion.config.controller import AdaptiveConfig
from companion.config.loader import FlightConfig, load_flight
from companion.control.adaptive import Adaptation, AdaptiveController
from companion.control.types import PlantState, Wrench
from companion.model.types import IDENTITY_QUAT, Joints
from tests.control.states import at, at_rest

FOLD: Joints = (math.radians(165), math.radians(140))
HOVER = 0.49
REFERENCE = at_rest((0.0, 0.0, 1.0), 0.0, FOLD)
state = partial(at, arm=FOLD)


@pytest.fixture(scope="module", params=["paper", "recommended"])
def config(request: pytest.FixtureRequest) -> FlightConfig:
    return load_flight("configs/missions/catch.yaml", preset=request.param)


def law(config: FlightConfig) -> AdaptiveConfig:
    assert isinstance(config.controller, AdaptiveConfig)
    return config.controller


def settled(config: FlightConfig, plant: PlantState, ticks: int = 400) -> Wrench:
    controller = AdaptiveController(law(config), config.vehicle, HOVER)
    for _ in range(ticks):
        wrench = controller.step(0.005, plant, REFERENCE, 1.0)
    return wrench


def test_at_rest_on_the_reference_it_asks_for_hover_and_arm_gravity(config: FlightConfig) -> None:
    wrench = settled(config, state(), 1)
    assert wrench.collective_n == pytest.approx(config.vehicle.airframe.mass_kg * 9.81, abs=1e-9)
    assert wrench.attitude_wxyz == pytest.approx(IDENTITY_QUAT, abs=1e-12)
    assert wrench.log.saturated == (False, False, False)


def test_a_payload_is_carried_after_a_while() -> None:
    """recommended: the measured pull of 2 N goes into the vertical force; the arm's desired force follows it."""
    config = load_flight("configs/missions/catch.yaml", preset="recommended")
    wrench = settled(config, state(force=(0.0, 0.0, -2.0)), 1200)
    weight = config.vehicle.airframe.mass_kg * 9.81
    assert wrench.collective_n == pytest.approx(weight + 2.0, abs=0.05)
    assert max(abs(e) for e in wrench.log.e_tau) < 0.01


norms = st.floats(0, 1e4)
LAW = law(load_flight("configs/missions/catch.yaml"))


@given(st.lists(st.tuples(norms, norms, st.floats(0, 3), st.booleans()), max_size=40), st.floats(1e-4, 1.0))
def test_adaptive_gains_stay_nonnegative_for_any_input(
    inputs: list[tuple[float, float, float, bool]], dt_s: float
) -> None:
    """Property: H and zeta stay >= 0 and rho stays within its cap, whatever ||s||, ||xi|| and ||chi_dd|| do."""
    adaptation = Adaptation(LAW)
    for norm_s, x, acceleration, frozen in inputs:
        regressor = (1.0, x, x * x, acceleration)
        assert 0.0 <= adaptation.rho(regressor) <= LAW.rho_max
        adaptation.advance(dt_s, norm_s, regressor, frozen)
        assert min(adaptation.H) >= 0.0
        assert adaptation.zeta >= 0.0
