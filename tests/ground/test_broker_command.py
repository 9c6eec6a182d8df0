"""`companion broker`: a folder whole or not at all, private secrets, and the permissions of a login."""

from __future__ import annotations

import datetime
import os
import shutil
import socket
import stat
import sys
import threading
from pathlib import Path

import pytest
import yaml

from companion.cli.main import make_parser
from companion.config.ground import Ground
from companion.ground.broker import setup as broker_setup
from companion.ground.broker.certificates import certificate_hosts, make_authority, make_server
from companion.ground.protocol.keys import load_login, load_operators
from companion.model.exit_codes import EXIT_BAD_INPUT, EXIT_OK, EXIT_REFUSED
from tests.broker import loopback_broker
from tests.commands import companion, refused
from tests.ground.test_broker import WANTED, Site, running
from tests.support import Ended, free_port, run_here

ROOMS = ["vehicles/tarot", "vehicles/second", "operators/anna", "operators/bert", "viewers/wall"]


@pytest.fixture(scope="module")
def site(tmp_path_factory: pytest.TempPathFactory) -> Site:
    """Made once; no test changes it."""
    folder = tmp_path_factory.mktemp("made") / "site"
    broker_setup.create(folder, WANTED, datetime.datetime.now(datetime.UTC))
    return Site(folder, None, 0, 0)  # type: ignore[arg-type]


def broker(*words: object, code: int = EXIT_OK) -> Ended:
    return companion("broker", *words, code=code)


def test_init_prints_what_to_copy_to_which_computer(tmp_path: Path) -> None:
    folder = tmp_path / "a site"
    words = ["--host", "gcs.lab", "10.0.0.2", "--operator", "anna", "--viewer", "wall", "--vehicle", "tarot", "second"]
    told = broker("init", folder, *words).out
    for room in ("vehicles/tarot", "vehicles/second", "operators/anna", "viewers/wall"):
        assert f"copy {folder}/{room} " in told or f"copy {folder}/{room}." in told
    section = (
        told[told.index("  ground:") : told.index("operators_file: ")]
        + "operators_file: /etc/companion/operators.yaml\n"
    )
    ground = Ground.model_validate(yaml.safe_load(section)["ground"])
    assert ground.topic == "tarot"
    assert ground.mqtt is not None
    assert str(ground.mqtt.address) == "mqtts://gcs.lab:8883"
    for path in folder.rglob("login.yaml"):
        assert load_login(path).password not in told
    monitors = [line.split()[1:] for line in told.splitlines() if line.startswith("  companion monitor")]
    assert len(monitors) == 2
    for monitor in monitors:
        assert make_parser().parse_known_args(monitor)[1] == []
    assert set(certificate_hosts((folder / "server.pem").read_bytes())) == {
        "gcs.lab",
        "10.0.0.2",
        "localhost",
        "127.0.0.1",
        "::1",
    }


def test_init_without_options_makes_one_of_each(tmp_path: Path) -> None:
    broker("init", tmp_path / "site")
    assert len(list((tmp_path / "site").rglob("login.yaml"))) == 3
    assert (tmp_path / "site/vehicles/tarot650-2r/operators.yaml").is_file()


def test_secrets_are_private_and_go_to_whom_they_belong(site: Site) -> None:
    for path in site.folder.rglob("*"):
        if path.is_file():
            assert stat.S_IMODE(path.stat().st_mode) == 0o600, path
    assert stat.S_IMODE(site.folder.stat().st_mode) == 0o700
    everybody = load_operators(site.folder / "vehicles/tarot/operators.yaml")
    assert everybody.names == ("anna", "bert")
    for name in everybody.names:
        own = load_operators(site.folder / "operators" / name / "operators.yaml")
        assert own.names == (name,)
        assert own.key(name) == everybody.key(name)
    assert not (site.folder / "viewers/wall/operators.yaml").exists()
    passwords = {room: load_login(site.folder / room / "login.yaml").password for room in ROOMS}
    assert len(set(passwords.values())) == len(ROOMS)
    for path in site.folder.iterdir():
        if path.is_file():
            assert not any(password in path.read_text() for password in passwords.values()), path


def test_no_password_is_on_a_command_line(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    tool = shutil.which("mosquitto_passwd")
    assert tool is not None
    monkeypatch.setenv("PATH", f"{tmp_path}:{os.environ['PATH']}")
    wrapper = tmp_path / "mosquitto_passwd"
    wrapper.write_text(f'#!/bin/sh\necho "$@" >> {tmp_path}/words\nenv >> {tmp_path}/words\nexec {tool} "$@"\n')
    wrapper.chmod(0o700)
    broker_setup.create(tmp_path / "site", WANTED, datetime.datetime.now(datetime.UTC))
    words = (tmp_path / "words").read_text()
    assert words.startswith("-U ")
    for room in ROOMS:
        assert load_login(tmp_path / "site" / room / "login.yaml").password not in words


@pytest.mark.parametrize("inside", ["file", "folder"])
def test_nothing_is_overwritten(tmp_path: Path, inside: str) -> None:
    folder = tmp_path / "site"
    if inside == "file":
        folder.write_text("mine")
    else:
        (folder / "mine").mkdir(parents=True)
    assert broker("init", folder, code=EXIT_BAD_INPUT).err == (
        f"{folder}: already exists; nothing was changed. Choose another folder, or use --renew-certificates\n"
    )
    assert [path.name for path in tmp_path.iterdir()] == ["site"]


BAD = {
    "name with a slash": (["--operator", "../anna"], "--operator '../anna': expected 1 to 40 letters"),
    "parent folder": (["--viewer", ".."], "--viewer '..': expected 1 to 40 letters"),
    "wildcard": (["--vehicle", "+"], "--vehicle '+': expected 1 to 40 letters"),
    "line end": (["--operator", "anna\nuser eve"], "--operator 'anna\\nuser eve': expected 1 to 40 letters"),
    "twice": (
        ["--operator", "anna", "--viewer", "anna"],
        "anna: used twice; every vehicle and user needs a different name",
    ),
    "host": (["--host", "no host"], "--host 'no host': expected a name or an address"),
    "days": (["--days", "0"], "argument --days: expected a number of days from 1 to 3000, got '0'"),
    "users with renewal": (["--renew-certificates", "--viewer", "eve"], "--renew-certificates creates no users"),
    "renewal of nothing": (
        ["--renew-certificates"],
        "ca.pem: No such file or directory; expected a folder that broker init created",
    ),
}


@pytest.mark.parametrize(("words", "line"), BAD.values(), ids=BAD)
def test_bad_input_is_one_line_and_leaves_nothing(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], words: list[str], line: str
) -> None:
    told = refused(EXIT_BAD_INPUT, "broker", "init", tmp_path / "site", *words)
    assert line in told
    assert list(tmp_path.iterdir()) == []


def test_missing_mosquitto_passwd_is_one_line(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("PATH", str(tmp_path))
    assert broker("init", tmp_path / "site", code=EXIT_REFUSED).err == (
        "companion broker init: mosquitto_passwd is not installed: apt install mosquitto\n"
    )
    assert list(tmp_path.iterdir()) == []


def test_missing_cryptography_is_one_line(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    import companion.ground.broker

    for name in ("setup", "certificates"):
        monkeypatch.delitem(sys.modules, f"companion.ground.broker.{name}")
        monkeypatch.delattr(companion.ground.broker, name)
    monkeypatch.setitem(sys.modules, "cryptography", None)
    assert broker("init", tmp_path / "site", code=EXIT_REFUSED).err == (
        "companion broker init: certificates need cryptography: pip install 'companion-aerial-manipulation[ground]'\n"
    )


def test_a_renewed_certificate_is_trusted_with_the_same_ca(site: Site, tmp_path: Path) -> None:
    folder = tmp_path / "site"
    shutil.copytree(site.folder, folder)
    before = {path: path.read_bytes() for path in folder.rglob("*") if path.is_file()}
    assert "gcs.lab" in broker("init", folder, "--renew-certificates", "--days", "20").out
    after = {path: path.read_bytes() for path in folder.rglob("*") if path.is_file()}
    assert before.keys() == after.keys()
    assert {path.name for path in before if before[path] != after[path]} == {"server.pem", "server.key"}
    assert stat.S_IMODE((folder / "server.key").stat().st_mode) == 0o600
    config = folder / "mosquitto.conf"
    config.write_text(config.read_text().replace(str(site.folder), str(folder)))
    with running(folder, tmp_path) as renewed:
        room = site.folder / "operators/anna"
        words = ["--login", str(room / "login.yaml"), "--ca", str(room / "ca.pem")]
        broker("check", f"mqtts://127.0.0.1:{renewed.tls_port}", *words)
    broker("init", folder, "--renew-certificates", "--host", "other.lab")
    assert set(certificate_hosts((folder / "server.pem").read_bytes())) == {"other.lab", *broker_setup.LOCAL_HOSTS}


def test_renewal_by_a_wrong_or_old_authority_is_refused(site: Site, tmp_path: Path) -> None:
    folder = tmp_path / "site"
    shutil.copytree(site.folder, folder)
    now = datetime.datetime.now(datetime.UTC)
    (folder / "ca.key").write_bytes(make_authority(now).key)
    ended = broker("init", folder, "--renew-certificates", code=EXIT_BAD_INPUT)
    assert "the key does not belong to the certificate" in ended.err
    old = make_authority(now - datetime.timedelta(days=3640))
    (folder / "ca.key").write_bytes(old.key)
    (folder / "ca.pem").write_bytes(old.certificate)
    assert "the authority expires on" in broker("init", folder, "--renew-certificates", code=EXIT_BAD_INPUT).err
    assert (folder / "server.pem").read_bytes() == (site.folder / "server.pem").read_bytes()
    assert make_server(old, ["a"], 5, now).certificate


# --- check --------------------------------------------------------------------------------------------------------------------------


def rights(out: str) -> dict[str, tuple[str, str]]:
    rows = [
        line.split() for line in out.splitlines() if len(line.split()) == 3 and line.split()[1] in ("yes", "no", "?")
    ]
    return {topic: (read, write) for topic, read, write in rows}


PUBLISHED_TOPICS = ("state", "scene", "preflight", "events", "stream", "ack")
EXPECTED = {
    "viewers/wall": ([], "?", "no", ("?", "no"), False),
    "operators/anna": ([], "?", "no", ("no", "yes"), True),
    "vehicles/tarot": (["--vehicle", "tarot"], "no", "yes", ("?", "no"), True),
}


@pytest.mark.parametrize("room", EXPECTED)
def test_check_finds_what_a_login_may_do(site: Site, tmp_path: Path, room: str) -> None:
    words, read, write, command, tls = EXPECTED[room]
    words = [*words, "--login", str(site.folder / room / "login.yaml")]
    with running(site.folder, tmp_path) as made:
        if tls:
            words += ["--ca", str(site.folder / room / "ca.pem")]
        url = f"mqtts://localhost:{made.tls_port}" if tls else f"mqtt://127.0.0.1:{made.plain_port}"
        ended = broker("check", url, *words)
    out = ended.out
    assert ("TLSv1.3" in out) == tls
    assert rights(out) == {**dict.fromkeys(PUBLISHED_TOPICS, (read, write)), "command": command}


def test_check_of_the_loopback_profile_may_everything(tmp_path: Path) -> None:
    with loopback_broker(tmp_path) as site:
        ended = broker("check", site.url)
    out = ended.out
    assert "connected as anonymous (no login), not encrypted" in out
    assert rights(out) == dict.fromkeys((*PUBLISHED_TOPICS, "command"), ("yes", "yes"))


def test_check_reports_why_it_cannot_connect(
    site: Site, tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("companion.ground.broker.check.ANSWER_S", 1.0)
    login = str(site.folder / "operators/anna/login.yaml")
    other = tmp_path / "other.pem"
    other.write_bytes(make_authority(datetime.datetime.now(datetime.UTC)).certificate)

    def told(*words: str) -> str:
        ended = run_here("broker", "check", *words)
        assert len(ended.err_lines) == 1
        return f"{ended.code} {ended.err}"

    with running(site.folder, tmp_path) as made:
        plain, tls = f"mqtt://127.0.0.1:{made.plain_port}", f"mqtts://127.0.0.1:{made.tls_port}"
        assert "refuses the connection without a login: Not authorized; see --login" in told(plain)
        assert "3 " in told(tls, "--login", login, "--ca", str(other))
        assert "the broker's certificate is not trusted" in told(tls, "--login", login, "--ca", str(other))
        assert "does not use TLS" in told(f"mqtts://127.0.0.1:{made.plain_port}", "--ca", str(site.folder / "ca.pem"))
        assert "for a TLS port use mqtts://" in told(f"mqtt://127.0.0.1:{made.tls_port}", "--login", login)
    assert "Connection refused; check that the broker is running" in told(f"mqtt://127.0.0.1:{free_port()}")
    assert told("http://here").startswith("2 ")
    assert told(plain, "--vehicle", "#").startswith("2 --vehicle '#'")
    assert told(plain, "--login", str(tmp_path / "none.yaml")).startswith("2 ")


@pytest.mark.parametrize(
    ("answer", "said"),
    [
        (
            b"HTTP/1.1 400 Bad Request\r\n\r\n",
            "no MQTT broker answers: the server at this port ended the connection without an MQTT 5 answer",
        ),
        (b"", "no MQTT broker answers: the server at this port ended the connection without an MQTT 5 answer"),
        (b"\x20\x02\x00\x01", "Unsupported protocol version; it speaks MQTT 3.1.1 only, expected MQTT 5"),
        (b"\x20\x03\x00\x89\x00", "the broker refuses the connection without a login: Server busy\n"),
    ],
    ids=["web server", "silent", "MQTT 3.1.1", "busy"],
)
def test_a_server_that_is_no_mqtt_5_broker_is_reported_as_that(answer: bytes, said: str) -> None:
    with socket.create_server(("127.0.0.1", 0)) as server:

        def serve() -> None:
            server.accept()[0].close()  # the probe
            with server.accept()[0] as connected:
                connected.recv(1000)
                connected.sendall(answer)

        serving = threading.Thread(target=serve)
        serving.start()
        ended = broker("check", f"mqtt://127.0.0.1:{server.getsockname()[1]}", code=EXIT_REFUSED)
        serving.join()
    text = ended.err
    assert said in text and "--login" not in text
