"""The MuJoCo model of the vehicle, its tether and the thrown payload, built from the vehicle file."""

from __future__ import annotations

import math

from companion.config.arm import Tool
from companion.config.arm_chain import rod_of
from companion.config.vehicle import Vehicle
from companion.model.arm_chain import TOOL_PART_INERTIA_KG_M2, ChainLink
from companion.model.constants import GRAVITY_M_S2
from companion.model.frames import quat_conjugate, quat_from_euler_zyx, quat_multiply, quat_rotate
from companion.model.types import IDENTITY_QUAT, Joints, Quat, Vec3
from companion.sitl_config.effects.rotors import of_rotors
from companion.sitl_config.world import World
from sitl.world import surfaces
from sitl.world.effects import machine, transmission

PAYLOAD_RADIUS_M = 0.035
SECOND, SECOND_CATCH = "payload2", "catch2"
"""Names of the second ball, which a fault throws after the payload, and of its constraint."""
_FEET_M = ((0.18, -0.18), (-0.18, 0.18), (0.18, 0.18), (-0.18, -0.18))
"""Positions of the feet along the body's x and y axes."""


def base_mass_kg(vehicle: Vehicle, world: World) -> float:
    """Return the true mass of the flying base, without arm and tool."""
    arm, tool = vehicle.arm, vehicle.tool
    rest = arm.mass_kg
    if tool is not None:
        rest = rest + tool.sensor_mass_kg + tool.beyond_sensor_kg
    return (vehicle.airframe.mass_kg - rest) * (1.0 + world.mass_error)


def link_masses_kg(vehicle: Vehicle, world: World) -> Joints:
    """Return the true masses of the links, without sensor and net, whose masses in the vehicle file are taken as true."""
    return tuple(link.mass_kg for link in machine.true_chain(vehicle, world).links)


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


def _links(vehicle: Vehicle, world: World) -> str:
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
    bodies = f"""<body name="sensor" pos="{_xyz(chain.tip_m)}" {_quat(chain.tip_wxyz)}>
        {sensor}
        <body name="net" {turn}>
          {net}
          <site name="net"/>{_tip(vehicle, world)}
        </body>
      </body>"""
    friction_nm, damping_nms = world.joint_friction_nm, world.joint_damping_nms
    if transmission.acts(world):
        friction_nm = damping_nms = 0.0
    for number in range(len(chain.links), 0, -1):
        link = chain.links[number - 1]
        armature = 0.0 if transmission.acts(world) else link.armature_kg_m2
        bodies = f"""<body name="link{number}" pos="{_xyz(link.position_m)}" {_turn(link, number, world)}>
        <joint name="alpha{number}" axis="{_xyz(link.axis)}" frictionloss="{friction_nm}" damping="{damping_nms}"
               armature="{armature}"/>
        {_inertial(link)}
        {bodies}
      </body>"""
    return bodies


def _rod(vehicle: Vehicle, tool: Tool) -> str:
    """Return the inertia of a rod in the frame of the force-torque sensor."""
    half_m, moments = rod_of(tool)
    back = quat_conjugate(surfaces.sensor_turn(vehicle))
    centre_m = quat_rotate(back, (half_m, 0.0, 0.0))
    return f'<inertial pos="{_xyz(centre_m)}" {_quat(back)} mass="{max(tool.beyond_sensor_kg, 1e-4)}" diaginertia="{_xyz(moments)}"/>'


def _tip(vehicle: Vehicle, world: World) -> str:
    """Return the massless body at the tip, which touches the surfaces; it is left out where the net is the tip and touches nothing."""
    if not has_tip(vehicle, world):
        return ""
    back = quat_conjugate(surfaces.sensor_turn(vehicle))
    ball = f'<geom name="tip" type="sphere" size="{vehicle.tip_radius_m}" mass="0" contype="0" conaffinity="0"/>'
    return f"""
          <body name="tip" pos="{_xyz(surfaces.tip_offset_m(vehicle))}" {_quat(back)}>
            <site name="tip"/>
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


def mjcf(vehicle: Vehicle, world: World, timestep_s: float) -> str:
    """Return the MuJoCo model of the true vehicle as MJCF text."""
    airframe, joints = vehicle.airframe, range(1, len(vehicle.arm.joints) + 1)
    layout = airframe.rotor_layout
    clearance = airframe.ground_clearance_m
    rotors = "\n".join(
        f'<site name="rotor{i}" pos="{x} {y} {z}"/>' for i, (x, y, z) in enumerate(layout.positions_body_m)
    )
    yaw_errors = of_rotors(world.rotors.yaw_torque_error if world.rotors.on else (0.0,), layout.count)
    motors = "\n".join(
        f'<motor name="rotor{i}" site="rotor{i}" gear="0 0 1 0 0 {-spin * airframe.yaw_torque_per_thrust_m * (1.0 + error)}"/>'
        for i, (spin, error) in enumerate(zip(layout.spins, yaw_errors, strict=True))
    )
    feet = "\n".join(
        f'<geom name="foot{i}" type="sphere" size="0.02" pos="{x} {y} {-clearance + 0.02}" contype="1" '
        f'conaffinity="2" friction="0.8 0.02 0.001" solref="0.02 1"/>'
        for i, (x, y) in enumerate(_FEET_M)
    )
    anchor = tendon = tension = ""
    if vehicle.tether is not None:
        anchor = f'<site name="anchor" pos="{_xyz(vehicle.tether.anchor_world_m)}"/>'
        tendon = f"""<tendon>
    <spatial name="tether" limited="true" range="0 {vehicle.tether.length_m}" solreflimit="0.02 1">
      <site site="anchor"/><site site="tether"/>
    </spatial>
  </tendon>"""
        tension = '<tendonlimitfrc name="tether" tendon="tether"/>'
    tip = ""
    if has_tip(vehicle, world):
        tip = """
    <force name="contact" site="tip"/>
    <framepos name="tip" objtype="site" objname="tip"/>
    <framequat name="tip attitude" objtype="site" objname="tip"/>"""
    options = surfaces.OPTIONS if world.surfaces else 'cone="pyramidal"'
    payload = ""
    connect = ""
    balls = [("payload", "catch", world.payload_kg)]
    balls += [(SECOND, SECOND_CATCH, f.magnitude) for f in world.faults if f.kind == "payload_double"][:1]
    for row, (name, catch, mass_kg) in enumerate(balls):
        if mass_kg <= 0:
            continue
        payload += f"""
    <body name="{name}" pos="{row} 50 {PAYLOAD_RADIUS_M}">
      <freejoint name="{name}"/>
      <geom name="{name}" type="sphere" size="{PAYLOAD_RADIUS_M}" mass="{mass_kg}" contype="1" conaffinity="2"/>
    </body>"""
        connect += f"""
    <connect name="{catch}" body1="net" body2="{name}" anchor="0 0 0" active="false" solref="0.025 1"
             solimp="0.95 0.99 0.01"/>"""
    return f"""
<mujoco model="{vehicle.name}">
  <compiler angle="radian" eulerseq="zyx" inertiafromgeom="auto"/>
  <option timestep="{timestep_s}" gravity="0 0 -{GRAVITY_M_S2}" integrator="implicitfast" {options}/>
  <size memory="2M"/>
  <worldbody>
    <geom name="floor" type="plane" size="20 20 1" contype="2" conaffinity="1"/>{surfaces.geoms(world)}
    {anchor}
    <body name="base" pos="0 0 {clearance}">
      <freejoint name="base"/>
      <inertial pos="{_xyz(machine.centre_of_mass_m(world.machine))}" mass="{base_mass_kg(vehicle, world)}"
                diaginertia="{_xyz(machine.inertia_kg_m2(airframe.inertia_kg_m2, world.machine))}"/>
      <site name="imu"/>
      <site name="tether" pos="{_xyz(vehicle.tether.attachment_body_m if vehicle.tether is not None else (0.0, 0.0, 0.0))}"/>
      {rotors}
      {feet}
      {_links(vehicle, world)}
    </body>{payload}
  </worldbody>
  <equality>
    {"".join(f'<joint name="park{i}" joint1="alpha{i}" solref="0.01 1"/>' for i in joints)}{connect}
  </equality>
  {tendon}{surfaces.pairs(world)}
  <actuator>
    {motors}
    {"".join(f'<motor name="alpha{i}" joint="alpha{i}"/>' for i in joints)}
  </actuator>
  <sensor>
    <accelerometer name="accel" site="imu"/>
    <gyro name="gyro" site="imu"/>
    <force name="force" site="net"/>
    <torque name="torque" site="net"/>
    {tension}{tip}
  </sensor>
</mujoco>"""
