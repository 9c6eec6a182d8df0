"""The control loop of a flight: one tick after the other, from the devices through the core to the devices."""

from __future__ import annotations

import math
import socket

from companion.config.loader import FlightConfig
from companion.core.flight_core import FlightCore
from companion.core.verdict import sentence_of
from companion.flight.command_queue import Operator
from companion.flight.heartbeat import HeartbeatSender
from companion.flight.ticker import JOINT_LEAD_MAX_S, SIMULATED_START_S, SimulatedTicker, Ticker
from companion.io.devices import Devices
from companion.model.constants import TICK_PERIOD_S
from companion.model.launcher_messages import (
    CommandDone,
    FlightEvent,
    GroundText,
    Px4Text,
    Status,
)
from companion.model.outputs import Outputs, Sent
from companion.model.types import (
    AutopilotRequest,
    Event,
    GroundCommand,
    Inputs,
    Joints,
    OperatorCommand,
    Outcome,
    SafetyAction,
    Severity,
    VehicleState,
)
from companion.recorder.client import RecorderProcess
from companion.runtime import ipc, simulated_time
from companion.runtime.clock import Clock
from companion.runtime.event_loop import start_over
from companion.runtime.simulated_time import SimulatedTime
from companion.safety.rules import ARMED_EXTERNALLY

STATUS_EVERY = 20
JOINT_READ_TIMEOUT_S = 0.002
"""Timeout for the joint read, measured from the start of the tick; the read begins earlier."""
JOINT_MARGIN_S = 0.0001
"""Planned time between the arrival of the joint state and the start of the tick, so that the state is neither late nor stale."""


class Flight:
    """One flight with open devices."""

    def __init__(
        self,
        config: FlightConfig,
        devices: Devices,
        recorder: RecorderProcess,
        channel: socket.socket,
        operator: Operator,
        clock: Clock,
        guardian: HeartbeatSender | None,
    ) -> None:
        mocap = config.vehicle.devices.mocap
        self._external = mocap.external
        self._frame_rate_hz = 0.0 if mocap.external else mocap.rate_hz
        self._guardian = guardian
        self._devices = devices
        self._recorder = recorder
        self._channel = channel
        self._operator = operator
        self._clock = clock
        self._core = FlightCore(config)
        self._vehicle: VehicleState | None = None
        """PX4's state in the newest tick."""
        devices.forwarder.judge = lambda pose: self._core.forwards(pose, self._vehicle)
        self._missed = 0
        self._slow: SimulatedTicker | None = None
        """The ticker of simulated time; None in real time."""
        self._period_s = TICK_PERIOD_S
        self._phase = ""
        """The phase last reported to the launcher."""
        self._ground: str | None = None
        """State of the link to ground stations that was last reported to the launcher."""

    async def run(self) -> Outcome:
        """Run ticks until the flight ends; return its outcome."""
        simulated = simulated_time.current()
        if simulated is None:
            in_real_time = Ticker(self._period_s, self._clock, self._frame_rate_hz)
            self._devices.forwarder.on_frame = in_real_time.frame
            ticker: Ticker | SimulatedTicker = in_real_time
        else:
            ticker = self._slow = await self._in_simulated_time(simulated)
        self._devices.autopilot.start_sums()
        if self._devices.force is not None:
            self._devices.force.read_in_ticks()
        tick = 0
        if self._devices.ground is not None:
            self._tell_forwarding(self._clock(), self._devices.ground.line)
        if isinstance(ticker, Ticker):
            self._schedule_read(ticker.due_s)
        while True:
            now = await ticker.next()
            turn = self._operator.next(now.start_s)
            inputs, outputs, sent = await self._tick(tick, now.start_s, now.lateness_s, turn.command)
            if turn.asked is not None:
                self._answer(turn.asked, turn.refused, outputs)
            self._missed += now.lateness_s > self._period_s
            self._report(tick, outputs, sent)
            if self._devices.ground is not None:
                self._devices.ground.report_tick(inputs, outputs)
            if self._guardian is not None:
                link = self._devices.team
                self._guardian.tick(inputs, outputs, 0 if link is None else link.partner_session)
            if outputs.outcome is not None:
                return outputs.outcome
            if tick == 0 and self._devices.found_armed and not self._goes_on(outputs):
                return Outcome.ABORTED
            if isinstance(ticker, Ticker):  # at the end: it wakes the bus thread, which competes for the interpreter
                self._schedule_read(ticker.due_s)
            tick += 1

    async def _in_simulated_time(self, simulated: SimulatedTime) -> SimulatedTicker:
        """Let the world start over, and read the joints, which feeds the servos' watchdogs, until every device has sent new data."""
        if not self._devices.found_armed:
            await start_over(simulated)
        ticker = SimulatedTicker(self._period_s, self._clock)
        while self._clock() < SIMULATED_START_S:
            await ticker.next()
            if self._devices.arm is not None:
                await self._devices.arm.read(JOINT_READ_TIMEOUT_S)
        return ticker

    def judge_without_core(self) -> None:
        """Judge each pose on PX4's present state, because no tick evaluates it any more."""
        pose_filter, autopilot = self._core.pose_filter(), self._devices.autopilot
        self._devices.forwarder.judge = lambda pose: (
            pose_filter is not None and pose_filter.check(pose, autopilot.vehicle())
        )

    def _schedule_read(self, due_s: float) -> None:
        arm = self._devices.arm
        if arm is not None:
            arm.begin_read(due_s - min(JOINT_LEAD_MAX_S, arm.read_takes_s + JOINT_MARGIN_S))

    async def _tick(
        self, tick: int, start_s: float, lateness_s: float, command: OperatorCommand
    ) -> tuple[Inputs, Outputs, Sent]:
        devices = self._devices
        arm_state = await devices.arm.read(JOINT_READ_TIMEOUT_S) if devices.arm is not None else None
        joint_read_s = self._clock()
        inputs = Inputs(
            tick=tick,
            t_s=joint_read_s,
            vehicle=devices.autopilot.vehicle(),
            status=devices.autopilot.status(),
            mocap=devices.mocap.latest() if devices.mocap is not None else None,
            arm=arm_state,
            force=devices.force.latest() if devices.force is not None else None,
            command=command,
            recorder_dropped=self._recorder.client.dropped,
            guardian_ready=self._guardian.ready if self._guardian is not None else None,
            estimator=devices.autopilot.estimator() if self._external else None,
            markers=devices.mocap.markers() if devices.mocap is not None else None,
            clamp=devices.arm.clamp() if devices.arm is not None else None,
            bar=devices.mocap.bar() if devices.mocap is not None else None,
            partner=devices.team.newest() if devices.team is not None else None,
        )
        self._vehicle = inputs.vehicle
        outputs = self._core.step(inputs)
        if self._slow is not None:
            await self._slow.computed()
        core_s = self._clock()
        attitude_sent = devices.autopilot.send_attitude(outputs.attitude)
        setpoint_s = self._clock()
        torque_sent: Joints | None = None
        if outputs.arm_torque_nm is not None and devices.arm is not None:
            torque_sent = devices.arm.write_torque(outputs.arm_torque_nm)
        current_s = self._clock()
        if devices.arm is not None:
            devices.arm.command_clamp(outputs.clamp)
        if devices.team is not None and outputs.team is not None:
            devices.team.announce(outputs.team)
        if outputs.request is not AutopilotRequest.NONE:
            devices.autopilot.request(outputs.request)
        sent = Sent(
            tick=tick,
            attitude_sent=attitude_sent,
            arm_torque_sent_nm=torque_sent,
            start_s=start_s,
            lateness_s=lateness_s,
            joint_read_s=joint_read_s,
            core_s=core_s,
            setpoint_sent_s=setpoint_s,
            current_sent_s=current_s,
            hold=self._operator.judged(command, outputs),
        )
        self._recorder.client.record(inputs, outputs, sent)
        if commands := self._recorder.client.take_commands():
            for asked, why in self._operator.ask(commands):
                self._tell_asker(asked, False, why, outputs)
        return inputs, outputs, sent

    def _answer(self, asked: GroundCommand, refused: str | None, outputs: Outputs) -> None:
        if refused is not None:
            self._tell_asker(asked, False, refused, outputs)
        elif (verdict := outputs.verdict) is not None:
            self._tell_asker(asked, verdict.accepted, sentence_of(verdict, asked.command), outputs)

    def _tell_asker(self, asked: GroundCommand, accepted: bool, text: str, after: Outputs) -> None:
        self._recorder.client.ack(asked, accepted, text, after)
        done = CommandDone(
            mission_t_s=after.mission_t_s, operator=asked.operator, command=asked.command, accepted=accepted, text=text
        )
        ipc.send(self._channel, done)

    def _goes_on(self, outputs: Outputs) -> bool:
        """Report how a flight with a PX4 found armed goes on; return False if PX4 has disarmed since, which ends the flight."""
        goes_on = any(event.id == ARMED_EXTERNALLY for event in outputs.events)
        lines = [f"landing without this device: {line}" for line in self._devices.failures]
        if not goes_on:
            lines = [
                "PX4 was armed when the companion started and has disarmed since; the vehicle did not take off. To fly, start again"
            ]
        for text in lines:
            self._tell(
                0,
                outputs,
                Event(
                    t_s=outputs.t_s, id=ARMED_EXTERNALLY, severity=Severity.WARNING, action=SafetyAction.WARN, text=text
                ),
            )
            self._recorder.client.text(outputs.t_s, Severity.WARNING, ARMED_EXTERNALLY, text)
        return goes_on

    def _report(self, tick: int, outputs: Outputs, sent: Sent) -> None:
        for event in outputs.events:
            self._tell(tick, outputs, event)
        if tick % STATUS_EVERY and outputs.outcome is None and outputs.phase == self._phase:
            return
        self._phase = outputs.phase
        for text in self._devices.autopilot.take_messages():
            self._recorder.client.text(outputs.t_s, Severity.WARNING, "px4", text)
            ipc.send(self._channel, Px4Text(text))
        if self._devices.ground is not None:
            for text in self._devices.ground.take_messages():
                self._tell_forwarding(outputs.t_s, text)
        self._report_ground()
        ipc.send(self._channel, status_of(outputs, sent))

    def _tell_forwarding(self, t_s: float, text: str) -> None:
        self._recorder.client.text(t_s, Severity.INFO, "ground", text)
        ipc.send(self._channel, GroundText(text))

    def _report_ground(self) -> None:
        client = self._recorder.client
        gone = client.gone and client.telemetry_status is not None
        ground = (
            "the recorder process has ended: no telemetry, no commands; Ctrl-C lands"
            if gone
            else client.telemetry_status
        )
        if ground != self._ground:
            self._ground = ground
            ipc.send(self._channel, GroundText(ground))

    def _tell(self, tick: int, outputs: Outputs, event: Event) -> None:
        ipc.send(self._channel, FlightEvent.of(event, tick, outputs.mission_time_s(event)))


def status_of(outputs: Outputs, sent: Sent) -> Status:
    """Return what the launcher displays of one tick."""
    position_error_m = outputs.control.error[0:3] if outputs.control else None
    position_world_m = None
    if outputs.reference and position_error_m:
        (x, y, z), (e_x, e_y, e_z) = outputs.reference.position_world_m, position_error_m
        position_world_m = (x + e_x, y + e_y, z + e_z)
    return Status(
        mission_t_s=outputs.mission_t_s,
        phase=outputs.phase,
        kind=outputs.phase_kind,
        progress=outputs.progress,
        action=outputs.action,
        error_m=math.hypot(*position_error_m) if position_error_m else None,
        position_world_m=position_world_m,
        lateness_s=sent.lateness_s,
    )
