"""The web server of `companion monitor`: the page, a WebSocket for each viewer, and logs to replay.

WebSocket at ``/ws``, JSON text. Server to page:

    {"kind": "hello", "version", "can_command", "operator", "why_not", "replay"}     first of all; again when the token came late
    {"kind": "broker", "connected", "text", "rubbish"?, "rubbish_text"?}             how it stands with the broker
    {"kind": "state" | "scene" | "preflight" | "events" | "ack", "vehicle", "data"}  records of `companion.ground.protocol.messages`
    {"kind": "stream", "vehicle", "age_s", "data"}                                   age_s: how late it came to the server
    {"kind": "sent", "vehicle", "command", "nonce"}                                  to who commanded; its `ack` has the nonce
    {"kind": "refused", "vehicle", "command", "text"}                                to the viewer who commanded

Page to server: ``{"kind": "token", "token"}`` first (empty without one: view only), then ``{"kind": "command", "vehicle", "command",
"hold"?}``: with "resume" the number of the hold that the stream showed when the operator pressed; without it, the one that stands.
"""

from __future__ import annotations

import asyncio
import contextlib
import errno
import json
import socket
import ssl
import time
from collections.abc import Awaitable, Callable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, NoReturn

from aiohttp import WSMsgType, web

from companion import __version__
from companion.ground.protocol.access import BrokerAccess
from companion.ground.protocol.messages import CommandName
from companion.ground.protocol.proof import Signer
from companion.ground.station.command_sender import Failed, Orders, Sent
from companion.ground.station.hub import GOING_AWAY, TOO_SLOW, VIEWERS_MAX, Hub, Outbox, Parting
from companion.ground.station.replay_log import ReplayLog
from companion.ground.station.station import Station
from companion.ground.station.tasks import until_first
from companion.ground.station.web_guard import (
    HEADERS,
    MESSAGE_MAX_BYTES,
    MESSAGES_PER_S,
    Bucket,
    host_allowed,
    is_loopback,
    new_token,
    origin_allowed,
    same_token,
)

PAGE = Path(__file__).parent / "page"
TOKEN_WAIT_S = 1.0
"""A page says its token at once; until then it is not greeted, so that it is greeted once."""
HEARTBEAT_S = 6.0
SEND_S = 10.0
"""A viewer that takes nothing for so long is gone."""
CLOSE_S = 1.0
_SEND_BUFFER_BYTES = 65536
"""Of the kernel, for each viewer: what lies there is old when it arrives."""
NO_TOKEN = "view only: open the address that companion monitor printed, with all that follows the #"

_VIEW_ONLY_TEXT = "commands from other computers need TLS: --cert and --key, or come through ssh -L"


class WebError(Exception):
    """The server cannot run; one line for the user."""


@dataclass(frozen=True, slots=True)
class Serving:
    """Where and how the server listens."""

    host: str
    port: int
    tls: ssl.SSLContext | None = None


class Monitor:
    """One web server.

    Args:
        serving: where.
        hub: what viewers are told; None in a replay.
        orders: commands; None in a replay.
        replay_logs: the logs of a replay.
    """

    def __init__(
        self, serving: Serving, hub: Hub | None, orders: Orders | None, replay_logs: Sequence[ReplayLog] = ()
    ) -> None:
        self._serving = serving
        self._hub = hub
        self._orders = orders
        self._replay_logs = tuple(replay_logs)
        self._token = new_token()
        self._errands: asyncio.TaskGroup | None = None
        self._outboxes: set[Outbox] = set()
        self.port = serving.port

    @property
    def viewers(self) -> int:
        """How many watch."""
        return len(self._outboxes)

    @property
    def why_not(self) -> str | None:
        """Why nobody commands through this server, whatever he knows; None: who has the token does."""
        if self._orders is None:
            return "a log is replayed: there is nothing to command"
        if self._orders.why_not is not None:
            return self._orders.why_not
        if self._serving.tls is None and not is_loopback(self._serving.host):
            return _VIEW_ONLY_TEXT
        return None

    @property
    def url(self) -> str:
        """The page's address, with the token if it is worth anything."""
        host = "127.0.0.1" if self._serving.host in ("0.0.0.0", "") else self._serving.host
        host = f"[{host}]" if ":" in host else host
        scheme = "http" if self._serving.tls is None else "https"
        return f"{scheme}://{host}:{self.port}/" + (f"#token={self._token}" if self.why_not is None else "")

    async def serve(self, listening: Callable[[], None]) -> NoReturn:
        """Serve until cancelled, then say goodbye to all viewers.

        Args:
            listening: called once, when `url` can be opened.

        Raises:
            WebError: the port is taken, or the address is none of this computer.
        """
        app = web.Application(middlewares=[self._guard], client_max_size=MESSAGE_MAX_BYTES)
        app.on_response_prepare.append(_add_headers)
        app.router.add_get("/ws", self._viewer)
        app.router.add_get(r"/replay/{number:\d{1,3}}.json", self._log)
        app.router.add_get("/", _index)
        app.router.add_static("/", PAGE)
        runner = web.AppRunner(app, access_log=None, handle_signals=False, shutdown_timeout=CLOSE_S)
        await runner.setup()
        try:
            site = web.TCPSite(runner, self._serving.host, self._serving.port, ssl_context=self._serving.tls)
            try:
                await site.start()
            except OSError as error:
                raise WebError(_why_not_listening(self._serving, error)) from None
            self.port = runner.addresses[0][1]
            listening()
            async with asyncio.TaskGroup() as self._errands:
                while True:
                    await asyncio.sleep(1.0)
                    if self._hub is not None:
                        self._hub.tell_rubbish()
        finally:
            for outbox in self._outboxes:
                outbox.part(GOING_AWAY)
            await runner.cleanup()

    @web.middleware
    async def _guard(
        self, request: web.Request, handler: Callable[[web.Request], Awaitable[web.StreamResponse]]
    ) -> web.StreamResponse:
        if not host_allowed(request.headers.get("Host"), self._serving.host):
            raise web.HTTPForbidden(
                text="this server is not called so; use the address that companion monitor printed\n"
            )
        return await handler(request)

    async def _log(self, request: web.Request) -> web.Response:
        number = int(request.match_info["number"])
        if number >= len(self._replay_logs):
            raise web.HTTPNotFound(text="no such log\n")
        return web.Response(
            body=self._replay_logs[number].gzip_json,
            content_type="application/json",
            charset="utf-8",
            headers={"Content-Encoding": "gzip"},
        )

    async def _viewer(self, request: web.Request) -> web.StreamResponse:
        if not origin_allowed(
            request.headers.get("Origin"), request.headers.get("Host"), tls=self._serving.tls is not None
        ):
            raise web.HTTPForbidden(text="a WebSocket for pages of this server only (Origin)\n")
        ws = web.WebSocketResponse(
            heartbeat=HEARTBEAT_S, timeout=CLOSE_S, max_msg_size=MESSAGE_MAX_BYTES, compress=False, writer_limit=1
        )
        await ws.prepare(request)
        _keep_short(request)
        parting = await _Session(ws, self).run()
        with contextlib.suppress(TimeoutError):
            async with asyncio.timeout(CLOSE_S):
                await ws.close(code=parting.code, message=parting.reason.encode())
        if request.transport is not None:
            request.transport.abort()  # whoever does not answer the close frame is not waited for
        return ws

    def hello(self, given: object) -> str:
        """The greeting for a viewer with this token."""
        why_not = self.why_not or (None if same_token(given, self._token) else NO_TOKEN)
        return json.dumps(
            {
                "kind": "hello",
                "version": __version__,
                "can_command": why_not is None,
                "operator": None if self._orders is None else self._orders.operator,
                "why_not": why_not,
                "replay": self._hub is None,
                "logs": [log.name for log in self._replay_logs],
            }
        )

    def may_command(self, given: object) -> bool:
        """Whether a viewer with this token commands."""
        return self.why_not is None and same_token(given, self._token)

    def join(self, token: object) -> Outbox | None:
        """A new viewer; None: there are too many."""
        if len(self._outboxes) >= VIEWERS_MAX:
            return None
        outbox = Outbox()
        outbox.put(self.hello(token))
        self._outboxes.add(outbox)
        if self._hub is not None:
            self._hub.join(outbox, time.monotonic())
        return outbox

    def leave(self, outbox: Outbox) -> None:
        """A viewer is gone."""
        self._outboxes.discard(outbox)
        if self._hub is not None:
            self._hub.leave(outbox)

    def order(self, vehicle: str, command: CommandName, hold: int | None, outbox: Outbox) -> None:
        """Give a command; it is followed to its end even if the viewer goes away."""
        assert self._orders is not None and self._errands is not None
        self._errands.create_task(self._orders.give(vehicle, command, lambda note: outbox.put(_note(note)), hold))


Listening = Callable[[Monitor], None]
"""Called once, when the page can be opened."""


async def serve_live(
    serving: Serving, access: BrokerAccess, signer: Signer | str, only: str | None, listening: Listening
) -> None:
    """Serve what vehicles send, until cancelled.

    Raises:
        WebError: cannot listen.
        BrokerRefused: the broker does not want us.
    """
    hub: Hub
    station = Station(
        access, signer, only, lambda heard: hub.relay(heard), lambda connected, text: hub.broker(connected, text)
    )
    hub = Hub(station.watch, station.link.text)
    monitor = Monitor(serving, hub, station.orders)
    await until_first(monitor.serve(lambda: listening(monitor)), station.run())


async def serve_logs(serving: Serving, logs: Sequence[ReplayLog], listening: Listening) -> None:
    """Serve logs, until cancelled.

    Raises:
        WebError: cannot listen.
    """
    monitor = Monitor(serving, None, None, logs)
    await monitor.serve(lambda: listening(monitor))


class _Session:
    """One viewer's connection."""

    def __init__(self, ws: web.WebSocketResponse, monitor: Monitor) -> None:
        self._ws = ws
        self._monitor = monitor
        self._token: object = None
        self._bucket = Bucket(time.monotonic())

    async def run(self) -> Parting:
        """Until either side goes; says what the viewer is told in farewell."""
        first = None
        with contextlib.suppress(TimeoutError):
            async with asyncio.timeout(TOKEN_WAIT_S):
                first = await self._ws.receive()
        if first is not None:
            if first.type is not WSMsgType.TEXT:
                return GOING_AWAY
            message = _parsed(first.data)
            if message is None or message.get("kind") != "token":
                return Parting(1008, "the first message is the token")
            self._token = message.get("token")
        outbox = self._monitor.join(self._token)
        if outbox is None:
            return Parting(1013, f"{VIEWERS_MAX} watch already")
        try:
            await until_first(self._listen(outbox), self._send(outbox), outbox.parted())
        finally:
            self._monitor.leave(outbox)
        return outbox.parting or GOING_AWAY

    async def _send(self, outbox: Outbox) -> None:
        try:
            while outbox.parting is None:
                for text in await outbox.take():
                    async with asyncio.timeout(SEND_S):
                        await self._ws.send_str(text)
        except TimeoutError:
            outbox.part(TOO_SLOW)
        except (ConnectionError, RuntimeError):
            pass  # it is gone, or goes; aiohttp says so with either

    async def _listen(self, outbox: Outbox) -> None:
        async for received in self._ws:
            message = _parsed(received.data) if received.type is WSMsgType.TEXT else None
            if not self._bucket.take(time.monotonic()):
                outbox.part(Parting(1008, f"more than {MESSAGES_PER_S:g} messages a second"))
                return
            match message:
                case {"kind": "token", "token": token}:
                    self._token = token
                    outbox.put(self._monitor.hello(token))
                case {"kind": "command", "vehicle": str(vehicle), "command": str(name), **more} if name in COMMANDS:
                    hold = more.get("hold")
                    self._command(vehicle, COMMANDS[name], hold if type(hold) is int else None, outbox)
                case _:
                    outbox.part(Parting(1008, "expected a token or a command"))
                    return

    def _command(self, vehicle: str, command: CommandName, hold: int | None, outbox: Outbox) -> None:
        if self._monitor.may_command(self._token):
            self._monitor.order(vehicle, command, hold, outbox)
        else:
            outbox.put(_note(Failed(vehicle, command, self._monitor.why_not or NO_TOKEN)))


COMMANDS = {command.value: command for command in CommandName}


def _parsed(text: str) -> dict[str, Any] | None:
    try:
        message = json.loads(text)
    except (ValueError, RecursionError):
        return None
    return message if isinstance(message, dict) else None


def _note(note: Sent | Failed) -> str:
    common = {"vehicle": note.vehicle, "command": note.command.value}
    if isinstance(note, Sent):
        return json.dumps({"kind": "sent", **common, "nonce": note.nonce})
    return json.dumps({"kind": "refused", **common, "text": note.text})


def _keep_short(request: web.Request) -> None:
    """Little room for what is on its way to a viewer: it would be old when it arrives."""
    transport = request.transport
    if isinstance(transport, asyncio.Transport):
        transport.set_write_buffer_limits(high=_SEND_BUFFER_BYTES // 2)
        transport.get_extra_info("socket").setsockopt(socket.SOL_SOCKET, socket.SO_SNDBUF, _SEND_BUFFER_BYTES)


async def _add_headers(request: web.Request, response: web.StreamResponse) -> None:
    response.headers.update(HEADERS)


async def _index(request: web.Request) -> web.FileResponse:
    return web.FileResponse(PAGE / "index.html")


def _why_not_listening(serving: Serving, error: OSError) -> str:
    if error.errno == errno.EADDRINUSE:
        return (
            f"port {serving.port} of {serving.host} is in use, by another monitor perhaps; choose another one: --port N"
        )
    if error.errno in (errno.EACCES, errno.EPERM):
        return f"port {serving.port} is not for this user; choose one above 1023: --port N"
    return (
        f"--host {serving.host}: cannot listen there: {error.strerror or error}; expected an address of this computer"
    )
