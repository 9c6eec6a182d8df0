"""Poses that are too late for PX4 still show that the vehicle stands, while PX4's estimate drifts below the floor."""

from __future__ import annotations

import pytest
from msgspec.structs import replace

from companion.config.loader import load_vehicle
from companion.model.types import AutopilotRequest, FlightMode, LandedState, MocapPose
from companion.safety.autopilot_landing import AutopilotLanding
from companion.safety.monitors import Monitors
from companion.sitl_config.loader import load_sitl
from sitl.campaigns.flights import fly_to_end, with_world
from sitl.campaigns.robustness import prepare
from tests.safety.healthy import START_S, TICK_S, flying, healthy, put

CLEARANCE_M = 0.30
SINKS = put("vehicle", position_world_m=(0.0, 0.0, -1.0), velocity_world_m_s=(0.0, 0.0, -0.6))
LANDS = put("status", mode=FlightMode.LAND, landed=LandedState.LANDING)


def touchdown_s(height_m: float, sink_m_s: float = 0.0, late: bool = True) -> float | None:
    """Time from the start of the landing to the first request to stop the rotors, in 6 s; PX4's estimate sinks below the floor."""
    landing = AutopilotLanding.begin(START_S, CLEARANCE_M, 0.7, False, pose_s=START_S)
    for tick in range(1200):
        inputs = LANDS(SINKS(replace(healthy(tick), mocap=None)))
        pose = healthy(tick).mocap
        assert isinstance(pose, MocapPose)
        place = (0.0, 0.0, height_m - sink_m_s * tick * TICK_S)
        landing, step = landing.step(inputs, replace(pose, position_world_m=place) if late else None)
        assert step.request is not AutopilotRequest.FORCE_DISARM, (
            "not before PX4 was in OFFBOARD with zero thrust for 4 s"
        )
        if step.zero_thrust:
            return tick * TICK_S
    return None


@pytest.mark.parametrize(
    ("height_m", "sink_m_s", "late", "found_s"),
    [
        (CLEARANCE_M + 0.03, 0.0, True, 1.575),  # 1.5 s, after the window in which its descent is measured
        (CLEARANCE_M + 0.03, 0.0, False, None),
        (CLEARANCE_M + 0.2, 0.0, True, None),
        (CLEARANCE_M + 0.6, 0.1, True, None),
    ],
    ids=["stands", "not seen", "hovers higher", "still sinks"],
)
def test_late_poses_near_the_floor_show_a_touchdown(
    height_m: float, sink_m_s: float, late: bool, found_s: float | None
) -> None:
    assert touchdown_s(height_m, sink_m_s, late) == pytest.approx(found_s, abs=0.02)


@pytest.mark.parametrize(("age_s", "shows"), [(0.05, False), (0.2, True), (0.6, False), (3.0, False)])
def test_a_pose_of_seconds_ago_shows_no_touchdown(age_s: float, shows: bool) -> None:
    """A vehicle that has lifted off still stands in such a stream, and its rotors would be stopped in the air."""
    monitors = Monitors(load_vehicle("configs/vehicles/tarot650_2r.yaml"))
    for tick in range(100):
        inputs = healthy(tick)
        late = put("mocap", latency_s=age_s, exposure_server_s=inputs.t_s - age_s)
        monitors.check(late(inputs), flying())
    assert (monitors.late_pose is not None) == shows


def test_a_vehicle_whose_estimate_drifts_along_the_floor_is_stopped_where_late_poses_show_it() -> None:
    """It had slid 4 m to the end of its tether, its rotors on, until the landing was given up after 30 s."""
    fault = "world.faults=[{kind: mocap_network, phase: line, duration_s: 60.0, size: 0.15}]"
    config = load_sitl("catch", world="lab", overrides=(fault,))
    job = {"seed": 201, "flights": [{"name": "slid", "number": 98, "world": None}], "fixed": ["faults"]}
    (flight,) = prepare(job, [config])
    result = fly_to_end(with_world(config, flight["world"])).result
    assert result.outputs[-1].outcome is not None and result.outputs[-1].outcome.value == "aborted"
    assert not result.armed
    x, y, _ = result.truth[-1].position_world_m
    assert abs(x) < 0.3 and abs(y) < 0.4
