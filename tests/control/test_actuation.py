"""What every law's force and torques become: limited, then an attitude, a thrust and joint torques."""

from __future__ import annotations

import math
from typing import cast

import pytest
from hypothesis import given
from hypothesis import strategies as st
from msgspec.structs import replace

from companion.config.controller import LawConfig
from companion.config.loader import load_flight
from companion.control.arm_hold import ArmHold, towards
from companion.control.arm_model import manipulator_of
from companion.control.common import (
    AccelerationFilter,
    Actuation,
    DesiredForce,
    ForceFilter,
    tracking_errors,
    wrench_of,
)
from companion.control.thrust import ForceLimits, TiltFilter, saturate_force
from companion.control.types import PlantState
from companion.model.frames import quat_from_euler_zyx, quat_rotate, wrap_rad, yaw_from_quat
from companion.model.types import Vec3
from tests.control.states import at_rest

CONFIG = load_flight("configs/missions/catch.yaml")
VEHICLE, LAW = CONFIG.vehicle, cast(LawConfig, CONFIG.controller)
WEIGHT_N = VEHICLE.airframe.mass_kg * 9.81
DT_S = 0.005
UP: Vec3 = (0.0, 0.0, 1.0)
STATE = PlantState(
    position_world_m=(1.0, 2.0, 3.0),
    velocity_world_m_s=(0.1, 0.2, 0.3),
    acceleration_world_m_s2=(0.0, 0.0, 0.0),
    attitude_wxyz=(1.0, 0.0, 0.0, 0.0),
    angular_rate_body_rad_s=(9.0, 9.0, 0.5),
    arm_rad=(1.0, 2.0),
    arm_rate_rad_s=(0.3, 0.4),
)
LIMITS = ForceLimits(vertical_min_n=9.0, vertical_max_n=50.0, lateral_max_n=8.0, tilt_max_tan=0.4)


@pytest.mark.parametrize(
    ("force", "sent", "clipped"),
    [
        ((1.0, -2.0, 30.0), (1.0, -2.0, 30.0), (False, False)),
        ((0.0, 0.0, 8.0), (0.0, 0.0, 9.0), (True, False)),
        ((0.0, 0.0, -5.0), (0.0, 0.0, 9.0), (True, False)),
        ((0.0, 0.0, 60.0), (0.0, 0.0, 50.0), (True, False)),
        ((6.0, -8.0, 30.0), (4.8, -6.4, 30.0), (False, True)),  # 8 N sideways
        ((6.0, 8.0, 10.0), (2.4, 3.2, 10.0), (False, True)),  # 0.4 of the vertical force: the tilt
        ((3.0, 4.0, 5.0), (2.16, 2.88, 9.0), (True, True)),
    ],
)
def test_the_vertical_force_is_limited_first_and_the_lateral_one_by_it(
    force: Vec3, sent: Vec3, clipped: tuple[bool, bool]
) -> None:
    found, vertical, lateral = saturate_force(force, LIMITS)
    assert found == pytest.approx(sent)
    assert (vertical, lateral) == clipped


def actuation(hover_thrust: float = 0.5) -> Actuation:
    return Actuation(LAW, VEHICLE, hover_thrust)


def sent(force: Vec3, torque: tuple[float, float] = (0.0, 0.0), *, ticks: int = 1000, scale: float = 1.0) -> Actuation:
    """After the attitude filter has settled."""
    found = actuation()
    for _ in range(ticks):
        found.step(DT_S, force, torque, UP, 0.7, scale)
    return found


@given(
    st.tuples(st.floats(-40.0, 40.0), st.floats(-40.0, 40.0), st.floats(-20.0, 90.0)),
    st.floats(-6.0, 6.0),
    st.floats(-0.3, 0.3),
)
def test_whatever_a_law_asks_for_thrust_tilt_and_force_stay_within_the_limits(
    force: Vec3, yaw_rad: float, tilted_rad: float
) -> None:
    found = actuation()
    body_z = (math.sin(tilted_rad), 0.0, math.cos(tilted_rad))
    found.step(10.0, force, (0.0, 0.0), body_z, yaw_rad, 1.0)  # a step in which the filter settles
    x, y, z = found.force_world_n
    assert 0.3 * WEIGHT_N - 1e-9 <= z <= min(0.9 * VEHICLE.airframe.thrust_max_n, 0.9 / 0.5 * WEIGHT_N) + 1e-9
    lateral_n = math.hypot(x, y)
    assert lateral_n <= LAW.lateral_force_max_n + 1e-9
    assert lateral_n <= z * math.tan(math.radians(VEHICLE.airframe.tilt_max_deg)) + 1e-9
    assert found.collective_n == pytest.approx(max(0.0, x * body_z[0] + z * body_z[2]))
    assert found.attitude_wxyz[0] >= 0.0
    assert wrap_rad(yaw_from_quat(found.attitude_wxyz) - yaw_rad) == pytest.approx(0.0, abs=1e-6)
    thrust = quat_rotate(found.attitude_wxyz, UP)
    share = math.hypot(x, y, z)
    assert thrust == pytest.approx((x / share, y / share, z / share), abs=2e-3)


def test_a_setpoint_that_turns_leads_by_what_px4_would_lag_and_leaves_the_thrust_where_it_was() -> None:
    at_rest, turning = actuation(), actuation()
    for found, rate_rad_s in ((at_rest, 0.0), (turning, 0.56)):
        found.step(10.0, (4.0, -3.0, WEIGHT_N), (0.0, 0.0), UP, 0.7, 1.0, rate_rad_s)
    assert yaw_from_quat(turning.attitude_wxyz) - yaw_from_quat(at_rest.attitude_wxyz) == pytest.approx(0.2, abs=0.01)
    assert quat_rotate(turning.attitude_wxyz, UP) == pytest.approx(quat_rotate(at_rest.attitude_wxyz, UP))
    assert turning.roll_pitch_yaw_rad == at_rest.roll_pitch_yaw_rad, "what the vehicle is to do"


@pytest.mark.parametrize("rate_rad_s", [30.0, -30.0, math.nan])
def test_a_rate_of_yaw_in_other_units_leads_by_half_a_radian_and_one_that_is_no_number_is_left_to_the_gate(
    rate_rad_s: float,
) -> None:
    found = actuation()
    found.step(10.0, (0.0, 0.0, WEIGHT_N), (0.0, 0.0), UP, 0.7, 1.0, rate_rad_s)
    if math.isnan(rate_rad_s):
        assert math.isnan(found.attitude_wxyz[0])
    else:
        assert yaw_from_quat(found.attitude_wxyz) == pytest.approx(0.7 + math.copysign(0.5, rate_rad_s))


def test_before_the_first_tick_nothing_is_commanded() -> None:
    found, nothing = actuation(), (0.0, 0.0, 0.0)
    assert (found.attitude_wxyz, found.roll_pitch_yaw_rad) == ((1.0, 0.0, 0.0, 0.0), nothing)
    assert (found.force_world_n, found.collective_n, found.arm_torque_nm) == (nothing, 0.0, (0.0, 0.0))
    assert found.clipped == (False, False, False) and not found.any_clipped
    assert DesiredForce(0.5).world_n == nothing


def test_upside_down_there_is_no_thrust() -> None:
    found = actuation()
    found.step(DT_S, (0.0, 0.0, WEIGHT_N), (0.0, 0.0), (0.0, 0.0, -1.0), 0.0, 1.0)
    assert found.collective_n == 0.0


@pytest.mark.parametrize(("hover_thrust", "most_n"), [(0.5, 1.8 * WEIGHT_N), (0.9, WEIGHT_N), (0.3, 54.0)])
def test_the_largest_vertical_force_leaves_a_tenth_of_the_thrust(hover_thrust: float, most_n: float) -> None:
    found = actuation(hover_thrust)
    found.step(DT_S, (0.0, 0.0, 500.0), (0.0, 0.0), UP, 0.0, 1.0)
    assert found.force_world_n[2] == pytest.approx(min(most_n, 0.9 * VEHICLE.airframe.thrust_max_n))


@pytest.mark.parametrize(
    ("force", "torque", "leaves", "clipped"),
    [
        ((0.0, 0.0, WEIGHT_N), (2.4, -2.4), (2.4, -2.4), (False, False, False)),
        ((0.0, 0.0, WEIGHT_N), (2.6, -1.0), (2.5, -1.0), (False, False, True)),
        ((0.0, 0.0, WEIGHT_N), (0.0, -9.0), (0.0, -2.5), (False, False, True)),
        ((0.0, 0.0, 200.0), (0.0, 0.0), (0.0, 0.0), (True, False, False)),
        ((30.0, 0.0, WEIGHT_N), (0.0, 0.0), (0.0, 0.0), (False, True, False)),
    ],
)
def test_each_saturation_is_known_to_the_law(
    force: Vec3, torque: tuple[float, float], leaves: tuple[float, float], clipped: tuple[bool, bool, bool]
) -> None:
    found = sent(force, torque)
    assert found.arm_torque_nm == pytest.approx(leaves)
    assert found.clipped == clipped
    assert found.any_clipped is any(clipped)


def test_on_the_ground_only_a_share_of_the_vertical_force_is_commanded() -> None:
    found = sent((5.0, 5.0, WEIGHT_N), scale=0.4)
    assert found.force_world_n == pytest.approx((0.0, 0.0, 0.4 * WEIGHT_N))
    assert found.roll_pitch_yaw_rad == pytest.approx((0.0, 0.0, 0.7))
    assert sent((0.0, 0.0, WEIGHT_N), scale=0.01).collective_n == pytest.approx(0.01 * WEIGHT_N), "from zero on"


def test_the_tilt_filter_is_the_second_order_system_of_its_bandwidth_and_damping() -> None:
    """Step response of an underdamped system: overshoot exp(-pi d / sqrt(1 - d^2)), at pi / (w sqrt(1 - d^2))."""
    w, d, step_s = 10.0, 0.5, 1e-4
    tilt = TiltFilter(w, d)
    way = [tilt.step(step_s, 0.2, -0.1) for _ in range(20_000)]
    roll = [a for a, _ in way]
    assert way[1000] == pytest.approx((roll[1000], -0.5 * roll[1000]))
    root = math.sqrt(1.0 - d * d)
    assert max(roll) / 0.2 == pytest.approx(1.0 + math.exp(-math.pi * d / root), abs=2e-3)
    assert roll.index(max(roll)) * step_s == pytest.approx(math.pi / (w * root), abs=2e-3)
    assert roll[-1] == pytest.approx(0.2, abs=1e-4)


def test_the_force_filter_is_first_order_and_starts_from_zero_after_a_gap() -> None:
    filtered, share = ForceFilter(5.0), 1.0 - math.exp(-2.0 * math.pi * 5.0 * DT_S)
    assert filtered.step(DT_S, (1.0, 2.0, 3.0)) == (1.0, 2.0, 3.0), "the first sample of all passes"
    assert filtered.step(DT_S, (2.0, 0.0, 3.0)) == pytest.approx((1.0 + share, 2.0 - 2.0 * share, 3.0))
    assert filtered.step(DT_S, None) == (0.0, 0.0, 0.0)
    assert filtered.step(DT_S, (1.0, -1.0, 4.0)) == pytest.approx((share, -share, 4.0 * share))


def test_the_acceleration_filter_is_first_order_and_differentiates_the_rates_of_the_joints() -> None:
    filtered, share = AccelerationFilter(5.0), 1.0 - math.exp(-2.0 * math.pi * 5.0 * DT_S)
    first = replace(STATE, acceleration_world_m_s2=(1.0, 2.0, 3.0))
    assert filtered.step(DT_S, first) == [1.0, 2.0, 3.0, 0.0, 0.0, 0.0, 0.0, 0.0]
    then = filtered.step(DT_S, replace(first, acceleration_world_m_s2=(2.0, 0.0, 3.0), arm_rate_rad_s=(0.31, 0.38)))
    gains = (share, -2.0 * share, 0.0, 0.0, 0.0, 0.0, share * 0.01 / DT_S, -share * 0.02 / DT_S)
    assert then == pytest.approx([a + b for a, b in zip((1.0, 2.0, 3.0, *(0.0,) * 5), gains, strict=True)])


def test_the_desired_force_follows_in_its_time_constant_and_never_beyond() -> None:
    desired = DesiredForce(0.5)
    desired.advance(0.1, (1.0, -2.0, 5.0))
    assert desired.world_n == pytest.approx((0.2, -0.4, 1.0))
    desired.advance(0.1, (1.2, -2.4, 0.0))
    assert desired.world_n == pytest.approx((0.4, -0.8, 0.8))
    desired.advance(3.0, (7.0, 8.0, 9.0))
    assert desired.world_n == (7.0, 8.0, 9.0)
    off = DesiredForce(None)
    off.advance(1.0, (1.0, 1.0, 1.0))
    assert off.world_n == (0.0, 0.0, 0.0)


def test_errors_are_state_minus_reference_and_no_error_of_tilt() -> None:
    reference = replace(
        at_rest((0.5, 1.0, 1.0), 3.0, (0.5, 1.0)),
        velocity_world_m_s=(0.05, 0.05, 0.05),
        yaw_rate_rad_s=0.2,
        arm_rate_rad_s=(0.1, 0.1),
    )
    error, rate = tracking_errors(STATE, reference, -3.0)
    assert error == pytest.approx((0.5, 1.0, 2.0, 0.0, 0.0, 2.0 * math.pi - 6.0, 0.5, 1.0))
    assert rate == pytest.approx((0.05, 0.15, 0.25, 0.0, 0.0, 0.3, 0.2, 0.3))


def test_the_log_of_a_law_without_adaptation_shows_what_was_sent_and_zeros() -> None:
    found = sent((2.0, 1.0, 200.0), (3.0, -1.0))
    zero = (0.0,) * 8
    wrench = wrench_of(found, (1.0,) * 8, (2.0,) * 8, (3.0,) * 8, (4.0, 5.0, 6.0), 0.5)
    assert wrench.arm_torque_nm == found.arm_torque_nm == (2.5, -1.0)
    assert (wrench.attitude_wxyz, wrench.collective_n) == (found.attitude_wxyz, found.collective_n)
    log = wrench.log
    assert log.tau == (*found.force_world_n, 0.0, 0.0, 0.0, 2.5, -1.0)
    assert (log.sliding, log.gamma, log.h_hat, log.zeta, log.rho) == (zero, zero, (0.0,) * 4, 0.0, 0.0)
    assert log.saturated == (True, False, True)
    assert log.attitude_desired_rad == found.roll_pitch_yaw_rad


def test_the_held_arm_is_pulled_to_its_target_and_damped_about_its_own_weight() -> None:
    hold, q = ArmHold(VEHICLE), quat_from_euler_zyx(0.1, -0.05, 0.3)
    weight = manipulator_of(VEHICLE).gravity_torque_nm((2.0, 1.0), q)
    found = hold.torque_nm((2.0, 1.0), (0.5, -0.5), (2.1, 0.8), (0.0, 0.1), q)
    assert found == pytest.approx((weight[0] + 5.0 * 0.1 - 0.45 * 0.5, weight[1] - 5.0 * 0.2 + 0.45 * 0.6))


def test_a_fold_goes_straight_in_joint_space_and_no_joint_exceeds_its_step() -> None:
    assert towards((1.0, 0.0), (0.0, 0.5), 0.1) == pytest.approx((0.9, 0.05))
    assert towards((0.1, 0.0), (0.0, 0.05), 0.1) == (0.0, 0.05)
    assert towards((0.0, 0.0), (0.0, -1.0), 0.25) == pytest.approx((0.0, -0.25))
    assert towards((), (), 0.1) == ()
