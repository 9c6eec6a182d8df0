"""Frozen records that pass between the rooms of the companion.

Everything here is plain data: floats, tuples of floats, enums and other records. Tuples, not arrays, because they are truly
immutable, compare bit for bit with ``==`` and survive a JSON round trip exactly; rooms that do linear algebra make arrays of them.

Conventions
    * World frame: ENU-like, z up, metres. Body frame: FLU (x forward, y left, z up).
    * Quaternions are ``(w, x, y, z)``, unit norm, and rotate a body vector into the world.
    * ``*_stamp_s`` and ``t_s`` are seconds on the flight clock (monotonic, zero when the flight process starts).
    * A value that is not known is ``None``, never NaN.
"""

from __future__ import annotations

from enum import Enum

from companion.model.codec import Record

Vec2 = tuple[float, float]
Vec3 = tuple[float, float, float]
Vec4 = tuple[float, float, float, float]
Vec8 = tuple[float, float, float, float, float, float, float, float]
Quat = tuple[float, float, float, float]

IDENTITY_QUAT: Quat = (1.0, 0.0, 0.0, 0.0)


class FlightMode(Enum):
    """The autopilot's flight mode, as far as the companion tells modes apart."""

    UNKNOWN = "unknown"
    OFFBOARD = "offboard"
    HOLD = "hold"
    TAKEOFF = "takeoff"
    LAND = "land"
    RETURN = "return"
    MANUAL = "manual"  # any mode in which a pilot steers: manual, stabilized, acro, altitude, position
    OTHER = "other"


class LandedState(Enum):
    """EXTENDED_SYS_STATE.landed_state."""

    UNKNOWN = "unknown"
    ON_GROUND = "on_ground"
    IN_AIR = "in_air"
    TAKING_OFF = "taking_off"
    LANDING = "landing"


class Severity(Enum):
    """How bad an event is."""

    INFO = "info"
    WARNING = "warning"
    CRITICAL = "critical"


class SafetyAction(Enum):
    """Rungs of the safety ladder, mildest first."""

    NOMINAL = "nominal"
    WARN = "warn"
    HOLD = "hold"  # come to rest on the planned way and stay
    RETRACT = "retract"  # the arm folds, back inward along the tether, then land
    LAND = "land"  # the companion lands, with position
    AUTOPILOT_LAND = "autopilot_land"  # the companion's own state is not to be trusted: PX4's LAND mode
    TERMINATE = "terminate"

    @property
    def rank(self) -> int:
        """Position on the ladder; a larger one is graver."""
        return _ACTION_RANK[self]


_ACTION_RANK = {action: rank for rank, action in enumerate(SafetyAction)}


class AutopilotRequest(Enum):
    """What the core asks of the autopilot beside setpoints. The driver carries it out and reports through `AutopilotStatus`."""

    NONE = "none"
    OFFBOARD = "offboard"  # enter OFFBOARD (setpoints are streaming already)
    ARM = "arm"
    LAND = "land"  # PX4's own LAND mode
    DISARM = "disarm"
    FORCE_DISARM = "force_disarm"  # against PX4's land detector; when it is allowed: companion.safety.rotor_stop


class Outcome(Enum):
    """How a flight ended; values of `outcome` in summary.json."""

    COMPLETED = "completed"
    REFUSED = "refused"
    ABORTED = "aborted"
    CRASHED = "crashed"
    LOST = "lost"


class PhaseKind(Enum):
    """What sort of flying a phase is; metrics and safety tell phases apart by it, people by its name."""

    GROUND = "ground"  # before the rotors lift
    TAKEOFF = "takeoff"
    FLIGHT = "flight"
    LANDING = "landing"
    DONE = "done"


class OperatorCommand(Enum):
    """What the people on the ground ask for."""

    NONE = "none"
    HOLD = "hold"
    RESUME = "resume"  # go on after a HOLD, if what held it is gone; nothing else is taken back by it
    START = "start"  # take off, for a flight that waits for it
    LAND = "land"
    ABORT = "abort"  # land at once, the arm folds; recorded as what it is


class GroundCommand(Record, frozen=True, kw_only=True):
    """A command that came over the air, verified by the recorder process; in `Inputs` only what was asked for goes on."""

    command: OperatorCommand
    operator: str
    """Name of the one whose key signed it."""
    nonce: str
    """The answer names it."""
    hold: int
    """Number of the hold that a RESUME is to end, `Sent.hold`; 0: none, and in every other command."""


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
    """What the accelerometer feels: +9.81 on z at rest, level."""
    boot_s: float | None = None
    """PX4's own clock, seconds since it started (time_boot_ms of ATTITUDE or ODOMETRY); None: not told."""
    imu_boot_s: float | None = None
    """End of the newest IMU sample's interval on PX4's clock (HIGHRES_IMU.time_usec), s; None: unknown, as in old logs."""
    delta_velocity_body_m_s: Vec3 | None = None
    """Integral of the specific force over all IMU samples since the link was opened, up to `imu_boot_s`; None: unknown."""


class AutopilotStatus(Record, frozen=True, kw_only=True):
    """Slow state of the autopilot."""

    heartbeat_stamp_s: float
    armed: bool
    mode: FlightMode
    landed: LandedState
    battery_voltage_v: float | None = None
    battery_remaining: float | None = None
    """0 to 1."""
    system_status: int | None = None
    """HEARTBEAT.system_status (MAV_STATE); None if unknown, as in logs written before it was recorded."""


class MocapPose(Record, frozen=True, kw_only=True):
    """One motion-capture frame of the vehicle's rigid body, already in the world frame of the mission."""

    stamp_s: float
    """When the datagram arrived."""
    latency_s: float | None = None
    """Mid-exposure to transmission, by the server's own clock (NatNet >= 3.0)."""
    frame_number: int
    position_world_m: Vec3
    attitude_wxyz: Quat
    tracking_valid: bool
    marker_error_m: float
    exposure_server_s: float | None = None
    """Mid-exposure on the server's own clock (NatNet >= 3.0), s; None: unknown, as in old logs."""


class ArmState(Record, frozen=True, kw_only=True):
    """Joint state in the paper's angles: alpha_1 from body +x turning down, alpha_2 turning link 2 the other way."""

    stamp_s: float
    """When the joint read was complete."""
    angle_rad: Vec2
    velocity_rad_s: Vec2
    torque_nm: Vec2
    """From the present current and the torque constant."""
    hardware_error: tuple[int, int]
    """Register 70 of each servo; 0 is healthy. Bit 7 is the companion's own: the bus watchdog had let go and was started again."""
    temperature_c: Vec2
    read_failures: int
    """Consecutive bus cycles without an answer from every servo, up to now."""
    written_s: float | None = None
    """When the bus thread had written the newest currents before this read; None before the first."""
    asked_s: float | None = None
    """When the bus thread began this read."""


class ForceSample(Record, frozen=True, kw_only=True):
    """One sample of the force-torque sensor in its own frame, as measured (tare and gravity not removed)."""

    stamp_s: float
    force_sensor_n: Vec3
    torque_sensor_nm: Vec3
    overload: bool


class Inputs(Record, frozen=True, kw_only=True):
    """Everything that `FlightCore.step` may look at."""

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
    """The guardian said within the last second that it could take over; None: none stands by (fast loop)."""


class Reference(Record, frozen=True, kw_only=True):
    """Where the machine should be at one instant."""

    position_world_m: Vec3
    velocity_world_m_s: Vec3
    acceleration_world_m_s2: Vec3
    yaw_rad: float
    yaw_rate_rad_s: float
    arm_rad: Vec2
    arm_rate_rad_s: Vec2
    arm_acceleration_rad_s2: Vec2
    jerk_world_m_s3: Vec3
    """For laws that feed the acceleration forward ahead of time."""


class AttitudeSetpoint(Record, frozen=True):
    """SET_ATTITUDE_TARGET in the companion's frames."""

    attitude_wxyz: Quat
    thrust: float
    """Collective, normalised 0 to 1."""


class Event(Record, frozen=True, kw_only=True):
    """Something that happened and that a person may have to understand afterwards."""

    t_s: float
    id: str
    severity: Severity
    action: SafetyAction
    text: str


class ControlLog(Record, frozen=True, kw_only=True):
    """What the law computed in one tick; rows are chi = [p; q; alpha]."""

    error: Vec8
    error_rate: Vec8
    sliding: Vec8
    gamma: Vec8
    tau: Vec8
    """After saturation: N for rows 0-2, N m for rows 6-7; rows 3-5 belong to PX4 and are 0."""
    e_tau: Vec8
    h_hat: Vec4
    zeta: float
    rho: float
    force_ext_world_n: Vec3
    """Tared, gravity of the net removed, low-passed."""
    attitude_desired_rad: Vec3
    """Roll, pitch, yaw (ZYX) of the filtered desired attitude."""
    hover_thrust: float
    saturated: tuple[bool, bool, bool]
    """Vertical force, lateral force, joint torque."""
    payload_estimate_kg: float | None = None
    """Mass that the law believes to carry beyond the machine's own; None: the law estimates none."""


class TetherState(Record, frozen=True, kw_only=True):
    """What is known of the safety tether in one tick."""

    range_m: float
    """Anchor to attachment."""
    slack_m: float
    """Length less range."""
    stop_slack_m: float
    """Slack where the machine could stop at the soonest: after v t_react + v^2 / (2 a) of its outward speed."""
    elevation_rad: float
    """Of the straight line seen from the vehicle, below horizontal positive."""
    clearance_m: float
    """Least distance of the hanging line to rotor disk and arm sweep; negative: touches. The arm counts only if the attachment
    lies outside of the arm's plane (`companion.safety.tether_shape.Clearance.judges_arm`)."""
    turns: float
    """Winding about the anchor's vertical, counter-clockwise from above positive, in turns; whole turns come and go."""
    pull_n: float
    """Force towards the anchor that rotors, gravity and tool do not explain, low-passed; 0 if unknown, never negative."""
    taut: bool
    """Slack used up, or a pull that grows with the range."""
    snagged: bool
    """A pull towards the anchor or to the side although there is slack."""
    separated: bool
    """Farther away than the line is long, and nothing pulls."""
    vehicle_turns: float
    """Always 0; `turns` is the larger of the two windings. Logs have the field."""


class Outputs(Record, frozen=True, kw_only=True):
    """Everything that one tick decides."""

    tick: int
    t_s: float
    mission_t_s: float
    """Seconds since take-off was commanded; 0 before."""
    phase: str
    phase_kind: PhaseKind
    progress: float
    """0 to 1 of the whole mission's duration."""
    reference: Reference | None = None
    attitude: AttitudeSetpoint | None = None
    """None: nothing is to be sent to the autopilot in this tick."""
    arm_torque_nm: Vec2 | None = None
    """None: nothing is to be sent to the arm in this tick (its bus watchdog will let go)."""
    request: AutopilotRequest
    action: SafetyAction
    events: tuple[Event, ...]
    control: ControlLog | None = None
    outcome: Outcome | None = None
    """Set when the flight is over."""
    mocap_trusted: bool
    """Motion capture is plausible; while False no pose is to be passed on to PX4."""
    tether: TetherState | None = None
    bent_by: tuple[str, ...]
    """What the governor bent the reference for."""
    mocap_innovation_m: float | None = None
    """Distance between the newest pose and the position predicted by the IMU; 0 while that is not judged, None in old logs."""


class Sent(Record, frozen=True, kw_only=True):
    """What really left in one tick, and when: the drivers' answer to `Outputs`."""

    tick: int
    attitude_sent: bool
    arm_torque_sent_nm: Vec2 | None = None
    """After rounding to current counts and clipping."""
    start_s: float
    """When the tick began, flight clock."""
    lateness_s: float
    """Behind the motion-capture frame that started the tick, or behind its deadline."""
    joint_read_s: float
    core_s: float
    setpoint_sent_s: float
    current_sent_s: float
    """Stamps on the flight clock of: joint state at hand, core step done, setpoint sent, currents handed to the bus thread."""
    hold: int | None = None
    """Number of the hold that stands after this tick, counted from 1 in each flight. A command to hold begins a new one, also where
    the vehicle holds already. None: it does not hold."""


class LinkIdentity(Record, frozen=True, kw_only=True):
    """What another process must know to go on speaking on the MAVLink link to PX4."""

    autopilot_system: int
    own_system: int
    own_component: int
    local_port: int
    """UDP port that MAVSDK speaks from; 0: not UDP, or not known."""
    peer: tuple[str, int] | None = None
    """PX4's IPv4 address and UDP port, the only ones that MAVSDK hears; None: not UDP."""
