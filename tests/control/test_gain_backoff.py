"""The feedback of an arm that swings is lowered until it is still, and comes back slowly."""

import math

import pytest

from companion.control.gain_backoff import AGE_MAX_S, RISE_TIME_S, SHARE_MIN, GainBackoff

DT_S = 0.005


def after(ticks: int, swings: bool, backoff: GainBackoff, age_s: float = 0.001) -> float:
    for _ in range(ticks):
        backoff.update(DT_S, swings, age_s)
    return backoff.share


def test_the_share_falls_within_half_a_second_while_a_joint_swings_and_never_below_a_tenth() -> None:
    backoff = GainBackoff()
    assert after(1, False, backoff) == 1.0
    assert after(100, True, backoff) == SHARE_MIN
    assert after(100, True, backoff) == SHARE_MIN


def test_it_grows_slowly_afterwards_and_is_whole_in_the_end() -> None:
    backoff = GainBackoff()
    after(200, True, backoff)
    assert after(round(RISE_TIME_S / DT_S), False, backoff) == pytest.approx(1.0 - 0.9 / 2.718, abs=0.001)
    assert after(round(5 * RISE_TIME_S / DT_S), False, backoff) == 1.0


def test_joint_states_that_are_too_late_for_the_gain_lower_it_without_a_swing() -> None:
    assert after(100, False, GainBackoff(), AGE_MAX_S) == 1.0
    assert after(100, False, GainBackoff(), AGE_MAX_S + 0.001) == SHARE_MIN


def test_gravity_is_carried_whole_and_only_what_the_law_adds_is_lowered() -> None:
    backoff = GainBackoff()
    backoff.share = 0.25
    assert backoff.torque_nm((1.0, -2.0), (0.2, 0.4)) == pytest.approx((0.4, -0.2))


def test_torques_that_the_gate_refuses_pass_unchanged_and_raise_nothing() -> None:
    backoff = GainBackoff()
    backoff.share = 0.25
    assert backoff.torque_nm((1.0, -2.0, 0.5), (0.2, 0.4)) == (1.0, -2.0, 0.5)
    assert not math.isfinite(sum(backoff.torque_nm((math.nan, 0.0), (0.2, 0.4))))
