"""An arm from a URDF file: what is read is what Pinocchio reads, and a file that is no serial arm in SI units gives one line."""

from __future__ import annotations

import contextlib
import json
import random
import re
from pathlib import Path

import numpy as np
import pytest
import yaml

from companion.config.arm_chain import chain_of
from companion.config.document import ConfigError
from companion.config.loader import load_vehicle
from companion.config.urdf import read_urdf
from companion.config.vehicle import Vehicle
from companion.control.arm_model import dynamics_of, manipulator_of
from companion.control.arm_model.chain_manipulator import ChainManipulator
from companion.model.arm_chain import ArmChain, ChainLink, is_physical_inertia
from companion.model.frames import quat_from_euler_zyx, rotation_matrix
from tests.pinocchio_or_skip import pin
from tests.support import ROOT

URDF = ROOT / "configs" / "vehicles" / "arm_4r.urdf"
TEXT = URDF.read_text(encoding="utf-8")
JOINTS = [
    {"servo_id": number, "sign": 1, "zero_count": 2048, "angle_deg": [-170.0, 170.0], "torque_max_nm": 2.5}
    for number in range(1, 5)
]


def vehicle_file(folder: Path, arm: dict[str, object], name: str = "vehicle.yaml") -> Path:
    """The shipped vehicle with another arm."""
    data = yaml.safe_load((ROOT / "configs" / "vehicles" / "tarot650_2r.yaml").read_text(encoding="utf-8"))
    data["arm"] = arm
    data["safety"] = {"fold_arm_deg": [0.0] * len(JOINTS)}
    path = folder / name
    path.write_text(json.dumps(data), encoding="utf-8")
    return path


def vehicle_of(folder: Path, text: str, **keys: object) -> Vehicle:
    (folder / "arm.urdf").write_text(text, encoding="utf-8")
    return load_vehicle(vehicle_file(folder, {"urdf": "arm.urdf", **keys, "joints": JOINTS}))


def problem(folder: Path, text: str, base: str | None = None, tip: str | None = None) -> str:
    path = folder / "arm.urdf"
    path.write_text(text, encoding="utf-8")
    with pytest.raises(ConfigError) as caught:
        read_urdf(path, base, tip)
    (line,) = caught.value.lines
    found = re.fullmatch(re.escape(str(path)) + r":(\d+):\d+: (.*)", line)
    assert found, line
    return f"{found[1]}: {found[2]}"


def without(chain: ArmChain) -> ArmChain:
    """The chain without tool, which a URDF does not contain."""
    return ArmChain(chain.links, tip_m=chain.tip_m, tip_wxyz=chain.tip_wxyz, sensor_wxyz=chain.tip_wxyz)


def test_the_arm_is_the_one_that_pinocchio_reads(tmp_path: Path) -> None:
    vehicle = vehicle_of(tmp_path, TEXT)
    bare = vehicle.model_copy(
        update={"tool": None, "arm": vehicle.arm.model_copy(update={"joint_armature_kg_m2": 0.0})}
    )
    manipulator, dynamics = manipulator_of(bare), dynamics_of(bare)
    model = pin.buildModelFromUrdf(str(URDF))
    data, net = model.createData(), model.getFrameId("net")
    rng = np.random.default_rng(1)
    for _ in range(10):
        q, v, a = (rng.uniform(-2, 2, 4) for _ in range(3))
        angle, rate, acceleration = (tuple(x.tolist()) for x in (q, v, a))
        pin.framesForwardKinematics(model, data, q)
        np.testing.assert_allclose(manipulator.net_body_m(angle), data.oMf[net].translation, atol=1e-9)
        np.testing.assert_allclose(
            rotation_matrix(manipulator.sensor_attitude_body(angle)), data.oMf[net].rotation, atol=1e-9
        )
        positions = [data.oMi[number].translation for number in range(1, 5)]
        np.testing.assert_allclose(manipulator.joints_body_m(angle), positions, atol=1e-9)
        gravity = pin.computeGeneralizedGravity(model, data, q)
        np.testing.assert_allclose(manipulator.gravity_torque_nm(angle, (1.0, 0.0, 0.0, 0.0)), gravity, atol=1e-9)
        torque = pin.rnea(model, data, q, v, a) - gravity
        np.testing.assert_allclose(dynamics.arm_torque_nm(angle, rate, acceleration), torque, atol=1e-9)


def test_links_that_are_fixed_to_each_other_become_one_with_any_poses(tmp_path: Path) -> None:
    """Also with an inclined bracket between two joints, and an inertia whose frame is turned."""
    text = TEXT.replace('<origin xyz="0.16 0 0"/>', '<origin xyz="0.16 0.01 0" rpy="0.3 -0.2 0.1"/>')
    text = text.replace('<origin xyz="0.096 0 0"/>', '<origin xyz="0.096 0.02 -0.01" rpy="0.5 0.4 -0.3"/>')
    text = text.replace(
        '<origin xyz="0.055 0 0" rpy="0 1.5707963267948966 0"/>', '<origin xyz="0.055 0.01 0" rpy="0.2 1.1 0.7"/>'
    )
    path = tmp_path / "turned.urdf"
    path.write_text(text, encoding="utf-8")
    chain = without(chain_of(vehicle_of(tmp_path, text)))
    model = pin.buildModelFromUrdf(str(path))
    data, net = model.createData(), model.getFrameId("net")
    for link, inertia in zip(chain.links, list(model.inertias)[1:], strict=True):
        assert link.mass_kg == pytest.approx(inertia.mass)
        np.testing.assert_allclose(link.com_m, inertia.lever, atol=1e-12)
        np.testing.assert_allclose(link.inertia_kg_m2, inertia.inertia, atol=1e-12)
    q = np.array([0.3, 0.9, -0.4, 0.6])
    pin.framesForwardKinematics(model, data, q)
    manipulator = ChainManipulator(chain)
    angle = tuple(q.tolist())
    np.testing.assert_allclose(manipulator.net_body_m(angle), data.oMf[net].translation, atol=1e-12)
    sensor = rotation_matrix(manipulator.sensor_attitude_body(angle))
    np.testing.assert_allclose(sensor, data.oMf[net].rotation, atol=1e-12)


def test_a_log_of_a_vehicle_with_a_urdf_needs_no_urdf(tmp_path: Path) -> None:
    vehicle = vehicle_of(tmp_path, TEXT)
    logged = vehicle.model_dump_json()
    (tmp_path / "arm.urdf").unlink()
    assert Vehicle.model_validate_json(logged) == vehicle


def test_base_and_tip_may_be_named(tmp_path: Path) -> None:
    named = vehicle_of(tmp_path, TEXT, urdf_base="plate", urdf_tip="sensor_plate").arm
    assert named.links[0].origin_m == pytest.approx((0.0, 0.0, -0.008))
    assert named.tip_m == pytest.approx((0.055, 0.0, 0.0))
    assert named.tip_rpy_deg == pytest.approx((0.0, 90.0, 0.0))
    assert named.reach_m == pytest.approx(np.hypot(0.012, 0.05) + 0.16 + 0.14 + 0.055)


def second_branch() -> str:
    extra = '<link name="more"/><joint name="extra" type="revolute"><parent link="turret"/><child link="more"/></joint>'
    return TEXT.replace("</robot>", extra + "</robot>")


INERTIA = 'ixx="7.342e-05" iyy="8.577e-05" izz="4.896e-05"'
TURRET = f'<mass value="0.190"/>\n      <inertia {INERTIA} ixy="0" ixz="0" iyz="0"/>'
YAW = '<joint name="yaw" type="revolute">'
AXIS = '<axis xyz="0 0 1"/>'


def edited(old: str, new: str) -> str:
    assert old in TEXT
    return TEXT.replace(old, new, 1)


def fixed_joint(parent: str, child: str) -> str:
    return edited(
        "</robot>", f'<joint name="back" type="fixed"><parent link="{parent}"/><child link="{child}"/></joint></robot>'
    )


DAMAGED = {
    "empty": ("", r"1: not XML: no element found"),
    "cut off": (TEXT[:900], r"\d+: not XML: "),
    "another format": ("<sdf/>", "1: expected a <robot> element, got <sdf>"),
    "entities": ('<!DOCTYPE r [<!ENTITY a "b">]><robot/>', "1: expected no <!DOCTYPE>"),
    "unknown encoding": ('<?xml version="1.0" encoding="nonsense"?><robot/>', "1: not XML: "),
    "xacro": ('<robot xmlns:xacro="http://x"><xacro:macro/></robot>', "1: <xacro:macro> is not expanded; expected plain URDF"),
    "misspelled origin": (
        edited('<origin xyz="0 0 -0.008"/>', '<orgin xyz="0 0 -0.008"/>'),
        r"24: <joint>: unknown element <orgin>; did you mean <origin>\?",
    ),
    "misspelled rpy": (
        edited('<origin xyz="0 0 -0.008"/>', '<origin xyz="0 0 -0.008" ryp="0 1 0"/>'),
        r"24: <origin>: unknown attribute ryp; did you mean rpy\?",
    ),
    "degrees": (
        edited('<origin xyz="0 0 -0.008"/>', '<origin xyz="0 0 -0.008" rpy="0 90 0"/>'),
        r'24: <origin>: rpy: expected radians, at most 2 pi, got "0 90 0"',
    ),
    "two origins": (edited(AXIS, AXIS + "<origin/>"), r"25: <joint>: a second <origin>, expected one"),
    "rpy and quaternion": (
        edited('<origin xyz="0 0 -0.008"/>', '<origin rpy="0 0 1" quat_xyzw="0 0 0 1"/>'),
        "24: <origin>: expected rpy or quat_xyzw, got both",
    ),
    "quaternion of norm 2": (
        edited('<origin xyz="0 0 -0.008"/>', '<origin quat_xyzw="0 0 0 2"/>'),
        "24: <origin>: quat_xyzw: expected a quaternion of norm 1, got norm 2",
    ),
    "a frame that moves alone": (
        edited(TURRET, '<mass value="1e-9"/><inertia ixx="0" iyy="0" izz="0" ixy="0" ixz="0" iyz="0"/>'),
        r'28: link "turret" moves but has no <inertial> with a mass',
    ),
    "no link": ("<robot/>", r"1: expected one link that is no joint's child, got none"),
    "no joint": ('<robot><link name="a"/></robot>', "1: no revolute or continuous joint moves a link of the arm"),
    "same name": (edited('name="turret"', 'name="plate"'), r'28: link "plate" is defined twice'),
    "unknown link": (edited('<child link="turret"/>', '<child link="nobody"/>'), r'23: joint "yaw": there is no link "nobody"'),
    "no child": (edited('<child link="turret"/>', ""), r'21: joint "yaw": missing <child>'),
    "prismatic": (edited(YAW, YAW.replace("revolute", "prismatic")), r'21: joint "yaw": expected revolute, .*got "prismatic"'),
    "mimic": (edited(AXIS, '<mimic joint="elbow"/>'), r'21: joint "yaw": <mimic> is not supported'),
    "zero axis": (edited(AXIS, '<axis xyz="0 0 0"/>'), r'25: joint "yaw": the axis is zero'),
    "NaN": (edited(AXIS, '<axis xyz="0 0 nan"/>'), r"25: <axis>: xyz: expected 3 numbers"),
    "zero mass": (edited('value="0.190"', 'value="0"'), r'31: link "turret": expected a mass above 0 kg, got 0 kg'),
    "no mass": (edited('<mass value="0.190"/>', ""), r'29: link "turret": expected <mass> and <inertia> in <inertial>'),
    "no body": (edited('ixx="7.342e-05"', 'ixx="7.342e-02"'), r'32: link "turret": expected the inertia of a rigid body'),
    "kg mm^2": (
        edited(INERTIA, 'ixx="73.42" iyy="85.77" izz="48.96"'),
        r'32: link "turret": the inertia is that of 0.19 kg at a distance of 23.\d+ m; .*is the file in mm',
    ),
    "mm": (edited('xyz="0.16 0 0"', 'xyz="160 0 0"'), r"56: the origin is 160 m away; .*millimetres"),
    "two branches": (second_branch(), r'\d+: joint "extra" starts a second branch beside joint "shoulder"'),
    "loop": (fixed_joint("net", "upper_arm"), r'\d+: joint "back" closes a loop: link "upper_arm" is already the child of'),
    "loop with base": (fixed_joint("net", "body"), r"\d+: expected one link that .*, got none \(the joints form a loop\)"),
    "two bases": (edited("</robot>", '<link name="alone"/></robot>'), r"\d+: expected one link that .*, got 2 \(body, alone\)"),
    "two tips": (
        fixed_joint("hand", "grip").replace("</robot>", '<link name="grip"/></robot>'),
        r'\d+: expected one link that is fixed to the last link "hand" and marks the tip, got 2 \(grip, net\)',
    ),
}  # fmt: skip


@pytest.mark.parametrize("name", DAMAGED)
def test_a_damaged_or_unsuitable_file_gives_one_line(tmp_path: Path, name: str) -> None:
    text, expected = DAMAGED[name]
    found = problem(tmp_path, text)
    assert re.match(expected, found), found


@pytest.mark.parametrize("mass", ["0", "1e-9"])
def test_a_fixed_link_without_mass_is_a_frame(tmp_path: Path, mass: str) -> None:
    inertial = f'<inertial><mass value="{mass}"/><inertia ixx="0" iyy="0" izz="0" ixy="0" ixz="0" iyz="0"/></inertial>'
    text = edited('<link name="net"/>', f'<link name="net">{inertial}</link>')
    assert chain_of(vehicle_of(tmp_path, text)) == chain_of(vehicle_of(tmp_path, TEXT))


def test_a_rotation_may_be_a_quaternion(tmp_path: Path) -> None:
    text = edited('rpy="0 1.5707963267948966 0"', 'quat_xyzw="0 0.70710678 0 0.70710678"')
    np.testing.assert_allclose(
        vehicle_of(tmp_path, text).arm.tip_rpy_deg, vehicle_of(tmp_path, TEXT).arm.tip_rpy_deg, atol=1e-6
    )


def test_elements_that_are_not_read_and_extensions_may_contain_anything(tmp_path: Path) -> None:
    extra = '<transmission><joint name="yaw"><hardwareInterface/></joint></transmission><drake:frame/>'
    text = edited("</robot>", f'{extra}<gazebo reference="net"><mu1>0.2</mu1></gazebo></robot>')
    text = text.replace("<robot ", '<robot version="1.2" xmlns:drake="http://drake.mit.edu" ')
    assert chain_of(vehicle_of(tmp_path, text)) == chain_of(vehicle_of(tmp_path, TEXT))


def test_no_damage_to_a_file_raises_anything_but_a_config_error(tmp_path: Path) -> None:
    draw = random.Random(3)
    path = tmp_path / "arm.urdf"
    for _ in range(300):
        raw = bytearray(TEXT, "utf-8")
        for _ in range(draw.randint(1, 3)):
            at, length = draw.randrange(len(raw)), draw.randint(0, 20)
            raw[at : at + length] = draw.randbytes(draw.randint(0, 4))
        path.write_bytes(raw)
        with contextlib.suppress(ConfigError):
            assert len(read_urdf(path, None, None)) == 3


def test_unsuitable_names_of_base_and_tip_give_one_line(tmp_path: Path) -> None:
    assert 'urdf_tip: there is no link "hnd"' in problem(tmp_path, TEXT, tip="hnd")
    assert 'urdf_base: there is no link "bdy"' in problem(tmp_path, TEXT, base="bdy")
    assert 'urdf_tip: link "turret" is not fixed to the last moving link, "hand"' in problem(
        tmp_path, TEXT, tip="turret"
    )


def test_a_chain_of_eight_joints_is_refused(tmp_path: Path) -> None:
    inertial = (
        '<inertial><mass value="0.1"/><inertia ixx="1e-4" iyy="1e-4" izz="1e-4" ixy="0" ixz="0" iyz="0"/></inertial>'
    )
    links = "".join(f'<link name="l{number}">{inertial}</link>\n' for number in range(9))
    joints = "".join(
        f'<joint name="j{number}" type="revolute"><parent link="l{number}"/><child link="l{number + 1}"/></joint>\n'
        for number in range(8)
    )
    assert 'joint "j7" is moving joint 8; expected at most 7' in problem(tmp_path, f"<robot>{links}{joints}</robot>")


def test_the_vehicle_file_names_the_line_of_the_urdf_key(tmp_path: Path) -> None:
    with pytest.raises(ConfigError) as caught:
        vehicle_of(tmp_path, "<robot>")
    (line,) = caught.value.lines
    assert re.match(r".*vehicle\.yaml:\d+:\d+: arm\.urdf: .*arm\.urdf:1:\d+: not XML: ", line)
    with pytest.raises(ConfigError, match=r"arm\.urdf: .*missing\.urdf: not readable: No such file"):
        load_vehicle(vehicle_file(tmp_path, {"urdf": "missing.urdf", "joints": JOINTS}))
    (tmp_path / "arm.urdf").write_text(TEXT, encoding="utf-8")
    with pytest.raises(ConfigError, match=r"arm\.urdf: expected 3 moving joints, one for each of arm\.joints, got 4"):
        load_vehicle(vehicle_file(tmp_path, {"urdf": "arm.urdf", "joints": JOINTS[:3]}))


def test_links_in_the_vehicle_file_may_have_any_axis(tmp_path: Path) -> None:
    link = {"origin_m": [0.0, 0.0, -0.05], "axis": [0.0, 0.0, 2.0], "mass_kg": 0.1, "com_m": [0.1, 0.0, 0.0]}
    inertia = {"inertia_kg_m2": [1e-4, 2e-4, 2e-4, 0.0, 0.0, 1e-5]}
    arm = {"links": [link | inertia] * 4, "tip_m": [0.1, 0.0, 0.02], "tip_rpy_deg": [0.0, 10.0, 0.0], "joints": JOINTS}
    chain = chain_of(load_vehicle(vehicle_file(tmp_path, arm)))
    assert chain.links[0] == ChainLink(
        position_m=(0.0, 0.0, -0.05),
        attitude_wxyz=(1.0, 0.0, 0.0, 0.0),
        axis=(0.0, 0.0, 1.0),
        mass_kg=0.1,
        com_m=(0.1, 0.0, 0.0),
        inertia_kg_m2=((1e-4, 0.0, 0.0), (0.0, 2e-4, 1e-5), (0.0, 1e-5, 2e-4)),
        armature_kg_m2=0.008,
    )
    assert chain.tip_wxyz == pytest.approx(quat_from_euler_zyx(0.0, np.radians(10.0), 0.0))
    for wrong, expected in (
        ({"axis": [0.0, 0.0, 0.0]}, "expected a direction"),
        ({"inertia_kg_m2": [1e-4, 2e-4, 4e-4, 0.0, 0.0, 0.0]}, "expected the inertia of a rigid body"),
        ({"mass_kg": 0.0}, "mass_kg"),
    ):
        broken = arm | {"links": [link | inertia | wrong, *[link | inertia] * 3]}
        with pytest.raises(ConfigError, match=expected):
            load_vehicle(vehicle_file(tmp_path, broken))
    with pytest.raises(ConfigError, match=r"link_masses_kg: must be absent, because arm\.links is given"):
        load_vehicle(vehicle_file(tmp_path, arm | {"link_masses_kg": [0.1] * 4}))


def test_rods_may_have_axes_of_their_own(tmp_path: Path) -> None:
    joints = [
        joint | {"axis": axis}
        for joint, axis in zip(JOINTS, ([0, 0, 1], [0, 1, 0], [0, -2, 0], [1, 0, 0]), strict=True)
    ]
    rods = {"link_lengths_m": [0.1] * 4, "link_masses_kg": [0.1] * 4, "link_com_m": [0.05] * 4}
    chain = chain_of(
        load_vehicle(vehicle_file(tmp_path, {"shoulder_body_m": [0.0, 0.0, -0.05], **rods, "joints": joints}))
    )
    assert [link.axis for link in chain.links] == [(0.0, 0.0, 1.0), (0.0, 1.0, 0.0), (0.0, -1.0, 0.0), (1.0, 0.0, 0.0)]


@pytest.mark.parametrize(
    ("moments", "physical"),
    [((1, 2, 3), True), ((1, 2, 3.1), False), ((0, 1, 1), True), ((0, 0, 0), False), ((-1, 2, 2), False)],
)
def test_the_inertia_of_a_rigid_body_is_told_in_any_axes(moments: tuple[float, float, float], physical: bool) -> None:
    rotation = np.array(rotation_matrix(quat_from_euler_zyx(0.4, -1.1, 2.0)))
    for inertia in (np.diag(moments), rotation @ np.diag(moments) @ rotation.T):
        a, b, c = (tuple(row) for row in inertia.tolist())
        assert is_physical_inertia((a, b, c)) is physical
