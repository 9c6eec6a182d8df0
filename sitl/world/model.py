"""The MuJoCo model of a scene: the machines with their tethers, the floor, the surfaces and the thrown payload.

The parts of the first machine have the names below, such as `base` and `alpha1`; `prefix_of` returns the prefix of the others.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import NamedTuple

from companion.config.arm import Tool
from companion.config.arm_chain import rod_of
from companion.config.vehicle import Vehicle
from companion.model.arm_chain import TOOL_PART_INERTIA_KG_M2, ChainLink
from companion.model.constants import GRAVITY_M_S2
from companion.model.frames import quat_conjugate, quat_from_euler_zyx, quat_multiply, quat_rotate
from companion.model.types import IDENTITY_QUAT, Quat, Vec3
from companion.sitl_config.effects.rotors import of_rotors
from companion.sitl_config.world import World
from sitl.world import surfaces
from sitl.world.effects import machine, transmission

PAYLOAD, CATCH = "payload", "catch"
"""Names of the thrown ball and of the constraint that holds it in the net."""
SECOND, SECOND_CATCH = "payload2", "catch2"
"""Names of the second ball, which a fault throws after the payload, and of its constraint."""
_FEET_M = ((0.18, -0.18), (-0.18, 0.18), (0.18, 0.18), (-0.18, -0.18))
"""Positions of the feet along the body's x and y axes."""


def prefix_of(number: int) -> str:
    """Return the prefix of the names of a machine's parts, given the machine's index."""
    return "" if number == 0 else f"machine{number + 1}/"


def base_mass_kg(vehicle: Vehicle, world: World) -> float:
    """Return the true mass of the flying base, without arm and tool."""
    arm, tool = vehicle.arm, vehicle.tool
    rest = arm.mass_kg
    if tool is not None:
        rest = rest + tool.sensor_mass_kg + tool.beyond_sensor_kg
    return (vehicle.airframe.mass_kg - rest) * (1.0 + world.mass_error)


def _xyz(values: Vec3) -> str:
    return " ".join(str(value) for value in values)


def _inertial(link: ChainLink) -> str:
    (xx, xy, xz), (_, yy, yz), (_, _, zz) = link.inertia_kg_m2
    moments = (
        f'diaginertia="{xx} {yy} {zz}"' if xy == xz == yz == 0.0 else f'fullinertia="{xx} {yy} {zz} {xy} {xz} {yz}"'
    )
    return f'<inertial pos="{_xyz(link.com_m)}" mass="{link.mass_kg}" {moments}/>'


def _quat(attitude: Quat) -> str:
    return "" if attitude == IDENTITY_QUAT else f'quat="{" ".join(map(str, attitude))}"'


def _links(vehicle: Vehicle, world: World, prefix: str) -> str:
    """Return the bodies of the links, the sensor and the net, each inside the previous one.

    Without a tool, sensor and net are massless bodies at the tip, or without an arm at the origin of the base, so that every model has
    bodies with these names.
    """
    chain, tool = machine.true_chain(vehicle, world), vehicle.tool
    sensor = net = turn = ""
    if tool is not None:
        roll, pitch, yaw = tool.sensor_rpy_deg
        turn = f'euler="{math.radians(yaw)} {math.radians(pitch)} {math.radians(roll)}"'
        inertia = " ".join(3 * (str(TOOL_PART_INERTIA_KG_M2),))
        sensor, net = (
            f'<inertial pos="0 0 0" mass="{max(mass_kg, 1e-4)}" diaginertia="{inertia}"/>'
            for mass_kg in (tool.sensor_mass_kg, tool.beyond_sensor_kg)
        )
        if not tool.is_net:
            net = _rod(vehicle, tool)
    bodies = f"""<body name="{prefix}sensor" pos="{_xyz(chain.tip_m)}" {_quat(chain.tip_wxyz)}>
        {sensor}
        <body name="{prefix}net" {turn}>
          {net}
          <site name="{prefix}net"/>{_tip(vehicle, world, prefix)}
        </body>
      </body>"""
    friction_nm, damping_nms = world.joint_friction_nm, world.joint_damping_nms
    if transmission.acts(world):
        friction_nm = damping_nms = 0.0
    for number in range(len(chain.links), 0, -1):
        link = chain.links[number - 1]
        armature = 0.0 if transmission.acts(world) else link.armature_kg_m2
        bodies = f"""<body name="{prefix}link{number}" pos="{_xyz(link.position_m)}" {_turn(link, number, world)}>
        <joint name="{prefix}alpha{number}" axis="{_xyz(link.axis)}" frictionloss="{friction_nm}" damping="{damping_nms}"
               armature="{armature}"/>
        {_inertial(link)}
        {bodies}
      </body>"""
    return bodies


def _rod(vehicle: Vehicle, tool: Tool) -> str:
    half_m, moments = rod_of(tool)
    back = quat_conjugate(surfaces.sensor_turn(vehicle))
    centre_m = quat_rotate(back, (half_m, 0.0, 0.0))
    return f'<inertial pos="{_xyz(centre_m)}" {_quat(back)} mass="{max(tool.beyond_sensor_kg, 1e-4)}" diaginertia="{_xyz(moments)}"/>'


def _tip(vehicle: Vehicle, world: World, prefix: str) -> str:
    """Return the massless body at the tip, which touches the surfaces; it is left out where the net is the tip and touches nothing."""
    if not has_tip(vehicle, world):
        return ""
    back = quat_conjugate(surfaces.sensor_turn(vehicle))
    ball = (
        f'<geom name="{prefix}tip" type="sphere" size="{vehicle.tip_radius_m}" mass="0" contype="0" conaffinity="0"/>'
    )
    return f"""
          <body name="{prefix}tip" pos="{_xyz(surfaces.tip_offset_m(vehicle))}" {_quat(back)}>
            <site name="{prefix}tip"/>
            {ball if world.surfaces else ""}
          </body>"""


def has_tip(vehicle: Vehicle, world: World) -> bool:
    """Return whether the model has a body, a site and sensors named after the tip."""
    return bool(world.surfaces) or (vehicle.tool is not None and not vehicle.tool.is_net)


def _turn(link: ChainLink, number: int, world: World) -> str:
    """Return the attribute with the attitude of a link's body; that of the first link includes the turn of the arm's mount."""
    shoulder_ypr_rad = machine.shoulder_ypr_rad(world.machine)
    if number > 1 or shoulder_ypr_rad == (0.0, 0.0, 0.0):
        return _quat(link.attitude_wxyz)
    if link.attitude_wxyz == IDENTITY_QUAT:
        return f'euler="{_xyz(shoulder_ypr_rad)}"'
    yaw, pitch, roll = shoulder_ypr_rad
    return _quat(quat_multiply(quat_from_euler_zyx(roll, pitch, yaw), link.attitude_wxyz))


class _Parts(NamedTuple):
    """MJCF of one machine, by the section of the model to which it belongs."""

    worldbody: str
    equality: str
    tendon: str
    pairs: str
    actuator: str
    sensor: str

    @classmethod
    def of(cls, vehicle: Vehicle, world: World, p: str) -> _Parts:
        """Return the parts of a machine, whose names begin with the prefix `p`."""
        joints, tether = range(1, len(vehicle.arm.joints) + 1), vehicle.tether
        anchor = tendon = tension = tip = ""
        feet = "".join(
            f'<pair geom1="floor" geom2="{p}foot{i}" friction="1 1 0.02 0.001 0.001"/>' for i in range(len(_FEET_M))
        )
        if tether is not None:
            anchor = f'<site name="{p}anchor" pos="{_xyz(tether.anchor_world_m)}"/>'
            tendon = f"""
    <spatial name="{p}tether" limited="true" range="0 {tether.length_m}" solreflimit="0.02 1">
      <site site="{p}anchor"/><site site="{p}tether"/>
    </spatial>"""
            tension = f'<tendonlimitfrc name="{p}tether" tendon="{p}tether"/>'
        if has_tip(vehicle, world):
            tip = f"""
    <force name="{p}contact" site="{p}tip"/>
    <framepos name="{p}tip" objtype="site" objname="{p}tip"/>
    <framequat name="{p}tip attitude" objtype="site" objname="{p}tip"/>"""
        return cls(
            worldbody=f"""
    {anchor}{_base(vehicle, world, p)}""",
            equality="".join(f'<joint name="{p}park{i}" joint1="{p}alpha{i}" solref="0.01 1"/>' for i in joints),
            tendon=tendon,
            pairs=feet + surfaces.pairs(world, p),
            actuator=_motors(vehicle, world, p)
            + "".join(f'<motor name="{p}alpha{i}" joint="{p}alpha{i}"/>' for i in joints),
            sensor=f"""
    <accelerometer name="{p}accel" site="{p}imu"/>
    <gyro name="{p}gyro" site="{p}imu"/>
    <force name="{p}force" site="{p}net"/>
    <torque name="{p}torque" site="{p}net"/>
    {tension}{tip}""",
        )


def _motors(vehicle: Vehicle, world: World, p: str) -> str:
    airframe, layout = vehicle.airframe, vehicle.airframe.rotor_layout
    yaw_errors = of_rotors(world.rotors.yaw_torque_error if world.rotors.on else (0.0,), layout.count)
    return "\n".join(
        f'<motor name="{p}rotor{i}" site="{p}rotor{i}" '
        f'gear="0 0 1 0 0 {-spin * airframe.yaw_torque_per_thrust_m * (1.0 + error)}"/>'
        for i, (spin, error) in enumerate(zip(layout.spins, yaw_errors, strict=True))
    )


def _base(vehicle: Vehicle, world: World, p: str) -> str:
    """Return the body of the base with its feet and its arm."""
    airframe, tether = vehicle.airframe, vehicle.tether
    clearance = airframe.ground_clearance_m
    rotors = "\n".join(
        f'<site name="{p}rotor{i}" pos="{x} {y} {z}"/>'
        for i, (x, y, z) in enumerate(airframe.rotor_layout.positions_body_m)
    )
    feet = "\n".join(
        f'<geom name="{p}foot{i}" type="sphere" size="0.02" pos="{x} {y} {-clearance + 0.02}" contype="0" conaffinity="0"/>'
        for i, (x, y) in enumerate(_FEET_M)
    )
    return f"""
    <body name="{p}base" pos="0 0 {clearance}">
      <freejoint name="{p}base"/>
      <inertial pos="{_xyz(machine.centre_of_mass_m(world.machine))}" mass="{base_mass_kg(vehicle, world)}"
                diaginertia="{_xyz(machine.inertia_kg_m2(airframe.inertia_kg_m2, world.machine))}"/>
      <site name="{p}imu"/>
      <site name="{p}tether" pos="{_xyz(tether.attachment_body_m if tether is not None else (0.0, 0.0, 0.0))}"/>
      {rotors}
      {feet}
      {_links(vehicle, world, p)}
    </body>"""


def _balls(world: World) -> tuple[str, str, str]:
    """Return the balls' bodies, their contacts with the floor, and the constraints of the first machine's net."""
    bodies = pairs = connect = ""
    balls = [(PAYLOAD, CATCH, world.payload_kg)]
    balls += [(SECOND, SECOND_CATCH, f.magnitude) for f in world.faults if f.kind == "payload_double"][:1]
    for row, (name, catch, mass_kg) in enumerate(balls):
        if mass_kg <= 0:
            continue
        bodies += f"""
    <body name="{name}" pos="{row} 50 {world.payload_radius_m}">
      <freejoint name="{name}"/>
      <geom name="{name}" type="sphere" size="{world.payload_radius_m}" mass="{mass_kg}" contype="0" conaffinity="0"/>
    </body>"""
        pairs += f'<pair geom1="floor" geom2="{name}" friction="1 1 0.005 0.0001 0.0001"/>'
        connect += f"""
    <connect name="{catch}" body1="net" body2="{name}" anchor="0 0 0" active="false" solref="0.025 1"
             solimp="0.95 0.99 0.01"/>"""
    return bodies, pairs, connect


def mjcf(machines: Sequence[tuple[Vehicle, World]], timestep_s: float, bar: tuple[str, str, str] = ("", "", "")) -> str:
    """Return the MuJoCo model of a scene as MJCF text. Bodies touch only where a pair says so, which costs less than a search.

    Args:
        machines: vehicle file and configuration of each machine; the configuration of the first has the objects of the scene, and its
            machine catches the payload.
        bar: body, contacts and constraints of the bar that the machines carry.
    """
    vehicle, world = machines[0]
    parts = [_Parts.of(*each, prefix_of(number)) for number, each in enumerate(machines)]
    worldbody, equality, tendon, pairs, actuator, sensor = ("".join(texts) for texts in zip(*parts, strict=True))
    balls, ball_pairs, connect = _balls(world)
    bar_body, bar_pairs, clamps = bar
    options = surfaces.OPTIONS if world.surfaces else 'cone="pyramidal"'
    return f"""
<mujoco model="{vehicle.name}">
  <compiler angle="radian" eulerseq="zyx" inertiafromgeom="auto"/>
  <option timestep="{timestep_s}" gravity="0 0 -{GRAVITY_M_S2}" integrator="implicitfast" {options}/>
  <size memory="2M"/>
  <worldbody>
    <geom name="floor" type="plane" size="20 20 1" contype="0" conaffinity="0"/>{surfaces.geoms(world)}{worldbody}{balls}{bar_body}
  </worldbody>
  <equality>{equality}{connect}{clamps}</equality>
  <tendon>{tendon}</tendon>
  <contact>{pairs}{ball_pairs}{bar_pairs}</contact>
  <actuator>{actuator}</actuator>
  <sensor>{sensor}</sensor>
</mujoco>"""
