"""People on the ground command a flight over a real broker: START, HOLD, RESUME, LAND, signed with this user's own key."""

from __future__ import annotations

import asyncio
import os
import signal
import time
from collections.abc import Callable, Iterator
from pathlib import Path

import aiomqtt
import pytest
from mcap.reader import make_reader

from companion.analysis.log import FlightLog
from companion.config.ground import topic_name
from companion.config.loader import load_flight
from companion.ground.protocol.commands import make_command
from companion.ground.protocol.flight_clock import FlightClock
from companion.ground.protocol.keys import load_operators
from companion.ground.protocol.messages import (
    Ack,
    CommandName,
    Presence,
    State,
    Stream,
    Topic,
    decode,
    encode,
    vehicle_of,
)
from companion.ground.protocol.proof import ack_proven, stream_proven
from companion.model.exit_codes import EXIT_ABORTED, EXIT_OK
from companion.model.types import OperatorCommand, Outcome, SafetyAction
from tests.broker import loopback_broker
from tests.support import DEADLINE_S, HOVER, Sandbox, read_summary, run_here, sandbox_in, set_options

HIGH_AND_LONG = {
    "mission.phases[0].height_m": 1.0,
    "mission.phases[0].duration_s": 3.0,
    "mission.phases[1].duration_s": 60.0,
}
"""Room to be held in, and time for all that is commanded, on a loaded machine."""


class Station:
    """A ground station of a few lines: what the vehicle says, and commands to it."""

    def __init__(self, client: aiomqtt.Client, vehicle: str, operator: str, key: bytes) -> None:
        self._client = client
        self._vehicle = vehicle
        self._operator, self._key = operator, key
        self._clock = FlightClock()
        self._session: str | None = None
        self.state: State | None = None
        self.stream: Stream | None = None
        self.acks: dict[str, Ack] = {}

    async def until(self, condition: Callable[[], bool], what: str) -> None:
        """Listen until it holds."""
        try:
            async with asyncio.timeout(DEADLINE_S):
                while not condition():
                    self._take(await anext(self._client.messages))
        except TimeoutError:
            raise AssertionError(f"{what}: did not come; last: {self.state}, {self.stream}, {self.acks}") from None

    async def command(self, name: CommandName) -> Ack:
        """Command, and wait for the answer."""
        t_ms = self._clock.now_ms(time.monotonic())
        assert t_ms is not None and self._session is not None and self.stream is not None
        hold = (self.stream.hold or 0) if name is CommandName.RESUME else 0
        command = make_command(name, self._vehicle, self._session, self._operator, self._key, t_ms, hold)
        await self._client.publish(Topic.COMMAND.of(self._vehicle), encode(command), qos=1)
        await self.until(lambda: command.nonce in self.acks, f"an answer to {name.value}")
        return self.acks[command.nonce]

    def _take(self, message: aiomqtt.Message) -> None:
        named = vehicle_of(message.topic.value)
        assert named is not None and isinstance(message.payload, bytes)
        match named[1]:
            case Topic.STATE:
                self.state = decode(State, message.payload)
            case Topic.STREAM:
                self.stream = decode(Stream, message.payload)
                assert stream_proven(self.stream, self._vehicle, self._key)
                self._session = self.stream.session
                self._clock.add(self.stream.t_s, time.monotonic())
            case Topic.ACK:
                ack = decode(Ack, message.payload)
                assert ack_proven(ack, self._vehicle, self._key)
                self.acks[ack.nonce] = ack


@pytest.fixture
def sandbox(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Iterator[Sandbox]:
    """The flight and this process are of one user, whose keys nobody has made yet."""
    monkeypatch.setenv("XDG_CONFIG_HOME", str(tmp_path / "config"))
    with sandbox_in(tmp_path) as sandbox:
        yield sandbox


async def commanded(station: Station) -> None:
    """START, HOLD, RESUME, LAND; what is answered is what the vehicle does."""

    def stream() -> Stream:
        assert station.stream is not None
        return station.stream

    await station.until(lambda: station.stream is not None and stream().waits_for_start, "waiting for start")
    await station.until(lambda: station.state is not None and station.state.commands, "that commands are heard")
    assert not stream().armed
    ack = await station.command(CommandName.RESUME)
    assert (ack.accepted, ack.text) == (False, "nothing to resume: on the ground")
    ack = await station.command(CommandName.START)
    assert (ack.accepted, ack.text) == (True, "taking off")
    await station.until(lambda: stream().phase == "hold", "the hover")
    ack = await station.command(CommandName.HOLD)
    assert (ack.accepted, ack.text, ack.action) == (True, "holding", SafetyAction.HOLD.value)
    await station.until(lambda: stream().action == SafetyAction.HOLD.value, "the hold")
    held = stream().progress
    ack = await station.command(CommandName.RESUME)
    assert (ack.accepted, ack.text) == (True, "continuing")
    await station.until(lambda: stream().action == "nominal" and stream().progress > held + 0.01, "continuing")
    ack = await station.command(CommandName.LAND)
    assert (ack.accepted, ack.text) == (True, "landing")
    await station.until(lambda: station.state is not None and station.state.presence is Presence.ENDED, "the end")


@pytest.mark.flight
def test_started_held_let_go_on_and_landed_from_the_ground(sandbox: Sandbox, tmp_path: Path) -> None:
    operators = load_operators()
    [operator] = operators.names
    ground = load_flight(HOVER).vehicle
    vehicle = topic_name(ground.ground.topic, ground.name)
    with loopback_broker(tmp_path) as broker:
        options = set_options(**{"vehicle.ground.mqtt.url": broker.url, **HIGH_AND_LONG})

        async def on_the_ground() -> None:
            async with aiomqtt.Client("127.0.0.1", broker.port, protocol=aiomqtt.ProtocolVersion.V5) as client:
                for topic in (Topic.STATE, Topic.STREAM, Topic.ACK):
                    await client.subscribe(topic.of(vehicle), qos=1)
                await commanded(Station(client, vehicle, operator, operators.key(operator)))

        with sandbox.start("fly", HOVER, "--sitl", "--wait-for-start", "--out", "out", *options) as flying:
            asyncio.run(on_the_ground())
            ended = flying.end()
    sandbox.assert_nobody_left()
    assert ended.code == EXIT_ABORTED, ended.out + ended.err
    assert ended.err == ""
    for line in (
        f"connected to {broker.url}",
        "take off with: companion command start",
        f"{operator} commanded start: taking off",
        f"{operator} commanded resume: nothing to resume: on the ground",
        f"{operator} commanded land: landing",
    ):
        assert ended.out.count(line) == 1, (line, ended.out)

    out = sandbox.cwd / "out"
    summary = read_summary(out)
    assert summary["outcome"] == Outcome.ABORTED.value
    wanted = ["operator_start", "takeoff", "operator_hold", "operator_resume", "operator_land", "touchdown"]
    assert [event["id"] for event in summary["events"] if event["id"] in wanted] == wanted
    assert summary["recorder"]["dropped"] == 0
    log = FlightLog.read(out / "flight.mcap")
    asked = [inputs.command for inputs in log.inputs if inputs.command is not OperatorCommand.NONE]
    assert asked == [
        *(OperatorCommand.RESUME, OperatorCommand.START, OperatorCommand.HOLD, OperatorCommand.RESUME),
        OperatorCommand.LAND,
    ]
    with (out / "flight.mcap").open("rb") as file:
        lines = [m.data.decode(errors="replace") for _, _, m in make_reader(file).iter_messages(topics=["/log"])]
    assert any(f"hold of {operator}: holding" in line for line in lines)

    replayed = run_here("replay", out / "flight.mcap")
    assert replayed.code == EXIT_OK, replayed.out + replayed.err


@pytest.mark.flight
def test_without_its_recorder_it_still_stands_down_on_ctrl_c(sandbox: Sandbox, tmp_path: Path) -> None:
    """Waiting for its start, the recorder is killed: no commands any more, told once; Ctrl-C ends it as ever."""
    with loopback_broker(tmp_path) as broker:
        options = set_options(**{"vehicle.ground.mqtt.url": broker.url})
        with sandbox.start("fly", HOVER, "--sitl", "--wait-for-start", "--out", "out", *options) as flying:
            flying.wait_for("take off with: companion command start")
            flying.wait_for("connected to")
            recorder = sandbox.pid_of("companion.recorder.main")
            os.kill(recorder, signal.SIGKILL)
            flying.wait_for("no telemetry, no commands")
            flying.signal(signal.SIGINT)
            ended = flying.end()
    sandbox.assert_nobody_left()
    assert ended.code == EXIT_ABORTED, ended.out + ended.err
    assert ended.out.count("no telemetry, no commands") == 1
