"""The web server of `companion monitor`: the page, a WebSocket for each viewer, and logs to replay.

WebSocket at ``/ws``, JSON text. Server to page:

    {"kind": "hello", "version", "can_command", "operator", "why_not", "replay"}     first message; again if the token was late
    {"kind": "broker", "connected", "text", "rejected"?, "rejected_text"?}           connection to the broker; rejected messages
    {"kind": "state" | "scene" | "preflight" | "events" | "ack", "vehicle", "data"}  records of `companion.ground.protocol.messages`
    {"kind": "stream", "vehicle", "age_s", "data"}                                   age_s: delay until it reached the server
    {"kind": "sent", "vehicle", "command", "nonce"}                                  to the commanding viewer; its `ack` has the nonce
    {"kind": "refused", "vehicle", "command", "text"}                                to the commanding viewer

Page to server: ``{"kind": "token", "token"}`` first (empty without one: view only), then ``{"kind": "command", "vehicle",
"command", "hold"?}``. With "resume", `hold` is the number of the hold that was displayed; without it, the current hold.
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
from companion.ground.protocol.proof import Signer
from companion.ground.station.command_sender import CommandSender, Failed, Sent
from companion.ground.station.hub import GOING_AWAY, TOO_SLOW, VIEWERS_MAX, CloseReason, Hub, Outbox
from companion.ground.station.replay_log import ReplayLog
from companion.ground.station.station import Station
from companion.ground.station.web_guard import (
    HEADERS,
    MESSAGE_MAX_BYTES,
    MESSAGES_BURST,
    MESSAGES_PER_S,
    host_allowed,
    is_loopback,
    new_token,
    origin_allowed,
    same_token,
)
from companion.model.commands import COMMANDS
from companion.model.types import OperatorCommand
from companion.runtime.tasks import until_first
from companion.runtime.token_bucket import TokenBucket

PAGE = Path(__file__).parent / "page"
TOKEN_WAIT_S = 1.0
"""Time for which the server waits for the page's token, so that one hello is enough."""
HEARTBEAT_S = 6.0
SEND_S = 10.0
"""Time after which a viewer that reads nothing is disconnected."""
CLOSE_S = 1.0
_SEND_BUFFER_BYTES = 65536
"""Kernel send buffer per viewer; a larger one would delay the data."""
NO_TOKEN = "view only: open the address that companion monitor printed, including the part after #"

_VIEW_ONLY_TEXT = "commands from other computers need TLS (--cert and --key) or an ssh -L tunnel"


class WebError(Exception):
    """The server cannot run. The exception's text is one line for the user."""


@dataclass(frozen=True, slots=True)
class ServerSettings:
    """Address and TLS settings of the server."""

    host: str
    port: int
    tls: ssl.SSLContext | None = None


class Monitor:
    """The web server.

    Args:
        hub: distributes messages to viewers; None for a replay.
        commands: sends commands; None for a replay.
    """

    def __init__(
        self,
        serving: ServerSettings,
        hub: Hub | None,
        orders: CommandSender | None,
        replay_logs: Sequence[ReplayLog] = (),
    ) -> None:
        self._serving = serving
        self._hub = hub
        self._commands = orders
        self._replay_logs = tuple(replay_logs)
        self._token = new_token()
        self._tasks: asyncio.TaskGroup | None = None
        self._outboxes: set[Outbox] = set()
        self.port = serving.port

    @property
    def viewers(self) -> int:
        """Number of connected viewers."""
        return len(self._outboxes)

    @property
    def view_only_reason(self) -> str | None:
        """Why no viewer can send commands through this server; None if viewers with the token can."""
        if self._commands is None:
            return "this is the replay of a log"
        if self._commands.view_only_reason is not None:
            return self._commands.view_only_reason
        if self._serving.tls is None and not is_loopback(self._serving.host):
            return _VIEW_ONLY_TEXT
        return None

    @property
    def url(self) -> str:
        """Address of the page, with the token if commands are possible."""
        host = "127.0.0.1" if self._serving.host in ("0.0.0.0", "") else self._serving.host
        host = f"[{host}]" if ":" in host else host
        scheme = "http" if self._serving.tls is None else "https"
        return f"{scheme}://{host}:{self.port}/" + (f"#token={self._token}" if self.view_only_reason is None else "")

    async def serve(self, listening: Callable[[], None]) -> NoReturn:
        """Serve until cancelled, then disconnect all viewers.

        Args:
            listening: called once, when `url` can be opened.

        Raises:
            WebError: the port is in use, or the address is not one of this computer.
        """
        app = web.Application(middlewares=[self._check_host], client_max_size=MESSAGE_MAX_BYTES)
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
            async with asyncio.TaskGroup() as self._tasks:
                while True:
                    await asyncio.sleep(1.0)
                    if self._hub is not None:
                        self._hub.publish_rejected()
        finally:
            for outbox in self._outboxes:
                outbox.close(GOING_AWAY)
            await runner.cleanup()

    @web.middleware
    async def _check_host(
        self, request: web.Request, handler: Callable[[web.Request], Awaitable[web.StreamResponse]]
    ) -> web.StreamResponse:
        if not host_allowed(request.headers.get("Host"), self._serving.host):
            raise web.HTTPForbidden(text="unknown host name; use the address that companion monitor printed\n")
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
            raise web.HTTPForbidden(text="this WebSocket accepts only pages served by this server (Origin mismatch)\n")
        ws = web.WebSocketResponse(
            heartbeat=HEARTBEAT_S, timeout=CLOSE_S, max_msg_size=MESSAGE_MAX_BYTES, compress=False, writer_limit=1
        )
        await ws.prepare(request)
        _limit_send_buffer(request)
        parting = await _Session(ws, self).run()
        with contextlib.suppress(TimeoutError):
            async with asyncio.timeout(CLOSE_S):
                await ws.close(code=parting.code, message=parting.reason.encode())
        if request.transport is not None:
            request.transport.abort()  # do not wait for a viewer that does not answer the close frame
        return ws

    def hello(self, given: object) -> str:
        """Return the hello message for a viewer with this token."""
        why_not = self.why_not(given)
        return json.dumps(
            {
                "kind": "hello",
                "version": __version__,
                "can_command": why_not is None,
                "operator": None if self._commands is None else self._commands.operator,
                "why_not": why_not,
                "replay": self._hub is None,
                "logs": [log.name for log in self._replay_logs],
            }
        )

    def why_not(self, given: object) -> str | None:
        """Return why a viewer with this token may not send commands; None if it may."""
        return self.view_only_reason or (None if same_token(given, self._token) else NO_TOKEN)

    def add_viewer(self, token: object) -> Outbox | None:
        """Add a viewer; return None if there are too many."""
        if len(self._outboxes) >= VIEWERS_MAX:
            return None
        outbox = Outbox()
        outbox.put(self.hello(token))
        self._outboxes.add(outbox)
        if self._hub is not None:
            self._hub.add(outbox, time.monotonic())
        return outbox

    def remove_viewer(self, outbox: Outbox) -> None:
        """Remove a viewer."""
        self._outboxes.discard(outbox)
        if self._hub is not None:
            self._hub.remove(outbox)

    def send_command(self, vehicle: str, command: OperatorCommand, hold: int | None, outbox: Outbox) -> None:
        """Send a command; it is completed even if the viewer disconnects."""
        assert self._commands is not None and self._tasks is not None
        self._tasks.create_task(self._commands.send(vehicle, command, lambda note: outbox.put(_note(note)), hold))


Listening = Callable[[Monitor], None]
"""Callback, called once when the page can be opened."""


async def serve_live(
    serving: ServerSettings, access: BrokerAccess, signer: Signer | str, only: str | None, listening: Listening
) -> None:
    """Serve the vehicles' messages until cancelled.

    Raises:
        WebError: the server cannot listen.
        BrokerRefused: the broker refuses the connection.
    """
    hub: Hub
    station = Station(
        access,
        signer,
        only,
        lambda received: hub.publish(received),
        lambda connected, text: hub.set_broker(connected, text),
    )
    hub = Hub(station.tracker, station.link.text)
    monitor = Monitor(serving, hub, station.commands)
    await until_first(monitor.serve(lambda: listening(monitor)), station.run())


async def serve_logs(serving: ServerSettings, logs: Sequence[ReplayLog], listening: Listening) -> None:
    """Serve logs until cancelled.

    Raises:
        WebError: the server cannot listen.
    """
    monitor = Monitor(serving, None, None, logs)
    await monitor.serve(lambda: listening(monitor))


class _Session:
    """One viewer's connection."""

    def __init__(self, ws: web.WebSocketResponse, monitor: Monitor) -> None:
        self._ws = ws
        self._monitor = monitor
        self._token: object = None
        self._bucket = TokenBucket(MESSAGES_PER_S, MESSAGES_BURST)

    async def run(self) -> CloseReason:
        """Run until either side ends the connection; return the reason for the close frame."""
        first = None
        with contextlib.suppress(TimeoutError):
            async with asyncio.timeout(TOKEN_WAIT_S):
                first = await self._ws.receive()
        if first is not None:
            if first.type is not WSMsgType.TEXT:
                return GOING_AWAY
            message = _parsed(first.data)
            if message is None or message.get("kind") != "token":
                return CloseReason(1008, "expected the token as the first message")
            self._token = message.get("token")
        outbox = self._monitor.add_viewer(self._token)
        if outbox is None:
            return CloseReason(1013, f"the limit of {VIEWERS_MAX} viewers is reached")
        try:
            await until_first(self._listen(outbox), self._send(outbox), outbox.wait_closed())
        finally:
            self._monitor.remove_viewer(outbox)
        return outbox.close_reason or GOING_AWAY

    async def _send(self, outbox: Outbox) -> None:
        try:
            while outbox.close_reason is None:
                for text in await outbox.take():
                    async with asyncio.timeout(SEND_S):
                        await self._ws.send_str(text)
        except TimeoutError:
            outbox.close(TOO_SLOW)
        except (ConnectionError, RuntimeError):
            pass  # the viewer has disconnected; aiohttp raises either

    async def _listen(self, outbox: Outbox) -> None:
        async for received in self._ws:
            message = _parsed(received.data) if received.type is WSMsgType.TEXT else None
            if not self._bucket.take(time.monotonic()):
                outbox.close(CloseReason(1008, f"more than {MESSAGES_PER_S:g} messages a second"))
                return
            match message:
                case {"kind": "token", "token": token}:
                    self._token = token
                    outbox.put(self._monitor.hello(token))
                case {"kind": "command", "vehicle": str(vehicle), "command": str(name), **more} if name in COMMANDS:
                    hold = more.get("hold")
                    self._command(vehicle, COMMANDS[name], hold if type(hold) is int else None, outbox)
                case _:
                    outbox.close(CloseReason(1008, "expected a token or a command"))
                    return

    def _command(self, vehicle: str, command: OperatorCommand, hold: int | None, outbox: Outbox) -> None:
        why_not = self._monitor.why_not(self._token)
        if why_not is None:
            self._monitor.send_command(vehicle, command, hold, outbox)
        else:
            outbox.put(_note(Failed(vehicle, command, why_not)))


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


def _limit_send_buffer(request: web.Request) -> None:
    """Limit the data buffered for a viewer: buffered data would be stale when it arrives."""
    transport = request.transport
    if isinstance(transport, asyncio.Transport):
        transport.set_write_buffer_limits(high=_SEND_BUFFER_BYTES // 2)
        transport.get_extra_info("socket").setsockopt(socket.SOL_SOCKET, socket.SO_SNDBUF, _SEND_BUFFER_BYTES)


async def _add_headers(request: web.Request, response: web.StreamResponse) -> None:
    response.headers.update(HEADERS)


async def _index(request: web.Request) -> web.FileResponse:
    return web.FileResponse(PAGE / "index.html")


def _why_not_listening(serving: ServerSettings, error: OSError) -> str:
    if error.errno == errno.EADDRINUSE:
        return f"port {serving.port} of {serving.host} is in use, perhaps by another monitor; choose another: --port N"
    if error.errno in (errno.EACCES, errno.EPERM):
        return f"port {serving.port} is not allowed for this user; choose one above 1023: --port N"
    return (
        f"--host {serving.host}: cannot listen there: {error.strerror or error}; expected an address of this computer"
    )
