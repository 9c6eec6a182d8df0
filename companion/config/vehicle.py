"""The vehicle file: the vehicle, its devices, its tether and its room."""

from __future__ import annotations

import math
from collections.abc import Iterator
from typing import Annotated, Literal, Self

from pydantic import BeforeValidator, Field, JsonValue, model_validator

from companion.config.airframe import Airframe
from companion.config.base import (
    JOINTS_MAX,
    Axis,
    Fraction,
    Location,
    Model,
    NonNegative,
    OrElse,
    PerJoint,
    Positive,
    PositivePerJoint,
    Span,
    Vector3,
    refuse,
)
from companion.config.computer import Computer
from companion.config.ground import Ground
from companion.config.mocap import NATNET
from companion.model.arm_chain import is_physical_inertia
from companion.model.constants import GRAVITY_M_S2
from companion.model.servos import SERVOS, WITHOUT_CURRENT_CONTROL, ServoKind, ServoName
from companion.model.types import Joints

_CELL_MIN_V = (2.8, 4.1)
"""Range of the lowest permitted voltage of a lithium-polymer cell."""
FOLDED, UNFOLDED = "folded", "unfolded"
"""Names of poses that the shipped missions use."""


def _with_current_control(name: object) -> object:
    if isinstance(name, str) and name in WITHOUT_CURRENT_CONTROL:
        raise ValueError(f"the {name} has no current control (operating mode 0), so that it cannot follow a torque")
    return name


class Joint(Model):
    """One servo and its joint, with angles as defined in the paper."""

    servo: Annotated[ServoName, BeforeValidator(_with_current_control)] = "XM430-W210"
    """Model of the Dynamixel servo; the driver refuses a servo of another model."""
    servo_id: Annotated[int, Field(ge=0, le=252)]
    sign: Literal[-1, 1]
    """1 if the servo's counts increase with the joint angle, -1 if they decrease."""
    zero_count: Annotated[int, Field(ge=-1048575, le=1048575)]
    """Present Position (register 132) at joint angle 0."""
    angle_deg: Span
    """Lower and upper joint limit."""
    torque_max_nm: Positive
    """Largest commanded torque, at most the stall torque of the servo."""
    velocity_max_deg_s: Positive = 300.0
    """Largest planned speed, at most the speed of the servo without load."""
    torque_per_amp_nm_a: Positive | None = None
    """Torque constant of this servo; null for the value of the arm."""
    axis: Axis | None = None
    """Direction of the axis in the link's frame, for arms without `links`. If it is absent, the first joint turns about +y and the
    others about -y.
    """

    @property
    def kind(self) -> ServoKind:
        """Return the data of the servo's model."""
        return SERVOS[self.servo]

    @model_validator(mode="after")
    def _servo_suffices(self) -> Self:
        kind, problems = self.kind, list[tuple[Location, str]]()
        if self.torque_max_nm > kind.stall_torque_nm:
            text = f"the {kind.name} stalls at {kind.stall_torque_nm:g} N m, got {self.torque_max_nm:g} N m"
            problems.append((("torque_max_nm",), text))
        speed_deg_s = 6.0 * kind.speed_max_rpm
        if self.velocity_max_deg_s > speed_deg_s:
            text = f"the {kind.name} turns at most at {speed_deg_s:g} deg/s, got {self.velocity_max_deg_s:g} deg/s"
            problems.append((("velocity_max_deg_s",), text))
        refuse("joint", problems)
        return self


class Link(Model):
    """A link in the general description of an arm. Its frame lies on its joint's axis and turns with it."""

    origin_m: Vector3
    """Position of the joint in the frame of the link before or, for the first link, in the body frame."""
    origin_rpy_deg: Vector3 = (0.0, 0.0, 0.0)
    """Attitude of the link's frame at joint angle 0, in the same frame: roll, pitch, yaw (ZYX)."""
    axis: Axis
    """Direction of the joint's axis in the link's frame, of any length; positive angles turn by the right-hand rule."""
    mass_kg: Positive
    com_m: Vector3
    """Centre of mass in the link's frame."""
    inertia_kg_m2: tuple[Positive, Positive, Positive, float, float, float]
    """Elements xx, yy, zz, xy, xz, yz of the inertia about the centre of mass, in the axes of the link's frame."""

    @model_validator(mode="after")
    def _rigid(self) -> Self:
        xx, yy, zz, xy, xz, yz = self.inertia_kg_m2
        if not is_physical_inertia(((xx, xy, xz), (xy, yy, yz), (xz, yz, zz))):
            text = "expected the inertia of a rigid body (no principal moment above the sum of the other two)"
            refuse("link", [(("inertia_kg_m2",), text)])
        return self


class Arm(Model):
    """A serial arm of up to 7 joints; the last link carries sensor and net.

    The links are rods along the x axes of their frames, in line with each other at angle 0 (`shoulder_body_m`, `link_lengths_m`,
    `link_masses_kg`, `link_com_m`), or any bodies (`links`, `tip_m`), or those of a URDF file (`urdf`).
    """

    shoulder_body_m: Vector3 = (0.0, 0.0, 0.0)
    """Position of the first joint."""
    link_lengths_m: PositivePerJoint = ()
    """Length of each link, from its joint to the next one; of the last link, to the centre of the net or, without a tool, to the link's
    end.
    """
    link_masses_kg: PositivePerJoint = ()
    """Mass of each link with the servo of the next joint; of the last link, without sensor and net."""
    link_com_m: PositivePerJoint = ()
    """Distance of each link's centre of mass from its joint."""
    links: Annotated[tuple[Link, ...], Field(max_length=JOINTS_MAX)] = ()
    """Links of an arm of any shape, in place of the four keys above; the mass of sensor and net is that of `tool`."""
    tip_m: Vector3 = (0.0, 0.0, 0.0)
    """Centre of the net or, without a tool, end of the arm, in the frame of the last of `links`."""
    tip_rpy_deg: Vector3 = (0.0, 0.0, 0.0)
    """Attitude of the tip's frame, whose x axis points outwards, in the frame of the last of `links`: roll, pitch, yaw (ZYX)."""
    urdf: str | None = None
    """URDF file, relative to the vehicle file, from which `links`, `tip_m` and `tip_rpy_deg` are read (docs/arms.md)."""
    urdf_base: str | None = None
    """Name of the URDF's link that is the vehicle's body. If it is absent, the link that is no joint's child is used."""
    urdf_tip: str | None = None
    """Name of the URDF's link whose frame is the tip. If it is absent, the only link that ends the chain is used."""
    torque_per_amp_nm_a: Positive | None = None
    """Torque constant of the servos, if all of them are of one model. null: stall torque divided by stall current of each model
    (docs/hardware.md)."""
    joint_armature_kg_m2: NonNegative = 0.008
    """Inertia of a servo's rotor and gears, referred to the joint; used by the model-based laws and the simulated arm."""
    joint_friction_nm: NonNegative = 0.04
    """Dry friction of one joint, for laws with friction feedforward."""
    joints: Annotated[tuple[Joint, ...], Field(max_length=JOINTS_MAX)]
    poses: dict[str, PerJoint] = Field(default={})
    """Joint angles, in degrees, that missions refer to by name. Always defined are `folded` (safety.fold_arm_deg) and, for two joints,
    `unfolded` (100, 60 unless given here).
    """

    @property
    def torque_constants_nm_a(self) -> tuple[float, ...]:
        """Return the torque constant of each joint's servo, N m/A: that of the joint, of the arm, or of the servo's model."""
        return tuple(
            joint.torque_per_amp_nm_a or self.torque_per_amp_nm_a or joint.kind.torque_per_amp_nm_a
            for joint in self.joints
        )

    @model_validator(mode="after")
    def _one_value_per_joint(self) -> Self:
        problems: list[tuple[Location, str]] = []
        count = len(self.joints)
        rods = ("link_lengths_m", "link_masses_kg", "link_com_m")
        if self.links:
            source, parts = ("links", "links") if self.urdf is None else ("urdf", "moving joints")
            if len(self.links) != count:
                text = f"expected {count} {parts}, one for each of arm.joints, got {len(self.links)}"
                problems.append(((source,), text))
            problems += [
                ((key,), f"must be absent, because arm.{source} is given") for key in rods if getattr(self, key)
            ]
            given = [index for index, joint in enumerate(self.joints) if joint.axis is not None]
            problems += [(("joints", index, "axis"), f"must be absent; arm.{source} has the axes") for index in given]
        # Without links, the loader could not read the URDF and reports that.
        others = bool(self.links) or self.urdf is not None
        lists: dict[Location, Joints] = {} if others else {(key,): getattr(self, key) for key in rods}
        lists |= {("poses", name): angles_deg for name, angles_deg in self.poses.items()}
        for location, values in lists.items():
            if len(values) != count:
                problems.append((location, f"expected {count} values, one for each of arm.joints, got {len(values)}"))
        if FOLDED in self.poses:
            problems.append((("poses", FOLDED), "is defined by safety.fold_arm_deg; give this pose another name"))
        for index, joint in enumerate(self.joints):
            for earlier in range(index):
                if self.joints[earlier].servo_id == joint.servo_id:
                    text = f"joint {earlier + 1} has the servo id {joint.servo_id} too; give each servo its own id"
                    problems.append((("joints", index, "servo_id"), text))
                    break
        names = list(dict.fromkeys(joint.servo for joint in self.joints if joint.torque_per_amp_nm_a is None))
        if self.torque_per_amp_nm_a is not None and len(names) > 1:
            text = f"one torque constant cannot hold for {' and '.join(names)}; set arm.joints[].torque_per_amp_nm_a instead"
            problems.append((("torque_per_amp_nm_a",), text))
        refuse("arm", problems)
        return self

    @property
    def mass_kg(self) -> float:
        """Mass of all links, without sensor and net."""
        return sum(link.mass_kg for link in self.links) if self.links else sum(self.link_masses_kg)

    @property
    def first_joint_body_m(self) -> Vector3:
        """Position of the first joint in the body frame."""
        return self.links[0].origin_m if self.links else self.shoulder_body_m

    @property
    def reach_m(self) -> float:
        """Largest possible distance of the tip from the first joint."""
        if not self.links:
            return sum(self.link_lengths_m)
        return sum(math.hypot(*link.origin_m) for link in self.links[1:]) + math.hypot(*self.tip_m)


NO_ARM: dict[str, JsonValue] = {
    "shoulder_body_m": [0.0, 0.0, 0.0],
    "link_lengths_m": [],
    "link_masses_kg": [],
    "link_com_m": [],
    "joints": [],
}
"""What `arm: null` in a file stands for; the loader replaces it."""


LINK_RADIUS_M = 0.03
"""Half the thickness of servos and links."""


class Tool(Model):
    """Force-torque sensor and net at the tip of the arm."""

    sensor_mass_kg: NonNegative
    """Mass of the sensor and the mount on the arm's side, which the sensor does not measure."""
    net_mass_kg: NonNegative
    """Mass of all parts on the tool side of the sensor; their weight is subtracted from the readings."""
    net_radius_m: Positive
    sensor_rpy_deg: Vector3 = (0.0, 0.0, 0.0)
    """Attitude of the sensor frame in the tip's frame (x outwards; for rods, the frame of the last link): roll, pitch, yaw (ZYX)."""


class Tether(Model):
    """The safety tether."""

    anchor_world_m: Vector3
    length_m: Positive
    attachment_body_m: Vector3 = (0.0, 0.0, 0.0)
    margin_m: NonNegative = 0.25
    """Smallest slack at every planned point and at every point where the vehicle could stop."""
    load_rating_n: Positive = 300.0
    """Working load of the whole tether, from anchor to attachment; it must withstand the full thrust of the rotors."""
    weight_n_per_m: NonNegative = 0.1
    """Weight per length; the vehicle carries the part of the tether that hangs from it."""
    turns_max: Positive = 1.5
    """Largest number of turns, in either direction, of the tether about the vertical through the anchor and about the vehicle."""
    taut_slack_m: NonNegative = 0.05
    """Slack below which the tether counts as taut."""
    pull_min_n: Positive = 3.0
    """Smallest pull that is detected. In simulated laboratories without faults, gusts, downwash and a drifted force sensor briefly
    produced 2.8 N. A pull of 3 N tilts a vehicle of 3 kg by 6 deg.
    """
    pull_filter_s: Positive = 0.1
    """Time constant of the low-pass filter on the force that is not due to the rotors, gravity or the tool."""
    pull_time_s: NonNegative = 0.8
    """Duration from which a pull is not treated as an impact."""
    separation_m: Positive = 0.3
    """Distance beyond the tether's length at which, without a pull, the tether counts as separated."""
    rotor_inner_radius_m: NonNegative = 0.15
    """Radius around the body's z axis that is free of rotor blades, so that the tether may hang down there."""
    clearance_min_m: NonNegative = 0.01
    """Smallest distance of the tether from the rotor disks and from the space that the arm sweeps."""


class Room(Model):
    """The flying volume; no part of the vehicle may leave it."""

    x_m: Span
    y_m: Span
    z_m: Span


class AutopilotDevice(Model):
    """PX4 over MAVLink."""

    address: str
    """MAVSDK connection, such as udpin://0.0.0.0:14540 or serial:///dev/ttyAMA0:921600."""
    discovery_timeout_s: Positive = 10.0
    setpoint_path: Literal["direct", "offboard"] = "direct"
    """How SET_ATTITUDE_TARGET is sent: direct (MAVSDK's MavlinkDirect, which sends only when the flight loop does) or offboard
    (MAVSDK's
    Offboard plugin, whose thread repeats the last setpoint at 20 Hz, even while the flight loop hangs)."""


ANY_INTERFACE = "0.0.0.0"


NatNetVersion = Literal["3.0", "3.1", "4.0", "4.1", "4.2", "4.3", "4.4"]
"""Versions of the NatNet bitstream that the NatNet SDK describes: those of Motive 2.0, 2.1, 3.0, 3.1, 3.2, 3.3 and 3.4."""


class MocapDevice(Model):
    """Motion capture: OptiTrack Motive over NatNet, or a system that a plug-in provides (docs/mocap-systems.md)."""

    type: str = NATNET
    """natnet, or the name of an installed motion-capture system (`companion plugins` lists them). With `--sitl`, natnet is used."""
    server: str
    """Address of the computer that runs Motive or the other system."""
    interface: str = ANY_INTERFACE
    """This computer's address on the camera network. Without `--sitl`, `fly` and `check` refuse 0.0.0.0 (all networks)."""
    transport: Literal["multicast", "unicast"] = "multicast"
    multicast_group: str = "239.255.42.99"
    command_port: Annotated[int, Field(gt=0, le=65535)] = 1510
    data_port: Annotated[int, Field(gt=0, le=65535)] = 1511
    natnet_version: NatNetVersion | None = None
    """Version that the server must use. If it is absent, all these versions and later ones are accepted."""
    rigid_body_id: Annotated[int, Field(ge=0)]
    up_axis: Literal["y", "z"] = "z"
    """Up axis in Motive's streaming settings."""
    rate_hz: Positive = 200.0
    """Expected frame rate."""
    options: dict[str, JsonValue] = Field(default={})
    """Settings of the system that a plug-in provides; must be empty for natnet."""


ServoBaud = Literal[57600, 115200, 1000000, 2000000, 3000000, 4000000]
"""Baud rates of the arm's servos, in the order of the values of register 8. The tools and the simulated servos also support rates that
are too slow or too fast for a flight."""


class ArmDevice(Model):
    """The Dynamixel bus, connected by a U2D2 adapter."""

    port: str
    baud: ServoBaud = 3000000
    watchdog_ms: Annotated[int, Field(ge=20, le=2540)] = 100
    """Timeout of the bus watchdog (register 98), a multiple of 20 ms; after this time without an instruction, the servos release
    torque.
    """

    @model_validator(mode="after")
    def _watchdog_steps(self) -> Self:
        if self.watchdog_ms % 20:
            refuse(
                "arm device",
                [(("watchdog_ms",), f"must be a multiple of 20 ms (the register's unit), got {self.watchdog_ms} ms")],
            )
        return self


class ForceDevice(Model):
    """The Robotous RFT60-HA01 on its serial port."""

    port: str
    baud: Literal[115200] = 115200
    rate_hz: Literal[200, 333] = 200
    force_max_n: Positive = 200.0


class Devices(Model):
    """Addresses and settings of the devices."""

    autopilot: AutopilotDevice
    mocap: MocapDevice
    arm: ArmDevice | None = None
    """Bus of the arm's servos; absent if and only if the vehicle has no arm."""
    force: ForceDevice | None
    """Force-torque sensor; null states that there is none: the control law then runs without a measured force, and no catch is detected
    (docs/parts.md)."""


class Safety(Model):
    """Thresholds of the safety rules, and limits of the reactions. docs/safety.md describes the rules."""

    preflight_s: Annotated[float, Field(ge=1, le=60)] = 5.0
    """Time for which the preflight check observes all devices before arming."""

    # Motion capture
    mocap_timeout_s: Positive = 0.2
    """Max age of a motion-capture pose; beyond it, the arm folds and PX4 lands using its own estimate. Until then, the vehicle
    follows PX4's dead reckoning: with an acceleration error of 0.5 m/s^2, it is off by 10 mm after 0.2 s and by 31 mm after 0.35 s.
    After 0.55 s,
    PX4's fusion flags are cleared. In a simulated laboratory without faults, hidden markers interrupt tracking for up to 0.1 s."""
    mocap_rate_min_hz: Positive = 50.0
    """Rate of poses below which a warning is raised."""
    mocap_latency_warn_s: Positive = 0.05
    """Time from mid-exposure to transmission, on the server's clock, above which a warning is raised."""
    mocap_latency_max_s: Positive = 0.12
    """Latency above which PX4 lands. PX4 fuses a pose at its arrival time minus EKF2_EV_DELAY, so at 1 m/s a pose that is 0.12 s late
    is
    off by 0.11 m, about as much as `mocap_jump_m` allows."""
    mocap_jump_m: Positive = 0.10
    """Largest distance between a pose and the position predicted from PX4's velocity; a more distant pose is ignored."""
    mocap_jump_deg: Positive = 20.0
    """Largest change of a pose's attitude in excess of the change computed from the angular rates."""
    mocap_frozen_s: Positive = 0.10
    """Longest time with new frames but an identical pose while the vehicle is moving."""
    mocap_inertial_m: Positive = 0.04
    """Largest distance between a pose and the position predicted from the IMU; above it, PX4 lands without motion capture. If one IMU
    sample in ten is lost, the distance reaches 0.024 at a vibration of 10 m/s^2 and 0.036 at 15 m/s^2. A limit of 0.015 detects poses
    that drift away at 0.2 m/s or faster, 0.025 at 0.3 m/s and 0.04 at 0.5 m/s; a vehicle that vibrates less should use a smaller
    value.
    """
    mocap_inertial_s: NonNegative = 0.05
    """Hold time of `mocap_inertial_m`."""
    estimate_disagreement_m: Positive = 0.30
    """Largest distance between PX4's position estimate and the motion-capture position."""
    yaw_disagreement_deg: Positive = 15.0
    """Largest difference between PX4's yaw and the motion-capture yaw."""

    # PX4 and battery
    vehicle_timeout_s: Positive = 0.25
    """Max age of PX4's attitude and position estimates."""
    link_lag_max_s: Positive = 0.07
    """Largest delay of PX4's messages relative to their smallest delay; above it, the link is too slow for control."""
    heartbeat_timeout_s: Positive = 2.5
    battery_min: Fraction = 0.2
    battery_warn: Fraction = 0.3
    battery_voltage_min_v: Positive | None = 13.2
    """Lowest permitted voltage under load; the default is 3.3 V per cell of a 4S battery. null disables the rule."""

    # Arm and force sensor
    arm_timeout_s: Positive = 0.10
    """Max age of the joint state; beyond it, the vehicle lands."""
    arm_read_failures_max: Annotated[int, Field(ge=1)] = 5
    """Largest number of consecutive bus cycles without an answer."""
    servo_warn_c: Positive = 65.0
    servo_max_c: Positive = 75.0
    """Temperature above which the vehicle lands; it must be below the temperature at which a servo shuts down (80 degC; 70 degC for the
    330 models)."""
    servo_overload_s: Positive = 1.0
    """Longest time for which a joint may be at its torque limit."""
    joint_jump_deg: Positive = 15.0
    """Largest change of a joint angle between two reads in excess of the change at the joint's largest speed."""
    joint_rate_max_deg_s: Positive = 700.0
    """Largest plausible joint rate; no XM430-W210 reaches it, even when driven by an external force."""
    joint_limit_warn_deg: Positive = 3.0
    joint_limit_max_deg: Positive = 10.0
    """Largest angle by which a joint may exceed its limits; beyond it, the vehicle lands."""
    servo_current_max_a: Positive | None = None
    """Largest commanded current of each servo; null for the stall current of its model."""
    force_timeout_s: Positive = 0.25
    """Max age of a force sample; beyond it, the controller continues without the force and a warning is raised."""
    force_stuck_s: Positive = 0.25
    """Time with new but identical samples after which the controller continues without the force."""
    force_drift_n: Positive = 2.0
    """Largest lasting force on the net before the catch. In simulated laboratories without faults, drift and the rotors' wake on the
    net reached 1.5 N.
    """

    # The flight itself
    loop_late_s: Positive = 0.05
    """Delay of a control tick above which a warning is raised."""
    loop_stalled_s: Positive = 0.3
    """Delay of a control tick above which the vehicle lands."""
    command_state_age_max_s: Positive = 0.10
    """Max age of the attitude from which a setpoint is computed; a setpoint computed from an older attitude is not sent to PX4."""
    thrust_slew_max_per_s: Positive = 100.0
    """Largest rate of change of the normalised thrust, far above the rate during a catch."""
    tilt_abort_deg: Annotated[float, Field(gt=0, le=80)] = 40.0
    tracking_error_warn_m: Positive = 0.45
    tracking_error_hold_m: Positive = 0.6
    tracking_error_abort_m: Positive = 0.8
    thrust_saturated_s: Positive = 1.0
    """Largest difference between the time at the upper thrust limit and the time below it."""
    speed_max_m_s: Positive = 2.0
    """Largest horizontal speed; a mission's speed limit must be lower."""
    climb_max_m_s: Positive = 1.5
    sink_max_m_s: Positive = 1.5
    geofence_tolerance_m: NonNegative = 0.10
    """Distance by which the rotors may leave the room, because a mission may use the whole room and tracking is not exact."""
    tether_stop_slack_min_m: NonNegative = 0.10
    """Smallest tether slack at the position where the vehicle is predicted to stop."""

    # Reactions
    react_time_s: NonNegative = 0.18
    """Time from a fault to PX4's LAND mode; 0.07 to 0.18 s were measured with the guardian."""
    stop_deceleration_m_s2: Positive = 2.0
    """Deceleration with which the governor stops the reference. Stopping distances assume the slower of this stop and a stop in PX4's
    LAND mode from the same speed."""
    guardian_timeout_s: Positive = 0.1
    """Time without a heartbeat from the flight process, while the rotors turn, after which the guardian kills that process, takes over
    and lands. In such a takeover this time is part of `react_time_s`, which must be increased with it.
    """
    hold_max_s: Positive = 20.0
    """Longest duration of a HOLD, after which the vehicle lands."""
    retract_max_s: Positive = 12.0
    """Longest duration of a RETRACT, after which the vehicle lands where it is."""
    retract_speed_m_s: Positive = 0.3
    retract_slack_m: Positive = 0.6
    """Tether slack at the end of a RETRACT."""
    land_speed_m_s: Positive = 0.35
    fold_arm_deg: PerJoint = (165.0, 140.0)
    """Joint angles of the folded arm, the pose `folded` of missions. The default is for an arm of two joints."""


class Vehicle(Model):
    """One vehicle with its devices, tether and room."""

    schema_version: Literal[1]
    name: str
    airframe: Airframe
    arm: Annotated[Arm, OrElse({"type": "null"})]
    """Arm; null states that there is none, and `arm.joints` is then empty (docs/parts.md)."""
    tool: Tool | None
    """Net, with the force-torque sensor between the last link and the net; null states that there is none, and nothing can be caught
    (docs/parts.md)."""
    tether: Tether | None
    """Safety tether; null states that there is none: only the room then limits the flight, and no tether rule is evaluated
    (docs/parts.md)."""
    room: Room
    devices: Devices
    computer: Computer = Computer()
    safety: Safety = Safety()
    ground: Ground = Ground()

    @property
    def fold_arm_deg(self) -> Joints:
        """Joint angles of the folded arm, deg."""
        return self.safety.fold_arm_deg[: len(self.arm.joints)]

    @property
    def joint_torque_limits_nm(self) -> Joints:
        """Largest torque that is commanded to each joint, N m: `torque_max_nm`, or what the largest current of its servo gives."""
        return tuple(
            min(joint.torque_max_nm, (self.safety.servo_current_max_a or joint.kind.stall_current_a) * nm_a)
            for joint, nm_a in zip(self.arm.joints, self.arm.torque_constants_nm_a, strict=True)
        )

    @property
    def arm_device(self) -> ArmDevice:
        """Bus of the arm's servos; may be read only if there is an arm."""
        assert self.devices.arm is not None, "the vehicle has no arm"
        return self.devices.arm

    @property
    def poses_deg(self) -> dict[str, Joints]:
        """Joint angles of each named pose, deg."""
        usual = {UNFOLDED: (100.0, 60.0)} if len(self.arm.joints) == 2 else {}
        return {FOLDED: self.fold_arm_deg, **usual, **self.arm.poses}

    @property
    def tip_radius_m(self) -> float:
        """Radius around the end of link 2, m: the radius of the net or, without a tool, half the thickness of the link."""
        return self.tool.net_radius_m if self.tool is not None else LINK_RADIUS_M

    @property
    def tool_mass_kg(self) -> float:
        """Mass of sensor and net, kg; 0 without a tool."""
        return self.tool.sensor_mass_kg + self.tool.net_mass_kg if self.tool is not None else 0.0

    @model_validator(mode="after")
    def _parts_fit(self) -> Self:
        problems: list[tuple[Location, str]] = []
        for index, (com_m, length_m) in enumerate(zip(self.arm.link_com_m, self.arm.link_lengths_m, strict=True)):
            if com_m > length_m:
                text = f"the centre of mass is beyond the end of the link: at {com_m:g} m on a link of {length_m:g} m"
                problems.append((("arm", "link_com_m", index), text))
        problems += self._poses_within_limits()
        coolest = min((joint.kind for joint in self.arm.joints), key=lambda kind: kind.temperature_max_c, default=None)
        if coolest is not None and self.safety.servo_max_c >= coolest.temperature_max_c:
            text = (
                f"expected less than {coolest.temperature_max_c:g} degC, at which the {coolest.name} switches its torque off, got "
                f"{self.safety.servo_max_c:g} degC{self._default_note('servo_max_c')}"
            )
            problems.append((("safety", "servo_max_c"), text))
        fastest_deg_s = max((joint.velocity_max_deg_s for joint in self.arm.joints), default=0.0)
        if fastest_deg_s >= self.safety.joint_rate_max_deg_s:
            text = (
                f"expected more than {fastest_deg_s:g} deg/s, the largest planned speed of a joint (arm.joints[].velocity_max_deg_s), "
                f"because the vehicle lands above this rate, got {self.safety.joint_rate_max_deg_s:g} deg/s"
            )
            problems.append((("safety", "joint_rate_max_deg_s"), text))
        for axis, own in enumerate(self.airframe.inertia_kg_m2):
            others = sum(self.airframe.inertia_kg_m2) - own
            if own > others * (1.0 + 1e-9):
                text = f"expected at most {others:g} kg m^2 (no moment of a rigid body exceeds the sum of the other two), got {own:g}"
                problems.append((("airframe", "inertia_kg_m2", axis), text))
        if self.tool is None and self.devices.force is not None:
            text = "the force-torque sensor is part of the tool, but tool is absent; add tool, or set devices.force to null"
            problems.append((("devices", "force"), text))
        if self.tool is not None and not self.arm.joints:
            text = "the tool is mounted on the arm's last link, but arm is null; set tool to null"
            problems.append((("tool",), text))
        if (self.devices.arm is None) != (not self.arm.joints):
            text = (
                "missing; the arm's servos need a bus"
                if self.devices.arm is None
                else "must be null, because arm is null"
            )
            problems.append((("devices", "arm"), text))
        carried_kg = self.arm.mass_kg + self.tool_mass_kg
        if carried_kg >= self.airframe.mass_kg:
            text = f"{self.airframe.mass_kg:g} kg is the mass of the whole vehicle, but arm and tool alone have {carried_kg:g} kg"
            problems.append((("airframe", "mass_kg"), text))
        if self.airframe.thrust_max_n <= GRAVITY_M_S2 * self.airframe.mass_kg:
            text = f"{self.airframe.thrust_max_n:g} N do not lift {self.airframe.mass_kg:g} kg"
            problems.append((("airframe", "thrust_max_n"), text))
        nearest_m = min(math.hypot(x, y) for x, y, _ in self.airframe.rotor_layout.positions_body_m)
        if self.tether is not None and nearest_m <= self.tether.rotor_inner_radius_m:
            text = f"expected less than {nearest_m:g} m, the distance of the nearest rotor from the body's z axis"
            text += f", got {self.tether.rotor_inner_radius_m:g} m"
            problems.append((("tether", "rotor_inner_radius_m"), text))
        cells, lowest_v = self.airframe.battery_cells, self.safety.battery_voltage_min_v
        low_v, high_v = (cells * cell_v for cell_v in _CELL_MIN_V)
        if lowest_v is not None and not low_v <= lowest_v <= high_v:
            text = (
                f"expected {low_v:.1f} to {high_v:.1f} V for the {cells} cells of airframe.battery_cells, got {lowest_v:g} V"
                + self._default_note("battery_voltage_min_v")
            )
            problems.append((("safety", "battery_voltage_min_v"), text))
        refuse("vehicle", problems)
        return self

    def _default_note(self, key: str) -> str:
        """Return a note for a message if the key of `safety` is not in the file, so that its default is used."""
        return "" if key in self.safety.model_fields_set else " (the default, because the file does not give it)"

    def _poses_within_limits(self) -> Iterator[tuple[Location, str]]:
        joints, fold = self.arm.joints, self.safety.fold_arm_deg
        if joints and len(fold) != len(joints):
            angles = "1 angle" if len(joints) == 1 else f"{len(joints)} angles"
            text = f"expected {angles}, one for each of arm.joints, got {len(fold)}{self._default_note('fold_arm_deg')}"
            yield ("safety", "fold_arm_deg"), text
            return
        poses: list[tuple[Location, Joints]] = [(("safety", "fold_arm_deg"), self.fold_arm_deg)]
        poses += [(("arm", "poses", name), at) for name, at in self.arm.poses.items()]
        for location, angles_deg in poses:
            for index, (joint, angle_deg) in enumerate(zip(joints, angles_deg, strict=True)):
                low_deg, high_deg = joint.angle_deg
                if not low_deg <= angle_deg <= high_deg:
                    text = f"{angle_deg:g} deg is outside the joint limits, {low_deg:g} to {high_deg:g} deg"
                    yield (*location, index), text
