"""One transition in progress: the flight's state, and the reports and requests collected so far."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Any

from msgspec.structs import replace

from companion.config.loader import FlightConfig
from companion.config.vehicle import Vehicle
from companion.control.arm_model import manipulator_of
from companion.control.manipulator import Manipulator
from companion.core.flight_state import FlightState, Tare
from companion.mission.active_plan import ActiveTrajectory
from companion.mission.air import NOTHING, Observation
from companion.mission.phase import Phase, phases_of
from companion.mission.plan import Plan
from companion.model import flight_stage as seq
from companion.model.flight_stage import Stage
from companion.model.negative_zero import without_negative_zero
from companion.model.types import Event, Joints, Outcome, SafetyAction, Severity
from companion.safety.autopilot_landing import AutopilotLanding
from companion.safety.governor import SafeSet
from companion.safety.notices import EventDefinition
from companion.safety.rotor_stop import RotorStop
from companion.safety.supervisor import EscalationTimeouts
from companion.safety.touchdown import Touchdown


@dataclass(frozen=True, slots=True)
class Parameters:
    """Constants of one flight: configuration, derived limits and options."""

    config: FlightConfig
    vehicle: Vehicle
    clearance_m: float
    """Height of the body's origin when the vehicle is on the ground."""
    tilt_max_rad: float
    """`safety.tilt_abort_deg`, in rad."""
    fold_rad: Joints
    times: EscalationTimeouts
    waits_for_start: bool
    """Whether the take-off waits for the operator's start command."""
    manipulator: Manipulator
    phases: tuple[Phase, ...]
    acts: bool
    """Whether one of the phases has a state of its own in the air."""
    safe: SafeSet

    @classmethod
    def of(cls, config: FlightConfig) -> Parameters:
        """Return the constants of an effective configuration."""
        vehicle, safety, phases = config.vehicle, config.vehicle.safety, phases_of(config.mission)
        return cls(
            config=config,
            vehicle=vehicle,
            clearance_m=vehicle.airframe.ground_clearance_m,
            tilt_max_rad=math.radians(safety.tilt_abort_deg),
            fold_rad=tuple(map(math.radians, vehicle.fold_arm_deg)),
            times=EscalationTimeouts.of(safety),
            waits_for_start=config.mission.start.takeoff == "by_operator",
            manipulator=manipulator_of(vehicle),
            phases=phases,
            acts=any(phase.acts for phase in phases),
            safe=SafeSet(vehicle),
        )

    def initial_state(self) -> FlightState:
        """Return the state before the first tick."""
        return FlightState(Touchdown.begin(self.clearance_m), RotorStop.begin(self.clearance_m, self.tilt_max_rad))


def event_of(notice: EventDefinition, t_s: float, text: str, severity: Severity | None = None) -> Event:
    """Return the event of a notice, by default with the severity of its row."""
    return Event(
        t_s=t_s,
        id=notice.id,
        severity=severity or notice.severity,
        action=notice.action,
        text=without_negative_zero(text),
    )


class Transition:
    """Collects what a transition changes, reports and requests; lives for one tick.

    Args:
        parameters: constants of the flight.
        state: state before the tick.
        events: events of the monitors in this tick.
        observation: other inputs of this tick.
    """

    __slots__ = ("events", "i", "o", "parameters", "pose_s", "resumed", "start_asked", "state", "tare")

    def __init__(
        self, parameters: Parameters, state: FlightState, events: tuple[Event, ...], observation: Observation
    ) -> None:
        self.parameters = parameters
        self.state = state
        self.events = list(events)
        self.o = observation
        self.i = observation.inputs
        self.pose_s = observation.pose_s
        """Time at which PX4 last used a pose, s."""
        self.start_asked = False
        """Whether the operator commanded take-off in this tick."""
        self.tare: list[Tare] = []
        self.resumed = False

    def change(self, **fields: Any) -> None:
        """Replace fields of the state."""
        self.state = replace(self.state, **fields)

    def change_waiting(self, **fields: Any) -> None:
        """Replace fields of `FlightState.waiting`."""
        self.state = replace(self.state, waiting=replace(self.state.waiting, **fields))

    def report(self, notice: EventDefinition, text: str, severity: Severity | None = None) -> None:
        """Add an event, by default with the severity of its row."""
        self.events.append(event_of(notice, self.i.t_s, text, severity))

    def report_rule(self, rule_id: str, action: SafetyAction, text: str) -> None:
        """Add the event of a rule that the sequence evaluates itself, with CRITICAL severity."""
        self.events.append(
            Event(
                t_s=self.i.t_s, id=rule_id, severity=Severity.CRITICAL, action=action, text=without_negative_zero(text)
            )
        )

    def enter(self, stage: Stage, *, pilot_flies: bool = False, flipped: bool = False) -> None:
        """Enter a stage. For a landing by PX4, `pilot_flies` means that it is only monitored, and `flipped` that the vehicle has
        flipped.
        """
        p, t_s = self.parameters, self.i.t_s
        if stage is Stage.AUTOPILOT_LAND:
            self.enter_landing(pilot_flies, self.pose_s, flipped)
        elif stage in seq.DISARMING:
            self.change(stage=stage, entered_s=t_s, rotor_stop=RotorStop.begin(p.clearance_m, p.tilt_max_rad))
        else:
            self.change(stage=stage, entered_s=t_s)

    def enter_landing(self, pilot_flies: bool, pose_s: float, flipped: bool = False) -> None:
        """Enter the landing by PX4; `pose_s` is the stamp of the newest pose that PX4 received, -inf if unknown."""
        p, t_s = self.parameters, self.i.t_s
        landing = AutopilotLanding.begin(
            t_s, p.clearance_m, p.tilt_max_rad, pilot_flies, pose_s=pose_s, flipped=flipped
        )
        self.change(stage=Stage.AUTOPILOT_LAND, entered_s=t_s, landing=landing)

    def finish(self, outcome: Outcome) -> None:
        """Set the outcome. A later outcome replaces it only if it is worse."""
        if self.state.outcome in (None, Outcome.COMPLETED) or outcome is Outcome.CRASHED:
            self.change(outcome=outcome)

    def stand_down(self, outcome: Outcome) -> None:
        """Disarm and end the flight, on the ground."""
        self.finish(outcome)
        self.enter(Stage.STAND_DOWN)

    def leave_mission(self, plan: Plan) -> None:
        """Replace the mission with this plan."""
        self.finish(Outcome.ABORTED)
        self.change(course=ActiveTrajectory(plan, self.i.t_s), aborting=True, own=None, expected=NOTHING)
