"""What a user may get wrong in the files or on the command line, and the exact line that tells it."""

# ruff: noqa: E501  (the lines are as long as users see them)

from __future__ import annotations

import json
import shutil
from collections.abc import Callable
from pathlib import Path

import pytest
import yaml

from companion.config.controller import LAWS, PRESETS, AdaptiveConfig, preset_file
from companion.config.document import ConfigError
from companion.config.loader import FlightConfig, load_flight, load_vehicle, logged_flight
from companion.model.link_address import parse_address
from companion.sitl_config.loader import SitlConfig, load_sitl, load_world
from tests.machines import overrides_with_joints

ROOT = Path(__file__).parents[2]
DATA = Path(__file__).parent / "data"
CATCH = "configs/missions/catch.yaml"
VEHICLE = "configs/vehicles/tarot650_2r.yaml"


@pytest.fixture
def project(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """A mission and a vehicle in a current directory of its own; not the ones that are flown, which may be tuned."""
    (tmp_path / CATCH).parent.mkdir(parents=True)
    (tmp_path / VEHICLE).parent.mkdir(parents=True)
    shutil.copy(DATA / "mission.yaml", tmp_path / CATCH)
    shutil.copy(DATA / "vehicle.yaml", tmp_path / VEHICLE)
    monkeypatch.chdir(tmp_path)
    return tmp_path


def lines_of(load: Callable[[], object]) -> list[str]:
    with pytest.raises(ConfigError) as caught:
        load()
    assert all(line and "\n" not in line for line in caught.value.lines)
    assert str(caught.value) == "\n".join(caught.value.lines)
    return list(caught.value.lines)


BAD_MISSION = [
    (
        "duration_s: 0.5",
        "duration_s: -3",
        [f"{CATCH}:34:17: phases[1].duration_s: expected a number > 0 and <= 600, got -3"],
    ),
    (
        "duration_s: 0.5",
        "duration: 0.5",
        [f"{CATCH}:34:5: phases[1].duration: unknown key; write duration_s, in s (without a unit)"],
    ),
    (
        "speed_max_m_s: 0.8",
        "speed_max_km_h: 0.8",
        [f"{CATCH}:18:3: limits.speed_max_km_h: unknown key; write speed_max_m_s, in m/s (not in km/h)"],
    ),
    ("arm_deg: [100.0, 60.0]", "arm_deg: stretched", [f'{CATCH}:39:14: phases[2].arm_deg: expected joint angles or a pose of the vehicle (folded, unfolded), got "stretched"; define it in arm.poses of the vehicle file']),
    (
        "height_m: 1.0",
        "height_m: 1 m",
        [f'{CATCH}:30:15: phases[0].height_m: expected a number > 0, got "1 m" (write 1; the key\'s name contains the unit)'],
    ),
    (
        "height_m: 1.0",
        "height_m: '1.0'",
        [f'{CATCH}:30:15: phases[0].height_m: expected a number > 0, got "1.0" (write 1.0 without quotes)'],
    ),
    ("    height_m: 1.0\n", "", [f"{CATCH}:29:5: phases[0].height_m: missing; expected a number > 0"]),
    (
        "to_m: [1.0, 0.0, 1.0]",
        "to_m: [1.0, 0.0]",
        [f"{CATCH}:37:11: phases[2].to_m: expected a list of 3 numbers, got [1.0, 0.0]"],
    ),
    (
        "type: takeoff ",
        "type: takeof ",
        [
            f'{CATCH}:29:11: phases[0].type: expected one of approach, arm, carry, detach, grip, hold, intercept, land, line, path, press, probe, release, slide, takeoff, got "takeof" '
            "(did you mean takeoff?)"
        ],
    ),
    (
        "type: takeoff               # 0.0 s\n    height_m: 1.0",
        "height_m: 1.0",
        [f"{CATCH}:29:5: phases[0].type: missing; expected one of approach, arm, carry, detach, grip, hold, intercept, land, line, path, press, probe, release, slide, takeoff"],
    ),
    ("  - type: land                  # 18.0 s\n    speed_m_s: 0.35\n", "", [f"{CATCH}:51:11: phases[5].type: the last phase must be of type land"]),
    (
        "arm_duration_s: 2.5",
        "arm_duration_s: 7",
        [
            f"{CATCH}:40:21: phases[2].arm_duration_s: the arm's motion would end 7 s into a line of 6 s; "
            "it must end within the line"
        ],
    ),
    (
        "    arm_deg: [100.0, 60.0]      # unfolded by 6.0 s\n",
        "",
        [f"{CATCH}:39:21: phases[2].arm_duration_s: sets the time of an arm motion, but its target, arm_deg, is missing"],
    ),
    (
        "preset: recommended",
        "preset: recomended",
        [
            f"{CATCH}:9:37: controller.preset: 'adaptive' has no preset \"recomended\"; available: paper, "
            "paper_slow_leakage, model_free, recommended"
        ],
    ),
    ("arm_deg: [100.0, 60.0]", "arm_deg: unfold", [f'{CATCH}:39:14: phases[2].arm_deg: expected joint angles or a pose of the vehicle (folded, unfolded), got "unfold" (did you mean unfolded?)']),
    ("vehicle: ../vehicles/tarot650_2r.yaml", "vehicle: ../vehicle/tarot650_2r.yaml", [f"{CATCH}:8:10: vehicle: configs/vehicle/tarot650_2r.yaml: no such file; the shipped file is named without a path: vehicle: tarot650_2r"]),
    ("schema_version: 1", "schema_version: 2", [f"{CATCH}:6:17: schema_version: expected 1, got 2"]),
    ("schema_version: 1", "schema_version: true", [f"{CATCH}:6:17: schema_version: expected 1, got true"]),
    (
        "{law: adaptive, preset: recommended}",
        "{file: ../controllers/none.yaml}",
        [f"{CATCH}:9:20: controller.file: configs/controllers/none.yaml: no such file"],
    ),
    (
        "{law: adaptive, preset: recommended}",
        f"{{law: csc, file: {preset_file('psc', 'tuned').absolute()}}}",
        [f'{CATCH}:9:19: controller.law: expected "psc", the law of controller.file, got "csc"; leave it out'],
    ),
]  # fmt: skip


def test_motion_capture_from_every_network_is_refused_unless_the_world_is_simulated(project: Path) -> None:
    line = (
        f'{VEHICLE}:63:16: devices.mocap.interface: expected the address of this computer on the camera network, got "0.0.0.0" (every network); '
        "`ip -4 address` shows it, `companion mocap check` proposes it; flights with --sitl do not need it"
    )
    assert lines_of(lambda: load_sitl(CATCH, hardware=True)) == [line]
    assert load_sitl(CATCH).vehicle.devices.mocap.interface == "0.0.0.0"
    given = load_sitl(CATCH, overrides=["vehicle.devices.mocap.interface=192.168.1.20"], hardware=True)
    assert given.vehicle.devices.mocap.interface == "192.168.1.20"
    told = lines_of(lambda: load_sitl(CATCH, overrides=["vehicle.devices.mocap.interface=0.0.0.0"], hardware=True))
    assert told[0].startswith("--set vehicle.devices.mocap.interface")


@pytest.mark.parametrize(("old", "new", "expected"), BAD_MISSION, ids=[repr(new)[:40] for _, new, _ in BAD_MISSION])
def test_bad_mission_file(project: Path, old: str, new: str, expected: list[str]) -> None:
    path = project / CATCH
    text = path.read_text()
    assert text.count(old) >= 1
    path.write_text(text.replace(old, new, 1))
    assert lines_of(lambda: load_sitl(CATCH)) == expected


BAD_VEHICLE = [
    ("servo_id: 2", "servo_id: 1", ["arm.joints[1].servo_id: joint 1 has the servo id 1 too; give each servo its own id"]),
    ("address: serial:///dev/ttyAMA0:921600", "address: /dev/ttyAMA0:921600", ["udpin://0.0.0.0:14540, udpout://HOST:PORT, tcpout://HOST:PORT or serial:///dev/ttyAMA0:921600, got '/dev/ttyAMA0:921600'"]),
    ("interface: 0.0.0.0", "interface: eth0", ["mocap.interface: expected an IPv4 address such as 192.168.1.20, got 'eth0'"]),
    ("multicast_group: 239.255.42.99", "multicast_group: 192.168.1.5", ["mocap.multicast_group: expected a multicast group, from 224.0.0.0 to 239.255.255.255, got 192.168.1.5"]),
    ("watchdog_ms: 100", "watchdog_ms: 90", ["watchdog_ms: must be a multiple of 20 ms (the register's unit), got 90 ms"]),
    ("sign: -1", "sign: 0", ["sign: expected one of -1, 1, got 0"]),
    ("rate_hz: 200.0", "rate_hz: 200.0\n    natnet_version: 3.0", ['expected one of "3.0", "3.1", "4.0", "4.1", "4.2", "4.3", "4.4", got 3.0 (put it in quotes)']),
    ("x_m: [-2.2, 2.2]", "x_m: [2.2, -2.2]", ["room.x_m: expected the first number to be below the second, got [2.2, -2.2]"]),
    ("link_com_m: [0.16, 0.08]", "link_com_m: [0.26, 0.08]", ["the centre of mass is beyond the end of the link: at 0.26 m on a link of 0.2 m"]),
    ("fold_arm_deg: [165.0, 140.0]", "fold_arm_deg: [165.0, 151.0]", ["fold_arm_deg[1]: 151 deg is outside the joint limits, -10 to 150 deg"]),
    ("fold_arm_deg: [165.0, 140.0]", "fold_arm_deg: [165.0]", ["fold_arm_deg: expected 2 angles, one for each of arm.joints, got 1"]),
    ("mass_kg: 3.0 ", "battery_cells: 6\n  mass_kg: 3.0 ", ["battery_voltage_min_v: expected 16.8 to 24.6 V for the 6 cells of airframe.battery_cells, got 13.2 V (the default, because the file does not give it)"]),
    ("mass_kg: 3.0 ", "mass_kg: 3,0 ", ['mass_kg: expected a number > 0, got "3,0" (write 3.0)']),
    ("servo_id: 1", "servo_id: 1\n      servo: XL330", ['expected one of 14 names ("XM430-W210", "XM430-W350", "XM540-W150", ...), got "XL330" (did you mean XL330-M288?)']),
    ("mass_kg: 3.0 ", "mass_kg: 0.4 ", ["mass_kg: 0.4 kg is the mass of the whole vehicle, but arm and tool alone have 0.45 kg"]),
    ("thrust_max_n: 60.0", "thrust_max_n: 20.0", ["thrust_max_n: 20 N do not lift 3 kg"]),
    ("thrust_max_n: 60.0", "thrust_max_n: 60.0\n  inertia_kg_m2: [0.02, 0.02, 0.05]", ["inertia_kg_m2[2]: expected at most 0.04 kg m^2 (no moment of a rigid body exceeds the sum of the other two), got 0.05"]),
    ("thrust_max_n: 60.0", "thrust_max_n: 60.0\n  hover_thrust: 0", ["airframe.hover_thrust: expected a number > 0 and <= 1, got 0"]),
    ("safety:", "computer:\n  cpus: [2, 3, 2]\nsafety:", ["computer.cpus: expected each core once, got 2 twice in [2, 3, 2]"]),
]  # fmt: skip


@pytest.mark.parametrize("address", ["14540", "udp://:14540", "udpin://0.0.0.0", "serial:///dev/ttyAMA0", "tcp://a:b"])
def test_an_address_of_another_form_names_the_good_ones(address: str) -> None:
    with pytest.raises(ValueError, match=r"expected an address like udpin://0\.0\.0\.0:14540"):
        parse_address(address)


def test_the_path_of_a_serial_port_may_contain_colons() -> None:
    parts = parse_address("serial:///dev/serial/by-path/platform-xhci-hcd.1-usb-0:1:1.0-port0:921600")
    assert (parts.host, parts.port) == ("/dev/serial/by-path/platform-xhci-hcd.1-usb-0:1:1.0-port0", 921600)


def test_a_pose_is_refused_without_an_arm() -> None:
    (line,) = lines_of(lambda: load_sitl(ROOT / CATCH, overrides=overrides_with_joints(0)))
    assert line.endswith(
        'phases[2].arm_deg: the mission moves the arm to "unfolded", but the vehicle has no arm; choose a mission without arm motion, '
        "such as hover, or a vehicle with an arm"
    )


@pytest.mark.parametrize(("old", "new", "expected"), BAD_VEHICLE, ids=[new for _, new, _ in BAD_VEHICLE])
def test_bad_vehicle_file(project: Path, old: str, new: str, expected: list[str]) -> None:
    path = project / VEHICLE
    text = path.read_text()
    assert old in text
    path.write_text(text.replace(old, new, 1))
    found = lines_of(lambda: load_sitl(CATCH))
    assert len(found) == len(expected)
    for line, end in zip(found, expected, strict=True):
        assert line.startswith(f"{VEHICLE}:")
        assert line.endswith(end)


BAD_OVERRIDES = [
    ("world.paylod_kg=0.2", "--set world.paylod_kg: unknown key; did you mean payload_kg?"),
    ("wrld.payload_kg=0.2", "--set wrld.payload_kg: unknown section 'wrld'; did you mean world?"),
    ("x.y=1", "--set x.y: unknown section 'x'; available: mission, vehicle, controller, world"),
    ("world.payload_kg", "--set world.payload_kg: no '='; expected SECTION.KEY=VALUE, for example --set world.payload_kg=0.2"),
    ("world=1", "--set world: the key names a whole section; expected SECTION.KEY=VALUE, for example --set world.payload_kg=0.2"),
    ("world..a=1", "--set world..a: cannot read the key from column 6; expected SECTION.KEY=VALUE, for example --set world.payload_kg=0.2"),
    ("mission.phases.0.height_m=1", "--set mission.phases.0.height_m: cannot read the key from column 15; write mission.phases[0].height_m"),
    ("controller.kp=[1, 2]", "--set controller.kp: unknown key; did you mean stiffness_kp?"),
    ("vehicle.tether.knot=1", "--set vehicle.tether.knot: unknown key; known keys: anchor_world_m, length_m, attachment_body_m, margin_m, load_rating_n, weight_n_per_m, turns_max, taut_slack_m, pull_min_n, pull_filter_s, pull_time_s, separation_m, rotor_inner_radius_m, clearance_min_m"),
    ("world.payload_kg=3", "--set world.payload_kg: expected a number from 0 to 2, got 3"),
    ("world.faults=[{kind: mocap_los, t_s: 5}]", '--set world.faults: faults[0].kind: expected one of 49 names ("mocap_loss", "mocap_occluded", "mocap_jump", ...), got "mocap_los" (did you mean mocap_loss?)'),
    ("world.throw_velocity_m_s=[1, 2", "--set world.throw_velocity_m_s: not YAML: expected ',' or ']', but got '<stream end>' while parsing a flow sequence"),
    ("mission.phases[9].duration_s=3", "--set mission.phases[9].duration_s: mission.phases has no index 9; available: 0 to 6"),
    ("mission.name.x=3", "--set mission.name.x: mission.name has no keys; it is a single value"),
    ("mission.vehicle=none.yaml", "--set mission.vehicle: vehicle: none.yaml: no such file"),
    ("mission.vehicle=tarot650_2x", "--set mission.vehicle: vehicle: tarot650_2x: expected hexa_2r, tarot650_2r, tarot650_2r_ball, tarot650_2r_clamp, tarot650_2r_rod, tarot650_4r or a file, found neither (did you mean tarot650_2r?)"),
    ("controller.rho_max=0", "--set controller.rho_max: expected a number > 0, got 0"),
    ("controller.stiffness_kp[2]=90", "--set controller.stiffness_kp[2]: gain_cond requires (K_d - M_d Phi) Phi = 144, got 90"),
    ("controller.damping_kd[0]=3", "--set controller.damping_kd[0]: gain_new requires K_d / M_d > Phi, got 3 <= 4"),
]  # fmt: skip


@pytest.mark.parametrize(("option", "line"), BAD_OVERRIDES, ids=[option for option, _ in BAD_OVERRIDES])
def test_bad_override(project: Path, option: str, line: str) -> None:
    assert lines_of(lambda: load_sitl(CATCH, preset="paper", overrides=[option])) == [line]


@pytest.mark.parametrize(
    ("role", "name", "line"),
    [
        ("mission", VEHICLE, f"{VEHICLE}: is a vehicle file, expected a mission file"),
        ("vehicle", CATCH, f"{CATCH}: is a mission file, expected a vehicle file"),
        ("world", CATCH, f"{CATCH}: is a mission file, expected a world file"),
        ("controller", VEHICLE, f"{VEHICLE}: is a vehicle file, expected a controller file"),
    ],
)
def test_a_file_of_another_kind_is_one_problem(project: Path, role: str, name: str, line: str) -> None:
    given = {"mission": CATCH, "vehicle": VEHICLE, "world": "lab", role: name}
    law = given.get("controller")
    assert lines_of(lambda: load_sitl(given["mission"], given["vehicle"], law, world=given["world"])) == [line]


def test_the_known_keys_of_a_mapping_are_listed_once(project: Path) -> None:
    path = project / CATCH
    path.write_text(path.read_text().replace("start:\n", "start:\n  qqq: 1\n  zzz: 2\n"))
    assert lines_of(lambda: load_sitl(CATCH)) == [
        f"{CATCH}:12:3: start.qqq: unknown key; known keys: yaw_tolerance_deg, arm_tolerance_deg, takeoff",
        f"{CATCH}:13:3: start.zzz: unknown key",
    ]


def test_problems_of_all_files_are_reported_together(project: Path) -> None:
    overrides = ["mission.phases[2].duration_s=0", "vehicle.airframe.mass_kg=0", "controller.nu=1", "world.seed=-1"]
    lines = lines_of(lambda: load_sitl(CATCH, overrides=overrides))
    assert [line.split(":")[0] for line in lines] == [
        "--set mission.phases[2].duration_s",
        "--set vehicle.airframe.mass_kg",
        "--set controller.nu",
        "--set world.seed",
    ]


def test_unknown_controller_and_preset(project: Path) -> None:
    assert lines_of(lambda: load_sitl(CATCH, controller_law="cscc")) == [
        "--controller cscc: no such controller; available: adaptive, csc, psc, policy, or a file (*.yaml, *.onnx) (did you mean csc?)"
    ]
    assert lines_of(lambda: load_sitl(CATCH, controller_law="psc", preset="paper")) == [
        "--preset paper: no such preset of 'psc'; available: tuned_extras, tuned"
    ]
    assert lines_of(lambda: load_sitl(CATCH, preset="papr")) == [
        "--preset papr: no such preset of 'adaptive'; available: paper, paper_slow_leakage, model_free, recommended (did you mean paper?)"
    ]


BAD_LAW_IN_MISSION = [
    ("{law: psk}", 'controller.law: expected one of "adaptive", "csc", "psc", "policy", got "psk" (did you mean psc?)'),
    ("{law: psc, preset: paper}", "controller.preset: 'psc' has no preset \"paper\"; available: tuned_extras, tuned"),
]


@pytest.mark.parametrize(("choice", "end"), BAD_LAW_IN_MISSION)
def test_unknown_law_or_preset_in_a_mission(project: Path, choice: str, end: str) -> None:
    path = project / CATCH
    path.write_text(path.read_text().replace("{law: adaptive, preset: recommended}", choice))
    [line] = lines_of(lambda: load_sitl(CATCH))
    assert line.startswith(f"{CATCH}:9:")
    assert line.endswith(": " + end)


def test_the_preset_option_is_of_the_missions_law(project: Path) -> None:
    path = project / CATCH
    path.write_text(path.read_text().replace("{law: adaptive, preset: recommended}", "{law: csc}"))
    assert load_sitl(CATCH).controller.law == "csc"
    assert load_sitl(CATCH, preset="tuned").controller.law == "csc"
    assert load_sitl(CATCH, controller_law="psc").controller.law == "psc"
    assert lines_of(lambda: load_sitl(CATCH, preset="paper")) == [
        "--preset paper: no such preset of 'csc'; available: tuned_extras, tuned"
    ]


BAD_LAW_IN_FILE = [
    ("law: csk", ':2:6: law: expected one of adaptive, csc, psc, policy, got "csk" (did you mean csc?)'),
    ("# law: csc", ":1:1: law: missing; expected one of adaptive, csc, psc, policy"),
]


@pytest.mark.parametrize(("law", "end"), BAD_LAW_IN_FILE)
def test_unknown_law_in_a_controller_file(project: Path, law: str, end: str) -> None:
    path = project / CATCH
    (path.parent / "mine.yaml").write_text(f"schema_version: 1\n{law}\npreset: mine\n")
    path.write_text(path.read_text().replace("{law: adaptive, preset: recommended}", "{file: mine.yaml}"))
    assert lines_of(lambda: load_sitl(CATCH)) == [f"configs/missions/mine.yaml{end}"]


def test_overrides_reach_every_section(project: Path) -> None:
    config = load_sitl(
        CATCH,
        overrides=[
            "world.payload_kg=0.3",
            "vehicle.safety.mocap_timeout_s=0.2",
            "controller.rho_max=4",
            "mission.phases[2].duration_s=5",
            "world.faults=[{kind: mocap_loss, t_s: 5}]",
            "world.faults[0].t_s=6",
            "mission.name=a=b",
        ],
    )
    assert config.world.payload_kg == 0.3
    assert config.vehicle.safety.mocap_timeout_s == 0.2
    assert isinstance(config.controller, AdaptiveConfig)
    assert config.controller.rho_max == 4.0
    assert isinstance(config.controller.rho_max, float)
    assert config.mission.phases[2].model_dump()["duration_s"] == 5.0
    assert config.world.faults[0].t_s == 6.0
    assert config.mission.name == "a=b"


def test_the_controller_file_of_a_mission_is_not_replaced_by_a_preset_of_another_law(project: Path) -> None:
    file = preset_file("psc", "tuned").absolute()
    choice = ["mission.controller=null", f"mission.controller.file={file}"]
    assert load_sitl(CATCH, preset="tuned", overrides=choice).controller.law == "psc"
    [line] = lines_of(lambda: load_sitl(CATCH, preset="recommended", overrides=choice))
    assert line == f'--preset recommended: the file {file} has the gains "tuned"; leave --preset out'
    assert load_sitl(CATCH, controller_law="csc", preset="tuned", overrides=choice).controller.law == "csc"


def test_override_of_a_key_and_a_section_that_the_file_leaves_to_defaults(project: Path) -> None:
    text = (project / VEHICLE).read_text()
    (project / VEHICLE).write_text(text[: text.index("safety:")])
    config = load_sitl(CATCH, overrides=["vehicle.safety.battery_min=0.3", "vehicle.airframe.hover_thrust=0.5"])
    assert config.vehicle.safety.battery_min == 0.3
    assert config.vehicle.airframe.hover_thrust == 0.5


@pytest.mark.parametrize(("law", "preset"), [(law, preset) for law, presets in PRESETS.items() for preset in presets])
def test_config_survives_a_json_round_trip(law: str, preset: str) -> None:
    config = load_sitl(ROOT / CATCH, controller_law=law, preset=preset, overrides=["world.payload_kg=0.1"])
    assert type(config.controller) is LAWS[law]
    again = SitlConfig.model_validate_json(config.model_dump_json())
    assert again == config
    assert again.model_dump_json() == config.model_dump_json()
    assert json.loads(config.model_dump_json())["controller"]["preset"] == preset


def test_paper_preset_is_the_papers_table() -> None:
    controller = load_sitl(ROOT / CATCH, preset="paper").controller
    assert isinstance(controller, AdaptiveConfig)
    assert controller.inertia_md == (1, 1, 1, 0.015, 0.015, 0.015, 0.1, 0.1)
    assert controller.lambda_gain == (1.5, 1.5, 2.0, 3.5, 3.5, 2.5, 1.0, 1.0)
    assert controller.phi == (4, 4, 4, 3, 3, 3, 3.5, 3.5)
    assert controller.damping_kd == (40, 40, 40, 0.75, 0.75, 0.75, 0.7, 0.7)
    assert controller.stiffness_kp == (144, 144, 144, 2.115, 2.115, 2.115, 1.225, 1.225)
    assert controller.desired_force_time_s is None
    assert (controller.epsilon, controller.boundary_layer, controller.zeta_initial) == (1e-4, 0.1, 0.1)


def test_relative_names_are_relative_to_the_file_that_names_them(
    project: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    elsewhere = tmp_path / "elsewhere"
    elsewhere.mkdir()
    mission = project / CATCH
    shutil.copy(ROOT / "configs/controllers/adaptive_paper.yaml", mission.parent / "mine.yaml")
    mission.write_text(mission.read_text().replace("{law: adaptive, preset: recommended}", "{file: mine.yaml}"))
    monkeypatch.chdir(elsewhere)
    config = load_sitl(mission)
    assert config.controller.preset == "paper"
    assert config.sources.controller == str(mission.parent / "mine.yaml")
    assert config.sources.phases[1] == f"{mission}:32:5"


def test_a_vehicle_on_the_command_line_is_relative_to_the_current_directory(
    project: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    (project / VEHICLE).rename(project / "other.yaml")
    config = load_sitl(CATCH, vehicle_path="other.yaml", overrides=["vehicle.name=other"])
    assert config.vehicle.name == "other"
    assert config.sources.vehicle == "other.yaml"


def test_a_mission_may_name_a_shipped_vehicle_and_a_file_beside_it_comes_first(project: Path) -> None:
    assert load_sitl(CATCH, overrides=["mission.vehicle=hexa_2r"]).vehicle.name == "hexa-2r"
    own = Path("hexa_2r")
    own.write_text((ROOT / "configs/vehicles/tarot650_2r.yaml").read_text())
    assert load_sitl(CATCH, overrides=["mission.vehicle=hexa_2r"]).vehicle.name == "tarot650-2r"


def test_vehicle_and_world_load_alone(project: Path) -> None:
    overrides = ["vehicle.airframe.mass_kg=3.1", "world.seed=7", "mission.phases[99].x=1"]
    assert load_vehicle(VEHICLE, overrides).airframe.mass_kg == 3.1
    assert load_world(overrides)[0].seed == 7
    assert lines_of(lambda: load_vehicle(VEHICLE, ["vehicle.airframe.mass_kg=x"]))[0].startswith(
        "--set vehicle.airframe"
    )
    assert lines_of(lambda: load_world(["world.sed=7"])) == ["--set world.sed: unknown key; did you mean seed?"]


@pytest.mark.parametrize("key", ["tether", "tool", "devices.force"])
def test_a_part_that_may_be_absent_is_not_left_out_by_mistake(project: Path, key: str) -> None:
    data = yaml.safe_load((project / VEHICLE).read_text(encoding="utf-8"))
    room = data["devices"] if key == "devices.force" else data
    del room[key.rpartition(".")[2]]
    (project / VEHICLE).write_text(yaml.safe_dump(data), encoding="utf-8")
    (line,) = lines_of(lambda: load_vehicle(VEHICLE, []))
    assert f"{key}: missing; expected a mapping with the keys" in line
    assert line.endswith(", or null if there is none")


def test_the_configuration_in_a_log_of_version_0_1_opens() -> None:
    config = logged_flight((Path(__file__).parent / "data" / "logged_0.1.0.json").read_text(encoding="utf-8"))
    assert (config.vehicle.safety.joint_limit_max_deg, config.vehicle.safety.react_time_s) == (10.0, 0.18)


@pytest.mark.parametrize(
    ("mission", "index", "old", "new"),
    [("slide", 4, "by_m", "displacement_m"), ("circuit", 2, "through_m", "waypoints_m")],
)
def test_old_spellings_of_phase_keys_are_accepted_in_files_options_and_logs(
    tmp_path: Path, mission: str, index: int, old: str, new: str
) -> None:
    shipped = ROOT / "configs" / "missions" / f"{mission}.yaml"
    text = shipped.read_text(encoding="utf-8")
    assert text.count(f"{new}:") == 1
    file = tmp_path / "old.yaml"
    file.write_text(text.replace(f"{new}:", f"{old}:").replace("../", f"{ROOT}/configs/"), encoding="utf-8")
    as_shipped, as_old = load_flight(shipped), load_flight(file)
    assert as_old.mission == as_shipped.mission.model_copy(update={"vehicle": as_old.mission.vehicle})
    value = getattr(as_shipped.mission.phases[index], new)
    changed = [[0.1, 0.7, 1.0]] if new == "waypoints_m" else [0.0, -0.2]
    changed_in = load_flight(shipped, overrides=[f"mission.phases[{index}].{old}={changed}"])
    assert getattr(changed_in.mission.phases[index], new) != value
    assert logged_flight(as_shipped.model_dump_json().replace(f'"{new}"', f'"{old}"')) == as_shipped


def test_old_spellings_of_the_worlds_keys_are_accepted() -> None:
    old = ("world.hand=true", "world.hand_t_s=3", "world.hand_taps=4", "world.hand_tap_n=9", "world.arm_hand=true")
    world, _ = load_world(old)
    assert (world.handling, world.handling_t_s, world.handling_taps, world.handling_tap_n) == (True, 3.0, 4, 9.0)
    assert world.arm_handling


def test_a_key_in_both_spellings_is_refused(tmp_path: Path) -> None:
    file = tmp_path / "both.yaml"
    file.write_text("handling_t_s: 3\nhand_t_s: 4\n", encoding="utf-8")
    with pytest.raises(ConfigError, match=r"both.yaml:2:1: hand_t_s: unknown key"):
        load_world((), str(file))


def test_a_flights_configuration_holds_nothing_of_the_simulated_world(project: Path) -> None:
    config = load_sitl(CATCH, overrides=["world.payload_kg=0.37", "vehicle.name=other"])
    text = config.flight.model_dump_json()
    assert "0.37" not in text and set(json.loads(text)) == {"mission", "vehicle", "controller", "sources", "agreed"}
    assert config.flight.sources.overrides == ("vehicle.name=other",)
    with pytest.raises(ValueError, match="world"):
        FlightConfig.model_validate_json(config.model_dump_json())


def test_the_world_in_the_configuration_of_an_older_log_is_left_out(project: Path) -> None:
    config = load_sitl(CATCH, overrides=["world.payload_kg=0.37"])
    assert logged_flight(config.model_dump_json(exclude={"laboratory"})) == config.flight
