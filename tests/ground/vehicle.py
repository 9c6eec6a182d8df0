"""A vehicle for ground stations: it sends real records through a real broker, and verifies commands as a vehicle does."""

from __future__ import annotations

import asyncio
import contextlib
import time
from collections.abc import AsyncIterator, Callable
from functools import lru_cache
from typing import Any

import aiomqtt
from msgspec.structs import replace

from companion.config.loader import FlightConfig, load_flight
from companion.ground.protocol.commands import Accepted, Refused, Verifier
from companion.ground.protocol.keys import Operators
from companion.ground.protocol.messages import (
    VERSION,
    Ack,
    Command,
    Events,
    Preflight,
    PreflightRow,
    Presence,
    Scene,
    State,
    Stream,
    Topic,
)
from companion.ground.protocol.proof import with_proof, with_proofs
from companion.ground.telemetry.scene import scene_of
from companion.ground.telemetry.stream import STREAM_PERIOD_S, replay
from companion.model.codec import to_json
from companion.model.types import OperatorCommand
from tests.analysis.synthetic_flight import synthetic_flight
from tests.support import CATCH


@lru_cache(maxsize=1)
def flight() -> tuple[FlightConfig, tuple[Stream, ...], Events]:
    """Return the records of a synthetic flight until shortly after the catch."""
    config = load_flight(CATCH)
    streams, events = replay(synthetic_flight(end_s=8.0), config, "session", 1.7e9)
    return config, tuple(streams), events


def state_of(name: str, session: str, **values: Any) -> State:
    state = State(
        v=VERSION,
        vehicle=name,
        session=session,
        presence=Presence.FLYING,
        simulated=True,
        mission="catch",
        law="adaptive",
        preset="recommended",
        wall_s=1.7e9,
        commands=True,
    )
    return replace(state, **values)


def ack_of(session: str, nonce: str = "0" * 32, **values: Any) -> Ack:
    """Return the answer to a HOLD of anna, with fields replaced."""
    ack = Ack(
        v=VERSION,
        session=session,
        nonce=nonce,
        operator="anna",
        command=OperatorCommand.HOLD,
        accepted=True,
        text="holding",
        t_s=1.0,
        phase="catch",
        action="hold",
        proof="",
    )
    return replace(ack, **values)


class PlayedVehicle:
    """Plays a flight repeatedly, 20 records a second by its own clock, until stopped."""

    def __init__(self, client: aiomqtt.Client, name: str, session: str, operators: Operators) -> None:
        self._client = client
        self._started_s = time.monotonic()
        self._verifier = Verifier(operators, name, session)
        self._operators = operators
        self._seq = 0
        self.name = name
        self.session = session
        self.accepted: list[Command] = []
        self.refused: list[Refused] = []
        self.commands_heard = 0
        self.answers = True
        """Send acks."""
        self.accepts: Callable[[Command], tuple[bool, str]] = lambda command: (True, f"{command.command.value}: done")
        self.streams = True
        """Send the stream."""
        self.last_stream: Stream | None = None

    @property
    def t_s(self) -> float:
        """Flight clock."""
        return time.monotonic() - self._started_s

    def scene(self) -> Scene:
        config, _, _ = flight()
        return scene_of(config, self.session, [(0.0, 0.0, 1.0), (1.0, 0.0, 1.0)], mission_s=21.0)

    async def say(self, topic: Topic, record: object, *, retain: bool = False, qos: int = 1) -> None:
        await self._client.publish(topic.of(self.name), to_json(record), qos=qos, retain=retain)
        task = asyncio.current_task()
        if task is not None and task.cancelling():  # forgotten by wait_for of Python 3.11, if the answer came just then
            raise asyncio.CancelledError

    async def say_state(self, **values: Any) -> None:
        await self.say(Topic.STATE, state_of(self.name, self.session, **values), retain=True)

    async def say_all(self) -> None:
        """Send all retained messages."""
        await self.say_state()
        await self.say(Topic.SCENE, self.scene(), retain=True)
        rows = (PreflightRow("px4_link", "ok", "3 ms"),)
        await self.say(Topic.PREFLIGHT, Preflight(VERSION, self.session, rows), retain=True)
        await self.say_events(*(line.text for line in flight()[2].lines))

    async def say_events(self, *texts: str) -> None:
        line = flight()[2].lines[0]
        lines = tuple(replace(line, text=text) for text in texts)
        await self.say(
            Topic.EVENTS, Events(v=VERSION, session=self.session, count=len(lines), lines=lines), retain=True
        )

    async def say_stream(self, **values: Any) -> Stream:
        _, streams, _ = flight()
        stream = replace(streams[self._seq % len(streams)], session=self.session, seq=self._seq, t_s=self.t_s, **values)
        stream = with_proofs(stream, self.name, self._operators.keys)
        self._seq += 1
        self.last_stream = stream
        await self.say(Topic.STREAM, stream, qos=0)
        return stream

    async def fly(self) -> None:
        """Send the stream and answer commands, until cancelled."""
        async with asyncio.TaskGroup() as both:
            both.create_task(self._stream())
            both.create_task(self._obey())

    async def _stream(self) -> None:
        while True:
            if self.streams:
                await self.say_stream()
            await asyncio.sleep(STREAM_PERIOD_S)

    async def _obey(self) -> None:
        async for message in self._client.messages:
            self.commands_heard += 1
            assert isinstance(message.payload, bytes)
            verdict = self._verifier.check(message.payload, message.retain, self.t_s)
            if isinstance(verdict, Accepted):
                command = verdict.command
                self.accepted.append(command)
                accepted, text = self.accepts(command)
            else:
                self.refused.append(verdict)
                if verdict.command is None:
                    continue
                command, accepted, text = verdict.command, False, verdict.text
            if self.answers:
                values = {"operator": command.operator, "command": command.command, "accepted": accepted, "text": text}
                ack = ack_of(self.session, command.nonce, **values, t_s=self.t_s, action="nominal")
                await self.say(Topic.ACK, with_proof(ack, self.name, self._operators.key(command.operator)))


@contextlib.asynccontextmanager
async def played_vehicle(
    port: int, operators: Operators, name: str = "rig", session: str = "session-1", *, quiet: bool = False
) -> AsyncIterator[PlayedVehicle]:
    """Connect a vehicle to a broker; a `quiet` one sends only what it is asked to send."""
    async with aiomqtt.Client("127.0.0.1", port, protocol=aiomqtt.ProtocolVersion.V5) as client:
        vehicle = PlayedVehicle(client, name, session, operators)
        await client.subscribe(Topic.COMMAND.of(name), qos=1)
        await vehicle.say_all()
        if quiet:
            yield vehicle
            return
        flying = asyncio.ensure_future(vehicle.fly())
        try:
            yield vehicle
        finally:
            flying.cancel()
            with contextlib.suppress(asyncio.CancelledError, aiomqtt.MqttError, ExceptionGroup):
                await flying  # the broker may have been killed meanwhile
