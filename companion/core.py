"""The flight core: a pure function of inputs and its own state. No I/O, no clock, no randomness: time arrives inside `Inputs`.

One `step` is one control tick: monitors and ladder -> sequence -> reference -> controller -> saturation -> gate.
"""

from __future__ import annotations

import math

from companion.config.loader import FlightConfig
from companion.control.adaptive import AdaptiveController
from companion.control.arm_hold import hold_torque_nm
from companion.control.manipulator import Manipulator
from companion.control.sensing import CatchDetector, ForceSensing, acceleration_world_m_s2
from companion.control.types import Controller, PlantState, Wrench
from companion.frames import euler_zyx_from_quat, quat_from_euler_zyx
from companion.mission import sequencer as seq
from companion.mission.autopilot_landing import AutopilotLanding
from companion.mission.check import check_start
from companion.mission.plan import Plan, landing_from
from companion.mission.sequencer import Stage
from companion.safety.gate import Gate
from companion.safety.monitors import Monitors, Situation
from companion.safety.supervisor import SupervisorState, update
from companion.types import (
    AttitudeSetpoint,
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
    Vec2,
)

NOMINAL_DT_S = 0.005
FOLD_RATE_RAD_S = 1.2
_DT_MIN_S, _DT_MAX_S = 0.001, 0.05


class FlightCore:
    """The whole decision making of one flight.

    Args:
        config: the effective configuration; `vehicle.airframe.hover_thrust` must be known by now.
    """

    def __init__(self, config: FlightConfig) -> None:
        vehicle = config.vehicle
        hover_thrust = vehicle.airframe.hover_thrust
        if hover_thrust is None:
            raise ValueError("hover_thrust must be in the effective configuration before the core starts")
        self._config = config
        self._hover_thrust = hover_thrust
        self._weight_n = vehicle.airframe.mass_kg * 9.81
        self._manipulator = Manipulator(vehicle.arm, vehicle.tool)
        self._sensing = ForceSensing(vehicle.tool, self._manipulator)
        self._catch = CatchDetector()
        self._controller: Controller = AdaptiveController(config.controller, vehicle, hover_thrust)
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
        self._arm_target: Vec2 | None = None
        self._tracking_error_m: float | None = None
        self._landing: AutopilotLanding | None = None
        self._zero_thrust = False
        self._events: list[Event] = []
        self._refused: set[str] = set()
        """What the gate held back in the last tick; told once when it begins."""
        fold = vehicle.safety.fold_arm_deg
        self._fold_rad: Vec2 = (math.radians(fold[0]), math.radians(fold[1]))

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
        reference, setpoint, torque, log = self._command(dt_s, inputs)
        arm_fresh = inputs.arm is not None and inputs.t_s - inputs.arm.stamp_s <= 0.05
        verdict = self._gate.check(setpoint, torque, inputs.arm.angle_rad if inputs.arm else None, arm_fresh)
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
            control=log,
            outcome=self._outcome if self._stage is Stage.DONE else None,
        )

    # -- judgement -------------------------------------------------------------------------------------------------

    def _judge(self, i: Inputs) -> None:
        """Monitors, ladder, and what the ladder's rung means for the sequence."""
        if self._stage is Stage.WAIT and not _complete(i):
            return
        situation = Situation(
            airborne=self._stage in seq.LIFTING,
            offboard_expected=self._stage in seq.COMMANDING,
            tracking_error_m=self._tracking_error_m if self._stage is Stage.PLAN else None,
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
            self._fold_rad,
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
        if not _complete(i):
            self._tare_start_s = None
            if elapsed_s > seq.WAIT_TIMEOUT_S:
                self._refuse(i, "inputs_missing", f"no data from: {', '.join(_missing(i))}")
            return
        assert i.vehicle is not None and i.arm is not None and i.force is not None
        if self._tare_start_s is None:
            self._tare_start_s = i.t_s
        self._sensing.collect(i.force, i.vehicle.attitude_wxyz, i.arm.angle_rad)
        if i.t_s - self._tare_start_s < seq.TARE_S:
            return
        self._sensing.finish_tare()
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
        self._arm_target = i.arm.angle_rad
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

    def _command(
        self, dt_s: float, i: Inputs
    ) -> tuple[Reference | None, AttitudeSetpoint | None, Vec2 | None, ControlLog | None]:
        vehicle, arm = i.vehicle, i.arm
        if self._stage in (Stage.WAIT, Stage.DONE) or vehicle is None:
            return None, None, None, None
        if self._stage in (Stage.SPOOL, Stage.PLAN, Stage.TOUCHDOWN) and self._plan is not None:
            return self._fly_law(dt_s, i)
        torque = None
        if arm is not None:
            target = self._fold_target() if self._stage is Stage.AUTOPILOT_LAND else (self._arm_target or arm.angle_rad)
            torque = hold_torque_nm(
                self._manipulator, arm.angle_rad, arm.velocity_rad_s, target, (0.0, 0.0), vehicle.attitude_wxyz
            )
        if self._stage is Stage.AUTOPILOT_LAND and not self._zero_thrust:
            return None, None, torque, None
        yaw = euler_zyx_from_quat(vehicle.attitude_wxyz)[2]
        return None, AttitudeSetpoint(quat_from_euler_zyx(0.0, 0.0, yaw), 0.0), torque, None

    def _fold_target(self) -> Vec2:
        """The folded pose, approached at a bounded rate from where the arm is."""
        goal = self._fold_rad
        now = self._arm_target or goal
        step = FOLD_RATE_RAD_S * NOMINAL_DT_S
        self._arm_target = (
            now[0] + max(-step, min(step, goal[0] - now[0])),
            now[1] + max(-step, min(step, goal[1] - now[1])),
        )
        return self._arm_target

    def _fly_law(
        self, dt_s: float, i: Inputs
    ) -> tuple[Reference | None, AttitudeSetpoint | None, Vec2 | None, ControlLog | None]:
        assert self._plan is not None and i.vehicle is not None and self._stage_s is not None
        vehicle, arm = i.vehicle, i.arm
        reference = self._plan.reference(i.t_s - self._plan_start_s if self._stage is not Stage.SPOOL else 0.0)
        arm_rad = arm.angle_rad if arm is not None else reference.arm_rad
        arm_rate = arm.velocity_rad_s if arm is not None else reference.arm_rate_rad_s
        self._arm_target = arm_rad
        force = None
        if i.force is not None and i.t_s - i.force.stamp_s <= self._config.vehicle.safety.force_timeout_s:
            force = self._sensing.external_world_n(i.force, vehicle.attitude_wxyz, arm_rad)
        state = PlantState(
            position_world_m=vehicle.position_world_m,
            velocity_world_m_s=vehicle.velocity_world_m_s,
            acceleration_world_m_s2=acceleration_world_m_s2(vehicle),
            attitude_wxyz=vehicle.attitude_wxyz,
            angular_rate_body_rad_s=vehicle.angular_rate_body_rad_s,
            arm_rad=arm_rad,
            arm_rate_rad_s=arm_rate,
            force_ext_world_n=force,
        )
        wrench = self._controller.step(dt_s, state, reference, self._vertical_scale(i))
        self._note_flight(i, wrench)
        thrust = min(1.0, wrench.collective_n / self._weight_n * self._hover_thrust)
        torque = wrench.arm_torque_nm if arm is not None else None
        return reference, AttitudeSetpoint(wrench.attitude_wxyz, thrust), torque, wrench.log

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

    def _note_flight(self, i: Inputs, wrench: Wrench) -> None:
        """What flying by the law teaches: tracking error, catch."""
        e = wrench.log.error
        self._tracking_error_m = (e[0] * e[0] + e[1] * e[1] + e[2] * e[2]) ** 0.5
        if self._stage is Stage.PLAN and self._phase_kind(i.t_s) is PhaseKind.FLIGHT:
            if self._catch.update(i.t_s, wrench.log.force_ext_world_n) and self._mission_start_s is not None:
                at = (self._catch.caught_s or i.t_s) - self._mission_start_s
                text = f"payload caught at t = {at:.2f} s"
                self._event(i, "catch", Severity.INFO, SafetyAction.NOMINAL, text, self._catch.caught_s)

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


def _complete(i: Inputs) -> bool:
    return not _missing(i)
