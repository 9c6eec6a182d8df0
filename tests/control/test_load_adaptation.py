"""Adaptive loads: they converge to what is there, stay inside their bounds, and wait while the machine cannot answer."""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import Any

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from msgspec.structs import replace

from companion.config.controller import AdaptiveConfig
from companion.config.loader import load_flight
from companion.control.adaptive import Adaptation, AdaptiveController
from companion.control.arm_model import manipulator_of
from companion.control.load_adaptation import LoadAdaptation
from companion.model.constants import GRAVITY_M_S2
from companion.model.frames import quat_from_euler_zyx
from companion.model.outputs import ControlLog
from companion.model.types import Joints, Matrix
from tests.control.states import POSE, ZERO, at, at_rest

CONFIG = load_flight("configs/missions/catch.yaml", preset="recommended")
MANIPULATOR = manipulator_of(CONFIG.vehicle)
DT_S = 0.005
MASS_KG, DAMPING = 3.0, 9.0
"""A row M s' = -Lambda s + load - theta."""
REFERENCE = at_rest((0.0, 0.0, 1.0), 0.0, POSE)


def law(**changes: Any) -> AdaptiveConfig:
    assert isinstance(CONFIG.controller, AdaptiveConfig)
    return AdaptiveConfig.model_validate(CONFIG.controller.model_dump() | changes)


def ticked(
    load: LoadAdaptation,
    s: Sequence[float],
    s_joints: Sequence[float] = (0.0, 0.0),
    wanted_rate_rad_s: Joints = (0.0, 0.0),
    levers_m_s2: Matrix = ((0.0, 0.0), (0.0, 0.0)),
) -> None:
    """One tick with s of x, y, z and of two joints; the measured rate is the requested one plus s."""
    load.tau(levers_m_s2, wanted_rate_rad_s)
    rates = tuple(wanted + row for wanted, row in zip(wanted_rate_rad_s, s_joints, strict=True))
    load.advance(DT_S, (*s, 0.0, 0.0, 0.0, *s_joints), rates)


def test_a_constant_force_is_cancelled_and_s_returns_to_zero() -> None:
    load = LoadAdaptation(law(load_rate_xyz=(5.0, 5.0, 20.0)), MANIPULATOR)
    s = np.zeros(3)
    pull_n = np.array([0.5, -0.3, -2.0])
    for _ in range(4000):
        s += DT_S / MASS_KG * (pull_n + np.array(load.force_n) - DAMPING * s)
        ticked(load, s.tolist())
    np.testing.assert_allclose(load.force_n, -pull_n, atol=1e-3)
    np.testing.assert_allclose(s, 0.0, atol=1e-3)


def test_leakage_leaves_the_error_of_its_balance() -> None:
    """At rest theta = -(Gamma / nu) s and Lambda s = load + theta, so s = load / (Lambda + Gamma / nu)."""
    load = LoadAdaptation(law(load_rate_xyz=(0.0, 0.0, 20.0), load_leakage=0.5), MANIPULATOR)
    s = 0.0
    for _ in range(8000):
        s += DT_S / MASS_KG * (-2.0 + load.force_n[2] - DAMPING * s)
        ticked(load, (0.0, 0.0, s))
    assert s == pytest.approx(-2.0 / (DAMPING + 20.0 / 0.5), rel=1e-3)


def test_moments_and_friction_are_found_while_the_arm_moves() -> None:
    """A 2R arm with unknown link moments and friction, swinging: the torque error goes to zero and the estimates to the truth."""
    load = LoadAdaptation(law(moment_rate=0.05, friction_rate=0.5), MANIPULATOR)
    moments, friction = np.array([0.06, 0.05]), np.array([0.08, 0.05])
    s = np.zeros(2)
    for tick in range(12000):
        t_s = tick * DT_S
        angle: Joints = (1.9 + 0.6 * math.sin(0.9 * t_s), 1.2 + 0.6 * math.sin(1.3 * t_s))
        rate: Joints = (0.54 * math.cos(0.9 * t_s), 0.78 * math.cos(1.3 * t_s))
        levers = MANIPULATOR.gravity_levers_m_s2(angle, (0.0, 0.0, GRAVITY_M_S2))
        turning = np.tanh(np.array(rate) / 0.1)
        needed = np.array(levers) @ moments + friction * turning
        given_nm = np.array(load.tau(levers, rate)[6:])
        s += DT_S / 0.1 * (given_nm - needed - 1.0 * s)
        ticked(load, ZERO, s.tolist(), rate, levers)
    np.testing.assert_allclose(load.moments_kg_m, moments, rtol=0.05)
    np.testing.assert_allclose(load.friction_nm, friction, rtol=0.1)
    np.testing.assert_allclose(s, 0.0, atol=5e-3)


@pytest.mark.parametrize("held_nm", [0.15, -0.15])
def test_static_friction_that_holds_a_joint_with_an_error_does_not_raise_the_friction_estimate(held_nm: float) -> None:
    """At rest s = Phi e is constant and the wanted rate is -s, so that s times tanh(wanted rate) has one sign for either error."""
    load = LoadAdaptation(law(friction_rate=0.5), MANIPULATOR)
    s = held_nm
    for _ in range(400):
        ticked(load, ZERO, (s, s), (-s, -s))
    assert load.friction_nm == (0.0, 0.0)


@pytest.mark.parametrize("rate_rad_s", [0.4, -0.4])
def test_friction_of_a_joint_that_turns_slower_than_wanted_grows_by_the_integral_of_its_lag(rate_rad_s: float) -> None:
    load = LoadAdaptation(law(friction_rate=0.5), MANIPULATOR)
    s = -0.05 * math.copysign(1.0, rate_rad_s)
    for _ in range(200):
        ticked(load, ZERO, (s, s), (rate_rad_s - s, rate_rad_s - s))
    grown_nm = 0.5 * 200 * DT_S * 0.05 * math.tanh(0.45 / 0.1)
    assert load.friction_nm == pytest.approx((grown_nm, grown_nm), rel=1e-9)


row = st.floats(-1e3, 1e3)


@given(st.lists(st.tuples(row, row, row, row, row, row, row), max_size=40))
def test_estimates_stay_inside_their_bounds_for_any_input(inputs: list[tuple[float, ...]]) -> None:
    config = law(load_rate_xyz=(5.0, 5.0, 20.0), moment_rate=1.0, friction_rate=1.0)
    load = LoadAdaptation(config, MANIPULATOR)
    for s0, s1, s2, s6, s7, lever, rate in inputs:
        ticked(load, (s0, s1, s2), (s6, s7), (rate, -rate), ((lever, -lever), (0.0, lever)))
        assert max(map(abs, load.force_n)) <= config.load_max_n
        assert max(map(abs, load.moments_kg_m)) <= config.moment_max_kg_m
        assert 0.0 <= min(load.friction_nm) <= max(load.friction_nm) <= config.friction_max_nm


def test_adaptive_loads_and_observer_hold_while_the_ground_may_carry_a_part_of_the_weight() -> None:
    config = law(load_rate_xyz=(5.0, 5.0, 20.0), moment_rate=0.05, disturbance_time_xyz_s=(0.5, 0.5, 0.5))
    controller = AdaptiveController(config, CONFIG.vehicle, 0.5)

    def pressed(airborne: bool) -> ControlLog:
        """One second 0.1 m above the reference, as on the ground at the end of a landing."""
        state = replace(at(position=(0.0, 0.0, 1.1), arm=(POSE[0], POSE[1] + 0.05)), airborne=airborne)
        for _ in range(200):
            log = controller.step(DT_S, state, REFERENCE, 1.0).log
        return log

    flown = pressed(True)
    assert flown.load_estimate_n is not None
    assert flown.load_estimate_n[2] < -5.0
    stood = pressed(False)
    assert stood.load_estimate_n == flown.load_estimate_n
    assert stood.moment_estimate_kg_m == flown.moment_estimate_kg_m
    assert stood.tau[2] == pytest.approx(flown.tau[2], abs=0.1), "only the robust term still moves"


def test_nothing_is_learned_further_into_saturation() -> None:
    config = law(load_rate_xyz=(5.0, 5.0, 20.0), moment_rate=0.05, friction_rate=0.5)
    controller = AdaptiveController(config, CONFIG.vehicle, 0.5)
    far_away = at(position=(3.0, -3.0, 2.0), arm=(POSE[0] + 1.0, POSE[1] + 0.5), arm_rate=(20.0, 20.0))
    first, *others = (controller.step(DT_S, far_away, REFERENCE, 1.0).log for _ in range(20))
    assert all(first.saturated)
    for log in others:
        for name in ("load_estimate_n", "moment_estimate_kg_m", "friction_estimate_nm"):
            assert getattr(log, name) == getattr(first, name)


@pytest.mark.parametrize("pitch_rad", [-0.3, -0.6])
def test_a_joint_at_the_limit_to_which_its_estimate_brought_it_comes_back(pitch_rad: float) -> None:
    """Held with an error, as a bar between two vehicles holds it, and tilted at the limit: the estimate once waited for the end of the
    saturation that it had caused itself.
    """
    controller = AdaptiveController(law(), CONFIG.vehicle, 0.5)

    def held(error_rad: float, pitch_rad: float, seconds: float) -> list[tuple[float, ...]]:
        arm = (POSE[0] + error_rad, POSE[1])
        state = at(arm=arm, attitude=quat_from_euler_zyx(0.0, pitch_rad, 0.0))
        return [controller.step(DT_S, state, REFERENCE, 1.0).log.tau[6:] for _ in range(round(seconds / DT_S))]

    most_nm = CONFIG.vehicle.arm.joints[0].torque_max_nm
    assert held(0.05, 0.0, 20.0)[-1][0] == -most_nm
    before, *_, after = held(-0.05, pitch_rad, 4.0)
    assert before == (-most_nm, most_nm)
    assert max(map(abs, after)) < 0.7 * most_nm


def test_a_sample_that_is_not_a_number_leaves_the_estimates() -> None:
    load = LoadAdaptation(law(load_rate_xyz=(5.0, 5.0, 20.0), moment_rate=1.0, friction_rate=1.0), MANIPULATOR)
    levers: Matrix = ((1.0, 1.0), (0.0, -1.0))
    ticked(load, (-1.0, -1.0, -1.0), (-1.0, -0.5), (2.0, 2.0), levers)
    before = (load.force_n, load.moments_kg_m, load.friction_nm)
    assert all(map(all, before))
    ticked(load, (math.nan,) * 3, (math.nan, math.nan), (2.0, 2.0), levers)
    assert (load.force_n, load.moments_kg_m, load.friction_nm) == before


def test_the_paper_bound_of_h_holds_for_slow_leakage() -> None:
    adaptation = Adaptation(law(nu=(0.1, 0.1, 0.1, 0.1), h_max=(1.0, 2.0, 3.0, 4.0)))
    for _ in range(2000):
        adaptation.advance(DT_S, 5.0, (1.0, 2.0, 4.0, 3.0), False)
    assert list(adaptation.H) == [1.0, 2.0, 3.0, 4.0]
