"""The flight process of `companion fly`: opens the edges, ticks the core, closes down in order.

Started by the launcher as `python -m companion.app --config FILE --out DIR --channel FD --guardian FD`. Ends with the outcome's exit
code.
"""

from __future__ import annotations

import argparse
import asyncio
import contextlib
import math
import os
import signal
import socket
import sys
import time
import traceback
from collections.abc import Coroutine, Iterator
from pathlib import Path
from typing import Any, TypeVar

from companion import status
from companion.clock import Clock, flight_clock
from companion.config.loader import FlightConfig
from companion.core import NOMINAL_DT_S, FlightCore
from companion.devices import Edges, open_edges
from companion.exit_codes import EXIT_CODES, EXIT_INTERNAL, EXIT_REFUSED
from companion.flight_guard import FlightGuard
from companion.guardian.client import GuardianClient
from companion.hand_over import hand_over, unflown
from companion.io.autopilot import MavsdkAutopilot
from companion.io.edges import DeviceError
from companion.io.recorder import RecorderProcess, epoch_offset_ns
from companion.mission.plan import Plan
from companion.preflight import run as preflight
from companion.preflight.observations import Observations
from companion.preflight.rows import refusals
from companion.realtime import FLIGHT_PRIORITY, claim_realtime
from companion.safety.rules import REATTACHED
from companion.ticker import Ticker
from companion.types import (
    AutopilotRequest,
    Event,
    Inputs,
    OperatorCommand,
    Outcome,
    Outputs,
    SafetyAction,
    Sent,
    Severity,
    Vec2,
)

STATUS_EVERY = 20
JOINT_READ_TIMEOUT_S = 0.003
_HOVER_PARAM = "MPC_THR_HOVER"

_T = TypeVar("_T")


class GivenUp(Exception):
    """A landing was asked for before the flight began."""


class Refused(Exception):
    """The preflight refuses; `lines` say why, one each."""

    def __init__(self, lines: list[str]) -> None:
        super().__init__("; ".join(lines))
        self.lines = lines


class Operator:
    """What the people on the ground want: the launcher's messages and the signals sent to this process."""

    def __init__(self, channel: socket.socket) -> None:
        self._channel = channel
        self._land = asyncio.Event()

    @property
    def command(self) -> OperatorCommand:
        """A landing that was asked for stays asked for."""
        return OperatorCommand.LAND if self._land.is_set() else OperatorCommand.NONE

    @contextlib.contextmanager
    def attention(self) -> Iterator[None]:
        """While inside, the channel and the signals are listened to."""
        loop = asyncio.get_running_loop()
        for number in (signal.SIGTERM, signal.SIGHUP):
            loop.add_signal_handler(number, self._land.set)
        loop.add_reader(self._channel, self._listen)
        try:
            yield
        finally:
            loop.remove_reader(self._channel)

    async def unless_land(self, opening: Coroutine[Any, Any, _T]) -> _T:
        """The result of `opening`, which is cancelled when a landing is asked for.

        Raises:
            GivenUp: a landing was asked for first.
        """
        task = asyncio.ensure_future(opening)
        land = asyncio.ensure_future(self._land.wait())
        try:
            await asyncio.wait((task, land), return_when=asyncio.FIRST_COMPLETED)
        finally:
            land.cancel()
            task.cancel()  # does nothing to one that is done
            await asyncio.wait((task, land))  # an edge that is opening takes itself back, within a deadline of its own
        if task.cancelled():
            raise GivenUp
        return task.result()

    def _listen(self) -> None:
        with contextlib.suppress(BlockingIOError):
            while True:
                message = status.receive(self._channel)
                if message is None:  # nobody watches any more
                    asyncio.get_running_loop().remove_reader(self._channel)
                    self._land.set()
                    return
                if message.get("type") == "land":
                    self._land.set()


class Flight:
    """One flight over open edges."""

    def __init__(
        self,
        config: FlightConfig,
        edges: Edges,
        recorder: RecorderProcess,
        channel: socket.socket,
        operator: Operator,
        clock: Clock,
        guardian: FlightGuard | None,
    ) -> None:
        self._guardian = guardian
        self._edges = edges
        self._recorder = recorder
        self._channel = channel
        self._operator = operator
        self._clock = clock
        self._core = FlightCore(config)
        self._missed = 0
        self._period_s = NOMINAL_DT_S

    async def run(self) -> Outcome:
        """Tick until the core says that it is over."""
        ticker = Ticker(self._period_s, self._clock)
        tick = 0
        while True:
            now = await ticker.next()
            inputs, outputs, sent = await self._tick(tick, now.start_s, now.lateness_s)
            self._missed += now.lateness_s > self._period_s
            self._report(tick, outputs, sent)
            if self._guardian is not None:
                self._guardian.tick(inputs, outputs)
            if outputs.outcome is not None:
                return outputs.outcome
            if tick == 0 and self._edges.found_armed and not self._goes_on(outputs):
                return Outcome.ABORTED
            tick += 1

    async def _tick(self, tick: int, start_s: float, lateness_s: float) -> tuple[Inputs, Outputs, Sent]:
        edges = self._edges
        arm_state = await edges.arm.read(JOINT_READ_TIMEOUT_S) if edges.arm is not None else None
        joint_read_s = self._clock()
        inputs = Inputs(
            tick=tick,
            t_s=joint_read_s,
            vehicle=edges.autopilot.vehicle(),
            status=edges.autopilot.status(),
            mocap=edges.mocap.latest() if edges.mocap is not None else None,
            arm=arm_state,
            force=edges.force.latest() if edges.force is not None else None,
            command=self._operator.command,
            recorder_dropped=self._recorder.client.dropped,
            guardian_ready=self._guardian.ready if self._guardian is not None else None,
        )
        outputs = self._core.step(inputs)
        edges.vision.open = outputs.mocap_trusted
        core_s = self._clock()
        torque_sent: Vec2 | None = None
        if outputs.arm_torque_nm is not None and edges.arm is not None:
            torque_sent = edges.arm.write_torque(outputs.arm_torque_nm)
        current_s = self._clock()
        attitude_sent = outputs.attitude is not None and edges.autopilot.send_attitude(outputs.attitude)
        setpoint_s = self._clock()
        if outputs.request is not AutopilotRequest.NONE:
            edges.autopilot.request(outputs.request)
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
        )
        self._recorder.client.record(inputs, outputs, sent)
        return inputs, outputs, sent

    def _goes_on(self, outputs: Outputs) -> bool:
        """Whether PX4, armed when its link was opened, still is: else there is nothing to land, and no reason to fly a mission."""
        goes_on = any(event.id == REATTACHED.id for event in outputs.events)
        lines = [f"landing without it: {line}" for line in self._edges.failures]
        if not goes_on:
            lines = [
                "PX4 was armed when the companion started, and has disarmed since; nothing was lifted: start again to fly"
            ]
        for text in lines:
            self._tell(0, outputs, Event(outputs.t_s, REATTACHED.id, Severity.WARNING, SafetyAction.WARN, text))
            self._recorder.client.text(outputs.t_s, Severity.WARNING, REATTACHED.id, text)
        return goes_on

    def _report(self, tick: int, outputs: Outputs, sent: Sent) -> None:
        for event in outputs.events:
            self._tell(tick, outputs, event)
        if tick % STATUS_EVERY and outputs.outcome is None:
            return
        for text in self._edges.autopilot.take_messages():
            self._recorder.client.text(outputs.t_s, Severity.WARNING, "px4", text)
            status.send(self._channel, {"type": "px4", "text": text})
        status.send(self._channel, self._status(tick, outputs, sent))

    def _tell(self, tick: int, outputs: Outputs, event: Event) -> None:
        message = {
            "type": "event",
            "tick": tick,
            "t_s": outputs.mission_t_s,
            "flight_t_s": event.t_s,
            "id": event.id,
            "severity": event.severity.value,
            "action": event.action.value,
            "text": event.text,
        }
        status.send(self._channel, message)

    def _status(self, tick: int, outputs: Outputs, sent: Sent) -> status.Message:
        error = outputs.control.error if outputs.control else None
        reference = outputs.reference
        return {
            "type": "status",
            "tick": tick,
            "t_s": outputs.t_s,
            "mission_t_s": outputs.mission_t_s,
            "phase": outputs.phase,
            "kind": outputs.phase_kind.value,
            "progress": outputs.progress,
            "action": outputs.action.value,
            "error_m": math.hypot(*error[0:3]) if error else None,
            "position_m": [r + e for r, e in zip(reference.position_world_m, error[0:3], strict=True)]
            if reference and error
            else None,
            "thrust": outputs.attitude.thrust if outputs.attitude else None,
            "lateness_ms": sent.lateness_s * 1e3,
            "missed": self._missed,
            "dropped": self._recorder.client.dropped,
        }


async def fly(
    config: FlightConfig,
    out: Path,
    channel: socket.socket,
    guardian_channel: socket.socket | None = None,
    *,
    sitl: bool = False,
) -> Outcome:
    """Open, fly, close.

    Args:
        config: checked.
        out: folder of the flight.
        channel: to the launcher.
        guardian_channel: to the guardian; None: nobody stands by.
        sitl: the devices are those of the simulated world.

    Raises:
        DeviceError: a device is not there or not as it must be; nothing was armed.
        Refused: something is not as it must be for a flight; nothing was armed.
        GivenUp: a landing was asked for before the first tick; nothing was armed.
    """
    origin_s = time.monotonic()
    clock = flight_clock(origin_s)
    client = GuardianClient(guardian_channel, clock) if guardian_channel is not None else None
    operator = Operator(channel)
    async with contextlib.AsyncExitStack() as stack:
        stack.enter_context(operator.attention())
        edges = await operator.unless_land(stack.enter_async_context(open_edges(config, clock)))
        if edges.found_armed:  # it flies, perhaps: nothing is waited for
            config = unflown(config)
        else:
            await operator.unless_land(check_before_flight(edges, config, clock, out, channel, sitl))
            config = await operator.unless_land(with_hover_thrust(config, edges.autopilot))
            if client is not None:
                await operator.unless_land(client.wait_ready())
        try:
            recorder = await asyncio.to_thread(
                RecorderProcess.start,
                out / "flight.mcap",
                config_json=config.model_dump_json(),
                epoch_offset_ns=epoch_offset_ns(clock()),
                metadata={
                    "mission": config.mission.name,
                    "law": config.controller.law,
                    "preset": config.controller.preset,
                },
            )
        except DeviceError as error:
            if not edges.found_armed:
                raise
            print(error, file=sys.stderr)  # no log, but a landing
            outcome = await hand_over(edges.autopilot, channel, clock, None)
            status.send(channel, {"type": "result", "outcome": outcome.value, "recorder": None})
            return outcome
        try:
            if not edges.found_armed:
                recorder.client.metadata("autopilot", {"firmware": await edges.autopilot.firmware()})
            guardian = FlightGuard(client, edges.autopilot.identity(), origin_s) if client is not None else None
            if client is not None:
                client.share_recorder(recorder.client.fileno())
            flight = Flight(config, edges, recorder, channel, operator, clock, guardian)
            status.send(
                channel,
                {"type": "started", "recorder_pid": recorder.process.pid, "realtime": claim_realtime(FLIGHT_PRIORITY)},
            )
            try:
                outcome = await flight.run()
            except Exception:  # whatever broke in here, the vehicle may be in the air
                with contextlib.suppress(
                    OSError, ValueError
                ):  # a full disk under flight.log costs the words, not the landing
                    traceback.print_exc()
                    sys.stderr.flush()
                if guardian is not None and guardian.would_take_over:
                    os._exit(EXIT_INTERNAL)  # at once and for good: the guardian lands, and nothing here may disturb it
                outcome = await hand_over(edges.autopilot, channel, clock, guardian)
            if guardian is not None and outcome is not Outcome.LOST:
                guardian.goodbye()
        finally:
            report = await asyncio.to_thread(recorder.finish)
        recorded = {"samples": report.samples, "dropped": report.dropped, "error": report.error}
        status.send(channel, {"type": "result", "outcome": outcome.value, "recorder": recorded})
    return outcome


async def check_before_flight(
    edges: Edges, config: FlightConfig, clock: Clock, out: Path, channel: socket.socket, sitl: bool
) -> None:
    """The preflight, told to the launcher and written to `preflight.json`.

    Raises:
        DeviceError: `preflight.json` cannot be written.
        Refused: a row refuses.
    """

    def tell(text: str, share: float) -> None:
        status.send(channel, {"type": "preflight_progress", "text": text, "share": share})

    # A path takes seconds to plan, once in a process: here, where motion capture goes on flowing meanwhile.
    plan = await asyncio.to_thread(Plan.build, config.mission, config.vehicle)
    known = Observations(0.0, 0.0, mission_s=plan.duration_s)
    rows = await preflight.preflight(edges, config, clock, out=out, tell=tell, known=known, sitl=sitl)
    status.send(channel, {"type": "preflight", "rows": [row.as_json() for row in rows]})
    try:
        preflight.write(rows, out)
    except OSError as error:
        raise DeviceError(
            f"{out / preflight.FILE}: cannot be written: {error.strerror}; choose another --out"
        ) from None
    if refused := refusals(rows):
        raise Refused([row.line() for row in refused])


async def with_hover_thrust(config: FlightConfig, autopilot: MavsdkAutopilot) -> FlightConfig:
    """The effective configuration: hover thrust from PX4 unless the vehicle file gives it.

    Raises:
        DeviceError: the parameter cannot be read or makes no sense.
    """
    airframe = config.vehicle.airframe
    if airframe.hover_thrust is not None:
        return config
    value = float(await autopilot.read_param(_HOVER_PARAM))
    if not 0.1 <= value <= 0.8:
        raise DeviceError(
            f"autopilot: {_HOVER_PARAM} = {value:.3f} is no hover thrust of this machine, expected 0.1 to 0.8;"
            f" set it in PX4 or give airframe.hover_thrust"
        )
    airframe = airframe.model_copy(update={"hover_thrust": value})
    vehicle = config.vehicle.model_copy(update={"airframe": airframe})
    return config.model_copy(update={"vehicle": vehicle})


def main(argv: list[str] | None = None) -> int:
    """Entry point of the flight process."""
    parser = argparse.ArgumentParser(prog="companion.app")
    parser.add_argument("--config", type=Path, required=True)
    parser.add_argument("--out", type=Path, required=True)
    parser.add_argument("--channel", type=int, required=True, help="socket to the launcher")
    parser.add_argument("--guardian", type=int, required=True, help="socket to the guardian")
    parser.add_argument("--sitl", action="store_true", help="the devices are those of the simulated world")
    arguments = parser.parse_args(argv)
    signal.signal(signal.SIGINT, signal.SIG_IGN)  # Ctrl-C is the launcher's: it asks for a landing
    config = FlightConfig.model_validate_json(arguments.config.read_text(encoding="utf-8"))
    channel = socket.socket(fileno=arguments.channel)
    channel.setblocking(False)
    try:
        guardian = socket.socket(fileno=arguments.guardian)
        outcome = asyncio.run(fly(config, arguments.out, channel, guardian, sitl=arguments.sitl))
    except DeviceError as error:
        status.send(channel, {"type": "refused", "lines": str(error).splitlines()})
        return EXIT_REFUSED
    except Refused as refused:
        status.send(channel, {"type": "refused", "lines": refused.lines})
        return EXIT_REFUSED
    except GivenUp:
        outcome = Outcome.ABORTED
        status.send(channel, {"type": "result", "outcome": outcome.value, "recorder": None})
    return EXIT_CODES[outcome]


if __name__ == "__main__":
    code = main()
    sys.stdout.flush()
    os._exit(code)  # MAVSDK's C++ threads may outlive the interpreter's teardown
