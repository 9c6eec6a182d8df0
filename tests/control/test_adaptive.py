"""The corrected discrete law: signs, invariants, and what the paper's proof leans on."""

from __future__ import annotations

import math
from functools import partial

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from companion.config.controller import AdaptiveConfig
from companion.config.loader import FlightConfig, load_flight
from companion.control.adaptive import Adaptation, AdaptiveController, rows_of
from companion.control.types import PlantState, Wrench
from companion.mission.reference import at_rest
from companion.model.types import IDENTITY_QUAT, Joints
from tests.control.states import at

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


@pytest.mark.parametrize("axis", [0, 1, 2])
def test_it_pushes_against_the_position_error(config: FlightConfig, axis: int) -> None:
    off = [0.0, 0.0, 1.0]
    off[axis] += 0.1
    tau = settled(config, state(position=(off[0], off[1], off[2])), 1).log.tau
    rest = (0.0, 0.0, config.vehicle.airframe.mass_kg * 9.81)
    # At least the free-motion stiffness Lambda Phi.
    stiffness = law(config).lambda_gain[axis] * law(config).phi[axis]
    assert tau[axis] - rest[axis] <= -0.1 * stiffness * 0.999


@pytest.mark.parametrize("joint", [0, 1])
def test_it_pushes_joints_back_and_respects_their_limit(config: FlightConfig, joint: int) -> None:
    rest = settled(config, state(), 1).arm_torque_nm
    off = list(FOLD)
    off[joint] += 0.2
    pushed = settled(config, state(arm=(off[0], off[1])), 1).arm_torque_nm
    assert pushed[joint] < rest[joint]
    far = [FOLD[0], FOLD[1]]
    far[joint] -= 3.0
    limit = config.vehicle.arm.joints[joint].torque_max_nm
    wrench = settled(config, state(arm=(far[0], far[1])), 50)
    assert abs(wrench.arm_torque_nm[joint]) <= limit


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


def test_gamma_is_the_exact_solution(config: FlightConfig) -> None:
    """M_d gamma' = e_tau - D gamma for a held e_tau, against a fine Euler integration."""
    rows = rows_of(law(config), 2)
    e_tau = [0.3, -0.2, 1.0, 0.0, 0.0, 0.0, 0.5, -0.4]
    for _ in range(20):
        for row, held in zip(rows, e_tau, strict=True):
            row.e_tau = held
            row.advance(0.005)
    gamma = np.zeros(8)
    m_d, d = np.array([row.M_d for row in rows]), np.array([row.D for row in rows])
    for _ in range(100_000):
        gamma += 1e-6 * (e_tau - d * gamma) / m_d
    np.testing.assert_allclose([row.gamma for row in rows], gamma, rtol=1e-3, atol=1e-9)
