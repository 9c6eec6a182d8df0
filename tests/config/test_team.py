"""The team file: two configurations from one mission, and what is refused before anything moves."""

from __future__ import annotations

import math
import re
from pathlib import Path

import pytest
from hypothesis import example, given
from hypothesis import strategies as st

from companion.config.document import ConfigError
from companion.mission.check import check_mission
from companion.model.algebra import minus, plus, scaled
from companion.model.types import Vec3
from companion.phases.carry.pair import segments_apart_m
from companion.sitl_config.team import SEED_APART, TeamConfig, load_team

CARRY = Path("configs/teams/carry.yaml")


def problems(*overrides: str) -> list[str]:
    with pytest.raises(ConfigError) as refused:
        load_team(CARRY, overrides)
    return list(refused.value.lines)


NEAR = "mission.phases[2].waypoints=[{position_m: [-0.9, 0.0]}]"
FROM_FAR = "left.mission.start.position_m=[2.0, 1.0]", "left.vehicle.tether.anchor_world_m=[-2.0, 1.9, 0.0]"


def phases(before: str = "", after: str = "", arm: str = "carry") -> list[str]:
    """Options with which both members fly more: the left one before it grips with the arm pose `arm`, and both after the release."""
    bar = "{length_m: 1.2, handle_height_m: 0.2, mass_max_kg: 0.5, position_m: [-1.0, 0.0], yaw_deg: 90}"
    takeoff, land = "{type: takeoff, height_m: 1.0, duration_s: 3.0}", "{type: land, speed_m_s: 0.35}"
    rest = "{type: carry, lift_m: 0.4, waypoints: [{position_m: [1.0, 0.0]}]}, {type: release, arm_deg: folded}"
    return [
        f"{end}.mission.phases=[{takeoff}{more}, {{type: grip, bar: {bar}, arm_deg: {pose}, end: {end}}}, {rest}{after}, {land}]"
        for end, more, pose in (("left", before, arm), ("right", "", "carry"))
    ]


def test_the_shipped_team_has_two_members_that_differ_where_they_must() -> None:
    team = load_team("carry", ["world.seed=7"])
    left, right = team.left, team.right
    assert [config.mission.phases[1].model_dump()["end"] for _, config in team.members] == ["left", "right"]
    assert left.mission.phases[2:] == right.mission.phases[2:]
    assert (left.world.seed, right.world.seed) == (7, 7 + SEED_APART)
    assert left.world.mass_error != right.world.mass_error
    links = [config.vehicle.devices.team for _, config in team.members]
    assert links[0] is not None
    assert links[1] is not None
    assert (links[0].port, links[0].partner_port) == (links[1].partner_port, links[1].port)
    assert [check_mission(config.mission, config.vehicle) for _, config in team.members] == [[], []]


def test_an_option_with_a_members_name_in_front_is_for_that_member() -> None:
    team: TeamConfig = load_team("carry", ["left.world.payload_radius_m=0.05", "mission.phases[2].lift_m=0.3"])
    assert [config.world.payload_radius_m for _, config in team.members] == [0.05, 0.035]
    assert [config.mission.phases[2].model_dump()["lift_m"] for _, config in team.members] == [0.3, 0.3]


@pytest.mark.parametrize(
    ("overrides", "said"),
    [
        (
            ["right.vehicle.devices.mocap.rigid_body_id=1"],
            "both members have devices.mocap.rigid_body_id 1; give each vehicle a rigid body of its own",
        ),
        (["right.vehicle.devices.team.port=14700"], "both members have devices.team.port 14700"),
        (["right.vehicle.ground.topic=carry-left"], "both members have ground.topic carry-left; give each"),
        (["right.mission.phases[2].lift_m=0.3"], "both members must fly the same phases from grip on"),
        (["left.mission.phases[1].bar.length_m=1.3"], "both members must fly the same phases from grip on"),
        (["left.vehicle.safety.land_speed_m_s=0.2"], "safety.land_speed_m_s differs between the members"),
        (["left.vehicle.devices.mocap.bar_id=4"], "devices.mocap.bar_id differs between the members"),
        (["left.vehicle.devices.mocap.server=192.168.1.11"], "devices.mocap.server differs between the members"),
        (["left.vehicle.devices.mocap.command_port=1512"], "devices.mocap.command_port differs between the members"),
        (["left.vehicle.devices.mocap.type=vicon"], "devices.mocap.type differs between the members"),
        (["vehicle.devices.mocap.type=external"], "devices.mocap.type is external, but the members share the clock"),
        (
            ["left.vehicle.devices.team.partner_port=14800"],
            "left sends to port 14800 (devices.team.partner_port), but right receives at 14701 (devices.team.port)",
        ),
        (
            ["left.vehicle.tether.anchor_world_m=[0.0,-1.9,0.0]", "right.vehicle.tether.anchor_world_m=[0.0,1.9,0.0]"],
            "the tethers come as near as 0.",
        ),
        (["mission.phases[1].bar.length_m=0.6"], "the vehicles come as near as 1.05 m "),
        (["left.mission.repeat=2"], "both members must fly the same phases from grip on, as often"),
        (
            [NEAR, *FROM_FAR, "right.vehicle.tether.anchor_world_m=[1.0, 1.6, 0.0]"],
            "the tethers come as near as 0.09 m on the ways to the bar (minimum 0.3 m)",
        ),
        (
            ["left.vehicle.tether=null", "right.vehicle.tether.anchor_world_m=[1.4, 1.2, 0.6]"],
            "one's tether and the other's rotors come as near as 0.00 m 10.5 s after the lift (minimum 0.3 m)",
        ),
        (
            [
                *(NEAR, "left.vehicle.tether=null", "left.mission.start.position_m=[1.0, 1.6]"),
                "right.vehicle.tether.anchor_world_m=[1.0, 1.6, 0.0]",
            ],
            "one's tether and the other's rotors come as near as 0.00 m on the ways to the bar",
        ),
        (
            ["vehicle.tether=null", *phases(after=", {type: line, to_m: [1.0, 0.0, 1.0]}")],
            "the vehicles come as near as 0.00 m on the ways from the bar",
        ),
        (
            ["vehicle.tether=null", "left.mission.start.position_m=[-1.0, -1.45]"],
            "the vehicles come as near as 0.00 m on the ways to the bar",
        ),
        (
            [
                "vehicle.tether=null",
                *("left.mission.start.position_m=[-1.0, -1.45]", "left.mission.start.yaw_deg=90"),
                *("right.mission.start.position_m=[-1.0, 1.45]", "right.mission.start.yaw_deg=-90"),
            ],
            "the vehicles come as near as 0.00 m on the ways to the bar",
        ),
    ],
)
def test_members_that_do_not_go_together_are_refused_in_one_line(overrides: list[str], said: str) -> None:
    (line,) = problems(*overrides)
    assert line.startswith(f"{CARRY}: ")
    assert said in line


def test_computers_with_other_files_have_another_agreement() -> None:
    """It covers what the check of the two together has read, and nothing that belongs to one computer."""
    agreed = load_team("carry").left.agreed
    assert agreed is not None
    same = (
        "vehicle.devices.mocap.interface=10.0.0.2",
        "mission.start.takeoff=by_operator",
        "vehicle.devices.team.key_file=k",
    )
    team = load_team("carry", same)
    assert team.left.agreed == team.right.agreed == agreed
    for other in (
        "mission.phases[2].lift_m=0.3",
        "mission.phases[2].compliance.mass_kg=5",
        "mission.limits.speed_max_m_s=0.5",
        "right.mission.start.position_m=[-1.0, -1.4]",
        "left.vehicle.tether.anchor_world_m=[0.1, 1.9, 0.0]",
        "vehicle.devices.mocap.server=192.168.1.12",
        "left.vehicle.devices.mocap.rigid_body_id=5",
        "vehicle.devices.mocap.bar_id=4",
    ):
        assert load_team("carry", [other]).left.agreed not in (None, agreed), other


def test_the_stubs_of_a_team_have_system_ids_of_their_own() -> None:
    teams = [load_team("carry", real_px4=real) for real in (False, True)]
    found = [[config.world.px4_params.get("MAV_SYS_ID") for _, config in team.members] for team in teams]
    assert found == [[1.0, 2.0], [None, None]], "a real PX4 has that of its instance"


def test_what_a_member_flies_before_grip_and_how_its_arm_holds_the_bar_are_its_own() -> None:
    overrides = ["vehicle.tether=null", *phases(", {type: hold, duration_s: 1.0}", arm="[70.0, 25.0]")]
    assert [len(config.mission.phases) for _, config in load_team(CARRY, overrides).members] == [6, 5]


def test_a_bar_that_is_carried_several_times_is_judged_like_one_that_is_carried_once() -> None:
    for count in (2, 3):
        assert load_team(CARRY, [f"mission.repeat={count}"]).left.mission.repeat == count


POINT = st.tuples(*3 * [st.floats(-2.0, 2.0)])


@given(st.tuples(POINT, POINT), st.tuples(POINT, POINT))
@example(((0.0, 0.0, 0.0), (1.0, 0.0, 0.0)), ((0.5, -1.0, 0.0), (0.5, 1.0, 0.0)))
@example(((0.0, 0.0, 0.0), (1.0, 0.0, 0.0)), ((0.2, 0.0, 0.5), (0.8, 0.0, 0.5)))
@example(((0.0, 0.0, 0.0), (0.0, 0.0, 0.0)), ((1.0, 1.0, 1.0), (1.0, 1.0, 1.0)))
def test_the_distance_of_two_tethers_is_the_least_between_any_points_of_them(
    one: tuple[Vec3, Vec3], other: tuple[Vec3, Vec3]
) -> None:
    def along(line: tuple[Vec3, Vec3]) -> list[Vec3]:
        return [plus(line[0], scaled(minus(line[1], line[0]), n / 40)) for n in range(41)]

    found_m = segments_apart_m(one, other)
    sampled_m = min(math.dist(a, b) for a in along(one) for b in along(other))
    assert found_m <= sampled_m + 1e-6
    assert found_m >= sampled_m - (math.dist(*one) + math.dist(*other)) / 80 - 1e-6


@pytest.mark.parametrize(
    ("old", "new", "line"),
    [
        ("rigid_body_id: 2", "rigid_body: 2", r"17:7: devices\.mocap\.rigid_body: unknown key"),
        (
            "../missions/carry",
            "../missions/hover",
            r"6:10: mission: .* has no phase of type grip, so that no team is needed",
        ),
    ],
    ids=["unknown key", "mission without a bar"],
)
def test_a_mistake_in_the_file_is_named_with_its_place(tmp_path: Path, old: str, new: str, line: str) -> None:
    text, path = CARRY.read_text(), tmp_path / "team.yaml"
    assert old in text
    path.write_text(text.replace(old, new).replace("../missions", str(Path("configs/missions").resolve())))
    with pytest.raises(ConfigError) as refused:
        load_team(path)
    (found,) = refused.value.lines
    assert re.match(f"{path}:{line}", found), found
