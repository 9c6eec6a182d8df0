"""The Foxglove server of the recorder, seen by a viewer: the protocol's messages over a real WebSocket.

Source: the Foxglove WebSocket protocol, https://github.com/foxglove/ws-protocol (docs/spec.md); its messages are those of the
subprotocol of foxglove-sdk, too.
"""

from __future__ import annotations

import asyncio
import base64
import contextlib
import itertools
import json
import select
import socket
import struct
from collections.abc import AsyncIterator, Iterator
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import aiohttp
import pytest

from companion.model.types import Severity
from companion.recorder.client import RecorderProcess
from tests.recorder.flights import Row, config_json, offer, started, tethered
from tests.recorder.viewers import protobuf_decoder, view
from tests.support import DEADLINE_S, free_port

RECORDS = {"/inputs", "/outputs", "/sent"}
SHOWN = {*RECORDS, "/tf", "/tf_arm", "/pose", "/reference", "/scene", "/scene_path", "/scene_static"}


@dataclass
class Viewer:
    """A connected viewer that has subscribed to every channel."""

    socket: aiohttp.ClientWebSocketResponse
    channels: dict[int, dict[str, Any]] = field(default_factory=dict)
    seen: dict[str, list[Any]] = field(default_factory=dict)
    """Decoded messages by topic."""

    async def subscribe(self) -> None:
        while not {channel["topic"] for channel in self.channels.values()} >= SHOWN:
            message = json.loads((await self.socket.receive(DEADLINE_S)).data)
            if message["op"] == "advertise":
                topics = [channel["topic"] for channel in message["channels"]]
                assert len(topics) == len(set(topics))
                self.channels |= {channel["id"]: channel for channel in message["channels"]}
        ids = [{"id": channel, "channelId": channel} for channel in self.channels]
        await self.socket.send_json({"op": "subscribe", "subscriptions": ids})

    async def read(self, within_s: float = DEADLINE_S) -> bool:
        """Read a message; return False at the end of the connection."""
        message = await self.socket.receive(within_s)
        if message.type is aiohttp.WSMsgType.BINARY:
            opcode, subscription, _ = struct.unpack_from("<BIQ", message.data)
            assert opcode == 1
            channel = self.channels[subscription]
            self.seen.setdefault(channel["topic"], []).append(decoded(channel, message.data[13:]))
        return message.type in (aiohttp.WSMsgType.BINARY, aiohttp.WSMsgType.TEXT)

    async def read_to_line(self, number: int) -> int:
        """Read until the line of `write_lines` with this number; return how many lines have come."""
        lines = self.seen.setdefault("/log", [])
        while not (lines and lines[-1]["message"].startswith(f"{number} ")):
            assert await self.read()
        return len(lines)


def decoded(channel: dict[str, Any], data: bytes) -> Any:
    if channel["encoding"] == "json":
        return json.loads(data)
    return protobuf_decoder(channel["schemaName"], base64.b64decode(channel["schema"]))(data)


@contextlib.contextmanager
def recorder_for_viewers(path: Path, port: int) -> Iterator[RecorderProcess]:
    config = json.loads(config_json())
    config["vehicle"]["ground"] |= {"mqtt": None, "foxglove": f"127.0.0.1:{port}"}
    recorder = started(path, json.dumps(config))
    try:
        yield recorder
    finally:
        recorder.finish(DEADLINE_S)


def write_lines(recorder: RecorderProcess, numbers: range) -> None:
    """Write lines of 64 kB that begin with their number."""
    for number in numbers:
        select.select([], [recorder.client], [], DEADLINE_S)
        assert recorder.client.text(1.0, Severity.INFO, "test", f"{number} " + 64_000 * "x")


def small_buffer(address: aiohttp.AddrInfoType) -> socket.socket:
    made = socket.socket(*address[:3])
    made.setsockopt(socket.SOL_SOCKET, socket.SO_RCVBUF, 2**16)
    return made


@contextlib.asynccontextmanager
async def connected(port: int) -> AsyncIterator[Viewer]:
    async with (
        aiohttp.ClientSession(connector=aiohttp.TCPConnector(socket_factory=small_buffer)) as http,
        http.ws_connect(f"http://127.0.0.1:{port}/", protocols=["foxglove.sdk.v1"]) as connection,
    ):
        viewer = Viewer(connection)
        await viewer.subscribe()
        yield viewer


async def offer_until(recorder: RecorderProcess, rows: Iterator[Row], viewer: Viewer, topics: set[str]) -> int:
    """Send ticks until the viewer has seen the topics; return how many."""
    count = 0
    async with asyncio.timeout(DEADLINE_S):
        while not topics <= viewer.seen.keys():
            count += offer(recorder, itertools.islice(rows, 20))
            with contextlib.suppress(TimeoutError):  # nothing more for now: the next ticks
                while await viewer.read(within_s=0.02):
                    pass
    return count


def test_a_viewer_sees_the_channels_of_the_log_live_and_the_static_scene_whenever_it_connects(tmp_path: Path) -> None:
    async def flight(recorder: RecorderProcess) -> None:
        recorder.client.metadata("plan", {"json": "[[0, 0, 1], [1, 0, 1]]"})
        rows = tethered(end_s=600.0)
        count = offer(recorder, itertools.islice(rows, 20))  # before any viewer
        for _ in range(2):
            async with connected(port) as viewer:
                count += await offer_until(recorder, rows, viewer, SHOWN)
                scene = {one["id"]: one for one in viewer.seen["/scene_static"][0]["entities"]}
                assert {"room", "anchor", "planned path", "vehicle", "link1", "link2", "net"} <= scene.keys()
                assert [one["id"] for one in viewer.seen["/scene"][0]["entities"]] == ["tether"]
                tf = viewer.seen["/tf"][0]
                assert (tf["parent_frame_id"], tf["child_frame_id"]) == ("world", "body")
        report = recorder.finish(DEADLINE_S)
        assert (report.samples, report.dropped, report.error) == (count, 0, None)
        log = view(tmp_path / "flight.mcap")
        assert [len(log.by_topic[topic]) for topic in RECORDS] == [count] * 3, "the log lacks ticks or has some twice"
        # The last viewer saw every tenth tick, each as it is in the log.
        logged = [seen.data for seen in log.by_topic["/outputs"]]
        shown = [logged.index(outputs) for outputs in viewer.seen["/outputs"]]
        assert {after - before for before, after in itertools.pairwise(shown)} <= {10}

    port = free_port()
    with recorder_for_viewers(tmp_path / "flight.mcap", port) as recorder:
        asyncio.run(flight(recorder))


def test_what_a_viewer_sends_costs_neither_a_tick_nor_a_line(tmp_path: Path, capfd: pytest.CaptureFixture[str]) -> None:
    async def flight(recorder: RecorderProcess) -> None:
        for damaged in (b"\x88" * 200, b'{"op":"subscribe","subscriptions":' + 10_000 * b"[", b"\xff"):
            async with connected(port) as viewer:
                await viewer.socket.send_bytes(damaged)
                await viewer.socket.send_frame(damaged, aiohttp.WSMsgType.TEXT)
        count = offer(recorder, itertools.islice(tethered(end_s=1.0), 20))
        report = recorder.finish(DEADLINE_S)
        assert (report.samples, report.dropped, report.error) == (count, 0, None)

    port = free_port()
    with recorder_for_viewers(tmp_path / "flight.mcap", port) as recorder:
        asyncio.run(flight(recorder))
    assert capfd.readouterr().err == ""


def test_a_viewer_that_reads_nothing_costs_no_tick_and_does_not_delay_the_end(tmp_path: Path) -> None:
    async def flight(recorder: RecorderProcess) -> None:
        rows = tethered(end_s=600.0)
        async with connected(port) as viewer, connected(port) as other:
            count = await offer_until(recorder, rows, viewer, {"/outputs"})
            # The sockets hold 4 MB, the server 256 messages: 16 MB.
            write_lines(recorder, range(500))
            count += offer(recorder, itertools.islice(rows, 20))
            await other.read_to_line(499)  # by now the recorder has offered every line to both viewers
            assert await viewer.read_to_line(499) < 500, "no message was dropped: the viewer was not slow"
            write_lines(recorder, range(100))
            count += offer(recorder, itertools.islice(rows, 20))
            report = recorder.finish(DEADLINE_S)
            assert (report.samples, report.dropped, report.error) == (count, 0, None)

    port = free_port()
    with recorder_for_viewers(tmp_path / "flight.mcap", port) as recorder:
        asyncio.run(flight(recorder))


def test_a_server_that_cannot_start_costs_a_line_in_the_log_and_no_tick(tmp_path: Path) -> None:
    with (
        socket.create_server(("127.0.0.1", 0)) as other,
        recorder_for_viewers(tmp_path / "flight.mcap", other.getsockname()[1]) as recorder,
    ):
        count = offer(recorder, itertools.islice(tethered(end_s=1.0), 5))
        report = recorder.finish(DEADLINE_S)
    assert (report.samples, report.dropped, report.error) == (count, 0, None)
    (line,) = view(tmp_path / "flight.mcap").by_topic["/log"]
    assert "no live viewers at 127.0.0.1:" in line.data["message"]
    assert "in use" in line.data["message"]
