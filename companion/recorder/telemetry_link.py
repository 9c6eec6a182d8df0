"""The event loop of telemetry: packets in, messages out, whatever the broker does. Runs in the recorder's telemetry thread only."""

from __future__ import annotations

import asyncio
import json
import time
from collections import deque
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any, Protocol

import aiomqtt

from companion.config.document import ConfigError
from companion.config.ground import Mqtt, topic_name
from companion.config.loader import FlightConfig
from companion.ground.protocol.access import KEYS, BrokerAccess, broker_access
from companion.ground.protocol.commands import Verifier
from companion.ground.protocol.connection import Connection, why
from companion.ground.protocol.keys import load_operators
from companion.ground.protocol.messages import MESSAGE_MAX_BYTES, RETAINED, STREAM_PERIOD_S, Command, Topic
from companion.model.codec import pack_plain
from companion.recorder.telemetry_session import INFO, WARNING, GroundDesk, Outgoing
from companion.runtime.packets import TEXT, UNNUMBERED

ANSWER_S = 4.0
"""For each answer of the broker."""
COMMAND_PACKET_MAX_BYTES = 16_384
"""The broker keeps larger messages to itself: sixteen times a command, so that one too large is seen and told."""
SEND_BUFFER_BYTES = 65_536
"""About a second of the stream: what a slow broker has not taken by then would be old anyway."""
PAUSE_MIN_S, PAUSE_MAX_S = 0.2, 2.0
"""Between two attempts to reach the broker."""
FAREWELL_S = 1.0
"""For the last words, if there is a broker."""
FLOOD_PER_S = 1500
"""Refused messages that are taken in a second as fast as they come; more of them are taken at `FLOOD_STEP / FLOOD_PAUSE_S` a second."""
FLOOD_STEP, FLOOD_PAUSE_S = 30, 0.02
_ACKS_MAX = 200


class FlightSide(Protocol):
    """What telemetry may do to the rest of the recorder; neither waits."""

    def say(self, message: dict[str, Any]) -> bool:
        """Tell the flight process. False: it does not listen."""

    def inject(self, packet: bytes) -> bool:
        """Into the log, as if the flight had sent it. False: no room."""


@dataclass(slots=True)
class Counts:
    """Of one session."""

    connections: int = 0
    stream_sent: int = 0
    stream_dropped: int = 0
    """Made while there was a broker that did not take them."""
    commands: int = 0
    """Handed to the flight."""
    refused: int = 0


class Outbox:
    """What is to be sent: of everything that is retained, and of the stream, the newest only. Never grows."""

    def __init__(self) -> None:
        self.stream: bytes | None = None
        self.stream_there = asyncio.Event()
        self.kept: dict[Topic, bytes] = {}
        """Newest of each retained topic."""
        self.due: dict[Topic, None] = {}
        """Retained topics that the broker does not have yet, in the order in which they changed."""
        self.acks: deque[bytes] = deque(maxlen=_ACKS_MAX)
        self.wake = asyncio.Event()
        self.sent = asyncio.Event()
        """Nothing with QoS 1 is left to send."""

    def put(self, out: Outgoing) -> None:
        """Take what is new; a message that is too large for the other end is left out."""
        for topic, payload in out.retained.items():
            if len(payload) <= MESSAGE_MAX_BYTES:
                self.kept[topic] = payload
                self.due[topic] = None
        self.acks.extend(out.acks)
        if self.due or self.acks:
            self.sent.clear()
            self.wake.set()

    def begin(self) -> None:
        """A new connection: the broker may have forgotten everything."""
        self.stream = None
        self.stream_there.clear()
        self.due = dict.fromkeys(sorted(self.kept, key=lambda topic: topic is not Topic.STATE))
        self.sent.clear()
        self.wake.set()


class Uplink:
    """Telemetry of one flight.

    Args:
        desk: what is told, and what becomes of commands.
        access: the broker.
        flight: the rest of the recorder.
        packets: filled by another thread: when it was received (CLOCK_MONOTONIC), packet.
        recorder_state: records lost, and why it records no more.
        ending: None: the flight goes on; else whether it ended in order.
        counts: filled in.
    """

    def __init__(
        self,
        desk: GroundDesk,
        access: BrokerAccess,
        flight: FlightSide,
        packets: deque[tuple[float, bytes]],
        recorder_state: Callable[[], tuple[int, str | None]],
        ending: Callable[[], bool | None],
        counts: Counts,
    ) -> None:
        self._desk = desk
        self._access = access
        self._flight = flight
        self._packets = packets
        self._recorder_state = recorder_state
        self._ending = ending
        self._counts = counts
        self._outbox = Outbox()
        self._connected = False
        self._told: str | None = None
        self._not_let: set[Topic] = set()
        self._flood_began_s, self._flood_before = 0.0, 0
        self._command_topic = Topic.COMMAND.of(desk.vehicle)

    async def run(self) -> None:
        """Until the flight has ended and that is told, or there is nobody to tell."""
        async with asyncio.TaskGroup() as group:
            staying = group.create_task(self._stay_connected())
            await self._pump()
            if self._connected:
                try:
                    async with asyncio.timeout(FAREWELL_S):
                        await self._outbox.sent.wait()
                except TimeoutError:
                    pass  # the broker is too slow: its last will says that we are gone
            staying.cancel()

    async def _pump(self) -> None:
        """20 times a second: take what has come, make what is to be sent."""
        due_s = time.monotonic()
        while True:
            ending = self._ending()
            while self._packets:
                for _ in range(min(200, len(self._packets))):
                    self._desk.take(*self._packets.popleft())
                await asyncio.sleep(0)
            if ending is not None:
                self._desk.end(in_order=ending)
            dropped, error = self._recorder_state()
            self._give(self._desk.collect(time.monotonic(), time.time(), dropped=dropped, recorder_error=error))
            if ending is not None:
                return
            due_s = max(due_s + STREAM_PERIOD_S, time.monotonic())
            await asyncio.sleep(due_s - time.monotonic())

    def _give(self, out: Outgoing) -> None:
        outbox = self._outbox
        self._counts.refused = self._desk.refused
        for t_s, severity, text in out.log:
            self._flight.inject(pack_plain((TEXT, UNNUMBERED, t_s, severity, "ground", text)))
        outbox.put(out)
        if out.stream is not None and self._connected:
            self._counts.stream_dropped += outbox.stream is not None
            outbox.stream = out.stream
            outbox.stream_there.set()

    async def _stay_connected(self) -> None:
        pause_s = PAUSE_MIN_S
        will = aiomqtt.Will(Topic.STATE.of(self._desk.vehicle), self._desk.last_will(), qos=1, retain=True)
        identifier = f"companion-{self._desk.vehicle}-{self._desk.session}"
        while True:
            client = Connection(
                self._access,
                identifier,
                self._message,
                packet_max_bytes=COMMAND_PACKET_MAX_BYTES,
                answer_s=ANSWER_S,
                will=will,
                send_buffer_bytes=SEND_BUFFER_BYTES,
            )
            reason = ""
            try:
                await client.open()
                pause_s = PAUSE_MIN_S
                await self._serve(client)
            except aiomqtt.MqttError as error:
                reason = why(error)
            finally:
                self._connected = False
                said = self._desk.over and self._outbox.sent.is_set()
                await client.drop(with_will=not said)
            self._tell_change(WARNING, f"no broker at {self._access.address}, trying: {reason}")
            await asyncio.sleep(pause_s)
            pause_s = min(PAUSE_MAX_S, pause_s * 1.6)

    async def _serve(self, client: Connection) -> None:
        """As long as the connection holds.

        Raises:
            aiomqtt.MqttError: it holds no more.
        """
        self._counts.connections += 1
        self._tell_change(INFO, f"connected to {self._access.address}")
        if self._desk.hears_commands:
            refusal = await client.hear(self._command_topic, 1)
            text = f"the broker does not let this vehicle hear commands: {refusal}"
            if refusal is not None:
                self._desk.tell(time.monotonic(), WARNING, text)
            self._desk.commands_heard(refusal is None, text)
        self._outbox.begin()
        self._connected = True
        parts = {
            asyncio.create_task(part) for part in (client.broken(), self._send_stream(client), self._send_kept(client))
        }
        try:
            done, _ = await asyncio.wait(parts, return_when=asyncio.FIRST_COMPLETED)
            for part in done:
                part.result()
        finally:
            for part in parts:
                part.cancel()
            await asyncio.wait(parts)
            for part in parts:
                if not part.cancelled():
                    part.exception()

    async def _send_stream(self, client: Connection) -> None:
        """One message at a time: as long as the system takes none, the newest replaces the one that waits."""
        outbox, topic = self._outbox, Topic.STREAM.of(self._desk.vehicle)
        while True:
            await outbox.stream_there.wait()
            payload, outbox.stream = outbox.stream, None
            outbox.stream_there.clear()
            if payload is not None:
                await client.send(topic, payload, qos=0, retain=False)
                self._counts.stream_sent += 1

    async def _send_kept(self, client: Connection) -> None:
        """Answers first, then what is retained; each is kept until the broker has it."""
        outbox = self._outbox
        while True:
            await outbox.wake.wait()
            outbox.wake.clear()
            while outbox.acks or outbox.due:
                if outbox.acks:
                    ack = outbox.acks[0]
                    await self._send(client, Topic.ACK, ack)
                    if outbox.acks and outbox.acks[0] is ack:
                        outbox.acks.popleft()
                    continue
                topic = next(iter(outbox.due))
                del outbox.due[topic]
                await self._send(client, topic, outbox.kept[topic])
            outbox.sent.set()

    async def _send(self, client: Connection, topic: Topic, payload: bytes) -> None:
        refusal = await client.send(topic.of(self._desk.vehicle), payload, qos=1, retain=topic in RETAINED)
        if refusal is None:
            self._not_let.discard(topic)
        elif topic not in self._not_let:
            text = f"the broker does not let this vehicle say its {topic.value}: {refusal}"
            self._desk.tell(time.monotonic(), WARNING, text)
            if not self._not_let:  # one line in the terminal is enough for a wrong login
                self._flight.say({"ground": text})
            self._not_let.add(topic)

    def _message(self, topic: str, payload: bytes, retained: bool) -> None:
        if topic != self._command_topic:
            return
        now_s = time.monotonic()
        command = self._desk.hear(payload, retained, now_s)
        if command is not None:
            self._hand_over(command, now_s)
        else:
            self._slow_down(now_s)

    def _slow_down(self, now_s: float) -> None:
        """Whoever floods us is not to have the processor that the flight needs: the rest waits at the broker, and is dropped there."""
        if now_s - self._flood_began_s >= 1.0:
            self._flood_began_s, self._flood_before = now_s, self._desk.refused
        many = self._desk.refused - self._flood_before
        if many > FLOOD_PER_S and many % FLOOD_STEP == 0:
            time.sleep(FLOOD_PAUSE_S)  # the whole loop, on purpose: reading must stop

    def _hand_over(self, command: Command, now_s: float) -> None:
        message = {
            "command": command.command.value,
            "operator": command.operator,
            "nonce": command.nonce,
            "hold": command.hold,
        }
        if self._flight.say(message):
            self._counts.commands += 1
            return
        text = "the flight process does not listen; use Ctrl-C or the pilot's switch"
        self._desk.answer(command, text, now_s)
        self._desk.tell(now_s, WARNING, f"{command.command.value} of {command.operator}: {text}")

    def _tell_change(self, severity: str, text: str) -> None:
        """Once per change: of a broker that is away, the first reason stands for all that follow."""
        kind = text.split(", ")[0]
        if kind == self._told:
            return
        self._told = kind
        self._desk.tell(time.monotonic(), severity, text, event=False)
        self._flight.say({"ground": text})


def run(
    config_json: str,
    session: str,
    simulated: bool,
    flight: FlightSide,
    packets: deque[tuple[float, bytes]],
    recorder_state: Callable[[], tuple[int, str | None]],
    ending: Callable[[], bool | None],
    counts: Counts,
) -> None:
    """Telemetry of one flight, from the first packet to the last word; returns at once if it cannot be. See `Uplink`.

    Raises:
        ConfigError: what the vehicle file names cannot be used; one line for the user.
        ValueError: the configuration is no flight's.
    """
    config = FlightConfig.model_validate(json.loads(config_json))
    mqtt = config.vehicle.ground.mqtt
    if mqtt is None:
        return
    access = broker_access(mqtt.url, mqtt.login_file, mqtt.ca_file, KEYS)

    async def all_of_it() -> None:
        verifier, no_commands = _verifier(config, mqtt, session)
        desk = GroundDesk(config, session, simulated=simulated, verifier=verifier, no_commands=no_commands)
        if no_commands is not None:
            desk.tell(time.monotonic(), WARNING if mqtt.commands else INFO, no_commands, event=False)
        await Uplink(desk, access, flight, packets, recorder_state, ending, counts).run()

    asyncio.run(all_of_it())


def _verifier(config: FlightConfig, mqtt: Mqtt, session: str) -> tuple[Verifier | None, str | None]:
    """Who judges commands; or why none are heard."""
    if not mqtt.commands:
        return None, "commands are switched off in the vehicle file (ground.mqtt.commands)"
    address = mqtt.address
    if not (address.loopback or address.tls):
        return None, f"commands are not heard over a plain connection to another computer ({address}); use mqtts://"
    try:
        operators = load_operators(mqtt.operators_file)
    except ConfigError as error:
        return None, f"commands are not heard: {error.lines[0]}"
    return Verifier(operators, topic_name(config.vehicle.ground.topic, config.vehicle.name), session), None
