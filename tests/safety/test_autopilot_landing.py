"""The landing in PX4's LAND mode: what the companion asks for, and when it lets go."""

from __future__ import annotations

import math
from collections.abc import Callable

import pytest

from companion.model.types import AutopilotRequest, FlightMode, Inputs, LandedState, Quat
from companion.safety.autopilot_landing import IMPACT_HOLD_S, TIMEOUT_S, AutopilotLanding, LandingStep
from companion.safety.touchdown import HEIGHT_HOLD_S, HEIGHT_MARGIN_M
from tests.safety.healthy import healthy, put

LEVEL: Quat = (1.0, 0.0, 0.0, 0.0)
CLEARANCE_M = 0.3
TILT_MAX_RAD = math.radians(40.0)


def seen(
    t_s: float,
    height_m: float,
    *,
    sink_m_s: float = 0.0,
    mode: FlightMode = FlightMode.LAND,
    landed: LandedState = LandedState.IN_AIR,
    armed: bool = True,
    heard_s: float | None = None,
    mocap: bool = True,
    mocap_m: float | None = None,
    position_s: float | None = None,
    attitude: Quat = LEVEL,
    mocap_attitude: Quat | None = None,
    attitude_s: float | None = None,
    imu_s: float | None = None,
    feels_m_s2: float = 9.81,
    aside_m: float = 0.0,
) -> Inputs:
    """PX4 at a height, in a mode, armed; motion capture agrees where it is not given another value."""
    vehicle = put(
        "vehicle",
        position_stamp_s=t_s if position_s is None else position_s,
        attitude_stamp_s=t_s if attitude_s is None else attitude_s,
        imu_stamp_s=t_s if imu_s is None else imu_s,
        position_world_m=(aside_m, 0.0, height_m),
        velocity_world_m_s=(0.0, 0.0, -sink_m_s),
        attitude_wxyz=attitude,
        specific_force_body_m_s2=(0.0, 0.0, feels_m_s2),
    )
    heartbeat_s = t_s if heard_s is None else heard_s
    status = put("status", heartbeat_stamp_s=heartbeat_s, armed=armed, mode=mode, landed=landed)
    pose = put(
        "mocap",
        stamp_s=t_s if mocap else 0.0,
        position_world_m=(aside_m, 0.0, height_m if mocap_m is None else mocap_m),
        attitude_wxyz=attitude if mocap_attitude is None else mocap_attitude,
    )
    return pose(status(vehicle(healthy(t_s=t_s))))


class Landing:
    """A landing that goes on from step to step."""

    def __init__(self, pilot: bool) -> None:
        self._now = AutopilotLanding.begin(0.0, CLEARANCE_M, TILT_MAX_RAD, pilot, pose_s=0.0)

    def step(self, i: Inputs) -> LandingStep:
        self._now, step = self._now.step(i)
        return step


def test_it_asks_for_land_until_touchdown_then_takes_offboard_back_with_zero_thrust_and_disarms() -> None:
    landing = Landing(pilot=False)
    step = landing.step(seen(0.1, 1.0, sink_m_s=0.7, mocap=False))
    assert (step.request, step.zero_thrust) == (AutopilotRequest.LAND, False)
    requests = []
    for k in range(300):
        t_s = 2.0 + k * 0.005
        mode = FlightMode.OFFBOARD if AutopilotRequest.OFFBOARD in requests else FlightMode.LAND
        landed = LandedState.ON_GROUND if t_s > 3.3 else LandedState.IN_AIR
        step = landing.step(seen(t_s, 0.31, mode=mode, landed=landed, mocap=False))
        requests.append(step.request)
        if step.request is not AutopilotRequest.LAND:
            assert step.zero_thrust
    order = [request for k, request in enumerate(requests) if k == 0 or request is not requests[k - 1]]
    assert order == [
        AutopilotRequest.LAND,
        AutopilotRequest.NONE,
        AutopilotRequest.OFFBOARD,
        AutopilotRequest.NONE,
        AutopilotRequest.DISARM,
    ]
    assert landing.step(seen(4.0, 0.31, armed=False)).ended


@pytest.mark.parametrize(("elapsed_s", "ended"), [(0.49, False), (0.51, True)])
def test_disarmed_in_the_first_half_second_does_not_end_the_landing(elapsed_s: float, ended: bool) -> None:
    """PX4 reports it once a second: the report may be older than the landing."""
    assert Landing(pilot=False).step(seen(elapsed_s, 1.0, armed=False)).ended is ended


def test_px4s_word_that_it_stands_is_believed_after_the_first_second() -> None:
    """Until then it may be that of before the flight."""
    landing = Landing(pilot=False)
    steps = {k: landing.step(seen(0.01 * k, 0.31, landed=LandedState.ON_GROUND)) for k in range(1, 110)}
    first = next(k for k, step in steps.items() if step.request is AutopilotRequest.DISARM)
    assert 0.01 * first == pytest.approx(1.0, abs=0.02)


def test_a_height_without_a_trusted_pose_is_no_touchdown() -> None:
    """Without vision for longer than PX4's height holds, thrust is not cut on its word."""
    landing = Landing(pilot=False)
    for k in range(400):
        step = landing.step(seen(5.0 + k * 0.005, 0.31, mocap=False))
        assert not step.zero_thrust


def test_a_height_that_does_not_arrive_any_more_is_no_touchdown() -> None:
    """PX4's attitude goes on and its position does not: the last one, low and still, said for good that the vehicle stands."""
    landing = Landing(pilot=False)
    landing.step(seen(0.2, 0.31, mocap=False))
    steps = [landing.step(seen(1.5 + k * 0.005, 0.31, mocap=False, position_s=1.2)) for k in range(400)]
    assert {step.request for step in steps} == {AutopilotRequest.LAND}
    assert not any(step.zero_thrust for step in steps)


def blind_landing(up_m_s: Callable[[float], float], height_m: float) -> float | None:
    """Time of zero thrust in a landing without motion capture with this estimated speed; None if there is none within 4 s."""
    landing = Landing(pilot=False)
    for k in range(1, 800):
        t_s = k * 0.005
        if landing.step(seen(t_s, height_m, sink_m_s=-up_m_s(t_s), mocap=False)).zero_thrust:
            return t_s
    return None


@pytest.mark.parametrize("after_m_s", [-0.2, 0.0, 0.4])
def test_a_descent_that_the_floor_stops_is_a_touchdown_although_the_estimate_drifts(after_m_s: float) -> None:
    """The floor is touched after 2 s; dead reckoning is 0.5 m off by then, and not at rest."""
    found_s = blind_landing(lambda t_s: -0.7 if 0.8 < t_s < 2.0 else after_m_s if t_s >= 2.0 else 0.0, 0.8)
    assert found_s == pytest.approx(2.0 + HEIGHT_HOLD_S, abs=0.02)


@pytest.mark.parametrize("drift_m_s2", [-0.1, 0.0, 0.05])
def test_an_impact_after_which_the_descent_does_not_resume_is_a_touchdown(drift_m_s2: float) -> None:
    """The vehicle touches the floor at 0.25 m/s, and the estimate goes on from 0.6 to 0.35 m/s: more than half."""

    def up_m_s(t_s: float) -> float:
        return -0.35 + drift_m_s2 * (t_s - 2.0) if t_s >= 2.0 else -0.6 if t_s > 0.8 else 0.0

    found_s = blind_landing(up_m_s, 0.8)
    assert found_s == pytest.approx(2.0 + IMPACT_HOLD_S, abs=0.02)


@pytest.mark.parametrize(
    "up_m_s",
    [
        lambda t_s: 0.0,  # it brakes, and has not begun to descend
        lambda t_s: -0.2 if t_s < 1.5 else 0.0,  # slower than any descent of PX4
        lambda t_s: 0.05,  # the estimate drifts up
        lambda t_s: -0.7,
        lambda t_s: -0.7 + min(0.3, max(0.0, t_s - 1.5)),  # PX4 descends more slowly near the floor
        lambda t_s: -0.7 + (t_s > 1.5) * 0.3 * math.exp(4.0 * (1.5 - t_s)),  # a bump, and PX4 descends as before
        lambda t_s: -0.7 if t_s < 1.5 or t_s > 1.7 else 0.0,  # a gust
        lambda t_s: -1.8 if t_s < 1.0 else -0.6,  # it falls when the landing begins, and PX4 brakes it
    ],
)
def test_a_descent_that_goes_on_is_no_touchdown(up_m_s: Callable[[float], float]) -> None:
    assert blind_landing(up_m_s, 0.8) is None


def test_a_descent_that_ends_higher_than_the_estimate_can_have_drifted_is_no_touchdown() -> None:
    assert (
        blind_landing(lambda t_s: -0.7 if 0.5 < t_s < 1.0 else 0.0, 2.0 + CLEARANCE_M + HEIGHT_MARGIN_M + 0.25 * 16)
        is None
    )


def test_a_slower_descent_after_a_gap_in_px4s_positions_is_no_impact() -> None:
    landing = Landing(pilot=False)
    for k in range(1, 800):
        t_s = k * 0.005
        stamp_s = 1.5 if 1.5 < t_s < 1.75 else t_s
        sink_m_s = 0.65 if stamp_s <= 1.5 else 0.4
        assert not landing.step(seen(t_s, 0.8, sink_m_s=sink_m_s, mocap=False, position_s=stamp_s)).zero_thrust


@pytest.mark.parametrize("mocap_m", [CLEARANCE_M + 0.6, None])
def test_thrust_is_not_cut_while_motion_capture_shows_the_vehicle_high_although_px4_believes_that_it_stands(
    mocap_m: float | None,
) -> None:
    """It hangs on its tether and PX4's height has drifted; the second run shows that it lands otherwise."""
    landing = Landing(pilot=False)
    steps = [landing.step(seen(1.0 + k * 0.005, 0.31, mocap_m=mocap_m)) for k in range(600)]
    assert any(step.zero_thrust for step in steps) is (mocap_m is None)


def test_a_touchdown_in_the_first_second_of_px4s_descent_does_not_count() -> None:
    """PX4 brakes first: neither its speed nor its height says that it stands."""
    landing = Landing(pilot=False)
    times = [k * 0.005 for k in range(1, 1200)]
    modes = {t_s: FlightMode.OFFBOARD if t_s < 3.0 else FlightMode.LAND for t_s in times}
    cut_s = next(t_s for t_s in times if landing.step(seen(t_s, 0.31, mode=modes[t_s])).zero_thrust)
    assert cut_s == pytest.approx(3.0 + 1.0 + HEIGHT_HOLD_S, abs=0.02)


def test_without_px4s_word_a_standing_vehicle_is_disarmed_by_force_after_four_seconds_of_zero_thrust() -> None:
    landing = Landing(pilot=False)
    offboard_s = math.inf
    requests: list[tuple[float, AutopilotRequest]] = []
    for k in range(1, 1800):
        t_s = k * 0.005
        mode = FlightMode.OFFBOARD if t_s >= offboard_s else FlightMode.LAND
        step = landing.step(seen(t_s, 0.31, mode=mode))
        requests.append((t_s, step.request))
        if step.request is AutopilotRequest.OFFBOARD and offboard_s == math.inf:
            offboard_s = t_s + 1.0
    first_s = next(t_s for t_s, request in requests if request is AutopilotRequest.FORCE_DISARM)
    assert first_s == pytest.approx(offboard_s + 4.0, abs=0.02)


def test_sinking_is_no_touchdown() -> None:
    landing = Landing(pilot=False)
    for k in range(300):
        assert not landing.step(seen(1.0 + k * 0.005, 0.35, sink_m_s=0.2)).zero_thrust


def test_nothing_is_asked_against_a_pilot_for_as_long_as_they_fly() -> None:
    landing = Landing(pilot=True)
    for t_s in (0.1, 1.0, TIMEOUT_S + 1.0, 600.0):
        step = landing.step(seen(t_s, 1.0, mode=FlightMode.MANUAL))
        assert step.request is AutopilotRequest.NONE
        assert not step.zero_thrust
        assert not step.ended
    silent = landing.step(seen(603.0, 1.0, mode=FlightMode.MANUAL, heard_s=600.0))
    assert not silent.ended, "a gap of the link costs the pilot no motion capture"
    assert landing.step(seen(600.0 + TIMEOUT_S, 1.0, mode=FlightMode.MANUAL, heard_s=600.0)).ended
    assert landing.step(seen(700.0, 0.3, mode=FlightMode.MANUAL, armed=False)).ended


@pytest.mark.parametrize(
    ("before", "mode", "request_"),
    [
        (FlightMode.OFFBOARD, FlightMode.MANUAL, AutopilotRequest.NONE),
        (FlightMode.OFFBOARD, FlightMode.HOLD, AutopilotRequest.LAND),  # perhaps its mode before the landing
        (FlightMode.LAND, FlightMode.HOLD, AutopilotRequest.NONE),
        (FlightMode.LAND, FlightMode.LAND, AutopilotRequest.LAND),
    ],
)
def test_nothing_is_asked_once_a_pilot_has_chosen_a_mode(
    before: FlightMode, mode: FlightMode, request_: AutopilotRequest
) -> None:
    landing = Landing(pilot=False)
    assert landing.step(seen(0.1, 1.0, mode=before)).request is AutopilotRequest.LAND
    assert landing.step(seen(0.2, 1.0, mode=mode)).request is request_


def test_a_silent_px4_that_stands_is_landed_and_one_in_the_air_is_not() -> None:
    landing = Landing(pilot=False)
    steps = [landing.step(seen(4.0 + k * 0.05, 0.31, heard_s=0.0)) for k in range(80)]
    assert steps[-1].ended
    assert steps[-1].landed
    assert "by hand" in (steps[-1].text or "")
    hovering = Landing(pilot=False)
    assert not any(hovering.step(seen(4.0 + k * 0.05, 1.0, heard_s=0.0)).ended for k in range(80))
    late = hovering.step(seen(TIMEOUT_S + 1.0, 1.0, heard_s=0.0))
    assert late.ended
    assert not late.landed
