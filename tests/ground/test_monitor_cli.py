"""The command `companion monitor`: it prints an address, reports every mistake in one line, and plays logs."""

from __future__ import annotations

import asyncio
import gzip
import json
import re
import signal
import socket
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import aiohttp
import pytest

from companion.config.loader import load_flight
from companion.ground.protocol.keys import operators_text, write_private
from companion.ground.protocol.messages import Events, Preflight, Scene, State, Stream, decode
from companion.ground.station.replay_log import read_for_page
from companion.model.codec import to_json
from companion.model.exit_codes import EXIT_BAD_INPUT, EXIT_OK, EXIT_REFUSED
from tests.analysis.synthetic_flight import record_flight
from tests.broker import Broker, loopback_broker
from tests.commands import refused
from tests.ground.monitor_rig import ANNA, OPERATORS, certificate
from tests.ground.vehicle import played_vehicle
from tests.support import CATCH, Sandbox, sandbox_in


@pytest.fixture
def sandbox(tmp_path: Path) -> Iterator[Sandbox]:
    with sandbox_in(tmp_path / "sandbox", {"XDG_CONFIG_HOME": str(tmp_path / "config")}) as sandbox:
        yield sandbox


@pytest.fixture(scope="module")
def log(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The log of a flight, written by the real recorder."""
    path = tmp_path_factory.mktemp("log") / "flight.mcap"
    record_flight(path, config=load_flight(CATCH).model_dump(mode="json"), end_s=8.0)
    return path


async def test_it_prints_an_address_to_open_and_ends_in_order(broker: Broker, sandbox: Sandbox, tmp_path: Path) -> None:
    keys = tmp_path / "operators.yaml"
    write_private(keys, operators_text([ANNA]).encode())

    arguments = ("monitor", "--broker", broker.url, "--operators", keys, "--port", 0)
    async with played_vehicle(broker.port, OPERATORS):
        with sandbox.start(*arguments) as running:
            await asyncio.to_thread(running.wait_for, "(Ctrl-C ends)\n")
            out = running._text("out")
            address = re.match(r"companion monitor: (http://127\.0\.0\.1:\d+/)#token=([\w-]{22})  ", out)
            assert address is not None, out
            async with aiohttp.ClientSession() as session:
                async with session.get(address[1]) as page:
                    assert page.status == 200 and "<script" in await page.text()
                async with session.ws_connect(f"{address[1]}ws", origin=address[1].rstrip("/")) as ws:
                    await ws.send_json({"kind": "token", "token": address[2]})
                    assert (await ws.receive_json())["can_command"] is True
                    running.signal(signal.SIGINT)
                    async for _ in ws:
                        pass
                    assert ws.close_code == 1001
            ended = await asyncio.to_thread(running.end)
    assert (ended.code, ended.err) == (EXIT_OK, "")
    sandbox.assert_nobody_left()


def test_a_refusal_by_the_broker_is_one_line(tmp_path: Path) -> None:
    with loopback_broker(tmp_path) as broker:
        broker.stop()
        config = tmp_path / "loopback.conf"
        config.write_text(config.read_text().replace("allow_anonymous true", "allow_anonymous false"))
        broker.start()
        for more in ([], ["--text"]):
            line = refused(EXIT_REFUSED, "monitor", "--broker", broker.url, "--view-only", "--port", "0", *more)
            assert line == (
                f"companion monitor: {broker.url}: the broker refuses a connection without login: Not authorized; see --login"
            )


def test_an_address_that_cannot_be_listened_on_is_reported_in_one_line() -> None:
    with socket.create_server(("127.0.0.1", 0)) as taken:
        port = taken.getsockname()[1]
        line = refused(EXIT_REFUSED, "monitor", "--port", port, "--view-only")
        assert f"port {port} of 127.0.0.1 is in use, perhaps by another monitor; choose another: --port N" in line
    line = refused(EXIT_REFUSED, "monitor", "--host", "192.0.2.7", "--port", "0", "--view-only")
    assert "--host 192.0.2.7: cannot listen there" in line


def test_bad_input_is_one_line(tmp_path: Path, log: Path) -> None:
    damaged, foreign, empty = tmp_path / "damaged.mcap", tmp_path / "foreign.mcap", tmp_path / "empty.mcap"
    data = bytearray(log.read_bytes())
    data[len(data) // 2] ^= 0xFF
    damaged.write_bytes(data)
    foreign.write_text("no log at all")
    empty.write_bytes(b"")
    cert, key, _ = certificate(tmp_path)
    for arguments, why in (
        ([str(tmp_path / "nofile.mcap")], "nofile.mcap: cannot be read: No such file"),
        ([str(damaged)], f"{damaged}: damaged"),
        ([str(foreign)], f"{foreign}: is not an MCAP file"),
        ([str(empty)], f"{empty}: is empty"),
        ([str(log), str(foreign)], f"{foreign}: is not an MCAP file"),
        ([str(log), "--text"], "--text shows only live flights"),
        (["--port", "70000"], "--port 70000: expected 0 to 65535"),
        (["--cert", str(cert)], "--cert and --key must be given together"),
        (["--cert", str(cert), "--key", "nofile.pem"], "--key nofile.pem: cannot be read"),
        (["--cert", str(key), "--key", str(cert)], "expected a certificate and its private key"),
        (["--broker", "localhost"], "--broker: expected mqtt://"),
        (["--broker", "mqtts://gcs..lab"], "--broker: expected mqtt://"),
        (["--broker", f"mqtts://{'a' * 64}.lab"], "--broker: expected mqtt://"),
        (["--broker", "mqtt://127.0.0.1:99999"], "--broker: expected a port"),
        (["--broker", "mqtts://127.0.0.1", "--ca", "nofile.pem"], "--ca nofile.pem: no such file"),
        (["--broker", "mqtts://127.0.0.1", "--ca", "README.md"], "--ca README.md: not a certificate"),
        (["--broker", "mqtt://127.0.0.1", "--ca", "README.md"], "--ca README.md: has no effect without TLS"),
        (["--vehicle", "a b"], "--vehicle 'a b'"),
        (["--operators", "nofile.yaml"], "nofile.yaml: no such file"),
        (["--login", "nofile.yaml"], "nofile.yaml: no such file"),
    ):
        assert why in refused(EXIT_BAD_INPUT, "monitor", *arguments), arguments


def test_a_log_is_the_records_that_the_vehicle_would_have_sent(log: Path) -> None:
    replayed = read_for_page(log, 3)
    assert replayed.name == str(log)
    data: dict[str, Any] = json.loads(gzip.decompress(replayed.gzip_json))

    def record(cls: type[Any], part: Any) -> Any:
        return decode(cls, to_json(part))

    state = record(State, data["state"])
    assert (state.presence.value, state.mission, state.law, state.commands) == ("ended", "catch", "adaptive", False)
    scene = record(Scene, data["scene"])
    assert scene.session == state.session == "log-3"
    assert 2 <= len(scene.path_world_m) <= 300
    assert record(Preflight, data["preflight"]).rows == ()
    events = record(Events, data["events"])
    assert "payload in the net" in [line.text for line in events.lines]
    streams = [record(Stream, part) for part in data["streams"]]
    assert {stream.phase for stream in streams} >= {"ground", "take-off", "catch"}
    assert streams[0].wall_s == pytest.approx(1.7e9, abs=1.0)


async def test_logs_are_served_without_a_broker(log: Path, tmp_path: Path, sandbox: Sandbox) -> None:
    with sandbox.start("monitor", log, log, "--port", 0) as running:
        await asyncio.to_thread(running.wait_for, "(Ctrl-C ends)\n")
        address = re.findall(r"http://\S+", running._text("out"))[0]
        assert "#" not in address
        async with aiohttp.ClientSession() as session:
            async with session.ws_connect(f"{address}ws", origin=address.rstrip("/")) as ws:
                await ws.send_json({"kind": "token", "token": ""})
                hello = await ws.receive_json()
                assert hello["replay"] is True and hello["logs"] == [str(log), str(log)]
                assert hello["can_command"] is False and "replay" in hello["why_not"]
            for number, status in ((0, 200), (1, 200), (2, 404)):
                async with session.get(f"{address}replay/{number}.json") as answer:
                    assert answer.status == status
                    if status == 200:
                        assert answer.headers["Content-Encoding"] == "gzip"
                        assert answer.content_type == "application/json"
                        data = await answer.json()
                        assert data["state"]["session"] == f"log-{number}"
        running.signal(signal.SIGINT)
        assert (await asyncio.to_thread(running.end)).code == EXIT_OK
    sandbox.assert_nobody_left()
