"""Telemetry as the ground sees it: the real recorder process, fed with a synthetic flight, and a real mosquitto."""

from __future__ import annotations

import contextlib
import datetime
import getpass
import json
import os
import random
import select
import signal
import socket
import subprocess
import sys
import threading
import time
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any, TypeVar

import jsonschema
import paho.mqtt.client as mqtt
import pytest
from mcap.exceptions import EndOfFile
from mcap.reader import NonSeekingReader
from paho.mqtt.enums import CallbackAPIVersion

from companion.analysis.log import FlightLog
from companion.config.ground import topic_name
from companion.config.loader import FlightConfig, load_flight
from companion.ground import broker_setup
from companion.ground.commands import FlightClock, make_command
from companion.ground.keys import Operator, load_login, load_operators, new_key, operators_text, write_private
from companion.ground.messages import (
    RETAINED,
    Ack,
    CommandName,
    Events,
    Preflight,
    Presence,
    Scene,
    State,
    Stream,
    Topic,
    decode,
    encode,
    vehicle_of,
)
from companion.ground.schemas import schema_of
from companion.io.recorder import RecorderProcess, RecorderReport
from companion.types import Inputs, OperatorCommand, Outputs, SafetyAction, Sent, Severity
from tests.analysis.synthetic_flight import synthetic_flight
from tests.broker import Broker, free_port, loopback_broker
from tests.ground.test_broker import WANTED, Site, running
from tests.support import CATCH, DEADLINE_S, wait_until

M = TypeVar("M")
Row = tuple[Inputs, Outputs, Sent]
ROWS: list[Row] = list(synthetic_flight(end_s=21.0))
ANNA = new_key()
VEHICLE = "rig-7"


class Listener:
    """A ground station that keeps everything it hears."""

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
        self.clock = FlightClock()
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
                self.clock.heard(decode(Stream, bytes(message.payload)).t_s, time.monotonic())
            self._changed.notify_all()

    def of(self, topic: Topic) -> list[bytes]:
        """Everything that was heard on a topic."""
        with self._changed:
            return [payload for heard, payload, _ in self._heard if heard is topic]

    def forget(self, topic: Topic) -> None:
        """What was heard so far."""
        with self._changed:
            self._heard = [heard for heard in self._heard if heard[0] is not topic]

    def retained(self) -> dict[Topic, bytes]:
        """What the broker had kept."""
        with self._changed:
            return {topic: payload for topic, payload, retained in self._heard if retained}

    def wait(self, topic: Topic, cls: type[M], wanted: Callable[[M], bool] = lambda _: True) -> M:
        """The newest message, past or to come, that is wanted."""
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
        """With QoS 1, until the broker has it."""
        self._client.publish(topic, payload, qos=1, retain=retain).wait_for_publish(DEADLINE_S)


class Flight:
    """A recorder process and what a flight process says to it."""

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
        """Ticks up to a number, faster than in reality: none may be dropped for that."""
        for row in ROWS[self._next : until]:
            select.select([], [self.recorder.client], [], DEADLINE_S)
            self.recorder.client.record(*row)
        self._next = until

    def wait(self, condition: Callable[[], bool], why: str) -> None:
        """Tick on, some ticks each time, until it holds: the flight hears its recorder only while it ticks."""

        def tick() -> bool:
            self.fly(self._next + 1)
            assert self._next < len(ROWS), why
            return condition()

        wait_until(tick, lambda: f"{why}: {self.recorder.client.ground}")

    def begin(self, listener: Listener) -> None:
        """Tick until the ground sees it: from then on everything is told as it happens."""
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


@pytest.fixture
def broker(tmp_path: Path) -> Iterator[Broker]:
    with loopback_broker(tmp_path) as broker:
        yield broker


@contextlib.contextmanager
def flight_with(folder: Path, url: str | None, **settings: Any) -> Iterator[Flight]:
    flight = Flight(folder, url, **settings)
    try:
        yield flight
    finally:
        flight.recorder.process.send_signal(signal.SIGCONT)
        flight.finish()


def log_lines(path: Path) -> list[str]:
    """Messages of the `/log` channel so far, by the mcap library's own reader."""
    lines = []
    with path.open("rb") as file, contextlib.suppress(EndOfFile):
        for _, _, message in NonSeekingReader(file).iter_messages(topics=["/log"], log_time_order=False):
            lines.append(message.data.decode("utf-8", "replace"))
    return lines


def test_every_topic_follows_its_schema_and_is_there_for_those_who_come_late(tmp_path: Path, broker: Broker) -> None:
    with Listener(broker.port) as listener, flight_with(tmp_path, broker.url) as flight:
        client = flight.recorder.client
        client.metadata("preflight", {"json": json.dumps([{"id": "px4", "level": "ok", "text": "well"}])})
        client.metadata("plan", {"json": json.dumps([[0, 0, 0.3], [1.5, 0, 1]]), "mission_s": "21.5"})
        flight.begin(listener)
        state = listener.wait(Topic.STATE, State, lambda state: state.presence is Presence.FLYING and state.commands)
        flight.fly(600)
        client.text(2.9, Severity.WARNING, "px4", "Preflight Fail: ears are cold")
        client.ack(
            "0" * 32, "anna", OperatorCommand.HOLD, True, "holding", t_s=3.0, phase="catch", action=SafetyAction.HOLD
        )
        flight.fly(2000)
        listener.wait(Topic.STREAM, Stream, lambda stream: stream.t_s > 5.0)
        flight.fly(len(ROWS))
        report = flight.finish()
        listener.wait(Topic.STATE, State, lambda state: state.presence is Presence.ENDED)
        assert (report.samples, report.dropped, report.error) == (len(ROWS), 0, None)
        for topic in Topic:
            heard = listener.of(topic)
            assert heard or topic is Topic.COMMAND
            for payload in heard:
                jsonschema.Draft202012Validator(schema_of(topic)).validate(json.loads(payload))
        ack = listener.wait(Topic.ACK, Ack)
        assert (ack.session, ack.command, ack.accepted, ack.text) == (state.session, CommandName.HOLD, True, "holding")
        streams = [decode(Stream, payload) for payload in listener.of(Topic.STREAM)]
        assert [stream.seq for stream in streams] == sorted({stream.seq for stream in streams})
        assert {stream.session for stream in streams} == {state.session}
        assert streams[-1].t_s == pytest.approx(ROWS[-1][0].t_s, abs=1e-3)
    assert (state.vehicle, state.simulated, state.mission, state.law) == (VEHICLE, True, "catch", "adaptive")
    with Listener(broker.port) as late:
        ended = late.wait(Topic.STATE, State)
        assert (ended.presence, ended.outcome, ended.session) == (Presence.ENDED, "completed", state.session)
        assert not ended.commands
        late.wait(Topic.EVENTS, Events)
        scene, preflight = late.wait(Topic.SCENE, Scene), late.wait(Topic.PREFLIGHT, Preflight)
        assert (scene.path_world_m, scene.mission_s) == (((0.0, 0.0, 0.3), (1.5, 0.0, 1.0)), 21.5)
        assert [(row.id, row.level, row.text) for row in preflight.rows] == [("px4", "ok", "well")]
        events = late.wait(Topic.EVENTS, Events)
        assert set(late.retained()) == RETAINED
    told = [event.id for row in ROWS for event in row[1].events]
    assert sorted(line.id for line in events.lines) == sorted([*told, "px4"])
    assert events.count == len(told) + 1
    log = FlightLog.read(flight.path)
    assert len(log.inputs) == len(ROWS)
    assert log.metadata["recorder"]["session"] == state.session
    assert int(log.metadata["recorder"]["stream_sent"]) >= len(streams)
    lines = log_lines(flight.path)
    assert any("hold of anna: holding" in line for line in lines)
    assert any(f"connected to {broker.url}" in line for line in lines)


def test_a_killed_recorder_is_lost_by_the_brokers_word(tmp_path: Path, broker: Broker) -> None:
    with Listener(broker.port) as listener, flight_with(tmp_path, broker.url) as flight:
        flight.begin(listener)
        flying = listener.wait(Topic.STATE, State, lambda state: state.presence is Presence.FLYING)
        flight.recorder.process.kill()
        lost = listener.wait(Topic.STATE, State, lambda state: state.presence is Presence.LOST)
        assert (lost.session, lost.wall_s, lost.commands) == (flying.session, 0.0, False)
    with Listener(broker.port) as late:
        assert late.wait(Topic.STATE, State).presence is Presence.LOST


def test_a_flight_process_that_dies_is_silent_first_and_lost_with_its_channel(tmp_path: Path, broker: Broker) -> None:
    with Listener(broker.port) as listener, flight_with(tmp_path, broker.url) as flight:
        flight.begin(listener)
        flight.fly(200)
        listener.wait(Topic.STATE, State, lambda state: state.presence is Presence.FLYING)
        silent = listener.wait(Topic.STATE, State, lambda state: state.presence is Presence.SILENT)
        assert silent.text is not None and "guardian" in silent.text
        flight.fly(400)
        back = len(listener.of(Topic.STATE))
        wait_until(
            lambda: any(
                decode(State, payload).presence is Presence.FLYING for payload in listener.of(Topic.STATE)[back - 1 :]
            ),
            lambda: "the flight is not seen to go on",
        )
        os.close(os.dup(flight.recorder.client.fileno()))
        flight.recorder.client._socket.close()  # as the kernel does for a process that is gone
        lost = listener.wait(Topic.STATE, State, lambda state: state.presence is Presence.LOST)
        assert lost.wall_s > 0.0 and lost.text is not None and "without a word" in lost.text
        flight.recorder.process.wait(DEADLINE_S)
    assert len(FlightLog.read(flight.path).inputs) == 400


def test_a_broker_that_dies_and_comes_back_costs_no_sample_and_is_told_everything_again(
    tmp_path: Path, broker: Broker
) -> None:
    with flight_with(tmp_path, broker.url) as flight:
        with Listener(broker.port) as listener:
            flight.begin(listener)
            flight.fly(700)
            listener.wait(Topic.EVENTS, Events, lambda events: events.count == 1)
            broker.kill()
        flight.wait(lambda: "no broker" in (flight.recorder.client.ground or ""), "the flight is not told of the loss")
        flight.fly(3000)
        broker.start()
        with Listener(broker.port) as listener:
            events = listener.wait(Topic.EVENTS, Events, lambda events: events.count >= 3)
            assert [line.id for line in events.lines] == ["phase_takeoff", "phase_flight", "catch"]
            state = listener.wait(Topic.STATE, State, lambda state: state.commands)
            listener.forget(Topic.STREAM)
            flight.begin(listener)
            assert listener.wait(Topic.SCENE, Scene).session == state.session
            flight.fly(3600)
            listener.wait(Topic.STREAM, Stream, lambda stream: stream.t_s > 17.0)
            flight.wait(
                lambda: (flight.recorder.client.ground or "").startswith("connected"),
                "the flight is not told of the return",
            )
            flight.fly(len(ROWS))
            report = flight.finish()
            listener.wait(Topic.STATE, State, lambda state: state.presence is Presence.ENDED)
    assert (report.samples, report.dropped, report.error) == (len(ROWS), 0, None)
    log = FlightLog.read(flight.path)
    assert len(log.inputs) == len(ROWS)
    assert int(log.metadata["recorder"]["broker_connections"]) == 2
    told = [line for line in log_lines(flight.path) if "broker at" in line or "connected to" in line]
    assert len(told) == 3, told


def test_a_broker_that_takes_nothing_costs_no_sample_and_holds_nobody(tmp_path: Path, broker: Broker) -> None:
    with Listener(broker.port) as listener, flight_with(tmp_path, broker.url) as flight:
        flight.begin(listener)
        broker.signal(signal.SIGSTOP)
        flight.fly(len(ROWS))
        report = flight.finish()
        broker.signal(signal.SIGCONT)
        assert (report.samples, report.dropped, report.error) == (len(ROWS), 0, None)
        # It could not be told of the end in time: then the last word is the will's, or the end if it took that after all.
        listener.wait(Topic.STATE, State, lambda state: state.presence in (Presence.LOST, Presence.ENDED))
    assert len(FlightLog.read(flight.path).inputs) == len(ROWS)


def test_no_broker_at_all_is_told_once_and_costs_no_sample(tmp_path: Path) -> None:
    url = f"mqtt://127.0.0.1:{free_port()}"
    with flight_with(tmp_path, url) as flight:
        flight.wait(lambda: flight.recorder.client.ground is not None, "the flight is not told")
        assert flight.recorder.client.ground == f"no broker at {url}, trying: Connection refused"
        flight.fly(len(ROWS))
        report = flight.finish()
    assert (report.samples, report.dropped, report.error) == (len(ROWS), 0, None)
    assert sum("no broker" in line for line in log_lines(flight.path)) == 1


def command(listener: Listener, name: CommandName, session: str, key: bytes = ANNA, vehicle: str = VEHICLE) -> bytes:
    now_ms = listener.clock.now_ms(time.monotonic())
    assert now_ms is not None
    return encode(make_command(name, vehicle, session, "anna", key, now_ms))


def test_a_signed_command_reaches_the_flight_and_its_answer_comes_back(tmp_path: Path, broker: Broker) -> None:
    topic = Topic.COMMAND.of(VEHICLE)
    with Listener(broker.port) as listener, flight_with(tmp_path, broker.url) as flight:
        flight.begin(listener)
        state = listener.wait(Topic.STATE, State, lambda state: state.commands)
        client, heard = flight.recorder.client, []
        listener.publish(topic, command(listener, CommandName.LAND, state.session, key=new_key()))
        listener.publish(topic, command(listener, CommandName.LAND, "another"))
        genuine = command(listener, CommandName.HOLD, state.session)
        listener.publish(topic, genuine)
        listener.publish(topic, genuine)

        def came() -> bool:
            heard.extend(client.take_commands())
            return bool(heard)

        flight.wait(came, "the command does not come")
        asked = heard[0]
        assert (asked.command, asked.operator, asked.nonce) == (
            OperatorCommand.HOLD, "anna", json.loads(genuine)["nonce"],
        )  # fmt: skip
        client.ack(
            asked.nonce, asked.operator, asked.command, True, "holding", t_s=5.0, phase="x", action=SafetyAction.HOLD
        )
        flight.fly(2000)
        answer = listener.wait(Topic.ACK, Ack, lambda ack: ack.accepted)
        assert (answer.nonce, answer.text, answer.session) == (asked.nonce, "holding", state.session)
        refused = listener.wait(Topic.ACK, Ack, lambda ack: not ack.accepted)
        assert refused.command is CommandName.LAND and "another flight" in refused.text
        events = listener.wait(
            Topic.EVENTS, Events, lambda events: any(line.id == "command_refused_replayed" for line in events.lines)
        )
        told = {line.id: line.text for line in events.lines}
        assert "not signed with the key of anna" in told["command_refused_bad_signature"]
        assert "another flight" in told["command_refused_wrong_session"]
        flight.fly(len(ROWS))
        assert client.take_commands() == []
        assert len(listener.of(Topic.ACK)) == 2
        assert flight.finish().error is None
    metadata = FlightLog.read(flight.path).metadata["recorder"]
    assert (metadata["commands"], metadata["commands_refused"]) == ("1", "3")


def garbage(seed: int, count: int, session: str) -> Iterator[bytes]:
    chance = random.Random(seed)
    like = json.loads(encode(make_command(CommandName.LAND, VEHICLE, session, "anna", new_key(), 5000)))
    for k in range(count):
        match k % 5:
            case 0:
                yield chance.randbytes(chance.randrange(200))
            case 1:
                yield b"[" * chance.randrange(1, 1000)
            case 2:
                yield json.dumps({**like, "nonce": f"{chance.getrandbits(128):032x}"}).encode()
            case 3:
                yield json.dumps({**like, chance.choice(list(like)): chance.choice([None, 0, "x", [], 1e300])}).encode()
            case _:
                yield b"x" * chance.choice([1025, 20_000])


def test_a_flood_of_rubbish_passes_nothing_costs_no_sample_and_does_not_drown_the_log(
    tmp_path: Path, broker: Broker
) -> None:
    topic, count = Topic.COMMAND.of(VEHICLE), 5000
    with (
        Listener(broker.port, f"companion/{VEHICLE}/state") as states,
        Listener(broker.port, f"companion/{VEHICLE}/stream") as listener,
        flight_with(tmp_path, broker.url) as flight,
    ):
        flight.begin(listener)
        session = states.wait(Topic.STATE, State, lambda state: state.commands).session
        noise = mqtt.Client(CallbackAPIVersion.VERSION2, protocol=mqtt.MQTTv5)
        noise.connect("127.0.0.1", broker.port)
        noise.loop_start()
        began_s = time.monotonic()
        for k, payload in enumerate(garbage(4, count, session)):
            sent = noise.publish(topic, payload, qos=1)
            if k % 100 == 99:
                sent.wait_for_publish(DEADLINE_S)
                flight.fly(400 + 60 * (k + 1) // 100)
        noise.disconnect()
        noise.loop_stop()
        client, heard = flight.recorder.client, []
        assert client.take_commands() == []

        def came() -> bool:
            # The broker drops what it cannot deliver in time, a genuine command too: people press again.
            listener.publish(topic, command(listener, CommandName.HOLD, session))
            heard.extend(client.take_commands())
            return bool(heard)

        flight.wait(came, "nobody commands any more")
        took_s = time.monotonic() - began_s
        flight.fly(len(ROWS))
        report = flight.finish()
    assert {asked.command for asked in heard} == {OperatorCommand.HOLD}
    assert (report.samples, report.dropped, report.error) == (len(ROWS), 0, None)
    log = FlightLog.read(flight.path)
    assert len(log.inputs) == len(ROWS)
    refused = int(log.metadata["recorder"]["commands_refused"])
    assert 500 < refused <= count
    lines = [line for line in log_lines(flight.path) if "refused" in line]
    reasons = {"oversized", "malformed", "wrong_version", "wrong_vehicle", "unknown_operator", "bad_signature"}
    assert any(f"{reason}:" in line for reason in reasons for line in lines)
    assert len(lines) <= (took_s + 3.0) * (len(reasons) + 2)


def test_a_command_that_the_broker_kept_is_refused(tmp_path: Path, broker: Broker) -> None:
    with Listener(broker.port) as listener:
        listener.publish(Topic.COMMAND.of(VEHICLE), b'{"v":1}', retain=True)
        with flight_with(tmp_path, broker.url) as flight:
            flight.fly(100)
            listener.wait(Topic.STATE, State, lambda state: state.commands)
            listener.wait(
                Topic.EVENTS, Events, lambda e: any("refused a command: retained" in line.text or "refused a command: early"
                                                    in line.text for line in e.lines)
            )  # fmt: skip


@pytest.mark.parametrize(
    ("settings", "text"),
    [
        ({"commands": False}, "switched off in the vehicle file"),
        ({"operators_file": "/nowhere/operators.yaml"}, "/nowhere/operators.yaml: no such file"),
    ],
)
def test_a_vehicle_that_hears_no_commands_says_why(
    tmp_path: Path, broker: Broker, settings: dict[str, object], text: str
) -> None:
    with Listener(broker.port) as listener, flight_with(tmp_path, broker.url, **settings) as flight:
        flight.begin(listener)
        state = listener.wait(Topic.STATE, State, lambda state: state.presence is Presence.FLYING)
        assert not state.commands and state.text is not None and text in state.text
        listener.publish(Topic.COMMAND.of(VEHICLE), b"{}")
        flight.fly(400)
        flight.finish()
        assert FlightLog.read(flight.path).metadata["recorder"]["commands_refused"] == "0"
    assert any(text in line for line in log_lines(flight.path))


def own_address() -> str:
    """An address of this computer that is none of the vehicle file's loopback names; nothing is sent."""
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as probe:
        try:
            probe.connect(("192.0.2.1", 9))  # TEST-NET-1: for documentation only
        except OSError:
            pytest.skip("this computer has no address but loopback")
        address: str = probe.getsockname()[0]
    return address


def test_no_command_is_heard_over_a_plain_way_to_another_computer(tmp_path: Path) -> None:
    address = own_address()
    url = f"mqtt://{address}:{free_port()}"  # nobody listens there: what is refused is refused before any connection
    with flight_with(tmp_path, url) as flight:
        flight.wait(lambda: flight.recorder.client.ground is not None, "the flight is not told")
        flight.finish()
    assert any("commands are not heard over a plain connection" in line for line in log_lines(flight.path))


@pytest.mark.parametrize("fault", ["open to others", "absent", "no yaml"])
def test_a_login_that_cannot_be_used_is_told_in_one_line_and_the_log_is_written(
    tmp_path: Path, broker: Broker, fault: str
) -> None:
    login = tmp_path / "login.yaml"
    if fault != "absent":
        login.write_text("username: x\npassword: y\n" if fault == "open to others" else "{[", encoding="utf-8")
        login.chmod(0o644 if fault == "open to others" else 0o600)
    with flight_with(tmp_path, broker.url, login_file=str(login)) as flight:
        flight.wait(lambda: flight.recorder.client.ground is not None, "the flight is not told")
        told = flight.recorder.client.ground or ""
        assert told.startswith("no telemetry: ") and str(login) in told and "\n" not in told
        assert ("chmod 600" in told) == (fault == "open to others")
        flight.fly(600)
        assert flight.finish().samples == 600
    assert any("no telemetry" in line for line in log_lines(flight.path))


ACL = """listener {port} 127.0.0.1
allow_anonymous true
acl_file {acl}
user {user}
log_dest stderr
"""


def test_a_broker_that_does_not_let_the_vehicle_speak_is_told(tmp_path: Path) -> None:
    acl, config, port = tmp_path / "acl", tmp_path / "mosquitto.conf", free_port()
    acl.write_text(f"topic write companion/{VEHICLE}/stream\n", encoding="utf-8")
    acl.chmod(0o600)
    config.write_text(ACL.format(port=port, acl=acl, user=getpass.getuser()), encoding="utf-8")
    broker = Broker(tmp_path, config, port)
    broker.start()
    try:
        with flight_with(tmp_path, broker.url) as flight:
            text = "does not let this vehicle say its state: Not authorized"
            flight.wait(lambda: any(text in line for line in log_lines(flight.path)), "the log is not told")
            assert "does not let this vehicle say its" in (flight.recorder.client.ground or "")
    finally:
        broker.stop()


@pytest.fixture(scope="module")
def site(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Site]:
    """A broker with TLS, logins and ACLs, as `companion broker init` makes it."""
    folder = tmp_path_factory.mktemp("site") / "broker"
    broker_setup.make(folder, WANTED, datetime.datetime.now(datetime.UTC))
    with running(folder, tmp_path_factory.mktemp("run")) as made:
        yield made


def secure(site: Site, **but: str) -> dict[str, str]:
    """What the vehicle file of `tarot` says of that broker."""
    mine = site.folder / "vehicles/tarot"
    files = {
        "login_file": mine / "login.yaml",
        "ca_file": site.folder / "ca.pem",
        "operators_file": mine / "operators.yaml",
    }
    return {"vehicle": "tarot", **{key: str(path) for key, path in files.items()}, **but}


def test_over_tls_with_its_login_a_vehicle_is_seen_and_commanded(tmp_path: Path, site: Site) -> None:
    anna = site.folder / "operators/anna"
    key = load_operators(anna / "operators.yaml").key("anna")
    with (
        Listener(site.plain_port, "companion/tarot/+", anna / "login.yaml") as listener,
        flight_with(tmp_path, f"mqtts://localhost:{site.tls_port}", **secure(site)) as flight,
    ):
        flight.begin(listener)
        state = listener.wait(Topic.STATE, State, lambda state: state.commands)
        payload = command(listener, CommandName.LAND, state.session, key, "tarot")
        listener.publish(Topic.COMMAND.of("tarot"), payload)
        client, heard = flight.recorder.client, []

        def came() -> bool:
            heard.extend(client.take_commands())
            return bool(heard)

        flight.wait(came, "the command does not come")
        assert (heard[0].command, heard[0].operator) == (OperatorCommand.LAND, "anna")
        flight.fly(2000)
        assert flight.finish().samples == 2000
        listener.wait(Topic.STATE, State, lambda state: state.presence is Presence.ENDED)


@pytest.mark.parametrize(
    ("fault", "told"),
    [
        ("wrong password", "Not authorized"),
        ("no login", "Not authorized"),
        ("another authority", "certificate verify failed"),
        ("no certificate", "is no certificate in PEM form"),
        ("a viewer's login", "does not let this vehicle say its state: Not authorized"),
        ("plain to the TLS port", "no broker at"),
    ],
)
def test_what_is_wrong_with_login_or_certificate_is_told_and_the_log_is_written(
    tmp_path: Path, site: Site, fault: str, told: str
) -> None:
    settings: dict[str, Any] = secure(site)
    url = f"mqtts://localhost:{site.tls_port}"
    match fault:
        case "wrong password":
            write_private(tmp_path / "login.yaml", b"username: tarot\npassword: guessed\n")
            settings["login_file"] = str(tmp_path / "login.yaml")
        case "no login":
            settings["login_file"] = None
        case "another authority":
            settings["ca_file"] = None
        case "no certificate":
            settings["ca_file"] = settings["login_file"]
        case "a viewer's login":
            settings["login_file"] = str(site.folder / "viewers/wall/login.yaml")
        case _:
            url = f"mqtt://localhost:{site.tls_port}"
    with flight_with(tmp_path, url, **settings) as flight:
        flight.wait(lambda: told in (flight.recorder.client.ground or ""), "the flight is not told")
        assert "\n" not in (flight.recorder.client.ground or "")
        flight.fly(1500)
        assert flight.finish().samples == 1500


NO_BROKER = """
import sys
from companion import recorder_process
code = recorder_process.main(sys.argv[1:])
loaded = [name for name in ("aiomqtt", "asyncio", "pydantic") if name in sys.modules]
sys.exit(f"loaded: {loaded}" if loaded else code)
"""


def test_without_a_broker_in_the_vehicle_file_nothing_of_it_is_loaded(tmp_path: Path) -> None:
    config = tmp_path / "config.json"
    config.write_text(config_of(tmp_path, None).model_dump_json(), encoding="utf-8")
    ours, theirs = socket.socketpair(socket.AF_UNIX, socket.SOCK_SEQPACKET)
    with ours, theirs:
        ours.shutdown(socket.SHUT_WR)
        done = subprocess.run(
            [
                *(sys.executable, "-c", NO_BROKER, "--fd", str(theirs.fileno()), "--out", str(tmp_path / "x.mcap")),
                *("--config", str(config), "--epoch-offset-ns", "0"),
            ],
            pass_fds=(theirs.fileno(),),
            capture_output=True,
            text=True,
            timeout=DEADLINE_S,
        )
    assert (done.returncode, done.stderr) == (0, "")


def test_the_topic_is_the_vehicles_name_where_the_file_names_none() -> None:
    config = load_flight(CATCH)
    assert topic_name(config.vehicle.ground.topic, config.vehicle.name) == config.vehicle.name
