"""The MuJoCo model of the vehicle, its tether and the thrown payload, built from the vehicle file."""

from __future__ import annotations

import math

from companion.config.vehicle import Airframe, Vehicle
from companion.model.constants import GRAVITY_M_S2
from companion.sitl_config.world import World
from sitl.world.effects import machine, transmission

PAYLOAD_RADIUS_M = 0.035
SECOND, SECOND_CATCH = "payload2", "catch2"
"""Names of the second ball, which a fault throws after the payload, and of its constraint."""
ROTOR_HEIGHT_M = 0.03
"""Height of the rotors above the body origin."""
# In PX4's quad-x order: each rotor's position (body FLU, in units of arm/sqrt 2) and the sign of its reaction torque about z (up).
ROTORS = ((1, -1, -1), (-1, 1, -1), (1, 1, 1), (-1, -1, 1))


def rotor_offset_m(airframe: Airframe) -> float:
    """Return the distance in m of each rotor from the x-z and y-z planes of the body."""
    return airframe.rotor_arm_m / math.sqrt(2.0)


def base_mass_kg(vehicle: Vehicle, world: World) -> float:
    """Return the true mass of the flying base, without arm and tool."""
    arm, tool = vehicle.arm, vehicle.tool
    rest = sum(arm.link_masses_kg)
    if tool is not None:
        rest = rest + tool.sensor_mass_kg + tool.net_mass_kg
    return (vehicle.airframe.mass_kg - rest) * (1.0 + world.mass_error)


def link_masses_kg(vehicle: Vehicle, world: World) -> tuple[float, float]:
    """Return the true masses of both links, without sensor and net, whose masses in the vehicle file are taken as true."""
    first, second = vehicle.arm.link_masses_kg
    return first * (1.0 + world.link_mass_error[0]), second * (1.0 + world.link_mass_error[1])


def mjcf(vehicle: Vehicle, world: World, timestep_s: float) -> str:
    """Return the MuJoCo model of the true vehicle as MJCF text."""
    vehicle = machine.as_built(vehicle, world.machine)
    airframe, arm, tool = vehicle.airframe, vehicle.arm, vehicle.tool
    l1, l2 = arm.link_lengths_m
    m1, m2 = link_masses_kg(vehicle, world)
    offset = rotor_offset_m(airframe)
    clearance = airframe.ground_clearance_m
    rotors = "\n".join(
        f'<site name="rotor{i}" pos="{x * offset} {y * offset} {ROTOR_HEIGHT_M}"/>'
        for i, (x, y, _) in enumerate(ROTORS)
    )
    yaw_errors = world.rotors.yaw_torque_error if world.rotors.on else (0.0, 0.0, 0.0, 0.0)
    motors = "\n".join(
        f'<motor name="rotor{i}" site="rotor{i}" gear="0 0 1 0 0 {s * airframe.yaw_torque_per_thrust_m * (1.0 + error)}"/>'
        for i, ((_, _, s), error) in enumerate(zip(ROTORS, yaw_errors, strict=True))
    )
    feet = "\n".join(
        f'<geom name="foot{i}" type="sphere" size="0.02" pos="{x * 0.18} {y * 0.18} {-clearance + 0.02}" contype="1" '
        f'conaffinity="2" friction="0.8 0.02 0.001" solref="0.02 1"/>'
        for i, (x, y, _) in enumerate(ROTORS)
    )

    def rod(mass: float, com: float, length: float) -> str:
        inertia = mass * length * length / 12.0
        return f'<inertial pos="{com} 0 0" mass="{mass}" diaginertia="{0.1 * inertia + 1e-5} {inertia} {inertia}"/>'

    def xyz(values: tuple[float, float, float]) -> str:
        return " ".join(str(value) for value in values)

    friction_nm, damping_nms, armature = world.joint_friction_nm, world.joint_damping_nms, arm.joint_armature_kg_m2
    if transmission.acts(world):
        friction_nm = damping_nms = armature = 0.0
    sensor_kg, net_kg, (roll, pitch, yaw) = 0.0, 0.0, (0.0, 0.0, 0.0)
    if tool is not None:
        sensor_kg, net_kg, (roll, pitch, yaw) = tool.sensor_mass_kg, tool.net_mass_kg, tool.sensor_rpy_deg
    anchor = tendon = tension = ""
    if vehicle.tether is not None:
        anchor = f'<site name="anchor" pos="{xyz(vehicle.tether.anchor_world_m)}"/>'
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
      <inertial pos="{xyz(machine.centre_of_mass_m(world.machine))}" mass="{base_mass_kg(vehicle, world)}"
                diaginertia="{xyz(airframe.inertia_kg_m2)}"/>
      <site name="imu"/>
      <site name="tether" pos="{xyz(vehicle.tether.attachment_body_m if vehicle.tether is not None else (0.0, 0.0, 0.0))}"/>
      {rotors}
      {feet}
      <body name="link1" pos="{xyz(arm.shoulder_body_m)}" euler="{xyz(machine.shoulder_ypr_rad(world.machine))}">
        <joint name="alpha1" axis="0 1 0" frictionloss="{friction_nm}" damping="{damping_nms}"
               armature="{armature}"/>
        {rod(m1, arm.link_com_m[0], l1)}
        <body name="link2" pos="{l1} 0 0">
          <joint name="alpha2" axis="0 -1 0" frictionloss="{friction_nm}" damping="{damping_nms}"
                 armature="{armature}"/>
          {rod(m2, arm.link_com_m[1], l2)}
          <body name="sensor" pos="{l2} 0 0">
            <inertial pos="0 0 0" mass="{max(sensor_kg, 1e-4)}" diaginertia="1e-4 1e-4 1e-4"/>
            <body name="net" euler="{math.radians(yaw)} {math.radians(pitch)} {math.radians(roll)}">
              <inertial pos="0 0 0" mass="{max(net_kg, 1e-4)}" diaginertia="1e-4 1e-4 1e-4"/>
              <site name="net"/>
            </body>
          </body>
        </body>
      </body>
    </body>{payload}
  </worldbody>
  <equality>
    <joint name="park1" joint1="alpha1" solref="0.01 1"/>
    <joint name="park2" joint1="alpha2" solref="0.01 1"/>{connect}
  </equality>
  {tendon}
  <actuator>
    {motors}
    <motor name="alpha1" joint="alpha1"/>
    <motor name="alpha2" joint="alpha2"/>
  </actuator>
  <sensor>
    <accelerometer name="accel" site="imu"/>
    <gyro name="gyro" site="imu"/>
    <force name="force" site="net"/>
    <torque name="torque" site="net"/>
    {tension}
  </sensor>
</mujoco>"""
