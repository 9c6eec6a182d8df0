"""The monitor's real server in the test's event loop, and viewers connected over real sockets."""

from __future__ import annotations

import asyncio
import contextlib
import datetime
import json
from collections.abc import AsyncIterator, Callable
from pathlib import Path
from typing import Any

import aiohttp

from companion.ground.broker.certificates import make_authority, make_server
from companion.ground.protocol.access import broker_access
from companion.ground.protocol.keys import Operator, Operators
from companion.ground.protocol.proof import Signer
from companion.ground.station.web import Monitor, ServerSettings, serve_live
from tests.broker import Broker
from tests.ground.vehicle import PlayedVehicle, played_vehicle
from tests.support import DEADLINE_S

ANNA = Operator("anna", b"a" * 32)
OPERATORS = Operators([ANNA], "operators.yaml")
SIGNER = Signer(ANNA.name, ANNA.key)


async def until(condition: Callable[[], bool]) -> None:
    """Wait for a condition, until the deadline of the test."""
    while not condition():  # noqa: ASYNC110 - nobody tells
        await asyncio.sleep(0.01)


@contextlib.asynccontextmanager
async def monitor_at(
    url: str, signer: Signer | str = SIGNER, *, serving: ServerSettings | None = None
) -> AsyncIterator[Monitor]:
    """Run a monitor of a broker on a free port."""
    served: list[Monitor] = []
    listening = asyncio.Event()

    def on_listening(monitor: Monitor) -> None:
        served.append(monitor)
        listening.set()

    serving = serving or ServerSettings("127.0.0.1", 0)
    work = asyncio.ensure_future(serve_live(serving, broker_access(url, None, None), signer, None, on_listening))
    try:
        ready = asyncio.ensure_future(listening.wait())
        await asyncio.wait([work, ready], return_when=asyncio.FIRST_COMPLETED)
        ready.cancel()
        if work.done():
            work.result()
        yield served[0]
    finally:
        work.cancel()
        await asyncio.wait([work])


def base_of(monitor: Monitor) -> str:
    return monitor.url.split("#")[0]


def token_of(monitor: Monitor) -> str:
    return monitor.url.partition("#token=")[2]


class Viewer:
    """A WebSocket client that behaves as the page does."""

    def __init__(self, ws: aiohttp.ClientWebSocketResponse) -> None:
        self.ws = ws
        self.heard: list[dict[str, Any]] = []

    async def next(self) -> dict[str, Any]:
        """Return the next message."""
        message = await self.ws.receive(DEADLINE_S)
        assert message.type is aiohttp.WSMsgType.TEXT, (message.type, self.ws.close_code, message.extra)
        data: dict[str, Any] = json.loads(message.data)
        self.heard.append(data)
        return data

    async def until(self, kind: str, wanted: Callable[[dict[str, Any]], bool] = lambda message: True) -> dict[str, Any]:
        """Return the next matching message of a kind; earlier ones are in `heard`."""
        while True:
            message = await self.next()
            if message["kind"] == kind and wanted(message):
                return message

    async def order(self, command: str, vehicle: str = "rig") -> None:
        await self.ws.send_json({"kind": "command", "vehicle": vehicle, "command": command})

    async def closed(self) -> tuple[int | None, str]:
        """Return the close code and reason, skipping messages before it."""
        while True:
            message = await self.ws.receive(DEADLINE_S)
            if message.type is aiohttp.WSMsgType.CLOSE:
                return self.ws.close_code, str(message.extra or "")
            if message.type in (aiohttp.WSMsgType.CLOSED, aiohttp.WSMsgType.CLOSING, aiohttp.WSMsgType.ERROR):
                return self.ws.close_code, ""


@contextlib.asynccontextmanager
async def viewer_of(monitor: Monitor, token: str | None = None, **settings: Any) -> AsyncIterator[Viewer]:
    """Connect a viewer, by default with the monitor's token."""
    base = base_of(monitor)
    async with (
        aiohttp.ClientSession() as session,
        session.ws_connect(f"{base}ws", origin=base.rstrip("/"), max_msg_size=0, **settings) as ws,
    ):
        await ws.send_json({"kind": "token", "token": token_of(monitor) if token is None else token})
        yield Viewer(ws)


@contextlib.asynccontextmanager
async def on_page(
    broker: Broker, signer: Signer | str = SIGNER, token: str | None = None, *, quiet: bool = False
) -> AsyncIterator[tuple[PlayedVehicle, Monitor, Viewer]]:
    """Connect a vehicle, a monitor and a viewer."""
    async with (
        played_vehicle(broker.port, OPERATORS, quiet=quiet) as vehicle,
        monitor_at(broker.url, signer) as monitor,
        viewer_of(monitor, token) as viewer,
    ):
        yield vehicle, monitor, viewer


def certificate(folder: Path) -> tuple[Path, Path, Path]:
    """Return the files of a certificate for 127.0.0.1, its key, and the certificate of its authority."""
    now = datetime.datetime.now(datetime.UTC)
    authority = make_authority(now)
    made = make_server(authority, ["127.0.0.1"], 1, now)
    files = folder / "cert.pem", folder / "key.pem", folder / "ca.pem"
    for file, data in zip(files, (made.certificate, made.key, authority.certificate), strict=True):
        file.write_bytes(data)
    return files
