"""Frozen records that pass between the packages of the companion.

The records contain floats, tuples of floats, enums and other records. They use tuples instead of arrays because tuples are immutable,
compare with ``==`` and survive a JSON round trip exactly. Packages that do linear algebra convert the tuples to arrays.

Conventions:
    * World frame: ENU-like, z up, metres. Body frame: FLU (x forward, y left, z up).
    * Quaternions are ``(w, x, y, z)``, unit norm, and rotate a body vector into the world.
    * ``*_stamp_s`` and ``t_s`` are seconds on the flight clock (monotonic, zero when the flight process starts).
    * An unknown value is ``None``, never NaN.
"""

from __future__ import annotations

from enum import Enum

from companion.model.codec import Record
from companion.model.estimator import EstimatorReport
from companion.model.markers import MarkerFrame
from companion.model.team import BarPose, ClampState, PartnerState

Vec2 = tuple[float, float]
Vec3 = tuple[float, float, float]
Vec4 = tuple[float, float, float, float]
Quat = tuple[float, float, float, float]
Joints = tuple[float, ...]
"""One value for each joint of the arm, from the shoulder outwards; empty if there is no arm."""
Chi = tuple[float, ...]
"""Rows of chi = [x y z | roll pitch yaw | joints]: 6 and one for each joint."""

Mat3 = tuple[Vec3, Vec3, Vec3]
"""3x3 matrix as a tuple of rows."""
Matrix = tuple[tuple[float, ...], ...]
"""Matrix of any size as a tuple of rows."""

IDENTITY_QUAT: Quat = (1.0, 0.0, 0.0, 0.0)


class FlightMode(Enum):
    """The autopilot's flight modes that the companion distinguishes."""

    UNKNOWN = "unknown"
    OFFBOARD = "offboard"
    HOLD = "hold"
    TAKEOFF = "takeoff"
    LAND = "land"
    RETURN = "return"
    MANUAL = "manual"  # any mode that a pilot steers: manual, stabilized, acro, altitude, position
    OTHER = "other"


class LandedState(Enum):
    """State of PX4's land detector (EXTENDED_SYS_STATE.landed_state)."""

    UNKNOWN = "unknown"
    ON_GROUND = "on_ground"
    IN_AIR = "in_air"
    TAKING_OFF = "taking_off"
    LANDING = "landing"


class Severity(Enum):
    """Severity of an event."""

    INFO = "info"
    WARNING = "warning"
    CRITICAL = "critical"


class SafetyAction(Enum):
    """Safety states in order of escalation, and the actions that lead to them."""

    NOMINAL = "nominal"
    WARN = "warn"
    HOLD = "hold"  # stop on the planned path and stay
    RETRACT = "retract"  # fold the arm, fly back toward the anchor, then land
    LAND = "land"  # the companion lands under position control
    AUTOPILOT_LAND = "autopilot_land"  # PX4's LAND mode, because the companion's own state cannot be trusted
    TERMINATE = "terminate"

    @property
    def rank(self) -> int:
        """Return the position of this state in the order of escalation; 0 for NOMINAL."""
        return _ACTION_RANK[self]


_ACTION_RANK = {action: rank for rank, action in enumerate(SafetyAction)}


class AutopilotRequest(Enum):
    """A request to the autopilot in addition to setpoints. The driver sends it; `AutopilotStatus` shows its effect."""

    NONE = "none"
    OFFBOARD = "offboard"  # enter OFFBOARD; setpoints are already streaming
    ARM = "arm"
    LAND = "land"  # PX4's own LAND mode
    DISARM = "disarm"
    FORCE_DISARM = (
        "force_disarm"  # overrides PX4's land detector; companion.safety.rotor_stop decides when it is allowed
    )


class Outcome(Enum):
    """Outcome of a flight; also the value of `outcome` in summary.json."""

    COMPLETED = "completed"
    REFUSED = "refused"
    ABORTED = "aborted"
    CRASHED = "crashed"
    LOST = "lost"


class PhaseKind(Enum):
    """Kind of a phase. Metrics and safety distinguish phases by kind, the operator by name."""

    GROUND = "ground"  # before the rotors lift
    TAKEOFF = "takeoff"
    FLIGHT = "flight"
    LANDING = "landing"
    DONE = "done"


class OperatorCommand(Enum):
    """A command from the ground; `companion.model.commands` has the table of them."""

    NONE = "none"
    HOLD = "hold"
    RESUME = "resume"  # continue after a HOLD if its cause is gone; reverts no other safety state
    START = "start"  # take off; only for a flight that waits for its start
    LAND = "land"
    ABORT = "abort"  # fold the arm and land now; the outcome is ABORTED


class GroundCommand(Record, frozen=True, kw_only=True):
    """A command from a ground station, verified by the recorder process. Only `command` goes into `Inputs`."""

    command: OperatorCommand
    operator: str
    """Name of the operator whose key signed the command."""
    nonce: str
    """Unique identifier of the command, which the answer repeats."""
    hold: int
    """Number of the hold that a RESUME ends, as in `Sent.hold`; 0 in all other commands."""
    t_s: float
    """Flight clock at which it was given, as its sender estimated."""


class VehicleState(Record, frozen=True, kw_only=True):
    """PX4's fused state, converted to world ENU / body FLU by the autopilot driver."""

    position_stamp_s: float
    attitude_stamp_s: float
    imu_stamp_s: float
    position_world_m: Vec3
    velocity_world_m_s: Vec3
    attitude_wxyz: Quat
    angular_rate_body_rad_s: Vec3
    specific_force_body_m_s2: Vec3
    """Accelerometer reading; (0, 0, 9.81) for a level vehicle at rest."""
    boot_s: float | None = None
    """Time on PX4's own clock, s since boot (time_boot_ms of ATTITUDE or ODOMETRY); None if unknown."""
    imu_boot_s: float | None = None
    """End of the newest IMU sample's interval on PX4's clock (HIGHRES_IMU.time_usec), s; None in older logs."""
    delta_velocity_body_m_s: Vec3 | None = None
    """Integral of the specific force over all IMU samples since the link was opened, up to `imu_boot_s`; None in older logs."""
    imu_gaps: int | None = None
    """Number of gaps between IMU samples that the integral does not bridge; None in older logs."""


class AutopilotStatus(Record, frozen=True, kw_only=True):
    """Slowly changing state of the autopilot, from HEARTBEAT, EXTENDED_SYS_STATE and BATTERY_STATUS."""

    heartbeat_stamp_s: float
    armed: bool
    mode: FlightMode
    landed: LandedState
    battery_voltage_v: float | None = None
    """Voltage of the battery with the lowest one; None if PX4 does not report it."""
    battery_remaining: float | None = None
    """Remaining charge, 0 to 1, of the emptiest battery; None if PX4 does not report it."""
    battery_stamp_s: float | None = None
    """Arrival of the newest BATTERY_STATUS of the battery silent for longest; None if none has arrived, and in older logs."""
    system_status: int | None = None
    """HEARTBEAT.system_status (MAV_STATE); None in older logs."""
    system_id: int | None = None
    """MAVLink system id of PX4 (MAV_SYS_ID); None in older logs."""
    radio: bool | None = None
    """Whether PX4 receives a pilot's radio or joystick (SYS_STATUS); None if unknown, as in the fast loop and in older logs."""


class MocapPose(Record, frozen=True, kw_only=True):
    """Pose of the vehicle's rigid body in one motion-capture frame, in the world frame of the mission."""

    stamp_s: float
    """Flight clock at the arrival of the datagram."""
    latency_s: float | None = None
    """Time from mid-exposure to arrival (NatNet >= 3.0), or to transmission if the server answers no echo requests; None if the server
    does not stamp exposures."""
    frame_number: int
    position_world_m: Vec3
    attitude_wxyz: Quat
    tracking_valid: bool
    marker_error_m: float
    exposure_server_s: float | None = None
    """Time of mid-exposure on the server's clock (NatNet >= 3.0), s; None in older logs."""


class ArmState(Record, frozen=True, kw_only=True):
    """Joint state in the paper's angles: from the shoulder outwards. In the 2R arm, alpha_1 is measured from body
    +x downwards, and alpha_2 turns link 2 in the opposite direction."""

    stamp_s: float
    """Flight clock at the end of the joint read."""
    angle_rad: Joints
    velocity_rad_s: Joints
    torque_nm: Joints
    """Joint torque, computed from the present current and the torque constant."""
    hardware_error: tuple[int, ...]
    """Hardware error status (register 70) of each servo, 0 if healthy. The companion sets bit 7 after it has restarted a tripped bus
    watchdog."""
    temperature_c: Joints
    read_failures: int
    """Number of consecutive bus cycles, up to the newest one, in which not every servo answered."""
    written_s: float | None = None
    """Flight clock at the end of the bus thread's last write of currents before this read; None before the first write."""
    asked_s: float | None = None
    """Flight clock at which the bus thread began this read."""

    @property
    def measured_s(self) -> float:
        """Flight clock at which the joint state was measured: the servos measure when the read begins."""
        return self.stamp_s if self.asked_s is None else self.asked_s


class ForceSample(Record, frozen=True, kw_only=True):
    """One sample of the force-torque sensor in the sensor frame, before tare and gravity compensation."""

    stamp_s: float
    force_sensor_n: Vec3
    torque_sensor_nm: Vec3
    overload: bool


class Inputs(Record, frozen=True, kw_only=True):
    """All inputs of `FlightCore.step` in one tick."""

    tick: int
    t_s: float
    vehicle: VehicleState | None = None
    status: AutopilotStatus | None = None
    mocap: MocapPose | None = None
    arm: ArmState | None = None
    force: ForceSample | None = None
    command: OperatorCommand
    recorder_dropped: int
    guardian_ready: bool | None = None
    """Whether the guardian has reported within the last second that it can take over; None without a guardian (fast loop)."""
    estimator: EstimatorReport | None = None
    """Newest ESTIMATOR_STATUS, if another program feeds PX4 with poses (`devices.mocap.type: external`); else None."""
    markers: MarkerFrame | None = None
    """Single markers of the newest motion-capture frame, if the mission uses them (`devices.mocap.ball`); else None."""
    clamp: ClampState | None = None
    """Newest state of the clamp; None without a clamp (`tool.kind`)."""
    bar: BarPose | None = None
    """The bar's rigid body in the newest frame that had it; None without one (`devices.mocap.bar_id`)."""
    partner: PartnerState | None = None
    """Newest announcement of the other vehicle of a team; None without one."""


class Reference(Record, frozen=True, kw_only=True):
    """Reference motion of vehicle and arm at one instant."""

    position_world_m: Vec3
    velocity_world_m_s: Vec3
    acceleration_world_m_s2: Vec3
    yaw_rad: float
    yaw_rate_rad_s: float
    arm_rad: Joints
    arm_rate_rad_s: Joints
    arm_acceleration_rad_s2: Joints
    jerk_world_m_s3: Vec3
    """Reference jerk, used by laws whose acceleration feed-forward has a lead."""
    push_world_n: Vec3 | None = None
    """Force that the vehicle is to exert on a surface, world frame, but for that of `slide_world_n`; None without contact."""
    slide_world_n: Vec3 | None = None
    """Force that vehicle and arm are to exert with a tip that slides, world frame: along the surface against friction, and the wanted
    force across it; None unless the tip slides."""
    steer_rad: float | None = None
    """Angle added to the yaw setpoint to steer a sliding tip towards its path; the yaw error is still that from `yaw_rad`."""


class AttitudeSetpoint(Record, frozen=True):
    """Attitude and thrust setpoint (SET_ATTITUDE_TARGET), in the companion's frames."""

    attitude_wxyz: Quat
    thrust: float
    """Normalised collective thrust, 0 to 1."""


class Event(Record, frozen=True, kw_only=True):
    """An event of the flight, for the log and the operator."""

    t_s: float
    id: str
    severity: Severity
    action: SafetyAction
    text: str


class LinkIdentity(Record, frozen=True, kw_only=True):
    """Addresses and ids that another process needs to take over the MAVLink link to PX4."""

    autopilot_system: int
    own_system: int
    own_component: int
    local_port: int
    """Own UDP port; 0 if it is unknown or the link is not UDP."""
    peer: tuple[str, int] | None = None
    """PX4's IPv4 address and UDP port, the only sender that is accepted; None if the link is not UDP."""
