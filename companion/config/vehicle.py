"""The vehicle file: the vehicle, its devices, its tether and its room."""

from __future__ import annotations

from typing import Annotated, Literal, Self

from pydantic import Field, JsonValue, model_validator

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
from companion.config.mocap import NATNET
from companion.model.constants import GRAVITY_M_S2


class Airframe(Model):
    """The flying base."""

    mass_kg: Positive
    """Mass of the whole vehicle ready to fly, with arm and net, without payload."""
    inertia_kg_m2: Positive3 = (0.045, 0.045, 0.075)
    """Moments of inertia of the base without arm and tool about the body's x, y, z at its origin; used by the model-based laws and the
    simulated airframe. The default is the Tarot 650's."""
    rotor_arm_m: Positive = 0.325
    """Distance of each of the four rotors from the body's z axis, in the X layout (45 deg from the body's x axis); used by the
    simulated airframe and its CA_ROTOR parameters in PX4. The default is the Tarot 650's."""
    yaw_torque_per_thrust_m: Positive = 0.025
    """Yaw torque of one rotor divided by its thrust, N m/N; used by the simulated airframe and its CA_ROTOR parameters in PX4. The
    default is the Tarot 650's."""
    thrust_max_n: Positive
    """Thrust of all rotors at full command with a charged battery."""
    hover_thrust: Fraction | None = None
    """Normalised thrust that carries `mass_kg`. If it is absent, PX4's MPC_THR_HOVER is used."""
    hover_thrust_adapt: bool = True
    """Estimate the hover thrust in flight from the thrust sent, the IMU and the force sensor. If false it stays constant."""
    tilt_max_deg: Annotated[float, Field(gt=0, le=45)] = 20.0
    """Largest tilt of an attitude setpoint."""
    ground_clearance_m: Positive
    """Height of the body origin above the floor when the vehicle rests on its landing gear."""
    radius_m: Positive = 0.45
    """Horizontal radius around the body origin, rotor disks included."""
    payload_max_kg: NonNegative = 0.4
    """Payload that the check of a mission without `catch:` assumes."""


class Joint(Model):
    """One servo and its joint; angles as in the paper."""

    servo_id: Annotated[int, Field(ge=0, le=252)]
    sign: Literal[-1, 1]
    """1 if the servo's counts increase with the joint angle, -1 if they decrease."""
    zero_count: Annotated[int, Field(ge=-1048575, le=1048575)]
    """Present Position (register 132) at joint angle 0."""
    angle_deg: Span
    """Joint limits, lower and upper."""
    torque_max_nm: Annotated[float, Field(gt=0, le=3.0)]
    velocity_max_deg_s: Positive = 300.0


class Arm(Model):
    """The 2R arm. Link 1 begins at the shoulder, link 2 carries sensor and net."""

    shoulder_body_m: Vector3
    link_lengths_m: Positive2
    """Lengths from shoulder to elbow, and from elbow to the centre of the net, or without a tool to the end of link 2."""
    link_masses_kg: Positive2
    """Masses of link 1 with the elbow servo, and of link 2 without sensor and net."""
    link_com_m: Positive2
    """Distance of each link's centre of mass from its joint."""
    torque_per_amp_nm_a: Positive = 1.3
    joint_armature_kg_m2: NonNegative = 0.008
    """Inertia of a servo's rotor and gears at the joint; used by the model-based laws and the simulated arm."""
    joint_friction_nm: NonNegative = 0.04
    """Dry friction of one joint, for laws with friction feedforward."""
    joints: tuple[Joint, Joint]


LINK_RADIUS_M = 0.03
"""Half the thickness of servos and links."""


class Tool(Model):
    """Force-torque sensor and net at the end of link 2."""

    sensor_mass_kg: NonNegative
    """Mass of sensor and mount on the arm's side, which the sensor does not measure."""
    net_mass_kg: NonNegative
    """Mass of all parts on the tool side of the sensor; its weight is subtracted from the readings."""
    net_radius_m: Positive
    sensor_rpy_deg: Vector3 = (0.0, 0.0, 0.0)
    """Sensor frame in the frame of link 2 (x outwards along the link, y along the joint axis), ZYX roll, pitch, yaw."""


REACT_TIME_S, STOP_DECELERATION_M_S2 = 0.18, 2.0
"""Defaults of the stop model, also for a vehicle without a tether."""


class Tether(Model):
    """The safety tether."""

    anchor_world_m: Vector3
    length_m: Positive
    attachment_body_m: Vector3 = (0.0, 0.0, 0.0)
    margin_m: NonNegative = 0.25
    """Smallest slack at every planned point and at every point where the vehicle could stop."""
    load_rating_n: Positive = 300.0
    """Working load of the whole tether from anchor to attachment; it must hold the rotors at full command."""
    weight_n_per_m: NonNegative = 0.1
    """Weight per length; the vehicle carries the part that hangs from it."""
    react_time_s: NonNegative = REACT_TIME_S
    """Time from a fault to PX4's LAND mode; 0.07 to 0.18 s were measured with the guardian."""
    stop_deceleration_m_s2: Positive = STOP_DECELERATION_M_S2
    """Deceleration of the reference by the governor. Stopping distances assume the slower of this and PX4's LAND at that speed."""
    turns_max: Positive = 1.5
    """Largest number of turns about the anchor's vertical, and of the tether about the vehicle, in either direction."""
    taut_slack_m: NonNegative = 0.05
    """The tether is taut below this slack."""
    pull_min_n: Positive = 3.0
    """Smallest pull that is detected. Gusts, downwash and a force sensor that has drifted reached 2.8 N for a moment in simulated
    laboratories without faults; a pull of 3 N tilts a vehicle of 3 kg by 6 deg.
    """
    pull_filter_s: Positive = 0.1
    """Time constant of the low-pass of the force that rotors, gravity and tool do not explain."""
    pull_time_s: NonNegative = 0.8
    """Shortest pull that is not treated as an impact."""
    separation_m: Positive = 0.3
    """Distance beyond the length without a pull at which the tether is considered separated."""
    rotor_inner_radius_m: NonNegative = 0.15
    """Radius around the body's z axis without rotor blades, where the tether may hang down."""
    clearance_min_m: NonNegative = 0.01
    """Smallest distance between the tether and the rotor disks or the space swept by the arm."""


class Room(Model):
    """The flying volume; everything that moves stays inside."""

    x_m: Span
    y_m: Span
    z_m: Span


class AutopilotDevice(Model):
    """PX4 over MAVLink."""

    address: str
    """MAVSDK connection, such as udpin://0.0.0.0:14540 or serial:///dev/ttyAMA0:921600."""
    discovery_timeout_s: Positive = 10.0
    setpoint_path: Literal["direct", "offboard"] = "direct"
    """Path of SET_ATTITUDE_TARGET: direct (MAVSDK's MavlinkDirect, only when the flight loop sends) or offboard (MAVSDK's Offboard
    plugin, whose thread repeats the last setpoint at 20 Hz, even while the flight loop hangs)."""


ANY_INTERFACE = "0.0.0.0"


NatNetVersion = Literal["3.0", "3.1", "4.0", "4.1", "4.2", "4.3", "4.4"]
"""Versions of the NatNet bitstream that its SDK describes: those of Motive 2.0, 2.1, 3.0, 3.1, 3.2, 3.3 and 3.4."""


class MocapDevice(Model):
    """Motion capture: OptiTrack Motive over NatNet, or a system that a plug-in provides (docs/mocap-systems.md)."""

    type: str = NATNET
    """natnet, or the name of an installed motion-capture system, which `companion plugins` lists. With `--sitl` natnet is used."""
    server: str
    """Address of the Motive computer, or of the other system's."""
    interface: str = ANY_INTERFACE
    """This computer's address on the camera network. `fly` and `check` refuse 0.0.0.0 (all networks) without `--sitl`."""
    transport: Literal["multicast", "unicast"] = "multicast"
    multicast_group: str = "239.255.42.99"
    command_port: Annotated[int, Field(gt=0, le=65535)] = 1510
    data_port: Annotated[int, Field(gt=0, le=65535)] = 1511
    natnet_version: NatNetVersion | None = None
    """Version that the server must speak. If it is absent, all of them are accepted, and later ones too."""
    rigid_body_id: Annotated[int, Field(ge=0)]
    up_axis: Literal["y", "z"] = "z"
    """Up axis in Motive's streaming settings."""
    rate_hz: Positive = 200.0
    """Expected frame rate."""
    options: dict[str, JsonValue] = Field(default={})
    """Settings of a system that a plug-in provides; empty for natnet."""


ServoBaud = Literal[57600, 115200, 1000000, 2000000, 3000000, 4000000]
"""Baud rates of the arm's servos, in the order of register 8. The tools and the simulated servos have the same and those too slow or
too fast for a flight."""


class ArmDevice(Model):
    """The Dynamixel bus behind a U2D2."""

    port: str
    baud: ServoBaud = 3000000
    watchdog_ms: Annotated[int, Field(ge=20, le=2540)] = 100
    """Bus watchdog (register 98), a multiple of 20 ms; the servos release torque after this time without an instruction."""

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
    """Addresses of the devices."""

    autopilot: AutopilotDevice
    mocap: MocapDevice
    arm: ArmDevice
    force: ForceDevice | None = None
    """Force-torque sensor. If it is absent, the control law runs without a measured force and no catch is detected (docs/parts.md)."""


class Safety(Model):
    """Limits of the safety rules, and times of the reactions. docs/safety.md describes the rules."""

    preflight_s: Annotated[float, Field(ge=1, le=60)] = 5.0
    """Time for which all devices are observed before arming."""

    # Motion capture
    mocap_timeout_s: Positive = 0.2
    """Max age of a mocap pose; beyond it the arm folds and PX4 lands using its own estimate. Until then the vehicle follows PX4's dead
    reckoning: with an acceleration error of 0.5 m/s^2 it is 10 mm off after 0.2 s and 31 mm after 0.35 s. PX4 stops fusing after 0.55
        s. Hidden markers interrupt tracking for up to 0.1 s in a simulated laboratory without faults."""
    mocap_rate_min_hz: Positive = 50.0
    """Rate of poses below which a warning is raised."""
    mocap_latency_warn_s: Positive = 0.05
    """Time from mid-exposure to transmission, by Motive's clock, above which a warning is raised."""
    mocap_latency_max_s: Positive = 0.12
    """Latency above which PX4 lands: PX4 fuses a pose at its arrival minus EKF2_EV_DELAY, so at 1 m/s a pose that is 0.12 s late is
    0.11 m off, as far as `mocap_jump_m` allows."""
    mocap_jump_m: Positive = 0.10
    """Largest distance between a pose and the position predicted from PX4's velocity; a pose beyond it is ignored."""
    mocap_jump_deg: Positive = 20.0
    """Largest change of a pose's attitude beyond what the angular rates explain."""
    mocap_frozen_s: Positive = 0.10
    """Longest time with new frames but an identical pose while the vehicle moves."""
    mocap_inertial_m: Positive = 0.04
    """Largest distance between a pose and the position predicted from the IMU; above it PX4 lands without motion capture. With one IMU
    sample in ten lost it reaches 0.024 at 10 m/s2 of vibration, and 0.036 at 15 m/s2. 0.015 detects drags that begin at 0.2 m/s or
    faster, 0.025 at 0.3 m/s, 0.04 at 0.5 m/s; a vehicle that vibrates less should use a smaller value.
    """
    mocap_inertial_s: NonNegative = 0.05
    """Hold time of `mocap_inertial_m`."""
    estimate_disagreement_m: Positive = 0.30
    """Largest distance between PX4's position and mocap."""
    yaw_disagreement_deg: Positive = 15.0
    """Largest difference between PX4's yaw and mocap's."""

    # PX4 and battery
    vehicle_timeout_s: Positive = 0.25
    """Max age of PX4's attitude and position."""
    link_lag_max_s: Positive = 0.07
    """Largest delay of PX4's messages above their smallest delay; beyond it the link is too slow for control."""
    heartbeat_timeout_s: Positive = 2.5
    battery_min: Fraction = 0.2
    battery_warn: Fraction = 0.3
    battery_voltage_min_v: Positive | None = 13.2
    """Lowest voltage under load; 3.3 V per cell of a 4S battery. null disables the rule."""

    # Arm and force sensor
    arm_timeout_s: Positive = 0.10
    """Max age of the joint state; beyond it the vehicle lands."""
    arm_read_failures_max: Annotated[int, Field(ge=1)] = 5
    """Largest number of consecutive bus cycles without an answer."""
    servo_warn_c: Positive = 65.0
    servo_max_c: Positive = 75.0
    """The servos shut down at 80."""
    servo_overload_s: Positive = 1.0
    """Longest time that a joint may be at its torque limit."""
    joint_jump_deg: Positive = 15.0
    """Largest change between two reads beyond what the joint's largest speed explains."""
    joint_rate_max_deg_s: Positive = 700.0
    """Largest plausible joint rate: no servo of this type reaches it, even if an external force drives it."""
    joint_limit_warn_deg: Positive = 3.0
    joint_limit_max_deg: Positive = 10.0
    """Largest angle by which a joint may exceed its limits; beyond it the vehicle lands."""
    servo_current_max_a: Positive = 2.3
    """Largest commanded current: the stall current."""
    force_timeout_s: Positive = 0.25
    """Max age of a force sample; beyond it the controller continues without force and a warning is raised."""
    force_stuck_s: Positive = 0.25
    """Time with new but identical samples after which the controller continues without force."""
    force_drift_n: Positive = 2.0
    """Largest lasting force on the net before the catch. Drift and the rotors' wake on the net reached 1.5 N in simulated laboratories
    without faults.
    """

    # The flight itself
    loop_late_s: Positive = 0.05
    """Delay of a control tick above which a warning is raised."""
    loop_stalled_s: Positive = 0.3
    """Delay of a control tick above which the vehicle lands."""
    command_state_age_max_s: Positive = 0.10
    """Max age of the attitude from which a setpoint was computed; an older one is not sent to PX4."""
    thrust_slew_max_per_s: Positive = 100.0
    """Largest rate of change of the normalised thrust, far above that of a catch."""
    tilt_abort_deg: Annotated[float, Field(gt=0, le=80)] = 40.0
    tracking_error_warn_m: Positive = 0.45
    tracking_error_hold_m: Positive = 0.6
    tracking_error_abort_m: Positive = 0.8
    thrust_saturated_s: Positive = 1.0
    """Largest excess of the time at the upper thrust limit over the time below it."""
    speed_max_m_s: Positive = 2.0
    """Largest horizontal speed; a mission's limits must stay below."""
    climb_max_m_s: Positive = 1.5
    sink_max_m_s: Positive = 1.5
    geofence_tolerance_m: NonNegative = 0.10
    """Distance by which the rotors may leave the room: a mission may use all of it, and tracking has errors."""
    tether_stop_slack_min_m: NonNegative = 0.10
    """Smallest slack at the predicted stop."""

    # Reactions
    guardian_timeout_s: Positive = 0.1
    """Time without a heartbeat from the flight process, with turning rotors, after which the guardian kills it, takes over and lands.
    If the guardian takes over, this time is part of `tether.react_time_s`, which must grow with it.
    """
    hold_max_s: Positive = 20.0
    """Longest HOLD; then the vehicle lands."""
    retract_max_s: Positive = 12.0
    """Longest RETRACT; then the vehicle lands where it is."""
    retract_speed_m_s: Positive = 0.3
    retract_slack_m: Positive = 0.6
    """Slack at the end of a RETRACT."""
    land_speed_m_s: Positive = 0.35
    fold_arm_deg: Vector2 = (165.0, 140.0)


class Vehicle(Model):
    """One vehicle with its devices, tether and room."""

    schema_version: Literal[1]
    name: str
    airframe: Airframe
    arm: Arm
    tool: Tool | None = None
    """Net, and the force-torque sensor before it. If it is absent, nothing can be caught (docs/parts.md)."""
    tether: Tether | None = None
    """Safety tether. If it is absent, only the room limits the flight, and no tether rule is evaluated (docs/parts.md)."""
    room: Room
    devices: Devices
    computer: Computer = Computer()
    safety: Safety = Safety()
    ground: Ground = Ground()

    @property
    def tip_radius_m(self) -> float:
        """Radius around the end of link 2: that of the net, or half the thickness of the link without a tool."""
        return self.tool.net_radius_m if self.tool is not None else LINK_RADIUS_M

    @property
    def tool_mass_kg(self) -> float:
        """Mass of sensor and net; 0 without a tool."""
        return self.tool.sensor_mass_kg + self.tool.net_mass_kg if self.tool is not None else 0.0

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
                text = f"the centre of mass lies beyond the link's end: at {com_m:g} m on a link of {length_m:g} m"
                problems.append((("arm", "link_com_m", index), text))
        for index, (joint, angle_deg) in enumerate(zip(self.arm.joints, self.safety.fold_arm_deg, strict=True)):
            low_deg, high_deg = joint.angle_deg
            if not low_deg <= angle_deg <= high_deg:
                text = f"{angle_deg:g} deg is outside the joint limits, {low_deg:g} to {high_deg:g} deg"
                problems.append((("safety", "fold_arm_deg", index), text))
        for axis, own in enumerate(self.airframe.inertia_kg_m2):
            others = sum(self.airframe.inertia_kg_m2) - own
            if own > others * (1.0 + 1e-9):
                text = f"expected at most {others:g} kg m^2, the sum of the other two, as for every rigid body, got {own:g}"
                problems.append((("airframe", "inertia_kg_m2", axis), text))
        if self.tool is None and self.devices.force is not None:
            text = (
                "the force-torque sensor is mounted in the tool, but tool is absent; add tool, or remove devices.force"
            )
            problems.append((("devices", "force"), text))
        carried_kg = sum(self.arm.link_masses_kg) + self.tool_mass_kg
        if carried_kg >= self.airframe.mass_kg:
            text = f"{self.airframe.mass_kg:g} kg is the whole vehicle, but arm and tool alone weigh {carried_kg:g} kg"
            problems.append((("airframe", "mass_kg"), text))
        if self.airframe.thrust_max_n <= GRAVITY_M_S2 * self.airframe.mass_kg:
            text = f"{self.airframe.thrust_max_n:g} N do not lift {self.airframe.mass_kg:g} kg"
            problems.append((("airframe", "thrust_max_n"), text))
        refuse("vehicle", problems)
        return self
