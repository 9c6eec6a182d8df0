"""The stop model: no shorter than PX4's LAND, nor than the governor's braking."""

from __future__ import annotations

import math

import pytest
from hypothesis import given
from hypothesis import strategies as st

from companion.config.safety import Safety
from companion.safety.stop import LAND_AHEAD_S, LAND_DECELERATION_M_S2, StopModel

SPEEDS_M_S = st.floats(0.0, 3.0)
DECELERATIONS_M_S2 = st.floats(0.1, 20.0)


def model(react_s: float = Safety().react_time_s, deceleration_m_s2: float = 2.0) -> StopModel:
    return StopModel(Safety(react_time_s=react_s, stop_deceleration_m_s2=deceleration_m_s2))


@pytest.mark.parametrize(("speed_m_s", "drift_m"), [(0.625, 0.45), (0.8, 0.65), (1.13, 0.75)])
def test_it_covers_the_drift_of_a_real_px4(speed_m_s: float, drift_m: float) -> None:
    """PX4 1.16.1, companion hung in flight: docs/internals/px4.md."""
    assert model().distance_m(speed_m_s) >= drift_m


def test_at_flight_speeds_it_is_the_stop_point_of_land_after_the_reaction() -> None:
    assert model().distance_m(1.0) == pytest.approx(1.0 * (0.21 + 0.6 + 1.0 / 16.0))
    assert model().distance_m(0.0) == 0.0
    assert model().distance_m(-1.0) == 0.0
    assert model().time_s(0.0) == pytest.approx(0.81)


@given(SPEEDS_M_S, DECELERATIONS_M_S2, st.floats(0.0, 1.0))
def test_it_is_no_shorter_than_either_stop(speed_m_s: float, deceleration_m_s2: float, react_s: float) -> None:
    stop_m = model(react_s, deceleration_m_s2).distance_m(speed_m_s)
    land_m = speed_m_s * (react_s + LAND_AHEAD_S + speed_m_s / (2.0 * LAND_DECELERATION_M_S2))
    braked_m = speed_m_s * (react_s + speed_m_s / (2.0 * deceleration_m_s2))
    assert stop_m >= max(land_m, braked_m) - 1e-9


@given(SPEEDS_M_S, DECELERATIONS_M_S2, st.floats(0.0, 1.0))
def test_braking_never_moves_the_predicted_stop_outward(
    speed_m_s: float, deceleration_m_s2: float, share: float
) -> None:
    """What the governor's proof rests on."""
    stop = model(deceleration_m_s2=deceleration_m_s2)
    slower_m_s = share * speed_m_s
    way_m = (speed_m_s**2 - slower_m_s**2) / (2.0 * deceleration_m_s2)
    assert way_m + stop.distance_m(slower_m_s) <= stop.distance_m(speed_m_s) + 1e-9


@given(SPEEDS_M_S)
def test_time_and_distance_agree(speed_m_s: float) -> None:
    stop = model()
    assert math.isclose(stop.distance_m(speed_m_s), speed_m_s * stop.time_s(speed_m_s))
