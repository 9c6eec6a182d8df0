"""The flight core: a pure function of inputs and its own state. No I/O, no clock, no randomness: time arrives inside `Inputs`.

One `step` is one control tick: monitors and ladder -> sequence -> reference -> governor -> controller -> saturation -> gate.
"""

from __future__ import annotations

import dataclasses

from companion.config.loader import FlightConfig
from companion.control.pilot import Command, Pilot
from companion.core.stages import FlightStages, missing_inputs
from companion.mission.plan import Plan, landing_from
from companion.mission.reattach import found_armed
from companion.mission.retract import inward_only, retract_from
from companion.model import flight_stage as seq
from companion.model.flight_stage import Stage
from companion.model.types import (
    ControlLog,
    Inputs,
    OperatorCommand,
    Outcome,
    Outputs,
    PhaseKind,
    Reference,
    SafetyAction,
    Severity,
    Vec3,
)
from companion.safety.events import OPERATOR_START
from companion.safety.gate import ARM_FRESH_S, Gate, Refusal
from companion.safety.governor import Governor
from companion.safety.monitors import Monitors
from companion.safety.situation import Situation
from companion.safety.supervisor import (
    HOLD_EXPIRED,
    RESUME,
    RETRACT_DONE,
    RETRACT_EXPIRED,
    LadderTimes,
    SupervisorState,
    update,
)
from companion.safety.tether import TetherWatch

NOMINAL_DT_S = 0.005
_DT_MIN_S, _DT_MAX_S = 0.001, 0.05
HOLD_ABOVE_M = 0.3
"""Over standing height: lower than this there is no room to stand still in the air."""
# Members of an enum are looked up by code of their own; the tick needs these.
_PLAN, _SPOOL, _TOUCHDOWN = Stage.PLAN, Stage.SPOOL, Stage.TOUCHDOWN
_HOLD, _RETRACT = SafetyAction.HOLD, SafetyAction.RETRACT
_ASKED_TO_HOLD = OperatorCommand.HOLD
_BY_PEOPLE = ("operator_land", "operator_abort", "called_off")
_EXPIRED = {HOLD_EXPIRED: "nobody ended the hold", RETRACT_EXPIRED: "the way back took too long"}


class FlightCore:
    """The whole decision making of one flight.

    Args:
        config: the effective configuration; `vehicle.airframe.hover_thrust` must be known by now.
    """

    def __init__(self, config: FlightConfig) -> None:
        vehicle = config.vehicle
        self._vehicle = vehicle
        self._pilot = Pilot(config)
        # Solved here once, so that the plan from the measured start costs a tick next to nothing.
        Plan.build(config.mission, config.vehicle)
        self._monitors = Monitors(vehicle)
        self._watch = TetherWatch(vehicle)
        self._governor = Governor(vehicle, config.mission.limits)
        self._gate = Gate(vehicle)
        self._times = LadderTimes.of(vehicle.safety)
        self._ladder = SupervisorState()
        self._stages = FlightStages(config, self._pilot)
        self._situation = Situation(False, False, None)
        self._judged: Stage | None = None
        """The stage that the situation was last told; looking it up in sets costs time."""
        self._tether_watched = False
        self._armed_by_others = False
        """Nothing is to be sent to the rotors, not even no thrust."""
        self._last_t_s: float | None = None
        self._reference: Reference | None = None
        """What the law followed last, bent where it had to be."""
        self._bent_by: tuple[str, ...] = ()
        self._log: ControlLog | None = None
        self._refused: tuple[Refusal, ...] = ()
        """What the gate held back in the last tick; told once when it begins."""

    def step(self, inputs: Inputs) -> Outputs:
        """One control tick."""
        dt_s = NOMINAL_DT_S
        if self._last_t_s is not None:
            dt_s = inputs.t_s - self._last_t_s
            if not _DT_MIN_S <= dt_s <= _DT_MAX_S:
                dt_s = max(_DT_MIN_S, min(_DT_MAX_S, dt_s))
        self._last_t_s = t_s = inputs.t_s
        stages = self._stages
        stages.begin_tick(inputs)
        i = self._judge(inputs)
        request = stages.advance(i)
        self._bent_by = ()
        reference, command = self._command(dt_s, i)
        self._log = command.log
        arm, vehicle = i.arm, i.vehicle
        verdict = self._gate.check(
            command.attitude,
            command.arm_torque_nm,
            arm.angle_rad if arm else None,
            arm is not None and t_s - arm.stamp_s <= ARM_FRESH_S,
            t_s=t_s,
            state_age_s=t_s - vehicle.attitude_stamp_s if vehicle else 0.0,
            arm_rate_rad_s=arm.velocity_rad_s if arm else (0.0, 0.0),
        )
        if verdict.refused or self._refused:
            self._tell_refused(i, verdict.refused)
        phase, kind = stages.phase(t_s)
        start_s = stages.mission_start_s
        # In the order of the fields: names cost time here.
        return Outputs(
            inputs.tick,
            t_s,
            t_s - start_s if start_s is not None else 0.0,
            phase,
            kind,
            stages.progress(t_s),
            reference,
            verdict.attitude,
            verdict.arm_torque_nm,
            request,
            self._ladder.action,
            tuple(stages.events),
            command.log,
            stages.over,
            self._monitors.mocap_trusted,
            self._situation.tether,
            self._bent_by,
            self._monitors.mocap_innovation_m,
        )

    # -- judgement -------------------------------------------------------------------------------------------------

    def _judge(self, inputs: Inputs) -> Inputs:
        """Monitors, ladder, and what the ladder's rung means for the sequence; returns what of the inputs may be believed."""
        stages, situation = self._stages, self._situation
        stage = stages.stage
        if stage is not self._judged:
            self._judged = stage
            situation.airborne = stage in seq.LIFTING
            situation.offboard_expected = stage in seq.COMMANDING
            self._tether_watched = stage not in seq.BEFORE_LIFT
            situation.found_armed = None
        situation.tracking_error_m = self._pilot.tracking_error_m if stage is _PLAN else None
        situation.control = self._log
        situation.waiting = stage is Stage.WAIT and bool(missing_inputs(inputs))
        if stage in seq.BEFORE_ARMING and seq.is_armed(inputs.status):
            self._armed_by_others = True
            situation.airborne, situation.found_armed = found_armed(inputs, self._vehicle.airframe.ground_clearance_m)
        # The tether is judged as it was a tick ago: what is believed of this tick's state is not known yet.
        events = self._monitors.check(inputs, situation)
        i = self._monitors.trusted
        assert i is not None
        self._watch_tether(i)
        if events:
            stages.events += events
            stages.start_asked = any(event.id == OPERATOR_START for event in events)
        if inputs.command is _ASKED_TO_HOLD and stage in seq.BEFORE_LIFT:
            self._hold_on_ground(i)
        before = self._ladder
        action = before.action
        if action is _RETRACT and stages.course is not None and stages.course.left_s(i.t_s) <= 0.0:
            stages.tell(i, RETRACT_DONE, Severity.INFO, SafetyAction.LAND, "back along the tether; landing")
        if stages.events or action is _HOLD or action is _RETRACT:
            self._climb(i, before)
        return i

    def _climb(self, i: Inputs, before: SupervisorState) -> None:
        """The ladder after what happened, and what is to be done if it went up or down."""
        stages, standing = self._stages, None
        if before.action is _HOLD and any(event.id == RESUME for event in stages.events):
            standing = self._monitors.standing()
        ladder = self._ladder = update(before, stages.events, i.t_s, self._times, standing)
        if ladder.action is before.action:
            if standing is not None:
                stages.tell(i, "resume_refused", Severity.WARNING, SafetyAction.NOMINAL, standing)
            return
        if ladder.cause in _EXPIRED:
            severity = Severity.CRITICAL
            stages.tell(i, ladder.cause, severity, SafetyAction.LAND, _EXPIRED[ladder.cause])
        if ladder.action.rank > before.action.rank:
            self._react(i)
        elif stages.course is not None:  # people let it go on
            stages.course.resume(i.t_s)
            self._monitors.forget()

    def _react(self, i: Inputs) -> None:
        """The ladder has gone up."""
        stages, action, stage = self._stages, self._ladder.action, self._stages.stage
        if action.rank < SafetyAction.HOLD.rank:
            return
        if stage in seq.BEFORE_ARMING and self._situation.airborne:
            stages.reattach(i)
        elif stage in seq.BEFORE_LIFT:
            if action.rank >= SafetyAction.LAND.rank:
                by_people = self._ladder.cause in _BY_PEOPLE
                stages.stand_down(i, Outcome.ABORTED if by_people else Outcome.REFUSED)
        elif stages.pilot_flies:
            return
        elif action is SafetyAction.TERMINATE:
            stages.finish(Outcome.CRASHED)
            stages.enter(Stage.AUTOPILOT_LAND, i, flipped=True)
        elif action is SafetyAction.AUTOPILOT_LAND:
            if stage in seq.LIFTING:
                stages.finish(Outcome.ABORTED)
                stages.enter(Stage.AUTOPILOT_LAND, i, pilot_flies=self._ladder.cause == "pilot_took_over")
        elif stage is Stage.SPOOL:
            stages.finish(Outcome.ABORTED)
            stages.enter(Stage.TOUCHDOWN, i)
        elif stage is Stage.PLAN:
            if action is SafetyAction.HOLD:
                self._hold(i)
            elif action is SafetyAction.RETRACT:
                self._retract(i)
            else:
                self._land(i)

    def _hold_on_ground(self, i: Inputs) -> None:
        """There it means not to lift. One that waits for its start does that already."""
        stages = self._stages
        waits = stages.waits_for_start and stages.stage in (Stage.WAIT, Stage.READY)
        if not waits and not self._armed_by_others:
            text = "a stop was asked for before take-off; it stays on the ground"
            stages.tell(i, "called_off", Severity.INFO, SafetyAction.LAND, text)

    def _hold(self, i: Inputs) -> None:
        """Come to rest and stay; a landing goes on, and near the floor it becomes one."""
        course = self._stages.course
        if course is None or course.segment(i.t_s).kind is PhaseKind.LANDING:
            return
        standing_m = self._vehicle.airframe.ground_clearance_m
        if course.reference(i.t_s).position_world_m[2] < standing_m + HOLD_ABOVE_M:
            self._land_instead(i, "too low to stay")
        else:
            course.hold(i.t_s)

    def _retract(self, i: Inputs) -> None:
        stages = self._stages
        now = self._reference
        if now is None or stages.course is None or stages.course.segment(i.t_s).kind is PhaseKind.LANDING:
            self._land_instead(i, "landing already")
            return
        arm_rad = i.arm.angle_rad if i.arm is not None else now.arm_rad
        fold_rad = self._pilot.fold_rad
        plan = retract_from(now.position_world_m, now.velocity_world_m_s, now.yaw_rad, arm_rad, fold_rad, self._vehicle)
        stages.leave_mission(plan, i)

    def _land_instead(self, i: Inputs, text: str) -> None:
        self._stages.tell(i, "no_room_to_stay", Severity.CRITICAL, SafetyAction.LAND, text)
        self._ladder = update(self._ladder, self._stages.events, i.t_s, self._times)
        self._land(i)

    def _land(self, i: Inputs) -> None:
        """From the last reference on: stop, fold, descend."""
        stages, now, safety = self._stages, self._reference, self._vehicle.safety
        if now is None:  # the law has never flown
            stages.finish(Outcome.ABORTED)
            stages.enter(Stage.AUTOPILOT_LAND, i)
            return
        plan = landing_from(
            now.position_world_m,
            self._allowed_velocity(now),
            now.yaw_rad,
            i.arm.angle_rad if i.arm is not None else now.arm_rad,
            self._pilot.fold_rad,
            safety.land_speed_m_s,
            self._vehicle,
        )
        stages.leave_mission(plan, i)

    def _allowed_velocity(self, now: Reference) -> Vec3:
        """What a stop may begin with: nothing outward or up while the tether pulls."""
        tether = self._situation.tether
        if tether is not None and (tether.taut or tether.snagged):
            anchor = self._vehicle.tether.anchor_world_m
            return inward_only(now.velocity_world_m_s, now.position_world_m, anchor)
        return now.velocity_world_m_s

    def _watch_tether(self, i: Inputs) -> None:
        """From arming on: what was wound before take-off is not known, and counts as nothing."""
        v = i.vehicle
        if v is None or not self._tether_watched:
            return
        log, flying = self._log, self._stages.stage is _PLAN
        self._situation.tether = self._watch.update(
            i.t_s,
            v.position_world_m,
            v.velocity_world_m_s,
            v.attitude_wxyz,
            i.arm.angle_rad if i.arm is not None else None,
            self._pilot.disturbance_world_n if flying else None,
            log.force_ext_world_n if flying and log is not None else None,
        )

    def _tell_refused(self, i: Inputs, refused: tuple[Refusal, ...]) -> None:
        before = {refusal.kind for refusal in self._refused}
        for refusal in refused:
            if refusal.kind not in before:
                self._stages.tell(i, "gate", Severity.WARNING, SafetyAction.WARN, refusal.text)
        self._refused = refused

    # -- command ---------------------------------------------------------------------------------------------------

    def _command(self, dt_s: float, i: Inputs) -> tuple[Reference | None, Command]:
        stages, stage = self._stages, self._stages.stage
        if stage in (Stage.WAIT, Stage.READY, Stage.DONE):
            return None, Command()
        if stage is Stage.STAND_DOWN and self._armed_by_others:
            return None, dataclasses.replace(self._pilot.wait(i), attitude=None)
        if stage is Stage.AUTOPILOT_LAND:
            folding = self._pilot.fold(i, dt_s)
            return None, dataclasses.replace(folding, attitude=self._pilot.level(i)) if stages.zero_thrust else folding
        course = stages.course
        if course is None or not (stage is _PLAN or stage is _SPOOL or stage is _TOUCHDOWN):
            return None, self._pilot.wait(i)
        reference = course.plan.reference(0.0) if stage is _SPOOL else course.reference(i.t_s)
        if stage is _PLAN:
            governed = self._governor.bend(dt_s, reference, self._situation.tether)
            reference, self._bent_by = governed.reference, governed.bent_by
        self._reference = reference
        command = self._pilot.fly(i, dt_s, reference, stages.vertical_scale(i))
        self._watch_for_catch(i, command.log)
        return reference, command

    def _watch_for_catch(self, i: Inputs, log: ControlLog | None) -> None:
        stages = self._stages
        if log is None or stages.stage is not _PLAN or stages.course is None:
            return
        if stages.course.segment(i.t_s).kind is not PhaseKind.FLIGHT:
            return
        caught_s = self._pilot.catch_s(i.t_s, log)
        if caught_s is not None and stages.mission_start_s is not None:
            self._situation.caught = True
            text = f"payload caught at t = {caught_s - stages.mission_start_s:.2f} s"
            stages.tell(i, "catch", Severity.INFO, SafetyAction.NOMINAL, text, caught_s)
        elif self._pilot.payload_left(i.t_s):
            self._situation.caught = False
            stages.tell(i, "payload_left", Severity.INFO, SafetyAction.NOMINAL, "the payload has left the net")
