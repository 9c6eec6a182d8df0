"""The vehicle file: the machine, its devices, its tether and its room."""

from __future__ import annotations

from typing import Annotated, Literal, Self

from pydantic import Field, model_validator

from companion.config.base import (
    Fraction,
    Location,
    Model,
    NonNegative,
    Positive,
    Positive2,
    Positive3,
    Span,
    Vector2,
    Vector3,
    refuse,
)


class Airframe(Model):
    """The flying base."""

    mass_kg: Positive
    """Whole machine, arm and net included, ready to fly, without payload."""
    inertia_kg_m2: Positive3 = (0.045, 0.045, 0.075)
    """Of the base without arm and tool, about the body's x, y, z at its origin; for the laws that are built on a model."""
    thrust_max_n: Positive
    """All rotors at full command, at the voltage of a charged battery."""
    hover_thrust: Fraction | None = None
    """Normalised thrust that holds `mass_kg`; absent: PX4's MPC_THR_HOVER is read and used."""
    hover_thrust_adapt: bool = True
    """Go on estimating it in flight, from thrust sent, IMU and force sensor; false: it stays what it was at the start."""
    tilt_max_deg: Annotated[float, Field(gt=0, le=45)] = 20.0
    """No attitude setpoint leans further than this."""
    ground_clearance_m: Positive
    """Height of the body origin above the floor when standing on the landing gear."""
    radius_m: Positive = 0.45
    """Horizontal reach around the body origin, rotor disks included."""


class Joint(Model):
    """One servo and its joint, in the paper's angle."""

    servo_id: Annotated[int, Field(ge=0, le=252)]
    sign: Literal[-1, 1]
    """Direction of the servo's counts against the joint angle."""
    zero_count: Annotated[int, Field(ge=-1048575, le=1048575)]
    """Present position (register 132) at joint angle 0."""
    angle_deg: Span
    """Walls of the joint."""
    torque_max_nm: Annotated[float, Field(gt=0, le=3.0)]
    velocity_max_deg_s: Positive = 300.0


class Arm(Model):
    """The 2R arm: link 1 from the shoulder, link 2 carries sensor and net."""

    shoulder_body_m: Vector3
    link_lengths_m: Positive2
    """Shoulder to elbow, elbow to the net's centre."""
    link_masses_kg: Positive2
    """Link 1 with the elbow servo, link 2 without sensor and net."""
    link_com_m: Positive2
    """From the link's own joint outwards."""
    torque_per_amp_nm_a: Positive = 1.3
    joint_armature_kg_m2: NonNegative = 0.008
    """Inertia of rotor and gears of one servo, felt at the joint; for the laws that are built on a model."""
    joints: tuple[Joint, Joint]


class Tool(Model):
    """Force-torque sensor and net at the end of link 2."""

    sensor_mass_kg: NonNegative
    """The part of sensor and mount on the arm's side; not felt by the sensor."""
    net_mass_kg: NonNegative
    """Everything on the tool side of the sensor; its weight is taken out of the reading."""
    net_radius_m: Positive
    sensor_rpy_deg: Vector3 = (0.0, 0.0, 0.0)
    """Sensor frame in the frame of link 2 (x outwards along the link, y along the joint axis), ZYX roll, pitch, yaw."""


class Tether(Model):
    """The safety tether."""

    anchor_world_m: Vector3
    length_m: Positive
    attachment_body_m: Vector3 = (0.0, 0.0, 0.0)
    margin_m: NonNegative = 0.25
    """No planned point comes nearer to the taut sphere than this."""


class Room(Model):
    """The flying volume; everything that moves stays inside it."""

    x_m: Span
    y_m: Span
    z_m: Span


class AutopilotDevice(Model):
    """PX4 over MAVLink."""

    address: str
    """MAVSDK connection: udpin://0.0.0.0:14540, serial:///dev/ttyAMA0:921600, ..."""
    discovery_timeout_s: Positive = 10.0


class MocapDevice(Model):
    """OptiTrack Motive over NatNet."""

    server: str
    """Address of the Motive machine."""
    interface: str = "0.0.0.0"
    """Local address that receives."""
    transport: Literal["multicast", "unicast"] = "multicast"
    multicast_group: str = "239.255.42.99"
    command_port: Annotated[int, Field(gt=0, le=65535)] = 1510
    data_port: Annotated[int, Field(gt=0, le=65535)] = 1511
    natnet_version: Literal["3.0", "4.1"] | None = None
    """Refuse a server that speaks another; absent: take what the server says, if it is one of the two."""
    rigid_body_id: Annotated[int, Field(ge=0)]
    up_axis: Literal["y", "z"] = "z"
    """Motive's streaming setting."""
    rate_hz: Positive = 200.0
    """Expected frame rate."""


class ArmDevice(Model):
    """The Dynamixel bus behind a U2D2."""

    port: str
    baud: Literal[57600, 115200, 1000000, 2000000, 3000000, 4000000] = 3000000
    watchdog_ms: Annotated[int, Field(ge=20, le=2540)] = 100
    """Bus watchdog (register 98), a multiple of 20 ms: the servos let go when the bus falls silent."""

    @model_validator(mode="after")
    def _watchdog_steps(self) -> Self:
        if self.watchdog_ms % 20:
            refuse(
                "arm device",
                [(("watchdog_ms",), f"must be a multiple of 20 (the register's unit), got {self.watchdog_ms}")],
            )
        return self


class ForceDevice(Model):
    """The Robotous RFT60-HA01 on its serial port."""

    port: str
    baud: Literal[115200] = 115200
    rate_hz: Literal[200, 333] = 200
    force_max_n: Positive = 200.0


class Devices(Model):
    """Addresses of everything on a wire."""

    autopilot: AutopilotDevice
    mocap: MocapDevice
    arm: ArmDevice
    force: ForceDevice


class Safety(Model):
    """Limits after which the companion stops the mission by itself."""

    mocap_timeout_s: Positive = 0.12
    """Oldest mocap pose; beyond it the arm folds and PX4 lands on its own estimate."""
    vehicle_timeout_s: Positive = 0.25
    """Oldest attitude or position from PX4."""
    heartbeat_timeout_s: Positive = 2.5
    arm_timeout_s: Positive = 0.10
    """Oldest joint state; beyond it the vehicle lands."""
    force_timeout_s: Positive = 0.25
    """Oldest force sample; beyond it the law flies on without force, and says so."""
    loop_late_s: Positive = 0.05
    """A control tick that comes later than this is told."""
    loop_stalled_s: Positive = 0.3
    """A control tick that comes later than this lands the vehicle."""
    estimate_disagreement_m: Positive = 0.30
    """Between PX4's position and mocap, held for 0.2 s."""
    tilt_abort_deg: Annotated[float, Field(gt=0, le=80)] = 40.0
    tracking_error_abort_m: Positive = 0.8
    battery_min: Fraction = 0.2
    land_speed_m_s: Positive = 0.35
    fold_arm_deg: Vector2 = (165.0, 140.0)


class Vehicle(Model):
    """One machine with its devices, tether and room."""

    schema_version: Literal[1]
    name: str
    airframe: Airframe
    arm: Arm
    tool: Tool
    tether: Tether
    room: Room
    devices: Devices
    safety: Safety = Safety()

    @model_validator(mode="after")
    def _parts_fit(self) -> Self:
        problems: list[tuple[Location, str]] = []
        first, second = self.arm.joints
        if first.servo_id == second.servo_id:
            problems.append(
                (("arm", "joints", 1, "servo_id"), f"both servos have the id {second.servo_id}; give each its own")
            )
        for index, (com_m, length_m) in enumerate(zip(self.arm.link_com_m, self.arm.link_lengths_m, strict=True)):
            if com_m > length_m:
                text = f"the centre of mass lies beyond the link's end: {com_m:g} m on {length_m:g} m"
                problems.append((("arm", "link_com_m", index), text))
        for index, (joint, angle_deg) in enumerate(zip(self.arm.joints, self.safety.fold_arm_deg, strict=True)):
            low_deg, high_deg = joint.angle_deg
            if not low_deg <= angle_deg <= high_deg:
                text = f"{angle_deg:g} deg is outside the joint's walls, {low_deg:g} to {high_deg:g} deg"
                problems.append((("safety", "fold_arm_deg", index), text))
        carried_kg = sum(self.arm.link_masses_kg) + self.tool.sensor_mass_kg + self.tool.net_mass_kg
        if carried_kg >= self.airframe.mass_kg:
            text = f"{self.airframe.mass_kg:g} kg is the whole machine, but arm and tool alone weigh {carried_kg:g} kg"
            problems.append((("airframe", "mass_kg"), text))
        if self.airframe.thrust_max_n <= 9.81 * self.airframe.mass_kg:
            text = f"{self.airframe.thrust_max_n:g} N do not lift {self.airframe.mass_kg:g} kg"
            problems.append((("airframe", "thrust_max_n"), text))
        refuse("vehicle", problems)
        return self
