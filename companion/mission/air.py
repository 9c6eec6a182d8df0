"""What a phase with a state of its own sees in a tick, and what it may ask for in the air. Pure."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

from companion.config.mission import Limits
from companion.config.vehicle import Vehicle
from companion.control.manipulator import Manipulator
from companion.mission.segments import Segment
from companion.model.best_pose import best_pose
from companion.model.codec import Record
from companion.model.contact import ContactState
from companion.model.frames import quat_rotate
from companion.model.markers import BallState
from companion.model.outputs import ChaseState, TetherState
from companion.model.team import CarryState, ClampCommand, Grip, Together
from companion.model.types import Inputs, MocapPose, Reference, Vec3
from companion.safety.governor import SafeSet
from companion.safety.notices import EventDefinition


class HeldBar(Record, frozen=True, kw_only=True):
    """What a landing must know of the bar whose end the clamp holds."""

    stands_m: float
    """Height of the clamp's centre above the floor at which the bar stands on its feet."""
    let_go_m: float
    """Height of the clamp's centre below which the bar may be let go before it stands."""


class Expectation(Record, frozen=True):
    """What a phase expects of the flight as long as its present state lasts; rules, control and tether read it."""

    into_world: Vec3 | None = None
    """Unit vector into the surface that the tool may touch; None if there is none."""
    touches: bool = False
    """Whether the tool touches the surface."""
    force_n: float = 0.0
    """Force of the surface against `into_world`."""
    contact_n: float | None = None
    """Force that the rule `contact_force_high` limits; None without contact."""
    friction_max_n: float | None = None
    """Largest force along the surface, if the tool slides; None if it does not."""
    back_m: Vec3 | None = None
    """Way from the reference to a place in front of the surface, world frame; None if there is no surface."""
    contact: ContactState | None = None
    """State of the contact for the log and for the displays."""
    ball: BallState | None = None
    """The ball that the phase follows, for the log and for the displays."""
    chase: ChaseState | None = None
    """The way to a thrown ball, for the log."""
    clamp: ClampCommand | None = None
    grip: Grip = Grip.FREE
    """What the vehicle has in its clamp, for the other vehicle of a team."""
    together: Together = Together()
    """When both vehicles of a team begin to move the bar, if this vehicle sets it."""
    bar: HeldBar | None = None
    """The bar whose end the clamp holds; None if it holds nothing."""
    carry: CarryState | None = None
    """How the bar is carried, for the log and the displays."""


NOTHING = Expectation()


class Observation(Record, frozen=True):
    """Inputs to a transition other than the state and the events."""

    inputs: Inputs
    airborne: bool
    """The rotors may be lifting the vehicle, or PX4 was found armed and flying."""
    armed_by_others: bool
    """PX4 is armed although the companion has not requested it."""
    standing: str | None
    """Message of the active rule that still requires a hold and therefore forbids resuming; None if there is none."""
    reference: Reference | None
    """Reference that the controller followed in the last tick; None before its first tick."""
    tether: TetherState | None
    thrust_share: float
    """Thrust of the last command divided by hover thrust."""
    pose_s: float
    """Stamp of the newest trusted pose before this tick; -inf before the first."""
    dt_s: float
    """Time since the previous tick."""
    force_world_n: Vec3 | None
    """Force on the tool in the last tick, world frame; if the law did not run, the measured one. None if it is not known: an unmeasured
    force is not a force of 0.
    """
    disturbance_world_n: Vec3 | None
    """Force on the vehicle that its motion shows, world frame; None on the ground, if the law did not run, and if it is the force on
    the tool as well.
    """
    position_error_m: Vec3
    """Position minus reference in the last tick, world frame; 0 if the law did not run."""
    yaw_error_rad: float
    """Yaw minus reference in the last tick; 0 if the law did not run."""
    late_pose: MocapPose | None = None
    """Newest pose, if it is trusted but too late for PX4."""
    phase_error: str | None = None
    """Why the phase gave no reference in the last tick; None if it did."""


class Air:
    """One tick of a phase with a state of its own; `companion.core.phase_tick` implements it.

    Args:
        phases: phases of the mission (`companion.mission.phase.Phase`).
        segment: segment at the plan's time.
        engaged: segment of the phase whose state it is; after a hold, the plan's time may have passed its end.
        safe: the governor's safe set.
        nominal: whether the supervisor has not reacted to anything so far.
        holds: whether it has reacted by a hold or more; a mere warning stops no plan.
        waits: whether it holds only until the other vehicle of a team may go on, too.
    """

    def __init__(
        self,
        o: Observation,
        vehicle: Vehicle,
        manipulator: Manipulator,
        phases: Sequence[Any],
        segment: Segment,
        engaged: Segment,
        limits: Limits,
        safe: SafeSet,
        nominal: bool,
        holds: bool = False,
        waits: bool = False,
    ) -> None:
        self.o = o
        self.i = o.inputs
        self.t_s = o.inputs.t_s
        self.dt_s = o.dt_s
        self.vehicle = vehicle
        self.manipulator = manipulator
        self.phases = phases
        self.segment = segment
        self.engaged = engaged
        self.limits = limits
        self.safe = safe
        self.nominal = nominal
        self.holds = holds
        self.waits = waits
        self.skips_rest = False
        """Whether the phases that follow and need the state of this one are skipped when it ends."""

    def tip_world_m(self) -> Vec3 | None:
        """Return the measured position of the tip's centre, world frame; None if it is unknown."""
        pose, arm = best_pose(self.i), self.i.arm
        if pose is None or not pose.tracking_valid or arm is None:
            return None
        x, y, z = quat_rotate(pose.attitude_wxyz, self.manipulator.net_body_m(arm.angle_rad))
        px, py, pz = pose.position_world_m
        return (px + x, py + y, pz + z)

    def plan_s(self) -> float:
        """Return the plan's time since the start of the phase whose state it is."""
        raise NotImplementedError

    def plan_reference(self) -> Reference:
        """Return the plan's reference, without what the phase adds."""
        raise NotImplementedError

    def report(self, notice: EventDefinition, text: str) -> None:
        """Add an event; one whose action is LAND ends the mission by a landing."""
        raise NotImplementedError

    def fail(self, notice: EventDefinition, text: str) -> None:
        """Report a failure: the flight counts as aborted, and the plan's time stops until the state ends."""
        raise NotImplementedError

    def resume(self, notice: EventDefinition, text: str) -> None:
        """End the hold and report it. The phase calls this only after the operator has resumed each vehicle that began a hold."""
        raise NotImplementedError

    def stay(self, segment: Segment) -> None:
        """Keep the plan's time before the end of a segment."""
        raise NotImplementedError

    def move_to(self, plan_s: float) -> None:
        """Move the plan's time to a start or an end of a segment, where the plan is at rest, or to any place of it during a hold."""
        raise NotImplementedError
