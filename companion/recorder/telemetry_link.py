"""The event loop of the telemetry: turns packets into MQTT messages, with or without a connection to the broker. Runs in the
telemetry thread only.
"""

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
from companion.ground.protocol.connection import Connection, error_text
from companion.ground.protocol.keys import load_operators
from companion.ground.protocol.messages import MESSAGE_MAX_BYTES, RETAINED, Command, Topic
from companion.ground.telemetry.stream import STREAM_PERIOD_S
from companion.model.codec import to_packet
from companion.model.packets import LogLine
from companion.model.types import Severity
from companion.recorder.telemetry_session import INFO, WARNING, Outgoing, TelemetrySession
from companion.runtime.tasks import until_first

ANSWER_S = 4.0
COMMAND_PACKET_MAX_BYTES = 16_384
"""Maximum Packet Size given to the broker: sixteen times a command, so that a somewhat oversized command is received and reported."""
SEND_BUFFER_BYTES = 65_536
"""Size of the socket's send buffer: about one second of the stream. Data that a slow broker accepts later is stale."""
PAUSE_MIN_S, PAUSE_MAX_S = 0.2, 2.0
"""Pause between two connection attempts."""
END_TIMEOUT_S = 1.0
"""Timeout for the last messages of the session, if a broker is connected."""
FLOOD_PER_S = 1500
"""Number of refused messages per second that are processed at full speed; further ones are processed at `FLOOD_STEP /
FLOOD_PAUSE_S` a second.
"""
FLOOD_STEP, FLOOD_PAUSE_S = 30, 0.02
_ACKS_MAX = 200


class FlightSide(Protocol):
    """Calls that the telemetry may make to the rest of the recorder; none waits."""

    def send(self, message: dict[str, Any]) -> bool:
        """Send a message to the flight process. Return False if it does not read."""

    def inject(self, packet: bytes) -> bool:
        """Write a packet to the log as if the flight had sent it. Return False if the queue is full."""


@dataclass(slots=True)
class Counts:
    """Counts of one session."""

    connections: int = 0
    stream_sent: int = 0
    stream_dropped: int = 0
    """Stream messages that a connected broker did not accept in time."""
    commands: int = 0
    """Commands forwarded to the flight process."""
    refused: int = 0


@dataclass(frozen=True, slots=True)
class RecorderSide:
    """Interface of the telemetry link to the rest of the recorder."""

    flight: FlightSide
    packets: deque[tuple[float, bytes]]
    """Queue filled by another thread: time of receipt (CLOCK_MONOTONIC), packet."""
    state: Callable[[], tuple[int, str | None]]
    """Returns the number of lost records, and why recording stopped."""
    ending: Callable[[], bool | None]
    """Returns None during the flight, and afterwards whether the flight ended normally."""
    counts: Counts
    """Updated while the session runs."""


class Outbox:
    """Messages to send: the newest of each retained topic, the newest of the stream, and acks. Bounded."""

    def __init__(self) -> None:
        self.stream: bytes | None = None
        self.stream_available = asyncio.Event()
        self.kept: dict[Topic, bytes] = {}
        """Newest payload of each retained topic."""
        self.due: dict[Topic, None] = {}
        """Retained topics that the broker does not have yet, in the order of their changes."""
        self.acks: deque[bytes] = deque(maxlen=_ACKS_MAX)
        self.wake = asyncio.Event()
        self.sent = asyncio.Event()
        """Set when no message with QoS 1 is left to send."""

    def put(self, out: Outgoing) -> None:
        """Add new messages; drop one that is too large for the receivers."""
        for topic, payload in out.retained.items():
            if len(payload) <= MESSAGE_MAX_BYTES:
                self.kept[topic] = payload
                self.due[topic] = None
        self.acks.extend(out.acks)
        if self.due or self.acks:
            self.sent.clear()
            self.wake.set()

    def begin(self) -> None:
        """Prepare for a new connection: queue all retained messages again, for the broker, and drop the pending stream message."""
        self.stream = None
        self.stream_available.clear()
        self.due = dict.fromkeys(sorted(self.kept, key=lambda topic: topic is not Topic.STATE))
        self.sent.clear()
        self.wake.set()


class Uplink:
    """Connects a telemetry session to its broker."""

    def __init__(self, session: TelemetrySession, access: BrokerAccess, recorder: RecorderSide) -> None:
        self._session = session
        self._access = access
        self._recorder = recorder
        self._counts = recorder.counts
        self._outbox = Outbox()
        self._connected = False
        self._last_reported: str | None = None
        self._refused_topics: set[Topic] = set()
        self._flood_began_s, self._flood_before = 0.0, 0
        self._command_topic = Topic.COMMAND.of(session.vehicle)

    async def run(self) -> None:
        """Run until the end of the flight has been published or, if no broker is connected then, until the flight ends."""
        async with asyncio.TaskGroup() as group:
            staying = group.create_task(self._stay_connected())
            await self._pump()
            if self._connected:
                try:
                    async with asyncio.timeout(END_TIMEOUT_S):
                        await self._outbox.sent.wait()
                except TimeoutError:
                    pass  # the broker is too slow; it publishes the last will instead
            staying.cancel()

    async def _pump(self) -> None:
        due_s = time.monotonic()
        while True:
            ending = self._recorder.ending()
            while self._recorder.packets:
                for _ in range(min(200, len(self._recorder.packets))):
                    self._session.take_packet(*self._recorder.packets.popleft())
                await asyncio.sleep(0)
            if ending is not None:
                self._session.end(normally=ending)
            dropped, error = self._recorder.state()
            self._queue(self._session.collect(time.monotonic(), time.time(), dropped=dropped, recorder_error=error))
            if ending is not None:
                return
            due_s = max(due_s + STREAM_PERIOD_S, time.monotonic())
            await asyncio.sleep(due_s - time.monotonic())

    def _queue(self, out: Outgoing) -> None:
        outbox = self._outbox
        self._counts.refused = self._session.refused
        for t_s, severity, text in out.log:
            line = LogLine(t_s=t_s, severity=Severity(severity), source="ground", text=text)
            self._recorder.flight.inject(to_packet(line))
        outbox.put(out)
        if out.stream is not None and self._connected:
            self._counts.stream_dropped += outbox.stream is not None
            outbox.stream = out.stream
            outbox.stream_available.set()

    async def _stay_connected(self) -> None:
        pause_s = PAUSE_MIN_S
        will = aiomqtt.Will(Topic.STATE.of(self._session.vehicle), self._session.last_will(), qos=1, retain=True)
        identifier = f"companion-{self._session.vehicle}-{self._session.session}"
        while True:
            client = Connection(
                self._access,
                identifier,
                self._on_message,
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
                reason = error_text(error)
            finally:
                self._connected = False
                complete = self._session.over and self._outbox.sent.is_set()
                await client.shut_down(with_will=not complete)
            self._report_change(WARNING, f"no broker at {self._access.address}, trying: {reason}")
            await asyncio.sleep(pause_s)
            pause_s = min(PAUSE_MAX_S, pause_s * 1.6)

    async def _serve(self, client: Connection) -> None:
        """Serve one connection; raises aiomqtt.MqttError if it is lost."""
        self._counts.connections += 1
        self._report_change(INFO, f"connected to {self._access.address}")
        if self._session.accepts_commands:
            refusal = await client.subscribe_topic(self._command_topic, 1)
            text = f"the broker does not let this vehicle subscribe to commands: {refusal}"
            if refusal is not None:
                self._session.notify(time.monotonic(), WARNING, text)
            self._session.set_commands_available(refusal is None, text)
        self._outbox.begin()
        self._connected = True
        await until_first(client.wait_broken(), self._send_stream(client), self._send_kept(client))

    async def _send_stream(self, client: Connection) -> None:
        """Send one stream message at a time; while the socket is full the newest replaces the one that waits."""
        outbox, topic = self._outbox, Topic.STREAM.of(self._session.vehicle)
        while True:
            await outbox.stream_available.wait()
            payload, outbox.stream = outbox.stream, None
            outbox.stream_available.clear()
            if payload is not None:
                await client.publish_message(topic, payload, qos=0, retain=False)
                self._counts.stream_sent += 1

    async def _send_kept(self, client: Connection) -> None:
        """Send acks first, then retained messages; each is kept until the broker has it."""
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
        refusal = await client.publish_message(
            topic.of(self._session.vehicle), payload, qos=1, retain=topic in RETAINED
        )
        if refusal is None:
            self._refused_topics.discard(topic)
        elif topic not in self._refused_topics:
            text = f"the broker does not let this vehicle publish its {topic.value}: {refusal}"
            self._session.notify(time.monotonic(), WARNING, text)
            if not self._refused_topics:  # a wrong login affects all topics; report only one
                self._recorder.flight.send({"ground": text})
            self._refused_topics.add(topic)

    def _on_message(self, topic: str, payload: bytes, retained: bool) -> None:
        if topic != self._command_topic:
            return
        now_s = time.monotonic()
        command = self._session.receive_command(payload, retained, now_s)
        if command is not None:
            self._forward_command(command, now_s)
        else:
            self._slow_down(now_s)

    def _slow_down(self, now_s: float) -> None:
        """Limit the CPU time that a flood of invalid commands takes from the flight: unread messages wait at the broker."""
        if now_s - self._flood_began_s >= 1.0:
            self._flood_began_s, self._flood_before = now_s, self._session.refused
        many = self._session.refused - self._flood_before
        if many > FLOOD_PER_S and many % FLOOD_STEP == 0:
            time.sleep(FLOOD_PAUSE_S)  # blocks the event loop on purpose, so that reading stops

    def _forward_command(self, command: Command, now_s: float) -> None:
        message = {
            "command": command.command.value,
            "operator": command.operator,
            "nonce": command.nonce,
            "hold": command.hold,
            "t_s": command.t_ms / 1000.0,
        }
        if self._recorder.flight.send(message):
            self._counts.commands += 1
            return
        text = "the flight process does not read commands; use Ctrl-C or the pilot's switch"
        self._session.reject(command, text, now_s)
        self._session.notify(now_s, WARNING, f"{command.command.value} of {command.operator}: {text}")

    def _report_change(self, severity: str, text: str) -> None:
        """Report a change of the connection once; while the broker is unreachable, only the first reason is reported."""
        kind = text.split(", ")[0]
        if kind == self._last_reported:
            return
        self._last_reported = kind
        self._session.notify(time.monotonic(), severity, text, event=False)
        self._recorder.flight.send({"ground": text})


def run(config_json: str, session: str, simulated: bool, recorder: RecorderSide) -> None:
    """Run the telemetry of one flight until it ends; return at once if no broker is configured. See `Uplink`.

    Raises:
        ConfigError: a setting of the vehicle file cannot be used; one line for the user.
        ValueError: the configuration is not that of a flight.
    """
    config = FlightConfig.model_validate(json.loads(config_json))
    mqtt = config.vehicle.ground.mqtt
    if mqtt is None:
        return
    access = broker_access(mqtt.url, mqtt.login_file, mqtt.ca_file, KEYS)

    async def run_session() -> None:
        verifier, no_commands = _verifier(config, mqtt, session)
        telemetry = TelemetrySession(config, session, simulated=simulated, verifier=verifier, no_commands=no_commands)
        if no_commands is not None:
            telemetry.notify(time.monotonic(), WARNING if mqtt.commands else INFO, no_commands, event=False)
        await Uplink(telemetry, access, recorder).run()

    asyncio.run(run_session())


def _verifier(config: FlightConfig, mqtt: Mqtt, session: str) -> tuple[Verifier | None, str | None]:
    if not mqtt.commands:
        return None, "commands are disabled in the vehicle file (ground.mqtt.commands)"
    address = mqtt.address
    if not (address.loopback or address.tls):
        return (
            None,
            f"commands are not accepted over an unencrypted connection to another computer ({address}); use mqtts://",
        )
    try:
        operators = load_operators(mqtt.operators_file)
    except ConfigError as error:
        return None, f"commands are not accepted: {error.lines[0]}"
    return Verifier(operators, topic_name(config.vehicle.ground.topic, config.vehicle.name), session), None
