"""What the core decides in one tick and what the drivers send of it, in the conventions of `companion.model.types`."""

from __future__ import annotations

from companion.model.codec import Record
from companion.model.contact import ContactState
from companion.model.markers import BallState
from companion.model.team import CarryState, ClampCommand, TeamState
from companion.model.types import (
    AttitudeSetpoint,
    AutopilotRequest,
    Chi,
    Event,
    Joints,
    Outcome,
    PhaseKind,
    Reference,
    SafetyAction,
    Vec3,
    Vec4,
)
from companion.model.verdict import Verdict


class ChaseState(Record, frozen=True, kw_only=True):
    """How the net is to meet a ball in flight."""

    predicted_s: float
    """Time from the first plan to its meeting."""
    replans: int
    """Number of plans after the first."""
    relative_speed_m_s: float
    """Speed of the ball relative to the net at the meeting, if the vehicle keeps its velocity."""


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
    """Generalised force after saturation: N in rows 0 to 2, N m from row 6; rows 3 to 5 are 0, because PX4 controls attitude."""
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
    """Low-pass-filtered force toward the anchor that is not due to rotors, gravity or the tool, or the horizontal one while that counts
    as a snag; 0 if unknown, never negative.
    """
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

    def mission_time_s(self, event: Event) -> float:
        """Return the mission time of an event of this tick, which may be dated back to its cause; 0 before the take-off."""
        return max(0.0, self.mission_t_s + event.t_s - self.t_s) if self.mission_t_s else 0.0


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
