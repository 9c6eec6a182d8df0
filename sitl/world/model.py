"""The MuJoCo model of the vehicle, its tether and the thrown payload, built from the vehicle file."""

from __future__ import annotations

import math

from companion.config.vehicle import Vehicle
from companion.model.constants import GRAVITY_M_S2
from companion.model.types import Joints, Vec3
from companion.sitl_config.effects.rotors import of_rotors
from companion.sitl_config.per_joint import of_joints
from companion.sitl_config.world import World
from sitl.world.effects import machine, transmission

PAYLOAD_RADIUS_M = 0.035
SECOND, SECOND_CATCH = "payload2", "catch2"
"""Names of the second ball, which a fault throws after the payload, and of its constraint."""
_FEET_M = ((0.18, -0.18), (-0.18, 0.18), (0.18, 0.18), (-0.18, -0.18))
"""Positions of the feet along the body's x and y axes."""


def base_mass_kg(vehicle: Vehicle, world: World) -> float:
    """Return the true mass of the flying base, without arm and tool."""
    arm, tool = vehicle.arm, vehicle.tool
    rest = sum(arm.link_masses_kg)
    if tool is not None:
        rest = rest + tool.sensor_mass_kg + tool.net_mass_kg
    return (vehicle.airframe.mass_kg - rest) * (1.0 + world.mass_error)


def link_masses_kg(vehicle: Vehicle, world: World) -> Joints:
    """Return the true masses of the links, without sensor and net, whose masses in the vehicle file are taken as true."""
    masses_kg = vehicle.arm.link_masses_kg
    errors = of_joints(world.link_mass_error, len(masses_kg))
    return tuple(mass_kg * (1.0 + error) for mass_kg, error in zip(masses_kg, errors, strict=True))


def _xyz(values: Vec3) -> str:
    return " ".join(str(value) for value in values)


def _rod(mass_kg: float, com_m: float, length_m: float) -> str:
    inertia = mass_kg * length_m * length_m / 12.0
    return f'<inertial pos="{com_m} 0 0" mass="{mass_kg}" diaginertia="{0.1 * inertia + 1e-5} {inertia} {inertia}"/>'


def _links(vehicle: Vehicle, world: World) -> str:
    """Return the bodies of the links, the sensor and the net, each inside the previous one.

    Without an arm, sensor and net are massless bodies at the origin of the base, so that every model has a body with that name.
    """
    arm, tool = vehicle.arm, vehicle.tool
    sensor_kg, net_kg, (roll, pitch, yaw) = 0.0, 0.0, (0.0, 0.0, 0.0)
    if tool is not None:
        sensor_kg, net_kg, (roll, pitch, yaw) = tool.sensor_mass_kg, tool.net_mass_kg, tool.sensor_rpy_deg
    if arm.joints:
        sensor, net = (
            f'<inertial pos="0 0 0" mass="{max(mass_kg, 1e-4)}" diaginertia="1e-4 1e-4 1e-4"/>'
            for mass_kg in (sensor_kg, net_kg)
        )
    else:
        sensor = net = ""
    places = [_xyz(arm.shoulder_body_m), *(f"{length_m} 0 0" for length_m in arm.link_lengths_m)]
    bodies = f"""<body name="sensor" pos="{places[-1]}">
        {sensor}
        <body name="net" euler="{math.radians(yaw)} {math.radians(pitch)} {math.radians(roll)}">
          {net}
          <site name="net"/>
        </body>
      </body>"""
    friction_nm, damping_nms, armature = world.joint_friction_nm, world.joint_damping_nms, arm.joint_armature_kg_m2
    if transmission.acts(world):
        friction_nm = damping_nms = armature = 0.0
    rods = list(map(_rod, link_masses_kg(vehicle, world), arm.link_com_m, arm.link_lengths_m))
    for index in reversed(range(len(arm.joints))):
        turn = f'euler="{_xyz(machine.shoulder_ypr_rad(world.machine))}"' if index == 0 else ""
        bodies = f"""<body name="link{index + 1}" pos="{places[index]}" {turn}>
        <joint name="alpha{index + 1}" axis="0 {-1 if index else 1} 0" frictionloss="{friction_nm}" damping="{damping_nms}"
               armature="{armature}"/>
        {rods[index]}
        {bodies}
      </body>"""
    return bodies


def mjcf(vehicle: Vehicle, world: World, timestep_s: float) -> str:
    """Return the MuJoCo model of the true vehicle as MJCF text."""
    vehicle = machine.as_built(vehicle, world.machine)
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
  <option timestep="{timestep_s}" gravity="0 0 -{GRAVITY_M_S2}" integrator="implicitfast" cone="pyramidal"/>
  <size memory="2M"/>
  <worldbody>
    <geom name="floor" type="plane" size="20 20 1" contype="2" conaffinity="1"/>
    {anchor}
    <body name="base" pos="0 0 {clearance}">
      <freejoint name="base"/>
      <inertial pos="{_xyz(machine.centre_of_mass_m(world.machine))}" mass="{base_mass_kg(vehicle, world)}"
                diaginertia="{_xyz(airframe.inertia_kg_m2)}"/>
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
  {tendon}
  <actuator>
    {motors}
    {"".join(f'<motor name="alpha{i}" joint="alpha{i}"/>' for i in joints)}
  </actuator>
  <sensor>
    <accelerometer name="accel" site="imu"/>
    <gyro name="gyro" site="imu"/>
    <force name="force" site="net"/>
    <torque name="torque" site="net"/>
    {tension}
  </sensor>
</mujoco>"""
