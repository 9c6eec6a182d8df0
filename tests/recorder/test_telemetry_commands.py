"""Access to the vehicle: commands, logins, certificates and ACLs with the real recorder and a real mosquitto."""

from __future__ import annotations

import datetime
import getpass
import json
import random
import resource
import socket
import subprocess
import sys
import time
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import paho.mqtt.client as mqtt
import pytest
from paho.mqtt.enums import CallbackAPIVersion

from companion.analysis.log import FlightLog
from companion.config.ground import topic_name
from companion.config.loader import load_flight
from companion.ground.broker import setup as broker_setup
from companion.ground.protocol.commands import make_command
from companion.ground.protocol.keys import load_operators, new_key, write_private
from companion.ground.protocol.messages import Ack, Events, Presence, State, Topic
from companion.model.codec import to_json
from companion.model.types import GroundCommand, OperatorCommand
from tests.broker import Broker, loopback_broker
from tests.ground.test_broker import WANTED, Site, running
from tests.recorder.telemetry_rig import VEHICLE, Listener, command, config_of, flight_with, log_lines, rows
from tests.support import CATCH, DEADLINE_S, free_port


@pytest.fixture
def broker(tmp_path: Path) -> Iterator[Broker]:
    with loopback_broker(tmp_path) as broker:
        yield broker


def test_a_signed_command_reaches_the_flight_and_its_answer_comes_back(tmp_path: Path, broker: Broker) -> None:
    topic = Topic.COMMAND.of(VEHICLE)
    with Listener(broker.port) as listener, flight_with(tmp_path, broker.url) as flight:
        flight.begin(listener)
        state = listener.wait(Topic.STATE, State, lambda state: state.commands)
        client, heard = flight.recorder.client, []
        listener.publish(topic, command(listener, OperatorCommand.LAND, state.session, key=new_key()))
        listener.publish(topic, command(listener, OperatorCommand.LAND, "another"))
        genuine = command(listener, OperatorCommand.HOLD, state.session)
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
        client.ack(asked, True, "holding", rows()[1000][1])
        flight.fly(2000)
        answer = listener.wait(Topic.ACK, Ack, lambda ack: ack.accepted)
        assert (answer.nonce, answer.text, answer.session) == (asked.nonce, "holding", state.session)
        refused = listener.wait(Topic.ACK, Ack, lambda ack: not ack.accepted)
        assert refused.command is OperatorCommand.LAND and "another flight" in refused.text
        events = listener.wait(
            Topic.EVENTS, Events, lambda events: any(line.id == "command_refused_replayed" for line in events.lines)
        )
        reported = {line.id: line.text for line in events.lines}
        assert "not signed with the key of anna" in reported["command_refused_bad_signature"]
        assert "another flight" in reported["command_refused_wrong_session"]
        flight.fly(2400)
        assert client.take_commands() == []
        assert len(listener.of(Topic.ACK)) == 2
        assert flight.finish().error is None
    metadata = FlightLog.read(flight.path).metadata["recorder"]
    assert (metadata["commands"], metadata["commands_refused"]) == ("1", "3")


def garbage(seed: int, count: int, session: str) -> Iterator[bytes]:
    chance = random.Random(seed)
    like = json.loads(to_json(make_command(OperatorCommand.LAND, VEHICLE, session, "anna", new_key(), 5000)))
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
    topic, count = Topic.COMMAND.of(VEHICLE), 2000
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
            listener.publish(topic, command(listener, OperatorCommand.HOLD, session))
            heard.extend(client.take_commands())
            return bool(heard)

        flight.wait(came, "no ground station commands any more")
        took_s = time.monotonic() - began_s
        flight.fly(3000)
        report = flight.finish()
    assert {asked.command for asked in heard} == {OperatorCommand.HOLD}
    assert (report.samples, report.dropped, report.error) == (3000, 0, None)
    log = FlightLog.read(flight.path)
    assert len(log.inputs) == 3000
    refused = int(log.metadata["recorder"]["commands_refused"])
    assert 0 < refused <= count
    lines = [line for line in log_lines(flight.path) if "refused" in line]
    reasons = {"oversized", "malformed", "wrong_version", "wrong_vehicle", "unknown_operator", "bad_signature"}
    assert any(f"{reason}:" in line for reason in reasons for line in lines)
    assert len(lines) <= (took_s + 3.0) * (len(reasons) + 2)


def test_a_full_disk_costs_the_log_and_neither_a_command_nor_its_answer(tmp_path: Path, broker: Broker) -> None:
    with Listener(broker.port) as listener, flight_with(tmp_path, broker.url) as flight:
        flight.begin(listener)
        session = listener.wait(Topic.STATE, State, lambda state: state.commands).session
        client, heard = flight.recorder.client, list[GroundCommand]()
        size = flight.path.stat().st_size
        resource.prlimit(flight.recorder.process.pid, resource.RLIMIT_FSIZE, (size, size))
        flight.wait(lambda: client.error is not None, "the flight does not report that the disk is full")
        listener.publish(Topic.COMMAND.of(VEHICLE), command(listener, OperatorCommand.LAND, session))

        def came() -> bool:
            heard.extend(client.take_commands())
            return bool(heard)

        flight.wait(came, "the command does not come")
        assert [asked.command for asked in heard] == [OperatorCommand.LAND]
        client.ack(heard[0], True, "landing", rows()[1000][1])
        assert listener.wait(Topic.ACK, Ack).text == "landing"


def test_a_command_that_the_broker_kept_is_refused(tmp_path: Path, broker: Broker) -> None:
    with Listener(broker.port) as listener:
        kept = make_command(OperatorCommand.LAND, VEHICLE, "before", "anna", bytes(32), 0)
        listener.publish(Topic.COMMAND.of(VEHICLE), to_json(kept), retain=True)
        with flight_with(tmp_path, broker.url) as flight:
            flight.fly(100)
            listener.wait(Topic.STATE, State, lambda state: state.commands)
            listener.wait(
                Topic.EVENTS, Events, lambda e: any("refused a command: bad_signature" in line.text for line in e.lines)
            )  # fmt: skip


@pytest.mark.parametrize(
    ("settings", "text"),
    [
        ({"commands": False}, "disabled in the vehicle file"),
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
    """Return an address of this computer other than loopback; nothing is sent."""
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as probe:
        try:
            probe.connect(("192.0.2.1", 9))  # TEST-NET-1: for documentation only
        except OSError:
            pytest.skip("this computer has no address but loopback")
        address: str = probe.getsockname()[0]
    return address


def test_no_command_is_heard_over_a_plain_way_to_another_computer(tmp_path: Path) -> None:
    address = own_address()
    url = f"mqtt://{address}:{free_port()}"  # there is no listener: what is refused is refused before any connection
    with flight_with(tmp_path, url) as flight:
        flight.wait(lambda: flight.recorder.client.telemetry_status is not None, "the flight reports nothing")
        flight.finish()
    assert any("commands are not accepted over an unencrypted connection" in line for line in log_lines(flight.path))


def test_a_login_that_cannot_be_used_is_reported_in_one_line_and_the_log_is_written(
    tmp_path: Path, broker: Broker
) -> None:
    login = tmp_path / "login.yaml"
    login.write_text("username: x\npassword: y\n", encoding="utf-8")
    login.chmod(0o644)
    with flight_with(tmp_path, broker.url, login_file=str(login)) as flight:
        flight.wait(lambda: flight.recorder.client.telemetry_status is not None, "the flight reports nothing")
        reported = flight.recorder.client.telemetry_status or ""
        assert reported.startswith("no telemetry: ") and str(login) in reported and "\n" not in reported
        assert "chmod 600" in reported
        flight.fly(600)
        assert flight.finish().samples == 600
    assert any("no telemetry" in line for line in log_lines(flight.path))


ACL = """listener {port} 127.0.0.1
allow_anonymous true
acl_file {acl}
user {user}
log_dest stderr
"""


def test_a_broker_that_does_not_let_the_vehicle_speak_is_reported(tmp_path: Path) -> None:
    acl, config, port = tmp_path / "acl", tmp_path / "mosquitto.conf", free_port()
    acl.write_text(f"topic write companion/{VEHICLE}/stream\n", encoding="utf-8")
    acl.chmod(0o600)
    config.write_text(ACL.format(port=port, acl=acl, user=getpass.getuser()), encoding="utf-8")
    broker = Broker(tmp_path, config, port)
    broker.start()
    try:
        with flight_with(tmp_path, broker.url) as flight:
            text = "does not let this vehicle publish its state: Not authorized"
            flight.wait(lambda: any(text in line for line in log_lines(flight.path)), "the log has no line of it")
            text = "does not let this vehicle publish its"
            flight.wait(
                lambda: text in (flight.recorder.client.telemetry_status or ""), "the flight has no notice of it"
            )
    finally:
        broker.stop()


@pytest.fixture(scope="module")
def site(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Site]:
    """A broker with TLS, logins and ACLs, as `companion broker init` makes it."""
    folder = tmp_path_factory.mktemp("site") / "broker"
    broker_setup.create(folder, WANTED, datetime.datetime.now(datetime.UTC))
    with running(folder, tmp_path_factory.mktemp("run")) as made:
        yield made


def secure(site: Site, **but: str) -> dict[str, str]:
    """Return the settings of the vehicle `tarot` for that broker."""
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
        payload = command(listener, OperatorCommand.LAND, state.session, key, "tarot")
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
    ("fault", "reported"),
    [
        ("wrong password", "Not authorized"),
        ("another authority", "certificate verify failed"),
        ("no certificate", "not a certificate in PEM form"),
        ("a viewer's login", "does not let this vehicle publish its state: Not authorized"),
    ],
)
def test_what_is_wrong_with_login_or_certificate_is_reported_and_the_log_is_written(
    tmp_path: Path, site: Site, fault: str, reported: str
) -> None:
    settings: dict[str, Any] = secure(site)
    match fault:
        case "wrong password":
            write_private(tmp_path / "login.yaml", b"username: tarot\npassword: guessed\n")
            settings["login_file"] = str(tmp_path / "login.yaml")
        case "another authority":
            settings["ca_file"] = None
        case "no certificate":
            settings["ca_file"] = settings["login_file"]
        case _:
            settings["login_file"] = str(site.folder / "viewers/wall/login.yaml")
    with flight_with(tmp_path, f"mqtts://localhost:{site.tls_port}", **settings) as flight:
        flight.wait(lambda: reported in (flight.recorder.client.telemetry_status or ""), "the flight reports nothing")
        assert "\n" not in (flight.recorder.client.telemetry_status or "")
        flight.fly(1500)
        assert flight.finish().samples == 1500


NO_BROKER = """
import sys
from companion.recorder import main as recorder_process
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
