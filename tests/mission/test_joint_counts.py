"""Plans and their check for arms of any number of joints, and for a vehicle without an arm."""

from __future__ import annotations

import math

import pytest

from companion.config.loader import FlightConfig, load_flight
from companion.mission.active_plan import ActiveTrajectory
from companion.mission.check import check_mission, check_start
from companion.mission.plan import Plan, landing_from
from tests.machines import overrides_with_joints

COUNTS = (0, 1, 2, 4)
REST = (0.0, 0.0, 0.0)


def loaded(count: int, mission: str, *overrides: str) -> FlightConfig:
    return load_flight(f"configs/missions/{mission}.yaml", overrides=[*overrides_with_joints(count), *overrides])


@pytest.mark.parametrize("count", COUNTS)
def test_the_shipped_missions_are_accepted(count: int) -> None:
    for mission in ("hover", *(("catch",) if count else ())):
        config = loaded(count, mission)
        assert check_mission(config.mission, config.vehicle) == []


@pytest.mark.parametrize("count", COUNTS[1:])
def test_every_joint_reaches_the_pose_and_a_hold_stops_it(count: int) -> None:
    config = loaded(count, "catch")
    plan = Plan.build(config.mission, config.vehicle)
    unfolded = tuple(map(math.radians, config.vehicle.poses_deg["unfolded"]))
    reached = [plan.reference(segment.end_s - 1e-9).arm_rad for segment in plan.segments]
    assert any(math.dist(arm_rad, unfolded) < 1e-6 for arm_rad in reached)
    t_s, moving = max(
        ((0.1 * k, plan.reference(0.1 * k)) for k in range(int(10 * plan.duration_s))),
        key=lambda found: max(map(abs, found[1].arm_rate_rad_s)),
    )
    assert all(moving.arm_rate_rad_s)
    held = ActiveTrajectory(plan, 0.0).hold(t_s).reference(t_s + 10.0)
    assert held.arm_rate_rad_s == (0.0,) * count


@pytest.mark.parametrize("count", COUNTS)
def test_a_landing_folds_every_joint(count: int) -> None:
    vehicle = loaded(count, "hover").vehicle
    fold_rad = tuple(map(math.radians, vehicle.fold_arm_deg))
    landing = landing_from((0.0, 0.0, 1.5), REST, 0.0, tuple(a - 0.5 for a in fold_rad), fold_rad, 0.35, vehicle)
    assert landing.reference(landing.duration_s).arm_rad == fold_rad


@pytest.mark.parametrize(("phase", "why"), [("arm", "has no arm"), ("catch", "has no net")])
def test_a_mission_that_needs_the_absent_arm_is_refused_by_the_name_of_the_phase(phase: str, why: str) -> None:
    name = "unfold" if phase == "arm" else "wait"
    moves = {
        "arm": "mission.phases[1]={type: arm, name: unfold, arm_deg: []}",
        "catch": "mission.phases[1]={type: hold, name: wait, duration_s: 5.0}",
    }
    catch = ["mission.catch={expected_at_m: [0, 0], payload_max_kg: 0.1}"] if phase == "catch" else []
    config = loaded(0, "hover", moves[phase], *catch)
    (problem,) = check_mission(config.mission, config.vehicle)
    assert f"phase '{name}'" in problem and why in problem


@pytest.mark.parametrize("count", COUNTS[1:])
def test_an_arm_away_from_its_start_is_told_with_every_joint(count: int) -> None:
    config = loaded(count, "hover")
    start = config.mission.start
    arm_rad = tuple(map(math.radians, start.arm_deg))
    at = (*start.position_m, config.vehicle.airframe.ground_clearance_m)
    off = (*arm_rad[:-1], arm_rad[-1] - 0.5)
    assert check_start(config.mission, config.vehicle, at, math.radians(start.yaw_deg), arm_rad) == []
    (problem,) = check_start(config.mission, config.vehicle, at, math.radians(start.yaw_deg), off)
    wanted = ", ".join(f"{angle:g}" for angle in start.arm_deg)
    assert f"starts with the arm at ({wanted}) deg" in problem


@pytest.mark.parametrize(("yaw_deg", "hits"), [(45.0, True), (0.0, False)])
def test_an_arm_that_swings_into_a_rotor_is_refused(yaw_deg: float, hits: bool) -> None:
    """The forearm points up in front of the body, between the front rotors at a yaw of 0 and into the left one at 45 deg."""
    move = f"mission.phases[1]={{type: arm, name: swing, arm_deg: [{yaw_deg}, 20, 90, 0]}}"
    config = load_flight("hover", vehicle_path="tarot650_4r", overrides=[move])
    found = check_mission(config.mission, config.vehicle)
    assert any("brings the net into a rotor" in problem and "at rotor 3" in problem for problem in found) is hits
