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
from companion.model.markers import BallState, MarkerFrame
from companion.model.team import BarPose, CarryState, ClampCommand, ClampState, PartnerState, TeamState
from companion.model.verdict import Verdict

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
    """Arrival of the newest BATTERY_STATUS of the battery that has been silent for the longest time; None if none has arrived, and in
    older logs.
    """
    system_status: int | None = None
    """HEARTBEAT.system_status (MAV_STATE); None in older logs."""
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


class ContactMode(Enum):
    """What the flight does about a surface during its contact phases."""

    TARE = "tare"  # at rest before the approach: average the force that is there without contact
    APPROACH = "approach"  # move along the direction until the surface is touched
    PRESS = "press"  # touched: hold the force
    SLIDE = "slide"  # move the tip along the surface while the force is held
    LOST = "lost"  # the force has ended: wait at rest, then approach again
    BACK = "back"  # a point was touched: move back from the surface
    SHIFT = "shift"  # move in front of the next point, or turn to the surface
    LEAVE = "leave"  # release the force, then move back
    RETURN = "return"  # move back to the plan

    # An enum's own hash is a Python function.
    __hash__ = object.__hash__


class ContactShift(Record, frozen=True, kw_only=True):
    """Straight move of the reference from rest to rest across the direction of an approach, in which yaw and last joint turn as well.
    Everything is relative to the plan.
    """

    from_m: Vec3 = (0.0, 0.0, 0.0)
    to_m: Vec3 = (0.0, 0.0, 0.0)
    from_yaw_rad: float = 0.0
    to_yaw_rad: float = 0.0
    from_tool_rad: float = 0.0
    """Turn of the last joint."""
    to_tool_rad: float = 0.0
    length_m: float = 0.0
    """Length of the way; a turn counts as 1 m per rad if that is longer."""
    way_m: float = 0.0
    """Way that is done, its rate and its acceleration."""
    rate_m_s: float = 0.0
    acceleration_m_s2: float = 0.0


class TouchedPoint(Record, frozen=True):
    """A point of a surface that the tool has touched."""

    t_s: float
    tip_world_m: Vec3
    """Mean measured position of the tip's centre."""
    force_n: float
    """Mean measured force."""


class FoundSurface(Record, frozen=True):
    """Plane through the touched points."""

    point_world_m: Vec3
    """Centre of the touched points, on the surface."""
    normal_world: Vec3
    """Unit vector out of the surface, towards the vehicle."""


class ContactState(Record, frozen=True, kw_only=True):
    """Contact with a surface: the part of the reference that depends on the measured force."""

    mode: ContactMode
    since_s: float
    """Flight clock at the beginning of the mode."""
    direction_world: Vec3
    """Unit vector of the approach, into the surface."""
    offset_m: float
    """Offset of the reference from the plan along the direction, its rate and its acceleration."""
    rate_m_s: float
    acceleration_m_s2: float
    bias_n: float
    """Mean force against the direction before the approach."""
    force_n: float
    """Force of the surface against the direction: the sensor's, less `bias_n`, plus `unseen_n`."""
    beyond_s: float
    """Time for which the force has been beyond the threshold that ends the mode."""
    wanted_n: float
    """Force that is to be measured now; 0 without contact."""
    correction_n: float
    """Integral of the force error."""
    push_n: float
    """Force along the direction that the vehicle adds to what its control law needs."""
    tilting_n: float
    """Low-passed push, for which the reference has moved with the vehicle's tilt."""
    tip_per_n_m: Vec3
    """Shift of the reference per push that keeps the tip in place, m/N, world frame."""
    touches: int
    touched_offset_m: float
    """Offset at the last touch."""
    failed: bool
    """Whether the contact ended before its planned end."""
    disagreement_bias_n: float = 0.0
    """Mean before the approach of the force that the vehicle's motion shows minus the measured one, both against the direction."""
    disagreement_n: float = 0.0
    """The same difference now, less its mean and low-passed."""
    unopposed_n: float = 0.0
    """Push minus the force that the vehicle's motion shows, low-passed: what the vehicle pushes against nothing."""
    disagreed_s: float = 0.0
    """Time for which one of the two has been beyond `safety.contact_disagreement_n`."""
    shift: ContactShift = ContactShift()
    points: tuple[TouchedPoint, ...] = ()
    """Points touched so far by a `probe`, or by an approach that turns to the surface."""
    samples: int = 0
    """Number of samples of the point that is touched now, their mean position and their mean force."""
    mean_tip_m: Vec3 = (0.0, 0.0, 0.0)
    mean_force_n: float = 0.0
    surface: FoundSurface | None = None
    """Surface through the touched points; None before the last of them."""
    free_m: float = 0.0
    """Offset up to which the way is known to be free."""
    beside_m: Vec3 = (0.0, 0.0, 0.0)
    """Place of the tip minus that of its reference when a slide begins: its path begins where the tip is."""
    lag_m: float = 0.0
    """Distance of the tip behind its reference along a slide."""
    lag_integral_n: float = 0.0
    """Integral part of the force along a slide."""
    slide_world_n: Vec3 = (0.0, 0.0, 0.0)
    """Force along the surface that moves the tip against friction."""
    unseen_n: float = 0.0
    """Force against the direction that the sensor does not measure, averaged: the vehicle's motion shows it during a slide."""
    steer_rad: float = 0.0
    """Turn of the yaw setpoint that steers a sliding tip towards its path."""
    stuck_s: float = 0.0
    """Time for which the tip has been too far behind its reference."""


class ChaseState(Record, frozen=True, kw_only=True):
    """How the net is to meet a ball in flight."""

    predicted_s: float
    """Time from the first plan to its meeting."""
    replans: int
    """Number of plans after the first."""
    relative_speed_m_s: float
    """Speed of the ball relative to the net at the meeting, if the vehicle keeps its velocity."""


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


class ActiveRule(Record, frozen=True, kw_only=True):
    """A rule of `companion.safety.rules` that has raised its event, and held within the last second."""

    id: str
    action: SafetyAction
    text: str
    """The rule's message, with its newest values."""


class ControlLog(Record, frozen=True, kw_only=True):
    """Quantities that the control law computed in one tick. Vectors of type `Chi` are ordered as chi = [p; q; alpha]. `sliding` and
    `rho` are those that made tau; gamma, `h_hat`, `zeta` and the estimated loads are those of the next tick.
    """

    error: Chi
    error_rate: Chi
    sliding: Chi
    gamma: Chi
    tau: Chi
    """Generalised force after saturation: N in rows 0 to 2, N m in rows 6 and above. Rows 3 to 5 are 0, because PX4 controls the
    attitude.
    """
    e_tau: Chi
    h_hat: Vec4
    zeta: float
    rho: float
    force_ext_world_n: Vec3
    """External force on the net in the world frame: tared, without the net's weight, and low-pass filtered. With the momentum observer
    it is 0 while nothing was caught."""
    attitude_desired_rad: Vec3
    """Roll, pitch and yaw (ZYX) of the filtered desired attitude."""
    hover_thrust: float
    saturated: tuple[bool, bool, bool]
    """Whether vertical force, lateral force and joint torque were saturated."""
    payload_estimate_kg: float | None = None
    """Estimated mass of the payload; None if the law does not estimate it."""
    load_estimate_n: Vec3 | None = None
    """Rotor force that compensates for the adapted load, world frame. None if the law does not adapt loads."""
    moment_estimate_kg_m: Joints | None = None
    """Adapted first moments of links 1 and 2 about their joints, in addition to the nominal moments; None if the law does not adapt
    them."""
    friction_estimate_nm: Joints | None = None
    """Adapted friction of each joint; None if the law does not adapt it."""
    impedance_scale: float | None = None
    """Factor on Phi and Lambda of x, y and z by the optimisation in flight; None if it is off."""
    force_observed_world_n: Vec3 | None = None
    """Estimate of the momentum observer, also while the law does not use it; None if `force_source` is not `observer`."""
    force_measured_world_n: Vec3 | None = None
    """What the force sensor measures, tared and not filtered: with the momentum observer, and while the tool touches a surface, when
    `force_ext_world_n` has only the part along the press. Else None, as without a sensor.
    """


class TetherState(Record, frozen=True, kw_only=True):
    """State of the safety tether in one tick."""

    range_m: float
    """Distance from the anchor to the attachment point."""
    slack_m: float
    """Tether length minus `range_m`."""
    stop_slack_m: float
    """Slack at the position where the vehicle is predicted to stop after a fault (`companion.safety.stop`)."""
    elevation_rad: float
    """Elevation of the straight line from the vehicle to the anchor; positive if the anchor is below the vehicle."""
    clearance_m: float
    """Smallest distance of the sagging line from the rotor disks and the arm; negative if they touch. The arm counts only if the
    attachment point is outside the arm's plane (`companion.safety.tether_shape.Clearance.judges_arm`)."""
    turns: float
    """Winding of the tether about the vertical through the anchor, in turns; positive counter-clockwise as seen from above."""
    pull_n: float
    """Low-pass-filtered force toward the anchor that is not due to the rotors, gravity or the tool; 0 if unknown, never negative."""
    taut: bool
    """Whether the slack is used up."""
    snagged: bool
    """Whether there is tension, toward the anchor or sideways, although there is slack."""
    separated: bool
    """Whether the range exceeds the tether's length without tension."""
    vehicle_turns: float
    """Always 0, because `turns` is the larger of the windings about anchor and vehicle. The field is kept because logs contain it."""


class Outputs(Record, frozen=True, kw_only=True):
    """All outputs of `FlightCore.step` in one tick."""

    tick: int
    t_s: float
    mission_t_s: float
    """Time since take-off was commanded; 0 before that."""
    phase: str
    phase_kind: PhaseKind
    progress: float
    """Elapsed fraction of the mission's planned duration, 0 to 1."""
    reference: Reference | None = None
    attitude: AttitudeSetpoint | None = None
    """Setpoint for the autopilot; None if no setpoint may be sent in this tick."""
    arm_torque_nm: Joints | None = None
    """Joint torques for the arm; None if none may be sent in this tick. Without commands, the servos' bus watchdog trips."""
    request: AutopilotRequest
    action: SafetyAction
    events: tuple[Event, ...]
    verdict: Verdict | None = None
    """What becomes of `Inputs.command`; None without a command, and in older logs."""
    active: tuple[ActiveRule, ...] | None = None
    """The active rules, whose events were raised in this tick or before; None if there is none, and in older logs."""
    control: ControlLog | None = None
    outcome: Outcome | None = None
    """Outcome of the flight; None until it has ended."""
    mocap_trusted: bool
    """Whether motion capture is trusted. If not, no pose may be forwarded to PX4."""
    tether: TetherState | None = None
    limited_by: tuple[str, ...]
    """Reasons why the governor constrained the reference."""
    mocap_innovation_m: float | None = None
    """Distance between the newest pose and the position predicted from the IMU; 0 if it is not evaluated, None in older logs."""
    contact: ContactState | None = None
    """Contact with a surface; None outside contact phases."""
    ball: BallState | None = None
    """The ball that the phase follows; None without one, and in older logs."""
    chase: ChaseState | None = None
    """Figures of the plan to meet a thrown ball; None before the first plan, and in older logs."""
    clamp: ClampCommand | None = None
    """Command for the clamp; None before the first one, and without a clamp."""
    team: TeamState | None = None
    """What is announced to the other vehicle of a team; None without one."""
    carry: CarryState | None = None
    """How the bar is carried; None while it is not."""


class Sent(Record, frozen=True, kw_only=True):
    """What the drivers sent in one tick, and when."""

    tick: int
    attitude_sent: bool
    arm_torque_sent_nm: Joints | None = None
    """Torque sent, after rounding to current counts and clipping; None if no currents were sent."""
    start_s: float
    """Flight clock at the beginning of the tick."""
    lateness_s: float
    """Delay of the tick's start after the motion-capture frame that triggered it, or after its deadline."""
    joint_read_s: float
    """Flight clock after the joint state was read."""
    core_s: float
    """Flight clock after the core step."""
    setpoint_sent_s: float
    """Flight clock after the setpoint was sent."""
    current_sent_s: float
    """Flight clock after the currents were passed to the bus thread."""
    hold: int | None = None
    """Number of the hold that is active after this tick, counted from 1 in each flight; None if no hold is active. Each HOLD command
    starts a new hold, even during a hold."""


class LinkIdentity(Record, frozen=True, kw_only=True):
    """Addresses and ids that another process needs to take over the MAVLink link to PX4."""

    autopilot_system: int
    own_system: int
    own_component: int
    local_port: int
    """Own UDP port; 0 if it is unknown or the link is not UDP."""
    peer: tuple[str, int] | None = None
    """PX4's IPv4 address and UDP port, the only sender that is accepted; None if the link is not UDP."""
