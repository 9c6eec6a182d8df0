"""The stages of one flight as they follow one another: what each waits for, asks of PX4, and does when it takes too long.

`FlightCore` owns judgement and command; this owns where in the sequence the flight is. Pure; time is an argument.
"""

from __future__ import annotations

import math

from companion.config.loader import FlightConfig
from companion.control.pilot import Pilot
from companion.mission.autopilot_landing import FLIPPED, TIPPED, AutopilotLanding
from companion.mission.check import check_start
from companion.mission.course import Course
from companion.mission.plan import Plan
from companion.mission.settled import SettledEstimate
from companion.model import flight_stage as seq
from companion.model.flight_stage import Stage
from companion.model.frames import euler_zyx_from_quat
from companion.model.negative_zero import without_negative_zero
from companion.model.types import AutopilotRequest, Event, Inputs, Outcome, PhaseKind, SafetyAction, Severity
from companion.safety.events import CRASHED, PILOT_TOOK_OVER
from companion.safety.mocap import unfused
from companion.safety.rotor_stop import RotorStop
from companion.safety.touchdown import Touchdown

ARMED_SHOWN_S = 1.5
"""PX4's HEARTBEAT shows once a second whether it is armed: after a request to arm, an older "not armed" proves nothing."""
NO_TOUCHDOWN_S = 5.0
"""After the plan's end."""


class FlightStages:
    """Where the flight is, on which course, and what became of it.

    Args:
        config: the effective configuration.
        pilot: takes the tare.
    """

    def __init__(self, config: FlightConfig, pilot: Pilot) -> None:
        self._config = config
        self._pilot = pilot
        self._clearance_m = config.vehicle.airframe.ground_clearance_m
        self._tilt_max_rad = math.radians(config.vehicle.safety.tilt_abort_deg)
        self._touchdown = Touchdown(self._clearance_m)
        self._stop = RotorStop(self._clearance_m, self._tilt_max_rad)
        self._settled = SettledEstimate()
        self._pose_s = -math.inf
        """Of the newest motion-capture pose that was believed, and so passed on to PX4."""
        self._arm_requested_s = -math.inf
        """When ARM was last requested."""
        self._tare_start_s: float | None = None
        self.waits_for_start = config.mission.start.takeoff == "by_operator"
        self._was_ready = False
        """It had everything once: what it lost since may come back for as long as people wait."""
        self._unready = "nothing has been looked at yet"
        """What keeps it from being ready, in words; while it waits on the ground."""
        self._looked_s = 0.0
        self._landing: AutopilotLanding | None = None
        self._plan: Plan | None = None
        self._stage_s: float | None = None
        self.stage = Stage.WAIT
        self.course: Course | None = None
        """The plan and its clock, from the first moment at which one is flown."""
        self.aborting = False
        """What is flown is not the mission."""
        self.mission_start_s: float | None = None
        self.outcome: Outcome | None = None
        self.zero_thrust = False
        """The landing by PX4 wants level setpoints without thrust."""
        self.start_asked = False
        """People said `start` in this tick."""
        self.events: list[Event] = []
        """What happened in this tick, from whomever."""

    # -- for the core ----------------------------------------------------------------------------------------------

    def begin_tick(self, i: Inputs) -> None:
        """Nothing has happened yet in this tick."""
        self.events = []
        self.start_asked = False
        if self._stage_s is None:
            self._stage_s = i.t_s

    def tell(
        self, i: Inputs, event_id: str, severity: Severity, action: SafetyAction, text: str, t_s: float | None = None
    ) -> None:
        """Something happened; ids are listed in docs/safety.md."""
        told_s = i.t_s if t_s is None else t_s
        self.events.append(Event(told_s, event_id, severity, action, without_negative_zero(text)))

    def enter(self, stage: Stage, i: Inputs, *, pilot_flies: bool = False, flipped: bool = False) -> None:
        """Go to a stage. Of a landing by PX4: `pilot_flies` if it is only watched, `flipped` if that is known already."""
        if stage is Stage.AUTOPILOT_LAND:
            self._landing = AutopilotLanding(
                i.t_s, self._clearance_m, self._tilt_max_rad, pilot_flies, pose_s=self._pose_s, flipped=flipped
            )
        elif stage in seq.DISARMING:
            self._stop = RotorStop(self._clearance_m, self._tilt_max_rad)
        self.stage = stage
        self._stage_s = i.t_s

    def finish(self, outcome: Outcome) -> None:
        """Fix the outcome; a graver one replaces it, a better one never does."""
        if self.outcome in (None, Outcome.COMPLETED) or outcome is Outcome.CRASHED:
            self.outcome = outcome

    def reattach(self, i: Inputs) -> None:
        """PX4 flies already: it lands, or is only watched if people fly it; the mission is never begun."""
        self.finish(Outcome.ABORTED)
        self.stage, self._stage_s = Stage.AUTOPILOT_LAND, i.t_s
        pilot_flies = seq.people_fly(i.status)
        self._landing = AutopilotLanding(i.t_s, self._clearance_m, self._tilt_max_rad, pilot_flies, pose_s=-math.inf)

    def stand_down(self, i: Inputs, outcome: Outcome) -> None:
        """Disarm and end, on the ground."""
        self.finish(outcome)
        self.enter(Stage.STAND_DOWN, i)

    def leave_mission(self, plan: Plan, i: Inputs) -> None:
        """Fly this plan from now on; the mission is over."""
        self.finish(Outcome.ABORTED)
        self.course = Course(plan, i.t_s)
        self.aborting = True

    @property
    def pilot_flies(self) -> bool:
        """Nothing is to be sent against the one who does."""
        return self.stage is Stage.AUTOPILOT_LAND and self._landing is not None and self._landing.pilot

    @property
    def over(self) -> Outcome | None:
        """The outcome, once nothing more is to be done."""
        return self.outcome if self.stage is Stage.DONE else None

    # -- words and shares ------------------------------------------------------------------------------------------

    def phase(self, t_s: float) -> tuple[str, PhaseKind]:
        """Name for people and kind for programs of what is going on."""
        stage = self.stage
        if stage is Stage.PLAN and self.course is not None:
            segment = self.course.segment(t_s)
            return (f"abort: {segment.name}" if self.aborting else segment.name), segment.kind
        if stage in (Stage.TOUCHDOWN, Stage.AUTOPILOT_LAND):
            return (seq.PILOT_FLIES if self.pilot_flies else stage.value), PhaseKind.LANDING
        done = stage in (Stage.DISARM, Stage.DONE, Stage.STAND_DOWN)
        return stage.value, PhaseKind.DONE if done else PhaseKind.GROUND

    def progress(self, t_s: float) -> float:
        """Share of the plan's time, 0 to 1."""
        if self.mission_start_s is None or self.course is None:
            return 0.0
        return self.course.progress(t_s) if self.stage is Stage.PLAN else 1.0

    def vertical_scale(self, i: Inputs) -> float:
        """Share of the vertical force while rotors spool up or down on the ground."""
        assert self._stage_s is not None
        elapsed = i.t_s - self._stage_s
        if self.stage is Stage.SPOOL:
            return seq.SPOOL_SHARE * min(1.0, elapsed / seq.SPOOL_S)
        if self.stage is Stage.TOUCHDOWN:
            return max(0.0, min(seq.SPOOL_SHARE, self._touchdown.relief) * (1.0 - elapsed / seq.TOUCHDOWN_RAMP_S))
        if not self.aborting and elapsed < seq.SPOOL_TO_FULL_S:
            return seq.SPOOL_SHARE + (1.0 - seq.SPOOL_SHARE) * elapsed / seq.SPOOL_TO_FULL_S
        return self._touchdown.relief

    # -- sequence --------------------------------------------------------------------------------------------------

    def advance(self, i: Inputs) -> AutopilotRequest:
        """Move the sequence on; the request that the present stage makes."""
        assert self._stage_s is not None
        elapsed = i.t_s - self._stage_s
        if i.mocap is not None and i.mocap.tracking_valid:
            self._pose_s = i.mocap.stamp_s
        match self.stage:
            case Stage.PLAN:
                self._fly(i)
            case Stage.WAIT:
                self._wait(i, elapsed)
                if self.start_asked:
                    self._decline_start(i)
            case Stage.READY:
                self._ready(i)
            case Stage.OFFBOARD:
                # After a landing PX4 is in OFFBOARD already, but it arms only on a stream of setpoints.
                if seq.in_offboard(i.status) and elapsed > seq.STREAM_BEFORE_OFFBOARD_S:
                    self.enter(Stage.ARM, i)
                elif elapsed > seq.OFFBOARD_TIMEOUT_S:
                    self._refuse(i, "offboard_refused", "PX4 did not enter OFFBOARD")
                elif elapsed > seq.STREAM_BEFORE_OFFBOARD_S:
                    return AutopilotRequest.OFFBOARD
            case Stage.ARM:
                if seq.is_armed(i.status):
                    assert self._plan is not None
                    self.course = Course(self._plan, i.t_s + seq.SPOOL_S)
                    self.enter(Stage.SPOOL, i)
                elif elapsed > seq.ARM_TIMEOUT_S:
                    self._refuse(i, "arming_refused", "PX4 did not arm")
                else:
                    self._arm_requested_s = i.t_s
                    return AutopilotRequest.ARM
            case Stage.SPOOL:
                if elapsed >= seq.SPOOL_S:
                    assert self._plan is not None
                    self.mission_start_s = i.t_s
                    self.course = Course(self._plan, i.t_s)
                    self.enter(Stage.PLAN, i)
                    self.tell(i, "takeoff", Severity.INFO, SafetyAction.NOMINAL, "take-off")
            case Stage.TOUCHDOWN:
                if elapsed >= seq.TOUCHDOWN_RAMP_S:
                    self.enter(Stage.DISARM, i)
            case Stage.DISARM:
                return self._disarm(i, elapsed)
            case Stage.AUTOPILOT_LAND:
                return self._autopilot_land(i)
            case Stage.STAND_DOWN:
                return self._stand_down(i, elapsed)
            case Stage.DONE:
                pass
        return AutopilotRequest.NONE

    def _wait(self, i: Inputs, elapsed_s: float) -> None:
        """On the ground: until every input is there and PX4 demonstrably follows motion capture, for as long as the tare takes."""
        overdue = elapsed_s > seq.WAIT_TIMEOUT_S and not self._was_ready
        missing = missing_inputs(i)
        problem = _nothing_from(missing) if missing else unfused(i)
        if problem is not None:
            self._unready = problem
            self._tare_start_s = None
            self._settled.forget()
            if overdue:
                self._refuse(i, "inputs_missing" if missing else "vision_not_fused", problem)
            return
        if self._tare_start_s is None:
            self._begin_tare(i)
        self._weigh(i)
        assert self._tare_start_s is not None
        if i.t_s - self._tare_start_s < seq.TARE_S:
            self._unready = "the force sensor is still being weighed"
            return
        wanders = self._settled.problem(i.t_s)
        if wanders is not None:
            self._unready = wanders
            if overdue:
                self._refuse(i, "estimate_unsteady", wanders)
            return
        self._pilot.finish_tare()
        problems = self._misplaced(i)
        if not problems:
            self._is_ready(i)
        elif self._was_ready:  # somebody moved it; they may put it back
            self._unready = problems[0]
        else:
            for problem in problems:
                self.tell(i, "start_refused", Severity.CRITICAL, SafetyAction.NOMINAL, problem)
            self.stand_down(i, Outcome.REFUSED)

    def _is_ready(self, i: Inputs) -> None:
        if not self.waits_for_start:
            self._take_off(i)
            return
        self._was_ready = True
        self._unready = "it has become ready just now; say it again"
        self._looked_s = i.t_s
        self._begin_tare(i)
        self.enter(Stage.READY, i)

    def _ready(self, i: Inputs) -> None:
        """Everything is there; until people say `start`, or something is lost again."""
        missing = missing_inputs(i)
        problem = _nothing_from(missing) if missing else unfused(i)
        if problem is None:
            assert self._tare_start_s is not None
            self._weigh(i)
            if i.t_s - self._tare_start_s >= seq.TARE_S:
                self._pilot.finish_tare()
                self._begin_tare(i)
            if self.start_asked or i.t_s - self._looked_s >= seq.LOOK_AGAIN_S:
                self._looked_s = i.t_s
                problem = self._settled.problem(i.t_s) or next(iter(self._misplaced(i)), None)
        else:
            self._settled.forget()
        if problem is not None:
            self._unready = problem
            self._tare_start_s = None
            self.tell(i, "not_ready", Severity.WARNING, SafetyAction.NOMINAL, f"not ready any more: {problem}")
            self.enter(Stage.WAIT, i)
            if self.start_asked:
                self._decline_start(i)
        elif self.start_asked:
            self._take_off(i)

    def _begin_tare(self, i: Inputs) -> None:
        self._pilot.begin_tare()
        self._tare_start_s = i.t_s

    def _weigh(self, i: Inputs) -> None:
        assert i.vehicle is not None and i.mocap is not None
        self._pilot.collect_tare(i)
        self._settled.take(i.t_s, i.vehicle, i.mocap)

    def _misplaced(self, i: Inputs) -> list[str]:
        """How it does not stand as the mission says."""
        assert i.vehicle is not None and i.arm is not None
        yaw = euler_zyx_from_quat(i.vehicle.attitude_wxyz)[2]
        position = i.vehicle.position_world_m
        return check_start(self._config.mission, self._config.vehicle, position, yaw, i.arm.angle_rad)

    def _take_off(self, i: Inputs) -> None:
        """From where it stands now."""
        assert i.vehicle is not None and i.arm is not None
        yaw = euler_zyx_from_quat(i.vehicle.attitude_wxyz)[2]
        position = i.vehicle.position_world_m
        self._plan = Plan.build(self._config.mission, self._config.vehicle, position, yaw, i.arm.angle_rad)
        self.enter(Stage.OFFBOARD, i)

    def _decline_start(self, i: Inputs) -> None:
        text = self._unready if self.waits_for_start else "this flight takes off by itself as soon as it can"
        self.tell(i, "start_declined", Severity.WARNING, SafetyAction.NOMINAL, text)

    def _refuse(self, i: Inputs, event_id: str, text: str) -> None:
        self.tell(i, event_id, Severity.CRITICAL, SafetyAction.NOMINAL, text)
        self.stand_down(i, Outcome.REFUSED)

    def _fly(self, i: Inputs) -> None:
        assert self.course is not None
        vehicle = i.vehicle
        if vehicle is not None and self.course.segment(i.t_s).kind is PhaseKind.LANDING:
            reference_z = self.course.reference(i.t_s).position_world_m[2]
            share, landed = self._pilot.thrust_share, seq.on_ground(i.status)
            if self._touchdown.update(i.t_s, vehicle, i.mocap, reference_z, share, landed):
                self.tell(i, "touchdown", Severity.INFO, SafetyAction.NOMINAL, "touchdown")
                self.finish(Outcome.COMPLETED)
                self.enter(Stage.TOUCHDOWN, i)
                return
        if self.course.left_s(i.t_s) < -NO_TOUCHDOWN_S:
            self.tell(i, "no_touchdown", Severity.CRITICAL, SafetyAction.AUTOPILOT_LAND, "no touchdown was felt")
            self.finish(Outcome.ABORTED)
            self.enter(Stage.AUTOPILOT_LAND, i)

    def _stand_down(self, i: Inputs, elapsed_s: float) -> AutopilotRequest:
        if not seq.is_armed(i.status) and i.t_s - self._arm_requested_s > ARMED_SHOWN_S:
            self.enter(Stage.DONE, i)
        elif not self._left_to_pilot(i) and elapsed_s > seq.DISARM_TIMEOUT_S:
            text = "PX4 did not disarm: its rotors may turn; disarm it by its switch or from a ground station"
            self.tell(i, "disarm_refused", Severity.CRITICAL, SafetyAction.NOMINAL, text)
            self.enter(Stage.DONE, i)
        elif self.stage is Stage.STAND_DOWN:
            self._stop.update(i)
            return AutopilotRequest.DISARM if self._stop.may_disarm else AutopilotRequest.NONE
        return AutopilotRequest.NONE

    def _disarm(self, i: Inputs, elapsed_s: float) -> AutopilotRequest:
        if not seq.is_armed(i.status):
            self.enter(Stage.DONE, i)
            return AutopilotRequest.NONE
        if self._left_to_pilot(i):
            return AutopilotRequest.NONE
        self._stop.update(i)
        if self._stop.overturned:
            self._crash(i, FLIPPED if self._stop.flipped else TIPPED)
            return AutopilotRequest.FORCE_DISARM
        if elapsed_s > seq.DISARM_TIMEOUT_S or not seq.in_offboard(i.status):
            text = "PX4 did not disarm" if seq.in_offboard(i.status) else "PX4 left OFFBOARD before it was disarmed"
            self.tell(i, "disarm_refused", Severity.CRITICAL, SafetyAction.NOMINAL, text)
            self.finish(Outcome.ABORTED)
            self.enter(Stage.AUTOPILOT_LAND, i)
            return AutopilotRequest.NONE
        if seq.on_ground(i.status):
            return AutopilotRequest.DISARM if self._stop.may_disarm else AutopilotRequest.NONE
        return AutopilotRequest.FORCE_DISARM if self._stop.may_force else AutopilotRequest.NONE

    def _left_to_pilot(self, i: Inputs) -> bool:
        """A pilot took over while PX4 was to be disarmed: from now on nothing is sent, and the pilot's own disarm is waited for."""
        if not seq.people_fly(i.status):
            return False
        text = "a pilot took over before PX4 was disarmed; nothing is sent any more"
        if not any(event.id == PILOT_TOOK_OVER for event in self.events):
            self.tell(i, PILOT_TOOK_OVER, Severity.CRITICAL, SafetyAction.AUTOPILOT_LAND, text)
        self.finish(Outcome.ABORTED)
        self.enter(Stage.AUTOPILOT_LAND, i, pilot_flies=True)
        return True

    def _crash(self, i: Inputs, text: str) -> None:
        """Reported once: the ladder may have done so, by the rule of the same id."""
        if self.outcome is not Outcome.CRASHED:
            self.tell(i, CRASHED, Severity.CRITICAL, SafetyAction.TERMINATE, text)
            self.finish(Outcome.CRASHED)

    def _autopilot_land(self, i: Inputs) -> AutopilotRequest:
        assert self._landing is not None
        step = self._landing.step(i)
        self.zero_thrust = step.zero_thrust
        if self._landing.overturned and self.outcome is not Outcome.CRASHED:
            self._crash(i, step.text or TIPPED)
        elif step.text is not None:
            severity = Severity.INFO if step.text == "touchdown" else Severity.CRITICAL
            self.tell(i, "autopilot_landing", severity, SafetyAction.AUTOPILOT_LAND, step.text)
        if step.ended:
            if not step.landed and self.outcome is not Outcome.CRASHED:
                self.outcome = Outcome.LOST
            self.enter(Stage.DONE, i)
        return step.request


def missing_inputs(i: Inputs) -> list[str]:
    """Devices that have delivered nothing."""
    devices = {
        "PX4 state": i.vehicle,
        "PX4": i.status,
        "motion capture": i.mocap,
        "arm": i.arm,
        "force sensor": i.force,
    }
    return [name for name, value in devices.items() if value is None]


def _nothing_from(missing: list[str]) -> str:
    hint = (
        "; PX4 sends no local position: check EKF2_EV_CTRL = 11 and EKF2_HGT_REF = 3" if "PX4 state" in missing else ""
    )
    return f"no data from: {', '.join(missing)}{hint}"
