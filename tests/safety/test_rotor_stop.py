"""When the rotors may be stopped: what each source must show, and for how long. The numbers are those of docs/internals/safety.md."""

from __future__ import annotations

import math
from collections.abc import Callable
from typing import Any

import pytest

from companion.model.frames import quat_from_euler_zyx
from companion.model.types import FlightMode, Inputs, LandedState
from companion.safety.armed_externally import found_armed
from companion.safety.rotor_stop import RotorStop
from tests.safety.test_autopilot_landing import CLEARANCE_M, LEVEL, TILT_MAX_RAD, seen

STEP_S = 0.01
LOW_M, HIGH_M = CLEARANCE_M + 0.24, CLEARANCE_M + 0.26
"""Below and above the height at which a vehicle can be on the ground."""
FLIPPED, NEARLY_FLIPPED = (quat_from_euler_zyx(math.radians(deg), 0.0, 0.0) for deg in (71.0, 69.0))
TIPPED, NEARLY_TIPPED = (quat_from_euler_zyx(math.radians(deg), 0.0, 0.0) for deg in (41.0, 39.0))
Seen = Callable[[float], Inputs]


def always(**what: Any) -> Seen:
    return lambda t_s: seen(t_s, **{"height_m": LOW_M, "mode": FlightMode.OFFBOARD, **what})


def first_s(seen_at: Seen, evidence: str, *, until_s: float = 6.0, pose_s: float = -math.inf) -> float | None:
    """Time at which this evidence is complete, in s from the first tick; None if it is not."""
    stop = RotorStop.begin(CLEARANCE_M, TILT_MAX_RAD, pose_s)
    for k in range(round(until_s / STEP_S)):
        stop = stop.update(seen_at(10.0 + k * STEP_S))
        if getattr(stop, evidence):
            return k * STEP_S
    return None


def test_at_rest_it_may_be_disarmed_after_a_third_of_a_second_and_by_force_after_four() -> None:
    # Motion capture alone needs 0.08 s to measure that it does not sink.
    assert first_s(always(), "may_disarm") == pytest.approx(0.43, abs=0.03)
    assert first_s(always(), "may_force") == pytest.approx(4.08, abs=0.03)


@pytest.mark.parametrize(
    "what",
    [
        {"height_m": LOW_M, "mocap_m": HIGH_M},
        {"height_m": HIGH_M, "mocap_m": LOW_M},
        {"sink_m_s": 0.1, "mocap": False},
        {"mode": FlightMode.MANUAL},
        {"mode": FlightMode.HOLD},
        {"armed": False},
        {"heard_s": 0.0},
    ],
    ids=[
        "only PX4 low",
        "only motion capture low",
        "PX4 sinks, unseen",
        "a pilot",
        "a pilot's hold",
        "disarmed",
        "deaf to PX4",
    ],
)
def test_its_rotors_are_not_stopped_on_the_word_of_one_source_or_against_a_pilot(what: dict[str, Any]) -> None:
    at = always(**what)
    assert first_s(at, "may_disarm", pose_s=1e3) is None
    assert first_s(at, "may_force", pose_s=1e3) is None


def test_what_motion_capture_sees_sink_is_not_disarmed_although_px4_is_at_rest() -> None:
    assert first_s(lambda t_s: seen(t_s, LOW_M, mocap_m=LOW_M - 0.1 * (t_s - 10.0)), "may_disarm", until_s=2.0) is None


def test_by_px4s_estimate_alone_it_is_disarmed_only_while_that_is_fresh_and_never_by_force() -> None:
    unseen = always(mocap=False)
    assert first_s(unseen, "may_disarm", pose_s=10.0) == pytest.approx(0.35, abs=0.011)
    assert first_s(unseen, "may_disarm", pose_s=10.0 - 4.2 + 0.34) is None, "stale before it has been still long enough"
    assert first_s(unseen, "may_force", pose_s=1e3) is None
    assert first_s(always(mocap=False, position_s=9.0), "may_disarm", pose_s=1e3) is None, "no position any more"


def test_a_move_of_more_than_five_centimetres_begins_the_rest_anew() -> None:
    def moved(by_m: float) -> Seen:
        return lambda t_s: seen(t_s, LOW_M, aside_m=by_m if t_s > 13.0 else 0.0)

    assert first_s(moved(0.04), "may_force") == pytest.approx(4.08, abs=0.03)
    assert first_s(moved(0.06), "may_force") is None
    assert first_s(moved(0.06), "may_force", until_s=7.5) == pytest.approx(7.0, abs=0.03)


def test_a_source_that_goes_or_comes_back_begins_the_rest_anew() -> None:
    def gone(until_s: float) -> Seen:
        return lambda t_s: seen(t_s, LOW_M, mocap=not 13.0 <= t_s < until_s)

    # 0.08 s to measure that it does not sink.
    assert first_s(gone(13.6), "may_force", until_s=9.0) == pytest.approx(3.6 + 0.08 + 4.0, abs=0.03)
    assert first_s(gone(99.0), "may_force") is None, "motion capture has shown only 3 s of the rest"


@pytest.mark.parametrize(
    ("what", "stopped"),
    [
        ({"attitude": FLIPPED}, True),
        ({"attitude": NEARLY_FLIPPED}, False),
        ({"attitude": FLIPPED, "mocap_attitude": NEARLY_FLIPPED}, False),
        ({"attitude": FLIPPED, "mocap_attitude": LEVEL, "feels_m_s2": 0.0}, False),
        ({"attitude": LEVEL, "mocap_attitude": FLIPPED}, False),
        ({"attitude": FLIPPED, "attitude_s": 9.0}, False),
        ({"attitude": FLIPPED, "mode": FlightMode.MANUAL}, False),
        ({"attitude": FLIPPED, "mode": FlightMode.HOLD}, False),
        ({"attitude": FLIPPED, "mocap": False, "feels_m_s2": 3.2}, True),
        ({"attitude": FLIPPED, "mocap": False, "feels_m_s2": 3.5}, False),  # 9.81 cos 70 deg = 3.36
        ({"attitude": FLIPPED, "mocap": False, "feels_m_s2": 0.0, "imu_s": 9.0}, False),
    ],
)
def test_flipped_at_any_height_its_rotors_are_stopped_if_two_sources_say_so_for_0_3_s(
    what: dict[str, Any], stopped: bool
) -> None:
    found_s = first_s(always(height_m=2.0, **what), "flipped", until_s=1.5)
    assert found_s == (pytest.approx(0.3, abs=0.011) if stopped else None)


def test_what_was_flipped_before_the_landing_began_is_stopped_in_its_first_tick() -> None:
    stop = RotorStop.begin(CLEARANCE_M, TILT_MAX_RAD, flipped=True)
    assert stop.update(seen(10.0, 2.0, attitude=FLIPPED)).overturned
    assert not stop.update(seen(10.0, 2.0)).overturned, "it has righted itself"


@pytest.mark.parametrize(
    ("what", "stopped"),
    [
        ({"attitude": TIPPED}, True),
        ({"attitude": TIPPED, "mode": FlightMode.LAND}, True),
        ({"attitude": NEARLY_TIPPED}, False),
        ({"attitude": TIPPED, "mocap_attitude": LEVEL}, False),
        ({"attitude": LEVEL, "mocap_attitude": TIPPED}, False),
        ({"attitude": TIPPED, "attitude_s": 9.0}, False),
        ({"attitude": TIPPED, "height_m": HIGH_M}, False),
        ({"attitude": TIPPED, "mocap": False}, False),
        ({"attitude": TIPPED, "mode": FlightMode.OTHER}, False),
        ({"attitude": TIPPED, "mode": FlightMode.MANUAL}, False),
    ],
)
def test_tipped_over_on_the_floor_its_rotors_are_stopped_if_both_say_so_for_half_a_second(
    what: dict[str, Any], stopped: bool
) -> None:
    found_s = first_s(always(**what), "tipped", until_s=1.5)
    assert found_s == (pytest.approx(0.5, abs=0.011) if stopped else None)


@pytest.mark.parametrize(
    ("what", "flies", "text"),
    [
        ({"mode": FlightMode.OFFBOARD}, False, "the companion disarms it"),
        ({"mode": FlightMode.LAND}, False, "the companion disarms it"),
        ({"mode": FlightMode.OTHER}, True, "PX4 lands"),
        ({"height_m": HIGH_M}, True, "PX4 lands"),
        ({"landed": LandedState.IN_AIR}, True, "PX4 lands"),
        ({"mocap": False}, True, "PX4 lands"),  # PX4's own height may have drifted
        ({"height_m": HIGH_M, "mocap_m": LOW_M}, False, "the companion disarms it"),
        ({"mode": FlightMode.MANUAL}, True, "a pilot has chosen the mode"),
        ({"mode": FlightMode.HOLD}, True, "a pilot has chosen the mode"),
    ],
)
def test_what_was_armed_by_others_is_disarmed_only_if_it_stands_by_motion_capture_and_by_px4(
    what: dict[str, Any], flies: bool, text: str
) -> None:
    found = always(**{"landed": LandedState.ON_GROUND, **what})(10.0)
    assert found_armed(found, CLEARANCE_M)[0] is flies
    said = found_armed(found, CLEARANCE_M)[1]
    assert text in said and f"mode {what.get('mode', FlightMode.OFFBOARD).value.upper()}" in said
    seen_m = what.get("mocap_m", what.get("height_m", LOW_M))
    assert f"height {seen_m:.2f} m" in said
