"""The server of `companion monitor` with a real broker, a vehicle that verifies commands, and viewers over real sockets."""

from __future__ import annotations

import asyncio
import contextlib
import socket
import ssl
from collections.abc import Iterator
from pathlib import Path

import aiohttp
import pytest

from companion.ground.protocol.access import broker_access
from companion.ground.station.hub import Hub
from companion.ground.station.station import Station
from companion.ground.station.web import Monitor, ServerSettings
from companion.ground.station.web_guard import HEADERS, MESSAGE_MAX_BYTES
from tests.broker import Broker, loopback_broker
from tests.ground.monitor_rig import OPERATORS, SIGNER, base_of, certificate, monitor_at, on_page, until, viewer_of
from tests.ground.vehicle import flight, played_vehicle


async def test_a_viewer_receives_hello_and_the_known_state_and_then_live_data(broker: Broker) -> None:
    async with played_vehicle(broker.port, OPERATORS), monitor_at(broker.url) as monitor, viewer_of(monitor) as viewer:
        hello = await viewer.next()
        assert hello["kind"] == "hello" and hello["can_command"] is True and hello["why_not"] is None
        assert (hello["operator"], hello["replay"]) == ("anna", False)
        stream = await viewer.until("stream")
        later = await viewer.until("stream", lambda message: message["data"]["seq"] > stream["data"]["seq"])
        assert later["vehicle"] == "rig" and later["age_s"] >= 0.0
        newest = {message["kind"]: message for message in viewer.heard}
        assert newest["broker"]["connected"] is True and broker.url in newest["broker"]["text"]
        assert newest["state"]["data"]["presence"] == "flying"
        assert newest["scene"]["data"]["mission_s"] == 21.0
        assert newest["preflight"]["data"]["rows"][0]["id"] == "px4_link"
        assert [line["text"] for line in newest["events"]["data"]["lines"]] == [line.text for line in flight()[2].lines]


async def test_a_silent_viewer_is_greeted_without_a_token(broker: Broker) -> None:
    async with monitor_at(broker.url) as monitor, aiohttp.ClientSession() as session:
        base = base_of(monitor)
        async with session.ws_connect(f"{base}ws", origin=base.rstrip("/")) as ws:
            hello = await ws.receive_json()
            assert hello["kind"] == "hello" and hello["can_command"] is False


async def test_requests_of_other_hosts_and_origins_are_refused(broker: Broker) -> None:
    async with monitor_at(broker.url) as monitor, aiohttp.ClientSession() as session:
        base = base_of(monitor)
        own = base.rstrip("/")
        for path in ("", "ws", "replay/0.json"):
            async with session.get(base + path, headers={"Host": "evil.example", "Origin": own}) as answer:
                assert answer.status == 403
                assert HEADERS.items() <= dict(answer.headers).items()
        for origin in ("http://evil.example", "null", f"http://localhost:{monitor.port}", None):
            with pytest.raises(aiohttp.WSServerHandshakeError, match="403"):
                await session.ws_connect(f"{base}ws", origin=origin)
        async with session.get(base) as answer:
            assert answer.status == 200 and HEADERS.items() <= dict(answer.headers).items()
            assert answer.content_type == "text/html"
        async with session.get(f"{base}..%2f..%2fweb.py") as answer:
            assert answer.status in (403, 404)


@pytest.mark.parametrize(
    ("text", "code"),
    [
        ("x" * (MESSAGE_MAX_BYTES + 1), 1009),
        ("no JSON", 1008),
        ("[" * 1000, 1008),
        ('{"kind":"command","vehicle":7,"command":"hold"}', 1008),
    ],
)
async def test_a_viewer_that_sends_an_invalid_message_is_disconnected(broker: Broker, text: str, code: int) -> None:
    async with monitor_at(broker.url) as monitor, viewer_of(monitor) as viewer, viewer_of(monitor) as other:
        await viewer.until("broker")
        await viewer.ws.send_str(text)
        assert (await viewer.closed())[0] == code
        await other.until("hello")


async def test_a_viewer_that_floods_is_disconnected(broker: Broker) -> None:
    async with on_page(broker) as (vehicle, _monitor, viewer):
        await viewer.until("stream")
        with contextlib.suppress(ConnectionError):
            for _ in range(500):
                await viewer.order("hold", "nobody")
        code, reason = await viewer.closed()
        assert code == 1008 and "messages a second" in reason
        assert vehicle.commands_heard == 0


async def test_a_slow_viewer_is_disconnected_and_no_other_misses_an_event(broker: Broker) -> None:
    async with on_page(broker, quiet=True) as (vehicle, monitor, viewer):
        await viewer.until("events")
        with idle_viewer(monitor):
            await until(lambda: monitor.viewers == 2)
            count = 0
            while monitor.viewers == 2:
                count += 1
                assert count < 5000, "the idle viewer was never sent away"
                await vehicle.say_events(str(count), *(["x" * 300] * 99))
                got = await viewer.until("events")
                assert got["data"]["lines"][0]["text"] == str(count)


async def test_the_broker_may_come_and_go(tmp_path: Path) -> None:
    with loopback_broker(tmp_path) as broker:
        await asyncio.to_thread(broker.stop)
        async with monitor_at(broker.url) as monitor, viewer_of(monitor) as viewer:
            told = await viewer.until("broker", lambda message: "refused" in message["text"])
            assert told["connected"] is False and told["text"].startswith(f"no broker at {broker.url}, trying")
            for number in range(2):
                await asyncio.to_thread(broker.start)
                await viewer.until("broker", lambda message: message["connected"])
                async with played_vehicle(broker.port, OPERATORS, session=f"session-{number}") as vehicle:
                    session = vehicle.session
                    await viewer.until("stream", lambda m, session=session: m["data"]["session"] == session)  # type: ignore[misc]
                    await viewer.order("hold")
                    ack = await viewer.until("ack")
                    assert ack["data"]["session"] == session
                    await asyncio.to_thread(broker.kill)
                    await viewer.until("broker", lambda message: not message["connected"])
                    await viewer.order("land")
                    refused = await viewer.until("refused")
                    assert refused["text"].startswith(f"no broker at {broker.url}")
                    assert "pilot's switch" in refused["text"]


@contextlib.contextmanager
def idle_viewer(monitor: Monitor) -> Iterator[None]:
    """Connect a viewer that reads nothing after the handshake."""
    with socket.socket() as idle:
        idle.setsockopt(socket.SOL_SOCKET, socket.SO_RCVBUF, 4096)
        idle.connect(("127.0.0.1", monitor.port))
        base = base_of(monitor).rstrip("/")
        lines = (
            "GET /ws HTTP/1.1", f"Host: 127.0.0.1:{monitor.port}", f"Origin: {base}", "Upgrade: websocket",
            "Connection: Upgrade", "Sec-WebSocket-Version: 13", "Sec-WebSocket-Key: AAAAAAAAAAAAAAAAAAAAAA==", "", "",
        )  # fmt: skip
        idle.sendall("\r\n".join(lines).encode())
        yield


@pytest.mark.parametrize(("host", "tls", "commands"), [("127.0.0.1", False, True), ("::1", False, True),
                                                       ("192.0.2.7", False, False), ("0.0.0.0", False, False),
                                                       ("192.0.2.7", True, True)])  # fmt: skip
def test_other_computers_command_over_tls_only(host: str, tls: bool, commands: bool) -> None:
    serving = ServerSettings(host, 8642, ssl.SSLContext(ssl.PROTOCOL_TLS_SERVER) if tls else None)
    station = Station(
        broker_access("mqtt://127.0.0.1", None, None), SIGNER, None, lambda heard: None, lambda c, t: None
    )
    monitor = Monitor(serving, Hub(station.tracker, ""), station.commands)
    assert (monitor.view_only_reason is None) is commands
    assert ("#token=" in monitor.url) is commands


async def test_the_page_over_tls(broker: Broker, tmp_path: Path) -> None:
    cert, key, ca = certificate(tmp_path)
    server = ssl.SSLContext(ssl.PROTOCOL_TLS_SERVER)
    server.load_cert_chain(cert, key)
    trusting = ssl.create_default_context(cafile=str(ca))

    async with (
        played_vehicle(broker.port, OPERATORS),
        monitor_at(broker.url, serving=ServerSettings("127.0.0.1", 0, server)) as monitor,
        viewer_of(monitor, ssl=trusting) as viewer,
    ):
        assert monitor.url.startswith("https://127.0.0.1:")
        await viewer.until("stream")
        await viewer.order("land")
        await viewer.until("ack")
