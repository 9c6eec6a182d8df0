"""Frozen records: the state of one flight, and the inputs and requests of a transition."""

from __future__ import annotations

import math
from enum import Enum

from companion.mission.active_plan import ActiveTrajectory
from companion.mission.air import NOTHING, Expectation, HeldBar
from companion.mission.plan import Plan
from companion.mission.segments import Segment
from companion.mission.settled import SettledEstimate
from companion.model import flight_stage as seq
from companion.model.codec import Record
from companion.model.flight_stage import Stage
from companion.model.team import ClampCommand, Grip
from companion.model.types import (
    AutopilotRequest,
    Event,
    Outcome,
    PhaseKind,
)
from companion.safety.autopilot_landing import AutopilotLanding
from companion.safety.rotor_stop import RotorStop
from companion.safety.supervisor import SupervisorState
from companion.safety.touchdown import Touchdown


class Tare(Enum):
    """A step of the force sensor's tare."""

    BEGIN = "begin"
    COLLECT = "collect"  # add this tick's sample
    FINISH = "finish"


class Waiting(Record, frozen=True):
    """State while the vehicle waits on the ground for the inputs, the estimate, the tare and, if the mission requires it, a start
    command.
    """

    tare_start_s: float | None = None
    was_ready: bool = False
    """Whether everything has been ready at least once. If an input is lost after that, the vehicle waits without a timeout until it
    returns.
    """
    unready: str = "the inputs have not been checked yet"
    looked_s: float = 0.0
    """Time of the last check of the estimate and the position."""
    settled: SettledEstimate = SettledEstimate()


class FlightState(Record, frozen=True):
    """Everything that `companion.core.state_machine` keeps from tick to tick."""

    touchdown: Touchdown
    rotor_stop: RotorStop
    """Evidence for stopping the rotors, in the stages that disarm."""
    stage: Stage = Stage.WAIT
    entered_s: float | None = None
    """Flight clock when the stage was entered; None before the first tick."""
    supervisor: SupervisorState = SupervisorState()
    outcome: Outcome | None = None
    plan: Plan | None = None
    """Plan of the mission from the measured start."""
    course: ActiveTrajectory | None = None
    """The plan being flown with its start time and rate; None before arming."""
    aborting: bool = False
    """Whether `course` is an abort instead of the mission."""
    mission_start_s: float | None = None
    armed_by_others: bool = False
    """PX4 was armed without a request from the companion: no setpoint is sent."""
    arm_requested_s: float = -math.inf
    zero_thrust: bool = False
    """The landing by PX4 needs level setpoints with zero thrust."""
    waiting: Waiting = Waiting()
    landing: AutopilotLanding | None = None
    own: Record | None = None
    """State of the phase that is flown, if it acts and has begun."""
    engaged: Segment | None = None
    """Segment of the plan that this state belongs to."""
    skips: bool = False
    """Whether that state has ended early: phases that go on with it are skipped."""
    expected: Expectation = NOTHING
    """What that state expects of the flight."""
    clamp: ClampCommand | None = None
    """The newest command for the clamp; None before the first."""
    grip: Grip = Grip.FREE
    """What the vehicle has in its clamp; a landing keeps it until it lets go."""
    bar: HeldBar | None = None
    """The bar whose end the clamp holds; a landing keeps it until it lets go."""
    opens_s: float = math.inf
    """Flight clock at which a landing opens the clamp."""

    @property
    def pilot_flies(self) -> bool:
        """Return whether a pilot is flying the vehicle; nothing is sent then."""
        return self.stage is Stage.AUTOPILOT_LAND and self.landing is not None and self.landing.pilot

    @property
    def over(self) -> Outcome | None:
        """Return the outcome once the flight has ended; None before."""
        return self.outcome if self.stage is Stage.DONE else None

    def phase(self, t_s: float) -> tuple[str, PhaseKind, float]:
        """Return the phase's name for the operator, its kind for programs, and the completed fraction of the plan, 0 to 1."""
        stage, course = self.stage, self.course
        begun = self.mission_start_s is not None and course is not None
        if stage is Stage.MISSION and course is not None:
            plan_s = course.pace(t_s)[0]
            segment = course.plan.segment(plan_s)
            name = f"abort: {segment.name}" if self.aborting else segment.name
            return name, segment.kind, course.plan.progress(plan_s) if begun else 0.0
        progress = 1.0 if begun else 0.0
        if stage in (Stage.TOUCHDOWN, Stage.AUTOPILOT_LAND):
            return (seq.PILOT_FLIES if self.pilot_flies else stage.value), PhaseKind.LANDING, progress
        done = stage in (Stage.DISARM, Stage.DONE, Stage.STAND_DOWN)
        return stage.value, PhaseKind.DONE if done else PhaseKind.GROUND, progress

    def vertical_scale(self, t_s: float) -> float:
        """Return the fraction of the vertical force that the controller may command while the rotors spool up or down on the ground."""
        assert self.entered_s is not None
        elapsed_s = t_s - self.entered_s
        if self.stage is Stage.SPOOL:
            return seq.SPOOL_SHARE * min(1.0, elapsed_s / seq.SPOOL_S)
        if self.stage is Stage.TOUCHDOWN:
            return max(0.0, min(seq.SPOOL_SHARE, self.touchdown.relief) * (1.0 - elapsed_s / seq.TOUCHDOWN_RAMP_S))
        if elapsed_s < seq.SPOOL_TO_FULL_S:  # also in a landing that begins meanwhile
            return seq.SPOOL_SHARE + (1.0 - seq.SPOOL_SHARE) * elapsed_s / seq.SPOOL_TO_FULL_S
        return self.touchdown.relief


class Request(Record, frozen=True):
    """What a transition requests from the core."""

    autopilot: AutopilotRequest = AutopilotRequest.NONE
    events: tuple[Event, ...] = ()
    """Events that the transition received, followed by its own."""
    tare: tuple[Tare, ...] = ()
    """Steps of the tare, in order."""
    resumed: bool = False
    """The operator has ended a HOLD: active rules raise their events again."""
