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
from companion.config.computer import Computer
from companion.config.ground import Ground
from companion.model.constants import GRAVITY_M_S2


class Airframe(Model):
    """The flying base."""

    mass_kg: Positive
    """Whole machine, arm and net included, ready to fly, without payload."""
    inertia_kg_m2: Positive3 = (0.045, 0.045, 0.075)
    """Of the base without arm and tool, about the body's x, y, z at its origin: for the laws that are built on a model, and for the
    simulated airframe. The default is the Tarot 650's."""
    rotor_arm_m: Positive = 0.325
    """Distance of each of the four rotors from the body's z axis, in the X layout (45 deg from the body's x axis): for the simulated
    airframe and PX4's CA_ROTOR parameters there. The default is the Tarot 650's."""
    yaw_torque_per_thrust_m: Positive = 0.025
    """Yaw torque of one rotor over its thrust, N m/N: for the simulated airframe and PX4's CA_ROTOR parameters there. The default is
    the Tarot 650's."""
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
    payload_max_kg: NonNegative = 0.4
    """Largest payload that a mission which expects none (no `catch:`) is checked with."""


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
    """Inertia of rotor and gears of one servo, felt at the joint: for the laws that are built on a model, and for the simulated arm."""
    joint_friction_nm: NonNegative = 0.04
    """Dry friction of one joint; for laws that feed it forward."""
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
    """Slack that is kept: no planned point, and no point at which the machine could stop, comes nearer to the taut sphere."""
    load_rating_n: Positive = 300.0
    """Working load of the whole chain, anchor to attachment; must hold the rotors at full command."""
    weight_n_per_m: NonNegative = 0.1
    """What hangs from the machine is lifted by it."""
    react_time_s: NonNegative = 0.18
    """From a fault to PX4's mode LAND; 0.07 to 0.18 s were measured with the guardian."""
    stop_deceleration_m_s2: Positive = 2.0
    """The governor brakes the reference this fast. Stopping distances assume this or PX4's LAND, whichever is slower at that speed."""
    turns_max: Positive = 1.5
    """Turns about the anchor's vertical, and of the line about the vehicle, either way."""
    taut_slack_m: NonNegative = 0.05
    """Taut when less than this is left."""
    pull_min_n: Positive = 2.0
    """No pull below this is believed, however clear it looks."""
    pull_filter_s: Positive = 0.1
    """Time constant of the low-pass of the force that rotors, gravity and tool do not explain."""
    pull_time_s: NonNegative = 0.8
    """A pull that lasts shorter is a blow."""
    separation_m: Positive = 0.3
    """Farther than the length by this without a pull: the tether holds the machine no more."""
    rotor_inner_radius_m: NonNegative = 0.15
    """No blade sweeps nearer to the body's z axis; the line may hang down within."""
    clearance_min_m: NonNegative = 0.01
    """Between line and rotor disk or arm sweep."""


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
    setpoint_path: Literal["direct", "offboard"] = "direct"
    """How SET_ATTITUDE_TARGET leaves: direct (MAVSDK's MavlinkDirect: only when the flight loop sends), or offboard (MAVSDK's Offboard
    plugin: its thread repeats the last setpoint at 20 Hz, also while the flight loop hangs)."""


ANY_INTERFACE = "0.0.0.0"


class MocapDevice(Model):
    """OptiTrack Motive over NatNet."""

    server: str
    """Address of the Motive machine."""
    interface: str = ANY_INTERFACE
    """Local address that receives: this computer's on the camera network. `fly` and `check` refuse 0.0.0.0 (all) without `--sitl`."""
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
    """Limits after which the companion reacts by itself, and how. What each of them does: docs/safety.md."""

    preflight_s: Annotated[float, Field(ge=1, le=60)] = 5.0
    """So long are all devices watched before anything is armed."""

    # Motion capture
    mocap_timeout_s: Positive = 0.12
    """Oldest mocap pose; beyond it the arm folds and PX4 lands on its own estimate."""
    mocap_rate_min_hz: Positive = 50.0
    """Fewer poses in a second are told."""
    mocap_latency_warn_s: Positive = 0.05
    """Mid-exposure to transmission, by Motive's clock; beyond `mocap_timeout_s` a pose is as good as none."""
    mocap_jump_m: Positive = 0.10
    """Further from where PX4's velocity says it should be than this, a pose is not believed."""
    mocap_jump_deg: Positive = 20.0
    """The same for its attitude, beside what the rates explain."""
    mocap_frozen_s: Positive = 0.10
    """New frames with the very same pose for this long, while the vehicle moves."""
    mocap_inertial_m: Positive = 0.025
    """Largest distance between a pose and the position predicted by the IMU; above it PX4 lands without motion capture. Sound flights
    with 10 m/s2 of vibration reached 0.0084. 0.015 finds drags that begin at 0.2 m/s or faster, 0.025 at 0.3 m/s, 0.04 at 0.5 m/s."""
    mocap_inertial_s: NonNegative = 0.05
    """Hold time of `mocap_inertial_m`."""
    estimate_disagreement_m: Positive = 0.30
    """Between PX4's position and mocap."""
    yaw_disagreement_deg: Positive = 15.0
    """Between PX4's yaw and mocap's."""

    # PX4 and battery
    vehicle_timeout_s: Positive = 0.25
    """Oldest attitude or position from PX4."""
    link_lag_max_s: Positive = 0.07
    """What PX4 says may be so much older than at the best of times; beyond it nobody can steer over this link."""
    heartbeat_timeout_s: Positive = 2.5
    battery_min: Fraction = 0.2
    battery_warn: Fraction = 0.3
    battery_voltage_min_v: Positive | None = 13.2
    """Under load; 3.3 V per cell of a 4S battery. null: not watched."""

    # Arm and force sensor
    arm_timeout_s: Positive = 0.10
    """Oldest joint state; beyond it the vehicle lands."""
    arm_read_failures_max: Annotated[int, Field(ge=1)] = 5
    """Consecutive bus cycles without an answer."""
    servo_warn_c: Positive = 65.0
    servo_max_c: Positive = 75.0
    """The servos shut themselves down at 80."""
    servo_overload_s: Positive = 1.0
    """A joint at its torque limit for this long."""
    joint_jump_deg: Positive = 15.0
    """Between two reads, beside what the joint's largest speed explains."""
    joint_rate_max_deg_s: Positive = 700.0
    """No servo of this kind turns faster, not even when it is driven."""
    joint_wall_warn_deg: Positive = 3.0
    joint_wall_max_deg: Positive = 10.0
    """Beyond a joint's wall."""
    servo_current_max_a: Positive = 2.3
    """No command asks for more; the stall current."""
    force_timeout_s: Positive = 0.25
    """Oldest force sample; beyond it the law flies on without force, and says so."""
    force_stuck_s: Positive = 0.25
    """New samples with the very same values for this long; then the law flies on without force."""
    force_drift_n: Positive = 1.5
    """Lasting force on the net before anything was caught."""

    # The flight itself
    loop_late_s: Positive = 0.05
    """A control tick that comes later than this is told."""
    loop_stalled_s: Positive = 0.3
    """A control tick that comes later than this lands the vehicle."""
    command_state_age_max_s: Positive = 0.10
    """Nothing is sent to PX4 that was computed from an older attitude."""
    thrust_slew_max_per_s: Positive = 100.0
    """Normalised thrust; far above what a catch asks for."""
    tilt_abort_deg: Annotated[float, Field(gt=0, le=80)] = 40.0
    tracking_error_warn_m: Positive = 0.45
    tracking_error_hold_m: Positive = 0.6
    tracking_error_abort_m: Positive = 0.8
    thrust_saturated_s: Positive = 1.0
    """More of the time at the upper thrust limit than below it, by this much."""
    speed_max_m_s: Positive = 2.0
    """Horizontal; a mission's limits must stay below."""
    climb_max_m_s: Positive = 1.5
    sink_max_m_s: Positive = 1.5
    geofence_tolerance_m: NonNegative = 0.10
    """The rotors may lean out of the room by this much: a mission may use it to the full, and no flight is exact."""
    tether_stop_slack_min_m: NonNegative = 0.10
    """Tether left where the vehicle would come to rest."""

    # Reactions
    guardian_timeout_s: Positive = 0.1
    """The flight process silent for this long while the rotors turn: the guardian ends it, takes the link over and lands."""
    hold_max_s: Positive = 20.0
    """A HOLD that nobody ended by then becomes a landing."""
    retract_max_s: Positive = 12.0
    """A RETRACT that has not arrived by then becomes a landing where it is."""
    retract_speed_m_s: Positive = 0.3
    retract_slack_m: Positive = 0.6
    """So much tether is to be free at the end of a RETRACT."""
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
    computer: Computer = Computer()
    safety: Safety = Safety()
    ground: Ground = Ground()

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
        for axis, own in enumerate(self.airframe.inertia_kg_m2):
            others = sum(self.airframe.inertia_kg_m2) - own
            if own > others * (1.0 + 1e-9):
                text = (
                    f"expected at most {others:g} kg m^2, the sum of the other two, as of every rigid body, got {own:g}"
                )
                problems.append((("airframe", "inertia_kg_m2", axis), text))
        carried_kg = sum(self.arm.link_masses_kg) + self.tool.sensor_mass_kg + self.tool.net_mass_kg
        if carried_kg >= self.airframe.mass_kg:
            text = f"{self.airframe.mass_kg:g} kg is the whole machine, but arm and tool alone weigh {carried_kg:g} kg"
            problems.append((("airframe", "mass_kg"), text))
        if self.airframe.thrust_max_n <= GRAVITY_M_S2 * self.airframe.mass_kg:
            text = f"{self.airframe.thrust_max_n:g} N do not lift {self.airframe.mass_kg:g} kg"
            problems.append((("airframe", "thrust_max_n"), text))
        refuse("vehicle", problems)
        return self
