"""The security table: a real mosquitto with the files of `companion broker init`, and clients that must be refused."""

from __future__ import annotations

import datetime
import os
import queue
import re
import secrets
import shutil
import socket
import ssl
import time
from collections.abc import Iterator
from contextlib import closing, contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Self

import paho.mqtt.client as mqtt
import pytest
from paho.mqtt.enums import CallbackAPIVersion
from paho.mqtt.packettypes import PacketTypes
from paho.mqtt.properties import Properties

from companion.ground.broker import setup as broker_setup
from companion.ground.protocol.commands import Accepted, Reason, Refused, Verifier, make_command
from companion.ground.protocol.keys import load_login, load_operators
from companion.ground.protocol.messages import Command, Topic
from companion.model.codec import to_json
from companion.model.types import OperatorCommand
from tests.broker import LOOPBACK, Broker, loopback_broker
from tests.support import DEADLINE_S, ROOT, free_port
from tools.docs.mosquitto import example_files

NOT_AUTHORISED = 135
TOO_LARGE = 149
WANTED = broker_setup.BrokerUsers(
    hosts=("gcs.lab", "192.0.2.7"), operators=("anna", "bert"), viewers=("wall",), vehicles=("tarot", "second"), days=30
)
COMMAND = Topic.COMMAND.of("tarot")
ACK = Topic.ACK.of("tarot")


@dataclass(frozen=True)
class Site:
    """A running broker and the folder that it was made from."""

    folder: Path
    broker: Broker
    plain_port: int
    tls_port: int


def for_tests(text: str, plain_port: int, tls_port: int) -> str:
    """Return a profile on other loopback ports; a broker that root starts stays root, so that it can read the test's files."""
    assert "listener 8883\n" in text
    assert "listener 1883 127.0.0.1\n" in text
    text = text.replace("listener 8883\n", f"listener {tls_port} 127.0.0.1\n")
    text = text.replace("listener 1883 127.0.0.1\n", f"listener {plain_port} 127.0.0.1\n")
    return text if os.geteuid() else f"user root\n{text}"


@contextmanager
def running(folder: Path, logs: Path) -> Iterator[Site]:
    plain_port, tls_port = free_port(), free_port()
    config = logs / "mosquitto.conf"
    config.write_text(for_tests((folder / "mosquitto.conf").read_text(), plain_port, tls_port))
    broker = Broker(logs, config, plain_port)
    broker.start()
    try:
        yield Site(folder, broker, plain_port, tls_port)
    finally:
        broker.stop()


@pytest.fixture(scope="module")
def site(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Site]:
    folder = tmp_path_factory.mktemp("a site") / "broker"
    broker_setup.create(folder, WANTED, datetime.datetime.now(datetime.UTC))
    with running(folder, tmp_path_factory.mktemp("run")) as made:
        yield made


class Peer:
    """A client of the broker with blocking calls."""

    def __init__(
        self, port: int, login: Path | None = None, *, password: str | None = None, tls: ssl.SSLContext | None = None
    ) -> None:
        self._answers: queue.SimpleQueue[tuple[str, int, Any]] = queue.SimpleQueue()
        self._messages: queue.SimpleQueue[tuple[str, bytes, bool]] = queue.SimpleQueue()
        self.id = f"peer-{secrets.token_hex(6)}"
        self._port = port
        self._client = client = mqtt.Client(CallbackAPIVersion.VERSION2, client_id=self.id, protocol=mqtt.MQTTv5)
        if login is not None:
            known = load_login(login)
            client.username_pw_set(known.username, password or known.password)
        if tls is not None:
            client.tls_set_context(tls)
        client.on_connect = lambda c, u, flags, code, properties: self._answers.put(("connect", 0, code.value))
        client.on_subscribe = lambda c, u, mid, codes, properties: self._answers.put(("subscribe", mid, codes[0].value))
        client.on_publish = lambda c, u, mid, code, properties: self._answers.put(("publish", mid, code.value))
        client.on_disconnect = lambda c, u, flags, code, properties: self._answers.put(("disconnect", 0, code.value))
        client.on_message = lambda c, u, m: self._messages.put((m.topic, bytes(m.payload), m.retain))

    def __enter__(self) -> Self:
        assert self.connect() == 0
        return self

    def __exit__(self, *_: object) -> None:
        self._client.disconnect()
        self._client.loop_stop()

    def connect(self, host: str = "127.0.0.1") -> int:
        """Connect and return the broker's reason code; a refusal ends the connection."""
        self._client.connect(host, self._port, keepalive=30)
        self._client.loop_start()
        code = self._answer("connect", 0)
        if code:
            self._client.loop_stop()
        return code

    def will(self, topic: str, payload: bytes) -> None:
        self._client.will_set(topic, payload, qos=1)

    def subscribe(self, topic: str) -> int:
        _, mid = self._client.subscribe(topic, qos=1)
        return self._answer("subscribe", mid or 0)

    def publish(self, topic: str, payload: bytes, *, qos: int = 1, retain: bool = False) -> int:
        info = self._client.publish(topic, payload, qos=qos, retain=retain)
        return self._answer("publish", info.mid)

    def break_off(self) -> None:
        """Close the socket without DISCONNECT, so that the broker publishes the will."""
        connected = self._client.socket()
        assert isinstance(connected, socket.socket)
        connected.shutdown(socket.SHUT_RDWR)
        self.ended()
        self._client.loop_stop()

    def ended(self) -> int:
        return self._answer("disconnect", 0)

    def hear(self) -> tuple[str, bytes, bool]:
        """Return the next message: (topic, payload, retained)."""
        return self._messages.get(timeout=DEADLINE_S)

    def _answer(self, kind: str, mid: int) -> int:
        while True:
            found, number, code = self._answers.get(timeout=DEADLINE_S)
            assert found != "disconnect" or kind == "disconnect", f"{kind}: the broker hung up: {code}"
            if (found, number) == (kind, mid):
                return int(code)


def peer(site: Site, room: str, **settings: Any) -> Peer:
    """Connect with the login of a folder, over the listener without TLS."""
    return Peer(site.plain_port, site.folder / room / "login.yaml", **settings)


def logged(broker: Broker, pattern: str, after: int = 0) -> None:
    """Wait until the broker's log has a matching line after a given length."""
    deadline_s = time.monotonic() + DEADLINE_S
    while re.search(pattern, broker.log[after:]) is None:
        assert time.monotonic() < deadline_s, f"{pattern}\n{broker.log}"
        time.sleep(0.01)


def denied(client: Peer, topic: str) -> str:
    return rf"Denied PUBLISH from {client.id} \(d\d, q\d, r\d, m\d+, '{re.escape(topic)}'"


def trusting(ca: Path) -> ssl.SSLContext:
    return ssl.create_default_context(cafile=str(ca))


# --- who gets in --------------------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("how", ["anonymous", "anonymous over TLS", "wrong password"])
def test_a_missing_or_wrong_login_is_refused_and_logged(site: Site, how: str) -> None:
    before = len(site.broker.log)
    client = {
        "anonymous": lambda: Peer(site.plain_port),
        "anonymous over TLS": lambda: Peer(site.tls_port, tls=trusting(site.folder / "ca.pem")),
        "wrong password": lambda: peer(site, "operators/anna", password="guess"),
    }[how]()
    assert client.connect() == NOT_AUTHORISED
    logged(site.broker, "Client <unknown> disconnected, not authorised", before)


def test_every_login_gets_in_over_tls_and_over_loopback(site: Site) -> None:
    for room in ("vehicles/tarot", "vehicles/second", "operators/anna", "operators/bert", "viewers/wall"):
        login, ca = site.folder / room / "login.yaml", site.folder / room / "ca.pem"
        with Peer(site.plain_port, login), Peer(site.tls_port, login, tls=trusting(ca)):
            pass
    logged(site.broker, r"as peer-\w+ \(p5, c1, k30, u'wall'\)")


def test_tls_refuses_a_broker_of_another_authority(site: Site, tmp_path: Path) -> None:
    broker_setup.create(tmp_path / "other", WANTED, datetime.datetime.now(datetime.UTC))
    before = len(site.broker.log)
    assert "certificate verify failed" in tls_problem(site, trusting(tmp_path / "other/ca.pem"), "127.0.0.1")
    logged(site.broker, "SSL routines::.*alert", before)


def tls_problem(site: Site, context: ssl.SSLContext, name: str) -> str:
    """Make a TLS handshake with the broker under a host name; return the error, or the TLS version."""
    with socket.create_connection(("127.0.0.1", site.tls_port), DEADLINE_S) as plain:
        try:
            with context.wrap_socket(plain, server_hostname=name) as secure:
                return str(secure.version())
        except ssl.SSLError as error:
            return str(error)


@pytest.mark.parametrize("name", ["gcs.lab", "192.0.2.7", "localhost", "127.0.0.1", "elsewhere.lab", "192.0.2.8"])
def test_tls_refuses_a_broker_of_another_name(site: Site, name: str) -> None:
    context = trusting(site.folder / "ca.pem")
    context.verify_flags |= ssl.VERIFY_X509_STRICT
    found = tls_problem(site, context, name)
    if name in (*WANTED.hosts, *broker_setup.LOCAL_HOSTS):
        assert found == "TLSv1.3"
    else:
        assert "mismatch" in found


def test_plain_connection_to_the_tls_port_is_refused(site: Site) -> None:
    before = len(site.broker.log)
    client = Peer(site.tls_port, site.folder / "operators/anna/login.yaml")
    with pytest.raises(AssertionError, match="hung up"):
        client.connect()
    client.__exit__()
    logged(site.broker, "SSL routines::wrong version number", before)


def reached(host: str, port: int) -> bool:
    try:
        socket.create_connection((host, port), DEADLINE_S).close()
    except ConnectionRefusedError:
        return False
    return True


def test_plain_listener_accepts_this_computer_only(site: Site) -> None:
    """127.0.0.2 is another address of this computer, as its network address is."""
    with closing(socket.create_server(("0.0.0.0", 0))) as open_to_all:
        assert reached("127.0.0.2", open_to_all.getsockname()[1]), "the test itself: such a connection can be made"
    assert reached("127.0.0.1", site.plain_port)
    assert not reached("127.0.0.2", site.plain_port)


def test_loopback_profile_accepts_this_computer_only(tmp_path: Path) -> None:
    with loopback_broker(tmp_path) as broker:
        assert reached("127.0.0.1", broker.port)
        assert not reached("127.0.0.2", broker.port)


# --- who may do what ----------------------------------------------------------------------------------------------------------------


def test_operator_commands(site: Site) -> None:
    with peer(site, "vehicles/tarot") as vehicle, peer(site, "operators/anna") as anna:
        assert vehicle.subscribe(COMMAND) == 1
        assert anna.publish(COMMAND, b"land") == 0
        assert vehicle.hear() == (COMMAND, b"land", False)


@pytest.mark.parametrize("qos", [0, 1])
def test_viewer_commanding_is_refused_and_logged(site: Site, qos: int) -> None:
    with (
        peer(site, "vehicles/tarot") as vehicle,
        peer(site, "viewers/wall") as wall,
        peer(site, "operators/anna") as anna,
    ):
        assert vehicle.subscribe(COMMAND) == 1
        code = wall.publish(COMMAND, b"abort", qos=qos)
        assert code == (NOT_AUTHORISED if qos else 0), "QoS 0 has no answer"
        logged(site.broker, denied(wall, COMMAND))
        assert anna.publish(COMMAND, b"after it") == 0
        assert vehicle.hear() == (COMMAND, b"after it", False)


def test_a_viewers_last_will_is_not_delivered_as_a_command(site: Site) -> None:
    """The broker publishes a will in the client's name; an operator's will shows that it does."""
    with peer(site, "vehicles/tarot") as vehicle, peer(site, "operators/anna") as anna:
        assert vehicle.subscribe(COMMAND) == 1
        bert = peer(site, "operators/bert")
        bert.will(COMMAND, b"land")
        assert bert.connect() == 0
        bert.break_off()
        assert vehicle.hear() == (COMMAND, b"land", False)
        wall = peer(site, "viewers/wall")
        wall.will(COMMAND, b"abort")
        assert wall.connect() == 0
        wall.break_off()
        logged(site.broker, f"Client {wall.id} closed its connection")
        assert anna.publish(COMMAND, b"after it") == 0
        assert vehicle.hear() == (COMMAND, b"after it", False)


@pytest.mark.parametrize("room", ["viewers/wall", "operators/anna", "vehicles/second"])
@pytest.mark.parametrize("topic", [topic for topic in Topic if topic is not Topic.COMMAND])
def test_only_a_vehicle_may_publish_on_its_topics(site: Site, room: str, topic: Topic) -> None:
    with peer(site, room) as other:
        assert other.publish(topic.of("tarot"), b"forged", retain=True) == NOT_AUTHORISED
        logged(site.broker, denied(other, topic.of("tarot")))
    with peer(site, "operators/bert") as bert, peer(site, "vehicles/tarot") as vehicle:
        assert bert.subscribe(topic.of("tarot")) == 1
        assert vehicle.publish(topic.of("tarot"), b"true") == 0
        assert bert.hear() == (topic.of("tarot"), b"true", False), "nothing forged was kept"


def test_a_vehicle_may_not_publish_commands(site: Site) -> None:
    with peer(site, "vehicles/tarot") as vehicle:
        assert vehicle.publish(Topic.COMMAND.of("second"), b"land") == NOT_AUTHORISED
        assert vehicle.publish(COMMAND, b"land") == NOT_AUTHORISED


@pytest.mark.parametrize("room", ["viewers/wall", "operators/bert", "vehicles/second"])
@pytest.mark.parametrize("topic", ["companion/tarot/command", "companion/+/command", "companion/#", "#"])
def test_commands_are_delivered_to_their_vehicle_only(site: Site, room: str, topic: str) -> None:
    """The broker grants the subscription, and sends nothing."""
    with peer(site, room) as other, peer(site, "operators/anna") as anna, peer(site, "vehicles/second") as second:
        other.subscribe(topic)
        if room == "vehicles/second":
            other.subscribe(Topic.COMMAND.of("second"))
        else:
            other.subscribe(Topic.ACK.of("second"))
        anna.publish(COMMAND, b"secret")
        if room == "vehicles/second":
            anna.publish(Topic.COMMAND.of("second"), b"after it")
        else:
            second.publish(Topic.ACK.of("second"), b"after it")
        assert other.hear()[1] == b"after it"


def test_the_brokers_own_topics_are_not_delivered(site: Site) -> None:
    """$SYS would show a viewer who else is connected."""
    with peer(site, "viewers/wall") as wall, peer(site, "vehicles/tarot") as vehicle:
        wall.subscribe("$SYS/#")
        wall.subscribe(ACK)
        vehicle.publish(ACK, b"after it")
        assert wall.hear()[0] == ACK


def test_oversized_message_ends_the_connection(site: Site) -> None:
    with peer(site, "vehicles/tarot") as vehicle, peer(site, "operators/anna") as anna:
        assert vehicle.subscribe(COMMAND) == 1
        flood = peer(site, "operators/bert")
        assert flood.connect() == 0
        # Past paho, which keeps to the limit that the broker told it.
        none = Properties(PacketTypes.PUBLISH)  # type: ignore[no-untyped-call]
        flood._client._send_publish(1, COMMAND.encode(), bytes(300_000), qos=1, properties=none)
        assert flood.ended() == TOO_LARGE
        flood.__exit__()
        logged(site.broker, f"Client {flood.id} disconnected due to oversize packet")
        assert anna.publish(COMMAND, b"after it") == 0
        assert vehicle.hear() == (COMMAND, b"after it", False)


# --- what the vehicle makes of commands that do arrive ------------------------------------------------------------------------------

SESSION, NOW_T_S = "f3a9", 60.0


def signed(key: bytes) -> Command:
    return make_command(OperatorCommand.LAND, "tarot", SESSION, "anna", key, round(NOW_T_S * 1000))


@pytest.mark.parametrize("reason", [Reason.REPLAYED, Reason.BAD_SIGNATURE, Reason.RETAINED])
def test_open_broker_lets_it_pass_and_the_vehicle_refuses(site: Site, tmp_path: Path, reason: Reason) -> None:
    """On a broker that lets anyone publish. test_commands.py has every other reason."""
    operators = load_operators(site.folder / "vehicles/tarot/operators.yaml")
    key = load_operators(site.folder / "operators/anna/operators.yaml").key("anna")
    judge = Verifier(operators, "tarot", SESSION)
    with loopback_broker(tmp_path) as broker, Peer(broker.port) as vehicle, Peer(broker.port) as stranger:
        genuine = to_json(signed(key))
        if reason is Reason.RETAINED:
            stranger.publish(COMMAND, genuine, retain=True)
        vehicle.subscribe(COMMAND)
        if reason is not Reason.RETAINED:
            stranger.publish(COMMAND, genuine)
            _, payload, retained = vehicle.hear()
            assert isinstance(judge.check(payload, retained, NOW_T_S), Accepted)
            changed = genuine if reason is Reason.REPLAYED else genuine.replace(b'"land"', b'"abort"')
            stranger.publish(COMMAND, changed)
        _, payload, retained = vehicle.hear()
        verdict = judge.check(payload, retained, NOW_T_S)
        assert isinstance(verdict, Refused)
        assert verdict.reason is reason
        stranger.publish(COMMAND, to_json(signed(key)))
        _, payload, retained = vehicle.hear()
        assert isinstance(judge.check(payload, retained, NOW_T_S), Accepted), "a genuine one passes as before"


# --- the files ----------------------------------------------------------------------------------------------------------------------


def test_supplied_profile_is_what_broker_init_writes() -> None:
    """Written by `python -m tools.docs.mosquitto configs/mosquitto`."""
    folder = ROOT / "configs/mosquitto"
    assert {name: (folder / name).read_text() for name in example_files()} == example_files()
    assert {path.name for path in folder.iterdir()} == {*example_files(), LOOPBACK.name}


def test_profile_is_a_drop_in_of_the_system_service(site: Site, tmp_path: Path) -> None:
    """Debian's mosquitto.conf sets persistence and a log file first, and includes /etc/mosquitto/conf.d last."""
    plain_port, tls_port = free_port(), free_port()
    installed = tmp_path / "companion"
    installed.mkdir()
    for name in ("passwords", "acl", "server.pem", "server.key"):
        shutil.copy(site.folder / name, installed)
    drop_in = tmp_path / "conf.d"
    drop_in.mkdir()
    text = for_tests((site.folder / "service.conf").read_text(), plain_port, tls_port)
    (drop_in / "companion.conf").write_text(text.replace("/etc/mosquitto/companion", str(installed)))
    config = tmp_path / "debian.conf"
    config.write_text(
        f"pid_file {tmp_path}/mosquitto.pid\npersistence true\npersistence_location {tmp_path}/\n"
        f"log_dest file {tmp_path}/service.log\ninclude_dir {drop_in}\n"
    )
    broker = Broker(tmp_path, config, plain_port)
    broker.start()
    try:
        with Peer(plain_port, site.folder / "viewers/wall/login.yaml") as wall:
            assert wall.publish(COMMAND, b"abort") == NOT_AUTHORISED
        assert Peer(plain_port).connect() == NOT_AUTHORISED
    finally:
        broker.stop()
    assert re.search(denied(wall, COMMAND), (tmp_path / "service.log").read_text())
    assert not (tmp_path / "mosquitto.db").exists(), "no messages are kept over a restart"


def test_table_of_attacks_names_tests_that_exist() -> None:
    page = (ROOT / "docs/internals/broker.md").read_text(encoding="utf-8")
    rows = [line for line in page.splitlines() if line.startswith("| ") and "`test_" in line]
    named = {name for row in rows for name in re.findall(r"`(test_\w+)`", row)}
    defined = {
        name
        for file in (ROOT / "tests").rglob("test_*.py")
        for name in re.findall(r"^(?:async )?def (test_\w+)", file.read_text(encoding="utf-8"), re.M)
    }
    assert len(rows) >= 15
    assert named <= defined
