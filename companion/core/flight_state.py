"""The state of one flight, what a transition reads and what it requests: frozen records."""

from __future__ import annotations

import math
from dataclasses import dataclass, field
from enum import Enum

from companion.mission.active_plan import Course
from companion.mission.autopilot_landing import AutopilotLanding
from companion.mission.plan import Plan
from companion.mission.settled import SettledEstimate
from companion.model import flight_stage as seq
from companion.model.codec import Record
from companion.model.flight_stage import Stage
from companion.model.types import AutopilotRequest, Event, Inputs, Outcome, PhaseKind, Reference, TetherState
from companion.safety.rotor_stop import RotorStop
from companion.safety.supervisor import SupervisorState
from companion.safety.touchdown import Touchdown


class Tare(Enum):
    """A step of weighing the net with the force sensor."""

    BEGIN = "begin"
    COLLECT = "collect"  # add this tick's sample
    FINISH = "finish"


@dataclass(frozen=True, slots=True)
class Waiting:
    """What is known while the vehicle waits on the ground for inputs, estimate, tare and, if the mission says so, its start."""

    tare_start_s: float | None = None
    was_ready: bool = False
    """It had everything once: what it lost since may come back for as long as the operator waits."""
    unready: str = "the inputs have not been checked yet"
    """Why it is not ready."""
    looked_s: float = 0.0
    """When estimate and place were judged last."""
    settled: SettledEstimate = field(default_factory=SettledEstimate)


@dataclass(frozen=True, slots=True)
class FlightState:
    """Everything that `companion.core.state_machine` remembers from tick to tick."""

    touchdown: Touchdown
    rotor_stop: RotorStop
    """Of the stages that disarm."""
    stage: Stage = Stage.WAIT
    entered_s: float | None = None
    """When the stage was entered; None before the first tick."""
    supervisor: SupervisorState = field(default_factory=SupervisorState)
    outcome: Outcome | None = None
    plan: Plan | None = None
    """Plan of the mission from the measured start."""
    course: Course | None = None
    """Flown course with its clock; None before arming."""
    aborting: bool = False
    """Whether the course is an abort's, not the mission's."""
    mission_start_s: float | None = None
    armed_by_others: bool = False
    """PX4 was armed without a request of the companion: no setpoint is sent."""
    arm_requested_s: float = -math.inf
    """Time of the last request to arm."""
    zero_thrust: bool = False
    """The landing by PX4 needs level setpoints with zero thrust."""
    waiting: Waiting = Waiting()
    landing: AutopilotLanding | None = None
    """The landing by PX4, from its begin on."""

    @property
    def pilot_flies(self) -> bool:
        """A pilot has the vehicle: nothing is sent."""
        return self.stage is Stage.AUTOPILOT_LAND and self.landing is not None and self.landing.pilot

    @property
    def over(self) -> Outcome | None:
        """The outcome, once nothing more is to be done."""
        return self.outcome if self.stage is Stage.DONE else None

    def phase(self, t_s: float) -> tuple[str, PhaseKind]:
        """Return the name of what is going on, for the operator, and its kind, for programs."""
        stage = self.stage
        if stage is Stage.PLAN and self.course is not None:
            segment = self.course.segment(t_s)
            return (f"abort: {segment.name}" if self.aborting else segment.name), segment.kind
        if stage in (Stage.TOUCHDOWN, Stage.AUTOPILOT_LAND):
            return (seq.PILOT_FLIES if self.pilot_flies else stage.value), PhaseKind.LANDING
        done = stage in (Stage.DISARM, Stage.DONE, Stage.STAND_DOWN)
        return stage.value, PhaseKind.DONE if done else PhaseKind.GROUND

    def progress(self, t_s: float) -> float:
        """Return the share of the plan's time, 0 to 1."""
        if self.mission_start_s is None or self.course is None:
            return 0.0
        return self.course.progress(t_s) if self.stage is Stage.PLAN else 1.0

    def vertical_scale(self, t_s: float) -> float:
        """Return the share of the vertical force that the law may command: rotors spool up and down on the ground."""
        assert self.entered_s is not None
        elapsed_s = t_s - self.entered_s
        if self.stage is Stage.SPOOL:
            return seq.SPOOL_SHARE * min(1.0, elapsed_s / seq.SPOOL_S)
        if self.stage is Stage.TOUCHDOWN:
            return max(0.0, min(seq.SPOOL_SHARE, self.touchdown.relief) * (1.0 - elapsed_s / seq.TOUCHDOWN_RAMP_S))
        if not self.aborting and elapsed_s < seq.SPOOL_TO_FULL_S:
            return seq.SPOOL_SHARE + (1.0 - seq.SPOOL_SHARE) * elapsed_s / seq.SPOOL_TO_FULL_S
        return self.touchdown.relief


class Observation(Record, frozen=True):
    """What a transition reads beside state and events."""

    inputs: Inputs
    """Only what is believed of this tick's inputs."""
    airborne: bool
    """The rotors may lift, or PX4 was found armed and flying."""
    armed_by_others: bool
    """PX4 is armed before the companion has requested it."""
    standing: str | None
    """What the vehicle must hold for, if the operator asks to resume; None: nothing."""
    reference: Reference | None
    """What the law followed in the last tick; None before its first."""
    tether: TetherState | None
    thrust_share: float
    """Of hover thrust, in the last command."""
    pose_s: float
    """Stamp of the newest believed pose before this tick; -inf before the first."""


class Request(Record, frozen=True):
    """What a transition asks the core to do."""

    autopilot: AutopilotRequest = AutopilotRequest.NONE
    events: tuple[Event, ...] = ()
    """Those that the transition got, and then its own."""
    tare: tuple[Tare, ...] = ()
    """Steps of the tare, in this order."""
    resumed: bool = False
    """The operator has ended a HOLD: rules that hold raise their events again."""
