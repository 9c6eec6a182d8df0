"""Adaptive loads: they converge to what is there, stay inside their bounds, and wait while the machine cannot answer."""

from __future__ import annotations

import math
from typing import Any

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from companion.config.controller import AdaptiveConfig
from companion.config.loader import load_flight
from companion.control.adaptive import Adaptation
from companion.control.load_adaptation import LoadAdaptation
from companion.control.manipulator import Manipulator
from companion.model.constants import GRAVITY_M_S2
from companion.model.types import IDENTITY_QUAT, Vec2

CONFIG = load_flight("configs/missions/catch.yaml", preset="recommended")
DT_S = 0.005
MASS_KG, DAMPING = 3.0, 9.0
"""A row M s' = -Lambda s + load - theta."""


def law(**changes: Any) -> AdaptiveConfig:
    assert isinstance(CONFIG.controller, AdaptiveConfig)
    return AdaptiveConfig.model_validate(CONFIG.controller.model_dump() | changes)


def test_a_constant_force_is_cancelled_and_s_returns_to_zero() -> None:
    load = LoadAdaptation(law(load_rate_xyz=(5.0, 5.0, 20.0)))
    s = np.zeros(3)
    pull_n = np.array([0.5, -0.3, -2.0])
    for _ in range(4000):
        s += DT_S / MASS_KG * (pull_n + np.array(load.force_n) - DAMPING * s)
        load.advance(DT_S, (float(s[0]), float(s[1]), float(s[2]), 0.0, 0.0), True)
    np.testing.assert_allclose(load.force_n, -pull_n, atol=1e-3)
    np.testing.assert_allclose(s, 0.0, atol=1e-3)


def test_leakage_leaves_the_error_that_its_balance_says() -> None:
    """At rest theta = -(Gamma / nu) s and Lambda s = load + theta, so s = load / (Lambda + Gamma / nu)."""
    load = LoadAdaptation(law(load_rate_xyz=(0.0, 0.0, 20.0), load_leakage=0.5))
    s = 0.0
    for _ in range(8000):
        s += DT_S / MASS_KG * (-2.0 + load.force_n[2] - DAMPING * s)
        load.advance(DT_S, (0.0, 0.0, s, 0.0, 0.0), True)
    assert s == pytest.approx(-2.0 / (DAMPING + 20.0 / 0.5), rel=1e-3)


def test_moments_and_friction_are_found_while_the_arm_moves() -> None:
    """A 2R arm with unknown link moments and friction, swinging: the torque error goes to zero and the estimates to the truth."""
    load = LoadAdaptation(law(moment_rate=0.05, friction_rate=0.5))
    manipulator = Manipulator(CONFIG.vehicle.arm, CONFIG.vehicle.tool)
    moments, friction = np.array([0.06, 0.05]), np.array([0.08, 0.05])
    s = np.zeros(2)
    for tick in range(12000):
        t_s = tick * DT_S
        angle: Vec2 = (1.9 + 0.6 * math.sin(0.9 * t_s), 1.2 + 0.6 * math.sin(1.3 * t_s))
        rate: Vec2 = (0.54 * math.cos(0.9 * t_s), 0.78 * math.cos(1.3 * t_s))
        u1, u2 = manipulator.gravity_levers_m_s2(angle, 0.0, GRAVITY_M_S2)
        turning = np.tanh(np.array(rate) / 0.1)
        needed = np.array([moments[0] * u1 + moments[1] * u2, -moments[1] * u2]) + friction * turning
        given_nm = np.array(load.joint_torque_nm((u1, u2), rate))
        s += DT_S / 0.1 * (given_nm - needed - 1.0 * s)
        load.advance(DT_S, (0.0, 0.0, 0.0, float(s[0]), float(s[1])), True)
    np.testing.assert_allclose(load.moments_kg_m, moments, rtol=0.05)
    np.testing.assert_allclose(load.friction_nm, friction, rtol=0.1)
    np.testing.assert_allclose(s, 0.0, atol=5e-3)


def test_the_levers_of_gravity_times_the_moments_are_the_gravity_torque() -> None:
    arm, tool = CONFIG.vehicle.arm, CONFIG.vehicle.tool
    manipulator = Manipulator(arm, tool)
    carried_kg = tool.sensor_mass_kg + tool.net_mass_kg
    first = arm.link_masses_kg[0] * arm.link_com_m[0] + (arm.link_masses_kg[1] + carried_kg) * arm.link_lengths_m[0]
    second = arm.link_masses_kg[1] * arm.link_com_m[1] + carried_kg * arm.link_lengths_m[1]
    u1, u2 = manipulator.gravity_levers_m_s2((1.7, 1.0), 0.0, GRAVITY_M_S2)
    expected = manipulator.gravity_torque_nm((1.7, 1.0), IDENTITY_QUAT)
    assert (first * u1 + second * u2, -second * u2) == pytest.approx(expected, rel=1e-12)


row = st.floats(-1e3, 1e3)


@given(st.lists(st.tuples(row, row, row, row, row, row, row), max_size=40))
def test_estimates_stay_inside_their_bounds_for_any_input(inputs: list[tuple[float, ...]]) -> None:
    config = law(load_rate_xyz=(5.0, 5.0, 20.0), moment_rate=1.0, friction_rate=1.0)
    load = LoadAdaptation(config)
    for s0, s1, s2, s6, s7, lever, rate in inputs:
        load.joint_torque_nm((lever, -lever), (rate, -rate))
        load.advance(DT_S, (s0, s1, s2, s6, s7), True)
        assert max(map(abs, load.force_n)) <= config.load_max_n
        assert max(map(abs, load.moments_kg_m)) <= config.moment_max_kg_m
        assert 0.0 <= min(load.friction_nm) <= max(load.friction_nm) <= config.friction_max_nm


def test_nothing_is_learned_in_saturation() -> None:
    load = LoadAdaptation(law(load_rate_xyz=(5.0, 5.0, 20.0), moment_rate=1.0, friction_rate=1.0))
    load.joint_torque_nm((1.0, 1.0), (1.0, 1.0))
    load.advance(DT_S, (1.0, 1.0, 1.0, 1.0, 1.0), False)
    assert (load.force_n, load.moments_kg_m, load.friction_nm) == ((0.0, 0.0, 0.0), (0.0, 0.0), (0.0, 0.0))


def test_a_sample_that_is_not_a_number_leaves_the_estimates() -> None:
    load = LoadAdaptation(law(load_rate_xyz=(5.0, 5.0, 20.0), moment_rate=1.0, friction_rate=1.0))
    load.joint_torque_nm((1.0, 1.0), (1.0, 1.0))
    load.advance(DT_S, (-1.0, -1.0, -1.0, -1.0, -1.0), True)
    before = (load.force_n, load.moments_kg_m, load.friction_nm)
    load.advance(DT_S, (math.nan,) * 5, True)
    assert (load.force_n, load.moments_kg_m, load.friction_nm) == before


def test_the_paper_bound_of_h_holds_for_slow_leakage() -> None:
    bound = (1.0, 2.0, 3.0, 4.0)
    adaptation = Adaptation(law(nu=(0.1, 0.1, 0.1, 0.1), h_max=bound))
    for _ in range(2000):
        adaptation.advance(DT_S, 5.0, (1.0, 2.0, 4.0, 3.0), False)
    assert adaptation.h == bound
