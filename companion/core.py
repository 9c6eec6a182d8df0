"""The flight core: a pure function of inputs and its own state. No I/O, no clock, no randomness: time arrives inside `Inputs`.

One `step` is one control tick: monitors and ladder -> sequence -> reference -> controller -> saturation -> gate.
"""

from __future__ import annotations

import dataclasses

from companion.config.loader import FlightConfig
from companion.control.pilot import Command, Pilot
from companion.frames import euler_zyx_from_quat
from companion.mission import sequencer as seq
from companion.mission.autopilot_landing import AutopilotLanding
from companion.mission.check import check_start
from companion.mission.plan import Plan, landing_from
from companion.mission.sequencer import Stage
from companion.safety.gate import Gate
from companion.safety.monitors import Monitors, Situation, unfused
from companion.safety.supervisor import SupervisorState, update
from companion.types import (
    AutopilotRequest,
    ControlLog,
    Event,
    Inputs,
    Outcome,
    Outputs,
    PhaseKind,
    Reference,
    SafetyAction,
    Severity,
)

NOMINAL_DT_S = 0.005
_DT_MIN_S, _DT_MAX_S = 0.001, 0.05


class FlightCore:
    """The whole decision making of one flight.

    Args:
        config: the effective configuration; `vehicle.airframe.hover_thrust` must be known by now.
    """

    def __init__(self, config: FlightConfig) -> None:
        vehicle = config.vehicle
        self._config = config
        self._pilot = Pilot(config)
        # Solved here once, so that the plan from the measured start costs a tick next to nothing.
        Plan.build(config.mission, config.vehicle)
        self._monitors = Monitors(vehicle.safety)
        self._gate = Gate(vehicle)
        self._ladder = SupervisorState()
        self._touchdown = seq.TouchdownDetector(vehicle.airframe.ground_clearance_m)
        self._stage = Stage.WAIT
        self._stage_s: float | None = None
        self._plan: Plan | None = None
        self._plan_start_s = 0.0
        self._mission_start_s: float | None = None
        self._tare_start_s: float | None = None
        self._aborting = False
        self._outcome: Outcome | None = None
        self._last_t_s: float | None = None
        self._landing: AutopilotLanding | None = None
        self._zero_thrust = False
        self._events: list[Event] = []
        self._refused: set[str] = set()
        """What the gate held back in the last tick; told once when it begins."""

    def step(self, inputs: Inputs) -> Outputs:
        """One control tick."""
        dt_s = NOMINAL_DT_S
        if self._last_t_s is not None:
            dt_s = max(_DT_MIN_S, min(_DT_MAX_S, inputs.t_s - self._last_t_s))
        self._last_t_s = inputs.t_s
        if self._stage_s is None:
            self._stage_s = inputs.t_s
        self._events = []
        self._judge(inputs)
        request = self._advance(inputs)
        reference, command = self._command(dt_s, inputs)
        arm_fresh = inputs.arm is not None and inputs.t_s - inputs.arm.stamp_s <= 0.05
        verdict = self._gate.check(
            command.attitude, command.arm_torque_nm, inputs.arm.angle_rad if inputs.arm else None, arm_fresh
        )
        for reason in sorted(set(verdict.refused) - self._refused):
            self._event(inputs, "gate", Severity.WARNING, SafetyAction.WARN, reason)
        self._refused = set(verdict.refused)
        return Outputs(
            tick=inputs.tick,
            t_s=inputs.t_s,
            mission_t_s=inputs.t_s - self._mission_start_s if self._mission_start_s is not None else 0.0,
            phase=self._phase_name(inputs.t_s),
            phase_kind=self._phase_kind(inputs.t_s),
            progress=self._progress(inputs.t_s),
            reference=reference,
            attitude=verdict.attitude,
            arm_torque_nm=verdict.arm_torque_nm,
            request=request,
            action=self._ladder.action,
            events=tuple(self._events),
            control=command.log,
            outcome=self._outcome if self._stage is Stage.DONE else None,
        )

    # -- judgement -------------------------------------------------------------------------------------------------

    def _judge(self, i: Inputs) -> None:
        """Monitors, ladder, and what the ladder's rung means for the sequence."""
        if self._stage is Stage.WAIT and _missing(i):
            return
        situation = Situation(
            airborne=self._stage in seq.LIFTING,
            offboard_expected=self._stage in seq.COMMANDING,
            tracking_error_m=self._pilot.tracking_error_m if self._stage is Stage.PLAN else None,
        )
        self._events += self._monitors.check(i, situation)
        before = self._ladder.action
        self._ladder = update(self._ladder, self._events)
        action = self._ladder.action
        if action.rank <= before.rank or action.rank < SafetyAction.LAND.rank:
            return
        if self._stage in seq.BEFORE_LIFT:
            self._stand_down(i, Outcome.ABORTED if self._ladder.cause == "operator_land" else Outcome.REFUSED)
        elif action is SafetyAction.TERMINATE:
            self._finish(Outcome.CRASHED)
            self._enter(Stage.STAND_DOWN, i)
        elif action is SafetyAction.AUTOPILOT_LAND and self._stage in seq.LIFTING:
            self._finish(Outcome.ABORTED)
            self._enter(Stage.AUTOPILOT_LAND, i)
        elif self._stage is Stage.SPOOL:
            self._finish(Outcome.ABORTED)
            self._enter(Stage.TOUCHDOWN, i)
        elif self._stage is Stage.PLAN:
            self._finish(Outcome.ABORTED)
            self._land_from_here(i)

    def _stand_down(self, i: Inputs, outcome: Outcome) -> None:
        self._finish(outcome)
        self._enter(Stage.STAND_DOWN, i)

    def _finish(self, outcome: Outcome) -> None:
        """Fix the outcome; a graver one replaces it, a better one never does."""
        if self._outcome in (None, Outcome.COMPLETED) or outcome is Outcome.CRASHED:
            self._outcome = outcome

    def _land_from_here(self, i: Inputs) -> None:
        vehicle, arm = i.vehicle, i.arm
        if vehicle is None or self._plan is None:
            self._enter(Stage.AUTOPILOT_LAND, i)
            return
        now = self._plan.reference(i.t_s - self._plan_start_s)
        safety = self._config.vehicle.safety
        self._plan = landing_from(
            now.position_world_m,
            now.velocity_world_m_s,
            now.yaw_rad,
            arm.angle_rad if arm is not None else now.arm_rad,
            self._pilot.fold_rad,
            safety.land_speed_m_s,
            self._config.vehicle,
        )
        self._plan_start_s = i.t_s
        self._aborting = True

    # -- sequence --------------------------------------------------------------------------------------------------

    def _enter(self, stage: Stage, i: Inputs) -> None:
        if stage is Stage.AUTOPILOT_LAND:
            pilot = self._ladder.cause == "pilot_took_over"
            self._landing = AutopilotLanding(i.t_s, self._config.vehicle.airframe.ground_clearance_m, pilot)
        self._stage = stage
        self._stage_s = i.t_s

    def _advance(self, i: Inputs) -> AutopilotRequest:
        """Move the sequence on; the request that the present stage makes."""
        assert self._stage_s is not None
        elapsed = i.t_s - self._stage_s
        match self._stage:
            case Stage.WAIT:
                self._wait(i, elapsed)
            case Stage.OFFBOARD:
                if seq.in_offboard(i.status):
                    self._enter(Stage.ARM, i)
                elif elapsed > seq.OFFBOARD_TIMEOUT_S:
                    self._refuse(i, "offboard_refused", "PX4 did not enter OFFBOARD")
                elif elapsed > seq.STREAM_BEFORE_OFFBOARD_S:
                    return AutopilotRequest.OFFBOARD
            case Stage.ARM:
                if seq.is_armed(i.status):
                    self._enter(Stage.SPOOL, i)
                elif elapsed > seq.ARM_TIMEOUT_S:
                    self._refuse(i, "arming_refused", "PX4 did not arm")
                else:
                    return AutopilotRequest.ARM
            case Stage.SPOOL:
                if elapsed >= seq.SPOOL_S:
                    self._plan_start_s = self._mission_start_s = i.t_s
                    self._enter(Stage.PLAN, i)
                    self._event(i, "takeoff", Severity.INFO, SafetyAction.NOMINAL, "take-off")
            case Stage.PLAN:
                self._fly(i)
            case Stage.TOUCHDOWN:
                if elapsed >= seq.TOUCHDOWN_RAMP_S:
                    self._enter(Stage.DISARM, i)
            case Stage.DISARM:
                return self._disarm(i, elapsed)
            case Stage.AUTOPILOT_LAND:
                return self._autopilot_land(i)
            case Stage.STAND_DOWN:
                if not seq.is_armed(i.status) or elapsed > seq.DISARM_TIMEOUT_S:
                    self._enter(Stage.DONE, i)
                else:
                    return AutopilotRequest.DISARM
            case Stage.DONE:
                pass
        return AutopilotRequest.NONE

    def _wait(self, i: Inputs, elapsed_s: float) -> None:
        """On the ground: until every input is there and PX4 demonstrably follows motion capture, for as long as the tare takes."""
        missing = _missing(i)
        problem = _nothing_from(missing) if missing else unfused(i)
        if problem is not None:
            self._tare_start_s = None
            if elapsed_s > seq.WAIT_TIMEOUT_S:
                self._refuse(i, "inputs_missing" if missing else "vision_not_fused", problem)
            return
        assert i.vehicle is not None and i.arm is not None
        if self._tare_start_s is None:
            self._tare_start_s = i.t_s
        self._pilot.collect_tare(i)
        if i.t_s - self._tare_start_s < seq.TARE_S:
            return
        self._pilot.finish_tare()
        yaw = euler_zyx_from_quat(i.vehicle.attitude_wxyz)[2]
        problems = check_start(
            self._config.mission, self._config.vehicle, i.vehicle.position_world_m, yaw, i.arm.angle_rad
        )
        for problem in problems:
            self._event(i, "start_refused", Severity.CRITICAL, SafetyAction.NOMINAL, problem)
        if problems:
            self._stand_down(i, Outcome.REFUSED)
            return
        self._plan = Plan.build(
            self._config.mission, self._config.vehicle, i.vehicle.position_world_m, yaw, i.arm.angle_rad
        )
        self._enter(Stage.OFFBOARD, i)

    def _refuse(self, i: Inputs, event_id: str, text: str) -> None:
        self._event(i, event_id, Severity.CRITICAL, SafetyAction.NOMINAL, text)
        self._stand_down(i, Outcome.REFUSED)

    def _fly(self, i: Inputs) -> None:
        assert self._plan is not None
        t_s = i.t_s - self._plan_start_s
        vehicle = i.vehicle
        if vehicle is not None and self._plan.segment(t_s).kind is PhaseKind.LANDING:
            reference_z = self._plan.reference(t_s).position_world_m[2]
            height, sink = vehicle.position_world_m[2], vehicle.velocity_world_m_s[2]
            if self._touchdown.update(i.t_s, height, sink, reference_z):
                self._event(i, "touchdown", Severity.INFO, SafetyAction.NOMINAL, "touch-down")
                self._finish(Outcome.COMPLETED)
                self._enter(Stage.TOUCHDOWN, i)
                return
        if t_s > self._plan.duration_s + 5.0:
            self._event(i, "no_touchdown", Severity.CRITICAL, SafetyAction.AUTOPILOT_LAND, "no touch-down was felt")
            self._finish(Outcome.ABORTED)
            self._enter(Stage.AUTOPILOT_LAND, i)

    def _disarm(self, i: Inputs, elapsed_s: float) -> AutopilotRequest:
        if not seq.is_armed(i.status):
            self._enter(Stage.DONE, i)
            return AutopilotRequest.NONE
        if elapsed_s > seq.DISARM_TIMEOUT_S:
            self._event(i, "disarm_refused", Severity.CRITICAL, SafetyAction.NOMINAL, "PX4 did not disarm")
            self._finish(Outcome.ABORTED)
            self._enter(Stage.AUTOPILOT_LAND, i)
        return AutopilotRequest.DISARM if seq.on_ground(i.status) else AutopilotRequest.NONE

    def _autopilot_land(self, i: Inputs) -> AutopilotRequest:
        assert self._landing is not None
        step = self._landing.step(i)
        self._zero_thrust = step.zero_thrust
        if step.text is not None:
            severity = Severity.INFO if step.text == "touch-down" else Severity.CRITICAL
            self._event(i, "autopilot_landing", severity, SafetyAction.AUTOPILOT_LAND, step.text)
        if step.ended:
            if not step.landed:
                self._outcome = Outcome.LOST
            self._enter(Stage.DONE, i)
        return step.request

    # -- command ---------------------------------------------------------------------------------------------------

    def _command(self, dt_s: float, i: Inputs) -> tuple[Reference | None, Command]:
        if self._stage in (Stage.WAIT, Stage.DONE):
            return None, Command()
        if self._stage is Stage.AUTOPILOT_LAND:
            folding = self._pilot.fold(i, dt_s)
            return None, dataclasses.replace(folding, attitude=self._pilot.level(i)) if self._zero_thrust else folding
        if self._plan is None or self._stage not in (Stage.SPOOL, Stage.PLAN, Stage.TOUCHDOWN):
            return None, self._pilot.wait(i)
        reference = self._plan.reference(i.t_s - self._plan_start_s if self._stage is not Stage.SPOOL else 0.0)
        command = self._pilot.fly(i, dt_s, reference, self._vertical_scale(i))
        self._watch_for_catch(i, command.log)
        return reference, command

    def _vertical_scale(self, i: Inputs) -> float:
        assert self._stage_s is not None
        elapsed = i.t_s - self._stage_s
        if self._stage is Stage.SPOOL:
            return seq.SPOOL_SHARE * min(1.0, elapsed / seq.SPOOL_S)
        if self._stage is Stage.TOUCHDOWN:
            return max(0.0, seq.SPOOL_SHARE * (1.0 - elapsed / seq.TOUCHDOWN_RAMP_S))
        if self._plan_start_s == self._mission_start_s and elapsed < seq.SPOOL_TO_FULL_S:
            return seq.SPOOL_SHARE + (1.0 - seq.SPOOL_SHARE) * elapsed / seq.SPOOL_TO_FULL_S
        return 1.0

    def _watch_for_catch(self, i: Inputs, log: ControlLog | None) -> None:
        if log is None or self._stage is not Stage.PLAN or self._phase_kind(i.t_s) is not PhaseKind.FLIGHT:
            return
        caught_s = self._pilot.catch_s(i.t_s, log)
        if caught_s is not None and self._mission_start_s is not None:
            text = f"payload caught at t = {caught_s - self._mission_start_s:.2f} s"
            self._event(i, "catch", Severity.INFO, SafetyAction.NOMINAL, text, caught_s)

    # -- words -----------------------------------------------------------------------------------------------------

    def _event(
        self, i: Inputs, event_id: str, severity: Severity, action: SafetyAction, text: str, t_s: float | None = None
    ) -> None:
        self._events.append(Event(i.t_s if t_s is None else t_s, event_id, severity, action, text))

    def _phase_name(self, t_s: float) -> str:
        if self._stage is Stage.PLAN and self._plan is not None:
            name = self._plan.segment(t_s - self._plan_start_s).name
            return f"abort: {name}" if self._aborting else name
        return self._stage.value

    def _phase_kind(self, t_s: float) -> PhaseKind:
        if self._stage is Stage.PLAN and self._plan is not None:
            return self._plan.segment(t_s - self._plan_start_s).kind
        if self._stage in (Stage.TOUCHDOWN, Stage.AUTOPILOT_LAND):
            return PhaseKind.LANDING
        return PhaseKind.DONE if self._stage in (Stage.DISARM, Stage.DONE, Stage.STAND_DOWN) else PhaseKind.GROUND

    def _progress(self, t_s: float) -> float:
        if self._mission_start_s is None or self._plan is None:
            return 0.0
        if self._stage is not Stage.PLAN:
            return 1.0
        return max(0.0, min(1.0, (t_s - self._plan_start_s) / self._plan.duration_s))


def _missing(i: Inputs) -> list[str]:
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
