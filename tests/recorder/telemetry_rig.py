"""A recorder process with a broker, a flight that feeds it, and a ground station that listens."""

from __future__ import annotations

import contextlib
import itertools
import json
import select
import signal
import threading
import time
from collections.abc import Callable, Iterator
from functools import cache
from pathlib import Path
from typing import Any, TypeVar

import paho.mqtt.client as mqtt
from mcap.exceptions import EndOfFile
from mcap.reader import NonSeekingReader
from paho.mqtt.enums import CallbackAPIVersion

from companion.config.loader import FlightConfig, load_flight
from companion.ground.protocol.commands import make_command
from companion.ground.protocol.keys import Operator, load_login, new_key, operators_text, write_private
from companion.ground.protocol.messages import Stream, Topic, decode, vehicle_of
from companion.model.codec import to_json
from companion.model.outputs import Outputs, Sent
from companion.model.types import Inputs, OperatorCommand
from companion.recorder.client import RecorderProcess, RecorderReport
from tests.analysis.synthetic_flight import synthetic_flight
from tests.support import CATCH, DEADLINE_S, wait_until

M = TypeVar("M")
Row = tuple[Inputs, Outputs, Sent]
ANNA = new_key()
VEHICLE = "rig-7"
STREAM_TICKS = 10
"""Ticks in a period of the stream, 20 Hz."""


@cache
def rows() -> list[Row]:
    return list(synthetic_flight(end_s=21.0))


class Listener:
    """A ground station that keeps all received messages."""

    def __init__(self, port: int, pattern: str = "companion/#", login_file: Path | None = None) -> None:
        self._client = mqtt.Client(CallbackAPIVersion.VERSION2, protocol=mqtt.MQTTv5)
        if login_file is not None:
            login = load_login(login_file)
            self._client.username_pw_set(login.username, login.password)
        self._client.on_message = self._take
        self._client.on_connect = lambda client, *_: client.subscribe(pattern, qos=1)
        self._client.reconnect_delay_set(min_delay=1, max_delay=1)
        self._changed = threading.Condition()
        self._heard: list[tuple[Topic, bytes, bool]] = []
        self.t_s: float | None = None
        """Flight clock of the newest stream: it goes with the rig's ticks, not with the computer's clock."""
        self._client.connect("127.0.0.1", port, keepalive=5)
        self._client.loop_start()

    def __enter__(self) -> Listener:
        return self

    def __exit__(self, *_: object) -> None:
        self._client.disconnect()
        self._client.loop_stop()

    def _take(self, client: Any, userdata: Any, message: mqtt.MQTTMessage) -> None:
        found = vehicle_of(message.topic)
        assert found is not None
        with self._changed:
            self._heard.append((found[1], bytes(message.payload), message.retain))
            if found[1] is Topic.STREAM:
                self.t_s = decode(Stream, bytes(message.payload)).t_s
            self._changed.notify_all()

    def of(self, topic: Topic) -> list[bytes]:
        """Return all received messages of a topic."""
        with self._changed:
            return [payload for heard, payload, _ in self._heard if heard is topic]

    def forget(self, topic: Topic) -> None:
        """Forget the messages so far."""
        with self._changed:
            self._heard = [heard for heard in self._heard if heard[0] is not topic]

    def retained(self) -> dict[Topic, bytes]:
        """Return the retained messages."""
        with self._changed:
            return {topic: payload for topic, payload, retained in self._heard if retained}

    def wait(self, topic: Topic, cls: type[M], wanted: Callable[[M], bool] = lambda _: True) -> M:
        """Return the newest matching message, received already or later."""
        deadline_s = time.monotonic() + DEADLINE_S
        with self._changed:
            while True:
                for heard, payload, _ in reversed(self._heard):
                    if heard is topic and wanted(message := decode(cls, payload)):
                        return message
                left_s = deadline_s - time.monotonic()
                assert left_s > 0, (topic, [payload for heard, payload, _ in self._heard if heard is topic][-3:])
                self._changed.wait(left_s)

    def publish(self, topic: str, payload: bytes, *, retain: bool = False) -> None:
        """Publish with QoS 1 and wait until the broker has it."""
        self._client.publish(topic, payload, qos=1, retain=retain).wait_for_publish(DEADLINE_S)


class Flight:
    """A recorder process and its flight."""

    def __init__(self, folder: Path, url: str | None, **settings: Any) -> None:
        self.config = config_of(folder, url, **settings)
        self.path = folder / "flight.mcap"
        self.recorder = RecorderProcess.start(
            self.path,
            config_json=self.config.model_dump_json(),
            epoch_offset_ns=1_700_000_000_000_000_000,
            simulated=True,
            deadline_s=DEADLINE_S,
        )
        self._next = 0

    def fly(self, until: int) -> None:
        """Send ticks up to a number, faster than real time; none may be dropped."""
        for row in rows()[self._next : until]:
            select.select([], [self.recorder.client], [], DEADLINE_S)
            self.recorder.client.record(*row)
        self._next = until

    def wait(self, condition: Callable[[], bool], why: str) -> None:
        """Send a tick now and then until the condition holds: the flight reads the recorder's messages in its ticks. The flight's clock
        goes a hundred times slower than the computer's, so that no command grows old on a busy one.
        """
        looks = itertools.count()

        def look() -> bool:
            if next(looks) % 10 == 0:
                self.fly(self._next + 1)
                assert self._next < len(rows()), why
            return condition()

        wait_until(look, lambda: f"{why}: {self.recorder.client.telemetry_status}")

    def begin(self, listener: Listener) -> None:
        """Send ticks until the ground station sees the flight, so that later messages are received live."""
        self.fly(self._next + STREAM_TICKS)
        self.wait(lambda: bool(listener.of(Topic.STREAM)), "the ground sees nothing")

    def finish(self) -> RecorderReport:
        return self.recorder.finish(DEADLINE_S)


def config_of(folder: Path, url: str | None, vehicle: str = VEHICLE, **settings: object) -> FlightConfig:
    operators = folder / "operators.yaml"
    if not operators.exists():
        write_private(operators, operators_text([Operator("anna", ANNA)]).encode())
    given = {"url": url, "operators_file": str(operators), **settings}
    overrides = [f"vehicle.ground.mqtt.{key}={json.dumps(value)}" for key, value in given.items()]
    if url is None:
        overrides = ["vehicle.ground.mqtt=null"]
    return load_flight(CATCH, overrides=[f"vehicle.ground.topic={vehicle}", *overrides])


@contextlib.contextmanager
def flight_with(folder: Path, url: str | None, **settings: Any) -> Iterator[Flight]:
    flight = Flight(folder, url, **settings)
    try:
        yield flight
    finally:
        flight.recorder.process.send_signal(signal.SIGCONT)
        flight.finish()


def log_lines(path: Path) -> list[str]:
    """Return the messages of the `/log` channel so far, read with the mcap library."""
    lines = []
    with path.open("rb") as file, contextlib.suppress(EndOfFile):
        for _, _, message in NonSeekingReader(file).iter_messages(topics=["/log"], log_time_order=False):
            lines.append(message.data.decode("utf-8", "replace"))
    return lines


def command(
    listener: Listener, name: OperatorCommand, session: str, key: bytes = ANNA, vehicle: str = VEHICLE
) -> bytes:
    assert listener.t_s is not None
    return to_json(make_command(name, vehicle, session, "anna", key, round(listener.t_s * 1e3)))
