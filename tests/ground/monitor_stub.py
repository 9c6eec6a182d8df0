"""A stub of the monitor: a web server that sends the page what a test wants, and a recorded flight.

The flight is one of the fast loop, as the messages that a vehicle sends. The server is not the monitor's own, which has tests of its
own: here the test decides what is sent and when, and receives every message of the page.
"""

from __future__ import annotations

import asyncio
import threading
from collections.abc import Callable, Iterable
from concurrent.futures import Future
from dataclasses import dataclass
from functools import cache
from typing import Any, Self

from aiohttp import WSMsgType, web
from msgspec.structs import replace

from companion.ground.protocol.messages import (
    VERSION,
    Ack,
    EventLine,
    Events,
    Preflight,
    PreflightRow,
    Presence,
    Scene,
    State,
    Stream,
)
from companion.ground.station.web import PAGE
from companion.ground.station.web_guard import HEADERS
from companion.ground.telemetry.scene import scene_of
from companion.ground.telemetry.stream import replay
from companion.model.codec import to_jsonable
from companion.model.types import OperatorCommand
from companion.sitl_config.loader import load_sitl
from sitl.fast.loop import FastFlight
from sitl.fast.result import FastResult
from tests.analysis.synthetic_flight import sent_at
from tests.ground.vehicle import ack_of, state_of
from tests.support import CATCH, DEADLINE_S

SESSION = "5e55104e"
NAME = "tarot650-2r"
Message = dict[str, Any]


@dataclass(frozen=True)
class Flown:
    """A flight as telemetry."""

    scene: Scene
    streams: tuple[Stream, ...]
    events: Events

    def at(self, mission_t_s: float) -> Stream:
        """Return the record at a mission time."""
        return next(stream for stream in self.streams if stream.mission_t_s >= mission_t_s)


@cache
def catch_flight() -> FastResult:
    """The mission `catch`, flown in the fast loop."""
    return FastFlight(load_sitl(CATCH)).run()


@cache
def flown() -> Flown:
    """The mission `catch` as telemetry."""
    config, result = load_sitl(CATCH).flight, catch_flight()
    rows = [(i, o, sent_at(i.tick, i.t_s)) for i, o in zip(result.inputs, result.outputs, strict=True)]
    streams, events = replay(rows, config, SESSION, 1.7e9)
    path = [o.reference.position_world_m for o in result.outputs if o.reference is not None]
    scene = scene_of(config, SESSION, path[:: max(1, len(path) // 290)], mission_s=result.outputs[-1].mission_t_s)
    return Flown(scene, tuple(streams), events)


def state(presence: Presence = Presence.FLYING, **changes: Any) -> State:
    """Return a state message of the vehicle."""
    return replace(state_of(NAME, SESSION), presence=presence, **changes)


def preflight() -> Preflight:
    """Return two preflight rows."""
    rows = (
        PreflightRow("px4.link", "ok", "PX4 1.16.1 answers"),
        PreflightRow("battery", "warn", "82 %, 90 % wished for"),
    )
    return Preflight(VERSION, SESSION, rows)


def event(number: int, text: str, *, id_: str = "hold", severity: str = "warning", action: str = "hold") -> EventLine:
    """Return one event line."""
    return EventLine(t_s=20.0 + number, mission_t_s=8.0 + number, id=id_, severity=severity, action=action, text=text)


def ack(command: str, nonce: str, text: str, *, accepted: bool = True, operator: str = "anna") -> Ack:
    """Return the vehicle's answer to a command."""
    values = {"operator": operator, "accepted": accepted, "text": text, "t_s": 21.0}
    return ack_of(SESSION, nonce, command=OperatorCommand(command), **values)


def relayed(record: object, vehicle: str = NAME, **more: Any) -> Message:
    """Return a record as the monitor sends it to the page."""
    return {"kind": type(record).__name__.lower(), "vehicle": vehicle, **more, "data": to_jsonable(record)}


def hello(**changes: Any) -> Message:
    """Return the monitor's first message: this page may command."""
    usual = {"kind": "hello", "version": "1", "can_command": True, "operator": "anna", "why_not": None}
    return {**usual, "replay": False, "logs": [], **changes}


BROKER: Message = {"kind": "broker", "connected": True, "text": "connected to mqtt://127.0.0.1:1883"}


class MonitorStub:
    """The server, in a thread of its own.

    Attributes:
        greeting: messages to every page that connects.
        replay: answer to ``/replay/N.json``.
    """

    def __init__(self, greeting: Iterable[Message] = ()) -> None:
        self.greeting: list[Message] = [hello(), BROKER, *greeting]
        self.replay: list[Message] = []
        self.port = 0
        self._heard: list[Message] = []
        self._change = threading.Condition()
        self._sockets: list[web.WebSocketResponse] = []
        self._greeted = asyncio.Lock()
        """A page that has the greeting gets every message after it."""
        self._loop = asyncio.new_event_loop()
        self._thread = threading.Thread(target=self._loop.run_forever, name="monitor stub")
        self._runner: web.AppRunner | None = None

    def __enter__(self) -> Self:
        self._thread.start()
        self.start()
        return self

    def __exit__(self, *_: object) -> None:
        self.stop()
        self._loop.call_soon_threadsafe(self._loop.stop)
        self._thread.join()
        self._loop.close()

    @property
    def url(self) -> str:
        return f"http://127.0.0.1:{self.port}/#token=secret"

    def start(self) -> None:
        """Listen on the same port as before."""
        self._do(self._start())

    def stop(self) -> None:
        """Close all connections and stop listening."""
        self._do(self._stop())

    def hang_up(self) -> None:
        """Close all connections and forget what came over them, also what is still under way. A page may connect anew at once."""
        self._do(self._hang_up())

    def send(self, *messages: Message) -> None:
        """Send messages to all connected pages."""
        self._do(self._send(messages))

    def received(self, kind: str) -> list[Message]:
        """Return all received messages of a kind."""
        with self._change:
            return [message for message in self._heard if message["kind"] == kind]

    def wait_received(self, kind: str, count: int) -> list[Message]:
        """Wait for a number of messages of a kind."""
        with self._change:
            enough = self._change.wait_for(
                lambda: sum(message["kind"] == kind for message in self._heard) >= count, DEADLINE_S
            )
            assert enough, (kind, count, self._heard)
        return self.received(kind)

    def _do(self, work: Any) -> None:
        future: Future[None] = asyncio.run_coroutine_threadsafe(work, self._loop)
        future.result(DEADLINE_S)

    async def _start(self) -> None:
        app = web.Application()
        app.on_response_prepare.append(_guarded)
        app.router.add_get("/ws", self._viewer)
        app.router.add_get(r"/replay/{number:\d+}.json", self._log)
        app.router.add_get("/", _index)
        app.router.add_static("/", PAGE)
        self._runner = web.AppRunner(app, access_log=None, shutdown_timeout=0.5)
        await self._runner.setup()
        await web.TCPSite(self._runner, "127.0.0.1", self.port).start()
        self.port = self._runner.addresses[0][1]

    async def _hang_up(self) -> None:
        async with self._greeted:
            closing, self._sockets = self._sockets, []
            with self._change:
                self._heard.clear()
        for socket in closing:
            await socket.close()

    async def _stop(self) -> None:
        await self._hang_up()
        if self._runner is not None:
            await self._runner.cleanup()
            self._runner = None

    async def _send(self, messages: Iterable[Message]) -> None:
        async with self._greeted:
            for message in messages:
                for socket in [socket for socket in self._sockets if not socket.closed]:
                    await socket.send_json(message)

    async def _viewer(self, request: web.Request) -> web.WebSocketResponse:
        socket = web.WebSocketResponse()
        await socket.prepare(request)
        async with self._greeted:
            for message in self.greeting:
                await socket.send_json(message)
            self._sockets.append(socket)
        try:
            async for received in socket:
                if received.type is WSMsgType.TEXT and socket in self._sockets:
                    with self._change:
                        self._heard.append(received.json())
                        self._change.notify_all()
        finally:
            if socket in self._sockets:
                self._sockets.remove(socket)
        return socket

    async def _log(self, request: web.Request) -> web.Response:
        return web.json_response(self.replay[int(request.match_info["number"])])


async def _guarded(request: web.Request, response: web.StreamResponse) -> None:
    response.headers.update(HEADERS)


async def _index(request: web.Request) -> web.FileResponse:
    return web.FileResponse(PAGE / "index.html")


def retained(name: str = NAME, condition: Callable[[State], State] = lambda known: known) -> list[Message]:
    """Return the retained messages that a page receives when it connects."""
    flight = flown()
    known = condition(replace(state(), vehicle=name))
    return [
        relayed(record, name)
        for record in (known, flight.scene, preflight(), replace(flight.events, lines=(), count=0))
    ]
