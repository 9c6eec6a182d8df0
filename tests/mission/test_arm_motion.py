"""The arm's motion by ruckig: within its limits, both joints in step, no longer than needed."""

from __future__ import annotations

import math

import pytest
from hypothesis import assume, given
from hypothesis import strategies as st

from companion.mission.arm_motion import ArmLimits, plan_arm
from companion.mission.reference import Move
from companion.model.types import Joints

LIMITS = ArmLimits((math.radians(90.0), math.radians(90.0)), math.radians(180.0), math.radians(600.0))
limit = st.floats(0.1, 20.0)
limits_of_any_kind = st.builds(ArmLimits, st.tuples(limit, limit), limit, st.floats(0.5, 200.0))
delta = st.floats(-3.2, 3.2)


def used(delta_rad: Joints, limits: ArmLimits, move: Move) -> list[float]:
    """Largest share of each limit: speed, acceleration, jerk."""
    worst = [0.0, 0.0, 0.0]
    for index in range(1000):
        _, speeds, accelerations, jerks = move.at(move.start_s + move.duration_s * index / 1000)
        shares = (
            max(abs(speed) / most for speed, most in zip(speeds, limits.speed_max_rad_s, strict=True)),
            max(map(abs, accelerations)) / limits.acceleration_max_rad_s2,
            max(map(abs, jerks)) / limits.jerk_max_rad_s3,
        )
        worst = [max(a, b) for a, b in zip(worst, shares, strict=True)]
    return worst


@given(st.tuples(delta, delta), limits_of_any_kind, st.one_of(st.just(0.0), st.floats(0.1, 60.0)))
def test_any_move_keeps_its_limits_and_ends_at_rest(delta_rad: Joints, limits: ArmLimits, duration_s: float) -> None:
    assume(max(map(abs, delta_rad)) > 1e-6)
    motion = plan_arm(delta_rad, limits, duration_s)
    assert motion.duration_s >= duration_s
    move = Move(start_s=2.0, duration_s=motion.duration_s, origin=(0.0, 0.0), delta=delta_rad, profile=motion.profile)
    shares = used(delta_rad, limits, move)
    assert max(shares) <= 1.0 + 1e-6
    if motion.duration_s > duration_s:
        assert max(shares) >= 0.99, "slower than it must be"
    assert move.end == pytest.approx(delta_rad)
    value, speed, acceleration, _ = move.at(move.end_s - 1e-12 * move.duration_s)
    assert value == pytest.approx(delta_rad, abs=1e-8)
    assert speed == pytest.approx((0.0, 0.0), abs=1e-6 * (1.0 + max(map(abs, delta_rad)) / move.duration_s))
    assert acceleration == pytest.approx((0.0, 0.0), abs=1e-6 * limits.jerk_max_rad_s3 * motion.duration_s)


low = st.floats(1e-7, 20.0)


@given(st.tuples(delta, delta), st.builds(ArmLimits, st.tuples(low, low), low, low), st.floats(1e-3, 60.0))
def test_limits_that_are_absurdly_low_make_a_move_slow(delta_rad: Joints, limits: ArmLimits, duration_s: float) -> None:
    assume(max(map(abs, delta_rad)) > 1e-6)
    slowest_s = max(abs(to) / most for to, most in zip(delta_rad, limits.speed_max_rad_s, strict=True))
    assert plan_arm(delta_rad, limits, duration_s).duration_s >= max(duration_s, slowest_s * (1.0 - 1e-6))


@given(st.tuples(delta, delta), limits_of_any_kind, st.floats(0.1, 60.0))
def test_value_speed_and_acceleration_do_not_jump(delta_rad: Joints, limits: ArmLimits, duration_s: float) -> None:
    assume(max(map(abs, delta_rad)) > 1e-6)
    profile = plan_arm(delta_rad, limits, duration_s).profile
    for knot in profile.knots[1:]:
        before, after = profile(math.nextafter(knot, 0.0)), profile(knot)
        scale = 1.0 + max(map(abs, before))
        assert before[:3] == pytest.approx(after[:3], abs=1e-9 * scale)


def test_the_same_move_is_the_same_bit_for_bit() -> None:
    one, other = (plan_arm((-1.1, -1.4), LIMITS, 2.5) for _ in range(2))
    assert one == other
    assert one.duration_s == 2.5


def test_both_joints_move_in_step() -> None:
    motion = plan_arm((1.0, -0.5), LIMITS)
    move = Move(start_s=0.0, duration_s=motion.duration_s, origin=(0.2, 0.3), delta=(1.0, -0.5), profile=motion.profile)
    for index in range(100):
        first, second = move.at(move.duration_s * index / 100)[0]
        assert (first - 0.2) / 1.0 == pytest.approx((second - 0.3) / -0.5, abs=1e-12)


def test_a_slow_joint_sets_the_pace() -> None:
    slow = ArmLimits((math.radians(90.0), math.radians(20.0)), LIMITS.acceleration_max_rad_s2, LIMITS.jerk_max_rad_s3)
    assert plan_arm((1.0, 0.9), slow).duration_s > 0.9 / math.radians(20.0) > plan_arm((1.0, 0.9), LIMITS).duration_s


def test_a_move_to_where_it_is_is_no_move() -> None:
    with pytest.raises(ValueError, match="without displacement"):
        plan_arm((0.0, 0.0), LIMITS)


@pytest.mark.parametrize("duration_s", [1.0, 33.0, 600.0])
@pytest.mark.parametrize("delta_rad", [1e-4, 0.109375 * math.pi / 180.0, 0.109375, 2.0])
def test_a_small_move_in_a_long_time_is_planned(delta_rad: float, duration_s: float) -> None:
    motion = plan_arm((0.0, delta_rad), ArmLimits((1.0, 0.5), 2.8125, 132.5), max(duration_s, 10.0 * delta_rad))
    assert motion.duration_s == pytest.approx(max(duration_s, 10.0 * delta_rad))
