"""The flight core: a pure function of inputs and its own state. No I/O, no clock, no randomness: time is part of `Inputs`.

One `step` is one control tick: monitors -> state machine -> reference -> governor -> control law -> gate.
"""

from __future__ import annotations

import math
from typing import Final

import msgspec

from companion.config.loader import FlightConfig
from companion.config.vehicle import OBSERVER
from companion.control.types import MakeLaw, Tuning
from companion.control.vehicle_control import Command, VehicleControl
from companion.core.flight_state import Request, Tare
from companion.core.let_go import team_state_of
from companion.core.phase_tick import checked_reference, failed
from companion.core.readiness import missing_inputs
from companion.core.state_machine import transition
from companion.core.transition import Parameters, event_of
from companion.core.verdict import verdict_of
from companion.mission.air import Observation
from companion.mission.plan import Plan
from companion.model import flight_stage as seq
from companion.model.algebra import across
from companion.model.best_pose import pose_used_s
from companion.model.constants import TICK_PERIOD_S
from companion.model.flight_stage import Stage
from companion.model.outputs import ControlLog, Outputs
from companion.model.team import Grip
from companion.model.types import (
    Event,
    Inputs,
    MocapPose,
    OperatorCommand,
    PhaseKind,
    Reference,
    SafetyAction,
    Vec3,
    VehicleState,
)
from companion.safety import notices
from companion.safety.armed_externally import found_armed
from companion.safety.flight_context import FlightContext
from companion.safety.gate import ARM_FRESH_S, Gate, Refusal
from companion.safety.governor import Governor
from companion.safety.monitors import Monitors
from companion.safety.pose_filter import PoseFilter
from companion.safety.rules import OPERATOR_RESUME, PARTNER_HOLDS
from companion.safety.tether import TetherWatch

_DT_MIN_S: Final = 0.001
_DT_MAX_S: Final = 0.05
_POSE_AGE_MAX_S: Final = 0.1
"""Age of the last trusted pose beyond which the target impedance is not optimised."""
# Looking up members of an enum costs time in every tick.
_MISSION: Final = Stage.MISSION
_CHASE_M_S2: Final = 1.0
"""Acceleration of the reference of a chase from which the vehicle swings because of it."""
_REFUSED_AGAIN_S: Final = 1.0
"""Time without a rejection of the same kind after which it is reported again."""
_SPOOL: Final = Stage.SPOOL
_TOUCHDOWN: Final = Stage.TOUCHDOWN
_NO_COMMAND: Final = OperatorCommand.NONE
_NO_ERROR: Vec3 = (0.0, 0.0, 0.0)


class FlightCore:
    """Makes all decisions of one flight.

    Args:
        config: the effective configuration; `vehicle.airframe.hover_thrust` must already be set.
        make_law: makes the control law in place of the configured one, as in training.
    """

    def __init__(self, config: FlightConfig, make_law: MakeLaw | None = None) -> None:
        vehicle = config.vehicle
        self._vehicle = vehicle
        self._control = VehicleControl(config, make_law)
        # Solved once here, so that planning from the measured start costs next to nothing in a tick.
        Plan.build(config.mission, config.vehicle)
        self._monitors = Monitors(vehicle)
        self._watch = TetherWatch.of(vehicle)
        self._observes = vehicle.force_source == OBSERVER
        self._pull_min_n = vehicle.tether.pull_min_n if vehicle.tether is not None else math.inf
        self._governor = Governor(vehicle, config.mission.limits)
        self._gate = Gate(vehicle)
        self._parameters = Parameters.of(config)
        self._state = self._parameters.initial_state()
        self._context = FlightContext(False, False, None)
        self._context_stage: Stage | None = None
        """The stage for which the context was built."""
        self._tether_watched = False
        self._last_t_s: float | None = None
        self._pose_s = -math.inf
        """Time at which PX4 last used a trusted pose, s."""
        self._reference: Reference | None = None
        self._phase_error: str | None = None
        """The last reference that the controller followed, constrained by the governor."""
        self._limited_by: tuple[str, ...] = ()
        self._log: ControlLog | None = None
        self._refused_s: dict[str, float] = {}
        """Time at which the gate last rejected a command of each kind. A rejection is reported once, however often it comes and goes
        within `_REFUSED_AGAIN_S`."""

    def step(self, inputs: Inputs) -> Outputs:
        """Run one control tick."""
        t_s, dt_s = inputs.t_s, self._dt_s(inputs.t_s)
        observed, observation = self._observe(inputs, dt_s)
        i = observation.inputs
        before = self._state
        state, request = transition(self._parameters, before, observed, observation)
        self._state = state
        self._carry_out(request, i)
        self._control.watch_joints(i, dt_s, self._monitors.arm_swings)
        reference, command = self._command(dt_s, i)
        self._log = command.log
        phase, kind, progress = state.phase(t_s)
        events = list(request.events)
        if command.log is not None and kind is PhaseKind.FLIGHT and state.expected.into_world is None:
            self._watch_for_catch(t_s, command.log, events)
        online = self._control.online
        if online is not None and (report := online.take_report()):
            events.append(event_of(notices.IMPEDANCE_SCALED, t_s, report))
        arm, vehicle = i.arm, i.vehicle
        verdict = self._gate.check(
            command.attitude,
            command.arm_torque_nm,
            arm.angle_rad if arm else None,
            arm is not None and t_s - arm.stamp_s <= ARM_FRESH_S,
            t_s=t_s,
            state_age_s=t_s - vehicle.attitude_stamp_s if vehicle else 0.0,
            arm_rate_rad_s=arm.velocity_rad_s if arm else None,
        )
        self._context.torque_refused = None
        if verdict.refused:
            self._report_refused(t_s, verdict.refused, events)
        start_s = state.mission_start_s
        return Outputs(
            tick=inputs.tick,
            t_s=t_s,
            mission_t_s=t_s - start_s if start_s is not None else 0.0,
            phase=phase,
            phase_kind=kind,
            progress=progress,
            reference=reference,
            attitude=verdict.attitude,
            arm_torque_nm=verdict.arm_torque_nm,
            request=request.autopilot,
            action=state.supervisor.action,
            events=tuple(events),
            verdict=None if i.command is _NO_COMMAND else verdict_of(i.command, before, state, request.events, t_s),
            active=self._monitors.active(),
            control=command.log,
            outcome=state.over,
            mocap_trusted=self._monitors.mocap_trusted,
            tether=self._context.tether,
            limited_by=self._limited_by,
            mocap_innovation_m=self._monitors.mocap_innovation_m,
            contact=state.expected.contact,
            ball=state.expected.ball,
            chase=state.expected.chase,
            clamp=state.clamp,
            team=None
            if self._vehicle.devices.team is None
            else team_state_of(state, i, self._parameters.config.agreed),
            carry=state.expected.carry,
        )

    def forwards(self, pose: MocapPose, vehicle: VehicleState | None) -> bool:
        """Return whether a pose may be passed on to PX4 at its arrival, given PX4's newest state. Changes nothing: the next tick
        evaluates the pose again, so that a replay needs the inputs of the ticks only.
        """
        return self._monitors.forwards(pose, vehicle)

    def pose_filter(self) -> PoseFilter | None:
        """Return a filter for the poses of a landing without the core; None if no pose may be passed on to PX4."""
        return self._monitors.pose_filter()

    def _dt_s(self, t_s: float) -> float:
        """Return the time since the previous tick, s, limited to the range from `_DT_MIN_S` to `_DT_MAX_S`."""
        last_s, self._last_t_s = self._last_t_s, t_s
        if last_s is None:
            return TICK_PERIOD_S
        return max(_DT_MIN_S, min(_DT_MAX_S, t_s - last_s))

    # -- observation -----------------------------------------------------------------------------------------------

    def _observe(self, inputs: Inputs, dt_s: float) -> tuple[tuple[Event, ...], Observation]:
        """Run the monitors and the tether watch. Return this tick's events and the observation for the transition."""
        context, stage = self._context, self._state.stage
        if stage is not self._context_stage:
            self._context_stage = stage
            context.airborne = stage in seq.LIFTING
            context.offboard_expected = stage in seq.COMMANDING
            self._tether_watched = stage not in seq.BEFORE_LIFT
            context.found_armed = None
        context.tracking_error_m = self._control.tracking_error_m if stage is _MISSION else None
        context.control, context.disturbance_world_n = self._log, self._control.disturbance_world_n
        expected = self._state.expected
        context.chases = (expected.chase or expected.ball) is not None and _accelerates(self._reference)
        context.contact_n, context.grip = expected.contact_n, self._state.grip
        context.waiting = stage is Stage.WAIT and bool(missing_inputs(inputs, self._vehicle))
        armed_by_others = stage in seq.BEFORE_ARMING and seq.is_armed(inputs.status)
        if armed_by_others:
            context.airborne, context.found_armed = found_armed(inputs, self._parameters.clearance_m)
        # The monitors evaluate the tether of the previous tick: this tick's state is not validated yet.
        events = self._monitors.check(inputs, context)
        i = self._monitors.trusted
        assert i is not None
        self._watch_tether(i)
        carries = self._state.grip is Grip.CARRYING and self._state.supervisor.action is SafetyAction.HOLD
        resume = carries or (bool(events) and any(event.id == OPERATOR_RESUME for event in events))
        return events, Observation(
            inputs=i,
            airborne=context.airborne,
            armed_by_others=armed_by_others,
            standing=self._monitors.standing(PARTNER_HOLDS if carries else None) if resume else None,
            reference=self._reference,
            tether=context.tether,
            thrust_share=self._control.thrust_share,
            pose_s=self._pose_s,
            dt_s=dt_s,
            force_world_n=self._control.force_on_tool_n(i) if self._log is None else self._control.force_n,
            disturbance_world_n=None if self._observes or self._log is None else self._control.disturbance_world_n,
            position_error_m=_NO_ERROR
            if self._log is None
            else (self._log.error[0], self._log.error[1], self._log.error[2]),
            yaw_error_rad=0.0 if self._log is None else self._log.error[5],
            late_pose=self._monitors.late_pose,
            phase_error=self._phase_error,
        )

    def _watch_tether(self, i: Inputs) -> None:
        """Update the tether's state once the vehicle is armed. Earlier turns are unknown and assumed to be zero."""
        v, watch = i.vehicle, self._watch
        if v is None or watch is None or not self._tether_watched:
            return
        log, flying = self._log, self._state.stage is _MISSION
        # The observer's force contains the tether's pull: subtracted, it would hide the pull.
        expected = self._state.expected
        into = expected.into_world
        if log is None or not flying:
            tool_n = None
        elif into is not None and expected.touches and self._observes:
            nx, ny, nz = into
            tool_n = (-expected.force_n * nx, -expected.force_n * ny, -expected.force_n * nz)
        else:
            tool_n = log.force_measured_world_n if expected.touches or self._observes else log.force_ext_world_n
        if tool_n is not None and into is not None and expected.friction_max_n is not None:
            tool_n = within_friction(into, expected.friction_max_n, tool_n)
        # The bar's force, if it is not known, would seem to be the tether's.
        bar_unfelt = self._state.bar is not None and self._control.force_n is None
        self._context.tether = state = watch.update(
            i.t_s,
            v.position_world_m,
            v.velocity_world_m_s,
            v.attitude_wxyz,
            i.arm.angle_rad if i.arm is not None else None,
            self._control.disturbance_world_n if flying and not bar_unfelt else None,
            tool_n,
        )
        if self._observes:
            self._control.tether_pulls = state.pull_n >= self._pull_min_n

    def _carry_out(self, request: Request, i: Inputs) -> None:
        """Carry out what a transition requests from the core."""
        if (pose_s := pose_used_s(i)) is not None:
            self._pose_s = pose_s
        if request.resumed:
            self._monitors.forget()
        for step in request.tare:
            if step is Tare.BEGIN:
                self._control.begin_tare()
            elif step is Tare.COLLECT:
                self._control.collect_tare(i)
            else:
                self._control.finish_tare()

    def _report_refused(self, t_s: float, refused: tuple[Refusal, ...], events: list[Event]) -> None:
        for refusal in refused:
            if t_s - self._refused_s.get(refusal.kind, -math.inf) > _REFUSED_AGAIN_S:
                events.append(event_of(notices.GATE, t_s, refusal.text))
            self._refused_s[refusal.kind] = t_s
        self._context.torque_refused = next((refusal.text for refusal in refused if refusal.limp), None)

    # -- command ---------------------------------------------------------------------------------------------------

    def _command(self, dt_s: float, i: Inputs) -> tuple[Reference | None, Command]:
        self._limited_by = ()
        state, stage = self._state, self._state.stage
        course = state.course
        if course is None or not (stage is _MISSION or stage is _SPOOL or stage is _TOUCHDOWN):
            return None, self._without_reference(stage, dt_s, i)
        reference = course.plan.reference(0.0) if stage is _SPOOL else course.reference(i.t_s)
        expected, engaged = state.expected, state.engaged
        self._control.near_surface = expected.into_world is not None
        self._control.press_direction = expected.into_world if expected.touches else None
        if state.own is not None and engaged is not None:
            phase = self._parameters.phases[engaged.index]
            try:
                returned = phase.reference(reference, state.own)
                reference = checked_reference(returned, len(self._vehicle.arm.joints))
            except Exception as error:  # the next tick lands
                self._phase_error = str(failed(phase, error))
                reference = self._reference or reference
        if stage is _MISSION:
            governed = self._governor.constrain(dt_s, reference, self._context.tether)
            reference, self._limited_by = governed.reference, governed.limited_by
        self._reference = reference
        if self._control.online is not None:
            self._control.tuning = self._tuning(i.t_s)
        return reference, self._control.fly(i, dt_s, reference, state.vertical_scale(i.t_s))

    def _tuning(self, t_s: float) -> Tuning:
        """Return what an optimisation of the target impedance may do: it runs only while nothing else happens, and the mission's
        gains return for an undisturbed landing.
        """
        state, kind = self._state, self._state.phase(t_s)[1]
        if state.supervisor.action is not SafetyAction.NOMINAL:
            return Tuning.FREEZE
        if kind is PhaseKind.LANDING:
            return Tuning.UNDO
        disturbed = state.expected.into_world is not None or self._limited_by or not self._monitors.mocap_trusted
        stale = t_s - self._pose_s > _POSE_AGE_MAX_S
        return Tuning.FREEZE if disturbed or stale else Tuning.RUN

    def _without_reference(self, stage: Stage, dt_s: float, i: Inputs) -> Command:
        if stage in (Stage.WAIT, Stage.READY, Stage.DONE):
            return Command()
        if stage is Stage.STAND_DOWN and self._state.armed_by_others:
            return msgspec.structs.replace(self._control.wait(i), attitude=None)
        if stage is Stage.AUTOPILOT_LAND:
            # While PX4 lands, the tool keeps the rotors away from a surface.
            folding = self._control.hold_arm(i) if self._is_tool_a_bumper(i) else self._control.fold(i, dt_s)
            return (
                msgspec.structs.replace(folding, attitude=self._control.level(i))
                if self._state.zero_thrust
                else folding
            )
        return self._control.wait(i)

    def _is_tool_a_bumper(self, i: Inputs) -> bool:
        """Return whether the tool holds a bar, or may touch a surface and does not touch the floor before the landing gear."""
        if self._state.bar is not None:
            return True
        if self._state.expected.into_world is None or i.arm is None:
            return False
        z_m = self._parameters.manipulator.net_body_m(i.arm.angle_rad)[2]
        return z_m - self._vehicle.tip_radius_m > -self._vehicle.airframe.ground_clearance_m

    def _watch_for_catch(self, t_s: float, log: ControlLog, events: list[Event]) -> None:
        caught_s = self._control.catch_s(t_s, log, self._monitors.arm_swings)
        start_s = self._state.mission_start_s
        if caught_s is not None and start_s is not None:
            self._context.caught = True
            text = f"payload caught at t = {caught_s - start_s:.2f} s"
            events.append(event_of(notices.CATCH, caught_s, text))
        elif self._control.payload_left(t_s):
            self._context.caught = False
            events.append(event_of(notices.PAYLOAD_LEFT, t_s, "the payload has left the net"))


def _accelerates(reference: Reference | None) -> bool:
    return reference is not None and math.hypot(*reference.acceleration_world_m_s2) > _CHASE_M_S2


def within_friction(into_world: Vec3, most_n: float, force_world_n: Vec3) -> Vec3:
    """Return a measured force whose part along the surface is limited to the largest friction: what exceeds it is cross-talk."""
    x, y, z = across(force_world_n, into_world)
    size_n = math.hypot(x, y, z)
    if size_n <= most_n:
        return force_world_n
    k, (fx, fy, fz) = 1.0 - most_n / size_n, force_world_n
    return (fx - k * x, fy - k * y, fz - k * z)
