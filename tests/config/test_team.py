"""The team file: two configurations from one mission, and what is refused before anything moves."""

from __future__ import annotations

import re
from pathlib import Path

import pytest

from companion.config.document import ConfigError
from companion.mission.check import check_mission
from companion.sitl_config.team import SEED_APART, TeamConfig, load_team

CARRY = Path("configs/teams/carry.yaml")


def problems(*overrides: str) -> list[str]:
    with pytest.raises(ConfigError) as refused:
        load_team(CARRY, overrides)
    return list(refused.value.lines)


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
        (["mission.phases[1].bar.length_m=0.6"], "the vehicles come as near as "),
        (
            ["vehicle.tether=null", "left.mission.start.position_m=[-1.0, -1.45]"],
            "the ways of the vehicles to the bar come as near as 0.00 m",
        ),
        (
            [
                "vehicle.tether=null",
                *("left.mission.start.position_m=[-1.0, -1.45]", "left.mission.start.yaw_deg=90"),
                *("right.mission.start.position_m=[-1.0, 1.45]", "right.mission.start.yaw_deg=-90"),
            ],
            "the ways of the vehicles to the bar come as near as 0.00 m",
        ),
    ],
    ids=[
        "one body",
        "one port",
        "one name",
        "phases",
        "bars",
        "landing speeds",
        "bodies of the bar",
        "servers",
        "two programs of one server",
        "two systems",
        "no frames",
        "another port",
        "tethers",
        "short bar",
        "one start",
        "starts swapped",
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
    bar = "{length_m: 1.2, handle_height_m: 0.2, mass_max_kg: 0.5, position_m: [-1.0, 0.0], yaw_deg: 90}"
    rest = "{type: carry, lift_m: 0.4, waypoints: [{position_m: [1.0, 0.0]}]}, {type: release, arm_deg: folded}"
    overrides = ["vehicle.tether=null"]
    for end, before, arm in (("left", "{type: hold, duration_s: 1.0}, ", "[70.0, 25.0]"), ("right", "", "carry")):
        grip = f"{{type: grip, bar: {bar}, arm_deg: {arm}, end: {end}}}"
        takeoff = "{type: takeoff, height_m: 1.0, duration_s: 3.0}"
        overrides.append(f"{end}.mission.phases=[{takeoff}, {before}{grip}, {rest}, {{type: land, speed_m_s: 0.35}}]")
    assert [len(config.mission.phases) for _, config in load_team(CARRY, overrides).members] == [6, 5]


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
