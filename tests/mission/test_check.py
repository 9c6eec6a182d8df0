"""Missions that must not be flown, and the line that says so."""

# ruff: noqa: E501  (the lines are as long as users see them)

from __future__ import annotations

from bisect import bisect_left
from pathlib import Path
from typing import Any

import pytest
from msgspec.structs import replace

from companion.config.loader import FlightConfig, load_flight
from companion.mission.check import check_mission
from companion.mission.plan import Plan
from companion.safety.flight import FlightTracker
from companion.safety.rule import thresholds_of
from companion.safety.rules import RULES
from companion.safety.tether import TetherWatch, attachment_world_m, distance_m, slack_m
from tests.safety.healthy import flying, healthy
from tests.support import tether_of

ROOT = Path(__file__).parents[2]

LEVEL = (1.0, 0.0, 0.0, 0.0)


def load(*overrides: str, mission: str = "catch") -> FlightConfig:
    return load_flight(ROOT / f"configs/missions/{mission}.yaml", overrides=overrides)


def problems(*overrides: str, **measured: Any) -> list[str]:
    config = load(*overrides)
    return check_mission(config.mission, config.vehicle, **measured)


@pytest.mark.parametrize(("duration_s", "accepted"), [(5.03, False), (6.0, True)])
def test_a_line_to_the_wall_is_as_fast_as_the_landing_of_px4_can_stop_it(duration_s: float, accepted: bool) -> None:
    """1.13 m/s in between, rotors 0.15 m from the wall at its end: PX4's LAND overran the wall there by 0.02 m. 0.1 m more are left now."""
    line = f"mission.phases[1]={{type: line, to_m: [1.46, 0, 1.0], duration_s: {duration_s}}}"
    config = load("mission.limits.speed_max_m_s=1.2", "mission.limits.acceleration_max_m_s2=1.2", line, mission="hover")
    found = check_mission(config.mission, config.vehicle)
    assert found == [] if accepted else ["could not stop within the room" in problem for problem in found] == [True]


@pytest.mark.parametrize(
    ("where", "end", "off_m_s"),
    [
        (("vehicle.tether.length_m=3.5",), "room", (0.2, 0.0, 0.0)),
        (("vehicle.room.x_m=[-3, 3]", "vehicle.tether.length_m=2.6"), "tether sphere", (0.18, 0.14, 0.12)),
    ],
    ids=["wall", "tether"],
)
def test_0_2_m_s_or_more_off_the_fastest_accepted_plan_no_monitor_stops_it(
    where: tuple[str, ...], end: str, off_m_s: tuple[float, float, float]
) -> None:
    """Outward, at every instant of a line that ends near the wall or the tether's end; one that takes 0.1 s less is refused."""
    limits = ("mission.limits.speed_max_m_s=1.6", "mission.limits.acceleration_max_m_s2=2", *where)

    def line(tenths: int) -> tuple[FlightConfig, list[str]]:
        line = f"mission.phases[1]={{type: line, to_m: [1.5, 0, 1.0], duration_s: {tenths / 10}}}"
        config = load(*limits, line, mission="hover")
        return config, check_mission(config.mission, config.vehicle)

    tenths = 40 + bisect_left(range(40, 80), True, key=lambda tenths: not line(tenths)[1])
    config, found = line(tenths)
    refused = line(tenths - 1)[1]
    assert not found and refused and all(f"could not stop within the {end}" in problem for problem in refused)
    vehicle, start = config.vehicle, config.mission.start
    plan = Plan.build(config.mission, vehicle, (*start.position_m, vehicle.airframe.ground_clearance_m), 0.0)
    tracker, watch = FlightTracker(vehicle), TetherWatch(vehicle, tether_of(vehicle))
    stopping = {"geofence_near", "geofence_left", "tether_short", "tether_taut"}
    rules = [(rule, thresholds_of(rule, vehicle)) for rule in RULES if rule.id in stopping]
    assert len(rules) == len(stopping)
    line_segment = plan.segments[1]
    steps = int((line_segment.end_s - line_segment.start_s) / 0.02)
    assert tenths > 40 and steps > 200
    for k in range(steps):
        reference = plan.reference(line_segment.start_s + 0.02 * k)
        (vx, vy, vz), (ox, oy, oz) = reference.velocity_world_m_s, off_m_s
        position, velocity = reference.position_world_m, (vx + ox, vy + oy, vz + oz)
        tether = watch.update(0.02 * k, position, velocity, LEVEL, None, None, None)
        now = healthy(k)
        assert now.vehicle is not None
        state = replace(now.vehicle, position_world_m=position, velocity_world_m_s=velocity, attitude_wxyz=LEVEL)
        tracker.update(replace(now, vehicle=state), flying(tether=tether), 0.02)
        assert [rule.id for rule, thresholds in rules if rule.predicate(tracker, thresholds) is not None] == []


@pytest.mark.parametrize("mission", ["catch", "hover", "circuit"])
def test_committed_missions_are_flyable(mission: str) -> None:
    config = load(mission=mission)
    assert check_mission(config.mission, config.vehicle) == []
    assert check_mission(
        config.mission,
        config.vehicle,
        start_position_world_m=(-1.1, 0.08, config.vehicle.airframe.ground_clearance_m + 0.02),
        start_yaw_rad=0.1,
        start_arm_rad=(2.85, 2.42),
    ) == []  # fmt: skip


REFUSED = [
    (["mission.phases[2].to_m=[1, 0, 1.9]", "vehicle.tether.length_m=2.5"], "phase 'catch' leaves the tether sphere at t = 8.6 s, (0.97, 0.00, 1.89) m: 2.44 m from the anchor (limit 2.05 m: length minus margin and 0.2 m for the catch); shorten the line or move the anchor (also in 'stabilise', 'return')"),
    (["mission.phases[2].to_m=[1.9, 0, 1]"], "phase 'catch' leaves the room at t = 9.5 s, (1.90, 0.00, 1.00) m: the rotors, the arm and the net reach x = 2.39 m; the room is -2.2 to 2.2 m, reduced at each end by 0.1 m for tracking; move the waypoint inwards (also in 'stabilise', 'return')"),
    (["mission.phases[2].to_m=[1, -1.5, 1]"], "phase 'catch' leaves the room at t = 9.5 s, (1.00, -1.50, 1.00) m: the rotors, the arm and the net reach y = -1.99 m; the room is -1.8 to 1.8 m, reduced at each end by 0.1 m for tracking; move the waypoint inwards"),
    (["mission.phases[2].to_m=[1, 0, 2.1]"], "the rotors, the arm and the net reach z = 2.23 m; the room is 0 to 2.2 m, reduced at each end by 0.2 m for the catch"),
    (["mission.phases[2].to_m=[1, 0, 0.2]"], "phase 'catch' flies into the floor at t = 9.5 s, (1.00, 0.00, 0.20) m: the body's origin at 0.20 m (minimum 0.30 m); raise the waypoint"),
    (["mission.phases[2].to_m=[1, 0, 0.4]"], "phase 'catch' drags the net over the floor at t = 9.5 s, (1.00, 0.00, 0.40) m: its lowest point is -0.07 m high (minimum 0.01 m); fly higher or choose another pose of the arm"),
    (["mission.phases[4].arm_deg=[100, 60]"], "phase 'land' drags the net over the floor"),
    (["mission.phases[4].arm_deg=[50, 140]"], "phase 'return' drives joint 1 beyond its limit at t = 17.0 s, (-1.00, 0.00, 1.00) m: 50.0 deg (limits 60 and 175 deg); change arm_deg (also in 'above the start', 'land')"),
    (["mission.phases[2].arm_deg=[100, -20]"], "phase 'catch' drives joint 2 beyond its limit"),
    (["mission.phases[2].duration_s=4"], "phase 'catch' flies too fast at t = 5.5 s, (0.00, 0.00, 1.00) m: 1.09 m/s (limits.speed_max_m_s is 0.8); allow more time or shorten the move"),
    (["mission.limits.speed_max_m_s=1.61"], "mission 'catch': limits.speed_max_m_s is 1.61 m/s, but must be at least one fifth below safety.speed_max_m_s (2 m/s), above which the vehicle holds; lower limits.speed_max_m_s to 1.60 m/s or less"),
    (["mission.limits.speed_max_m_s=3"], "limits.speed_max_m_s is 3 m/s, but must be at least one fifth below safety.speed_max_m_s (2 m/s)"),
    (["vehicle.safety.speed_max_m_s=0.9"], "limits.speed_max_m_s is 0.8 m/s, but must be at least one fifth below safety.speed_max_m_s (0.9 m/s)"),
    (["mission.phases[2].duration_s=3"], "phase 'catch' accelerates too hard at t = 5.7 s, (0.81, 0.00, 1.00) m: 1.67 m/s^2 (limits.acceleration_max_m_s2 is 1); allow more time or shorten the move"),
    (["mission.phases[2].duration_s=2.2", "mission.phases[2].arm_duration_s=2"], "phase 'catch' starts or stops too abruptly at t = 4.6 s, (0.00, 0.00, 1.00) m: 9.86 m/s^3 (limits.jerk_max_m_s3 is 4)"),
    (["mission.phases[2].arm_duration_s=1"], "phase 'catch' turns a joint too fast at t = 4.0 s, (-1.00, 0.00, 1.00) m: 152 deg/s (limits.arm_speed_max_deg_s is 90)"),
    (["mission.phases[2].arm_duration_s=1"], "phase 'catch' accelerates a joint too hard"),
    (["mission.phases[2].arm_duration_s=1"], "phase 'catch' jerks a joint at t = 3.5 s"),
    (["vehicle.arm.joints[1].velocity_max_deg_s=30"], "phase 'catch' turns joint 2 faster than it can"),
    (["vehicle.safety.servo_current_max_a=0.3"], "phase 'take-off' overloads joint 2 at t = "),
    (["vehicle.safety.servo_current_max_a=0.3"], "N m of the 0.39 N m that the joint has (at most 90%); choose a pose closer to hanging"),
    (["vehicle.arm.link_lengths_m=[0.7, 0.1]", "vehicle.room.x_m=[-1.8, 2.2]"], "the rotors, the arm and the net reach x = -1.71 m; the room is -1.8 to 2.2 m"),
    (["mission.catch.payload_max_kg=2"], "phase 'take-off' needs too much thrust at t = 0.8 s"),
    (["mission.phases[2].duration_s=2.2", "mission.phases[2].arm_duration_s=2", "vehicle.airframe.tilt_max_deg=10"], "phase 'catch' tilts too far"),
    (["mission.phases[0].height_m=0.4"], "phase 'take-off' ends at 0.4 m, but the body's origin is 0.3 m above the floor when the vehicle is on the ground; set height_m to 0.5 or more"),
    (["mission.catch.expected_at_m=[1, 0]", "vehicle.room.x_m=[-1.64, 1.64]"], "phase 'catch' leaves the room at t = 9.5 s, (1.00, 0.00, 1.00) m: the rotors, the arm and the net reach x = 1.49 m; the room is -1.64 to 1.64 m, reduced at each end by 0.2 m for the catch"),
    (["vehicle.safety.stop_deceleration_m_s2=0.3", "vehicle.room.x_m=[-1.74, 1.74]", "vehicle.safety.react_time_s=0.3"], "phase 'catch' could not stop within the room at t = 7.1 s, (0.41, 0.00, 1.00) m: at 0.65 m/s the vehicle needs 0.96 m to stop, 0.31 m too far with 0.2 m for the catch; fly more slowly towards the edge or turn back earlier"),
    (["vehicle.safety.stop_deceleration_m_s2=0.2", "vehicle.tether.length_m=2.4"], "could not stop within the tether sphere"),
    (["mission.phases[1]={type: line, to_m: [-1, 0, 0.32], duration_s: 2}", "mission.phases[2]={type: line, to_m: [1, 0, 1]}"], "could not stop within the height above the floor"),
    (["mission.phases[2]={type: path, waypoints_m: [[1, -1.2, 1.2], [0, -2.2, 1.2], [-1, -1.2, 1.2], [0, -0.2, 1.2], [1, -1.2, 1.2], [0, -2.2, 1.2], [-1, -1.2, 1.2], [-1, 0, 1]]}", "vehicle.room.y_m=[-3, 2]"], "winds up the tether at t = "),
    (["vehicle.tether.anchor_world_m=[0, -1.2, 0.95]"], "phase 'take-off' brings the tether too close to the rotors or the arm at t = 0.0 s, (-1.00, 0.00, 0.30) m: -0.188 m between the line and the rotors or the arm (tether.clearance_min_m is 0.01; the anchor is seen -23 deg below the horizon); fly higher"),
    (["mission.catch=null", "vehicle.airframe.thrust_max_n=42"], "needs too much thrust at t = 0.8 s, (-1.00, 0.00, 0.37) m: 35.6 N with 0.4 kg of payload and the tether's weight (limit 33.6 N: 0.8 of 42 N); allow more time or carry less"),
    (["mission.limits.thrust_share_max=1", "vehicle.airframe.thrust_max_n=36"], "34.6 N with 0.3 kg of payload and the tether's weight (limit 32.4 N: 0.9 of 36 N)"),
    (["vehicle.tether.load_rating_n=50"], "vehicle 'tarot650-2r': tether.load_rating_n is 50 N, but the rotors pull with 60 N (airframe.thrust_max_n); the tether must hold them: use a stronger one"),
    (["vehicle.tether.length_m=0.2"], "vehicle 'tarot650-2r': the tether reaches 0.00 m (length_m 0.2 minus margin_m 0.25 and the lever of attachment_body_m), but the room begins"),
    (["mission.catch.expected_at_m=[0, 0.5]"], "mission 'catch': expects the payload at (0, 0.5) m, but never comes closer than 0.50 m; change catch.expected_at_m or the lines"),
]  # fmt: skip


@pytest.mark.parametrize(("overrides", "line"), REFUSED, ids=[line[:60] for _, line in REFUSED])
def test_unflyable_mission_is_refused(overrides: list[str], line: str) -> None:
    found = problems(*overrides)
    assert any(line in problem for problem in found), found
    assert all("\n" not in problem for problem in found)


def test_a_catch_without_a_net_is_refused_by_phase_and_part() -> None:
    absent = ("vehicle.tool=null", "vehicle.devices.force=null")
    (line,) = problems(*absent)
    assert (
        "mission 'catch', phase 'catch' expects a payload in the net, but vehicle 'tarot650-2r' has no net (tool)"
        in line
    )
    assert problems(*absent, "mission.catch=null") == []


def test_without_a_tether_nothing_about_a_tether_is_refused() -> None:
    short = "vehicle.tether.length_m=1.5"
    assert any("leaves the tether sphere" in line for line in problems(short))
    assert problems("vehicle.tether=null") == []
    (heavy,) = problems("vehicle.tether=null", "mission.catch.payload_max_kg=2")
    assert "with 2 kg of payload (limit " in heavy


@pytest.mark.parametrize(
    ("measured", "line"),
    [
        (
            {"start_position_world_m": (-1.0, 0.3, 0.3)},
            "mission 'catch': starts at (-1, 0) m, but the vehicle is at (-1.00, 0.30) m, 0.30 m away (tolerance 0.15 m); "
            "carry it there or change start.position_m",
        ),
        (
            {"start_position_world_m": (-1.0, 0.0, 0.5)},
            "mission 'catch': starts on the floor, with the body's origin at z = 0.30 m (airframe.ground_clearance_m), "
            "but z = 0.50 m was measured; check the floor of the motion-capture volume and the pivot of the rigid body",
        ),
        (
            {"start_yaw_rad": -1.0},
            "mission 'catch': starts at a yaw of 0 deg, but the vehicle's yaw is -57 deg (tolerance 15 deg); "
            "turn the vehicle or change start.yaw_deg",
        ),
        (
            {"start_arm_rad": (2.0, 2.44)},
            "mission 'catch': starts with the arm at (165, 140) deg, but it is at (115, 140) deg "
            "(tolerance 10 deg); move it there by hand",
        ),
    ],
)
def test_a_start_elsewhere_is_refused(measured: dict[str, Any], line: str) -> None:
    assert line in problems(**measured)


def test_a_problem_points_at_its_phase_in_the_file() -> None:
    config = load("mission.phases[2].to_m=[1.9, 0, 1]")
    found = check_mission(config.mission, config.vehicle, phase_origins=config.sources.phases)
    assert found[0].startswith(f"{config.sources.phases[2]}: mission 'catch', phase 'catch' ")


def test_limits_may_be_used_to_the_full() -> None:
    assert problems("mission.limits.speed_max_m_s=0.7291667") == []
    assert problems("mission.limits.speed_max_m_s=0.7291") != []
    least_s = Plan.build(load("mission.phases[2]={type: arm, arm_deg: [100, 60]}").mission, load().vehicle).segments[2]
    arm_s = least_s.end_s - least_s.start_s
    assert problems(f"mission.phases[2].arm_duration_s={arm_s}") == []
    assert problems(f"mission.phases[2].arm_duration_s={0.999 * arm_s}") != []


def test_what_has_no_duration_takes_the_least_that_the_limits_allow() -> None:
    free = [
        "mission.phases[2]={type: line, to_m: [1, 0, 1], arm_deg: [100, 60]}",
        "mission.phases[3]={type: arm, arm_deg: [120, 90]}",
        "mission.phases[4]={type: path, waypoints_m: [[0, 0.4, 1.1], [-1, 0, 1]]}",
        "mission.phases[5]={type: arm, arm_deg: [165, 140]}",
    ]
    assert problems(*free, "mission.catch=null") == []
    for index in range(2, 6):
        config = load(*free)
        segment = Plan.build(config.mission, config.vehicle).segments[index]
        shorter = f"mission.phases[{index}].duration_s={0.995 * (segment.end_s - segment.start_s)}"
        assert any("limits." in problem for problem in problems(*free, shorter))


def test_a_path_that_overshoots_the_room_is_refused() -> None:
    swing = "mission.phases[2]={type: path, waypoints_m: [[1.2, 0, 1], [1.2, 0.5, 1], [-1, 0, 1]]}"
    fits_the_points = 1.2 + load().vehicle.airframe.radius_m + 0.01
    assert any("leaves the room" in p for p in problems(swing, f"vehicle.room.x_m=[-2.2, {fits_the_points}]"))
    assert problems(swing, "mission.catch.expected_at_m=[1.2, 0]") == []


def test_a_yawed_vehicle_reaches_elsewhere_with_its_net() -> None:
    wide = "vehicle.arm.link_lengths_m=[0.4, 0.4]"
    overrides = [wide, "mission.phases[2].arm_deg=[60, 60]", "mission.limits.arm_speed_max_deg_s=200"]
    assert any("x = " in problem for problem in problems(*overrides, "vehicle.room.x_m=[-1.6, 1.6]"))
    assert not any("leaves the room" in problem for problem in problems(*overrides, "vehicle.room.x_m=[-1.9, 1.9]"))
    turned = problems(*overrides, "mission.start.yaw_deg=90", "vehicle.room.y_m=[-1.8, 0.6]")
    assert any("y = 0." in problem for problem in turned)


def test_on_the_way_back_over_the_place_of_the_catch_nothing_is_caught() -> None:
    found = problems("vehicle.room.x_m=[-1.72, 1.82]")
    assert found == [], "0.1 m for tracking is left behind the start, 0.2 m for the catch before the far end"


def test_without_payload_less_thrust_will_do() -> None:
    weak = ["mission.catch=null", "vehicle.airframe.thrust_max_n=42"]
    assert problems(*weak, "vehicle.airframe.payload_max_kg=0.1") == []


def test_tether_geometry() -> None:
    tether = tether_of(
        load("vehicle.tether.attachment_body_m=[0.1, 0, 0.2]", "vehicle.tether.anchor_world_m=[0, 0, 0]").vehicle
    )
    half = 0.5**0.5
    left: tuple[float, float, float, float] = (half, 0.0, 0.0, half)  # yaw +90 deg
    assert attachment_world_m(tether, (1.0, 0.0, 0.8), left) == pytest.approx((1.0, 0.1, 1.0))
    assert distance_m(tether, (1.0, 0.0, 0.8), left) == pytest.approx((1.0 + 0.01 + 1.0) ** 0.5)
    assert slack_m(tether, (1.0, 0.0, 0.8), left) == pytest.approx(tether.length_m - 2.01**0.5)
