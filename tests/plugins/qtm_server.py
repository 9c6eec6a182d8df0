"""A small QTM: the commands of its real-time protocol that a client of 6DOF bodies needs, on real sockets, in a thread of its own."""

from __future__ import annotations

import asyncio
import re
import struct
import threading
from collections.abc import Iterator, Sequence
from contextlib import contextmanager, suppress

_ERROR, _COMMAND, _XML, _DATA, _6D_RES = 0, 1, 2, 3, 11
PERIOD_S = 0.005
Body = tuple[str, tuple[float, ...]]
"""Name, and the 13 floats of 6DRes: position (mm), rotation matrix by columns, residual (mm)."""


class Qtm:
    """The server; `bodies` may be changed while it streams.

    Args:
        bodies: the bodies of the project, in order.
    """

    def __init__(self, bodies: Sequence[Body]) -> None:
        self.bodies = list(bodies)
        self.commands: list[str] = []
        self.port = 0
        self._frame = 0
        self._writers: list[asyncio.StreamWriter] = []
        self._streams: dict[asyncio.StreamWriter, tuple[str, int]] = {}
        self._loop = asyncio.new_event_loop()

    def hang_up(self) -> None:
        """Close every connection, as QTM does when it ends."""
        for writer in self._writers:
            self._loop.call_soon_threadsafe(writer.close)

    async def run(self, ready: threading.Event, stop: asyncio.Event) -> None:
        server = await asyncio.start_server(self._serve, "127.0.0.1", 0)
        self.port = server.sockets[0].getsockname()[1]
        transport, _ = await self._loop.create_datagram_endpoint(asyncio.DatagramProtocol, local_addr=("127.0.0.1", 0))
        ready.set()
        while not stop.is_set():
            self._frame += 1
            for address in list(self._streams.values()):
                transport.sendto(frame(self._frame, [values for _, values in self.bodies]), address)
            with suppress(TimeoutError):
                async with asyncio.timeout(PERIOD_S):
                    await stop.wait()
        transport.close()
        server.close()
        for writer in self._writers:
            writer.close()

    async def _serve(self, reader: asyncio.StreamReader, writer: asyncio.StreamWriter) -> None:
        self._writers.append(writer)
        _send(writer, _COMMAND, b"QTM RT Interface connected\0")
        with suppress(OSError, asyncio.IncompleteReadError):
            while True:
                size, _ = struct.unpack("<II", await reader.readexactly(8))
                text = (await reader.readexactly(size - 8)).rstrip(b"\0").decode()
                self.commands.append(text)
                self._answer(writer, text)
        self._streams.pop(writer, None)
        writer.close()

    def _answer(self, writer: asyncio.StreamWriter, text: str) -> None:
        if text == "Version 1.25":
            _send(writer, _COMMAND, b"Version set to 1.25\0")
        elif text == "GetParameters 6D":
            names = "".join(f"<Body><Name>{name}</Name></Body>" for name, _ in self.bodies)
            settings = f"<QTM_Parameters_Ver_1.25><The_6D>{names}</The_6D></QTM_Parameters_Ver_1.25>"
            _send(writer, _XML, settings.encode() + b"\0")
        elif found := re.fullmatch(r"StreamFrames AllFrames UDP:(\d+) 6DRes", text):
            self._streams[writer] = ("127.0.0.1", int(found[1]))
        else:
            _send(writer, _ERROR, b"Parse error\0")


def frame(number: int, bodies: Sequence[tuple[float, ...]]) -> bytes:
    """A data packet with the component 6DRes alone."""
    content = struct.pack("<ihh", len(bodies), 0, 0) + b"".join(struct.pack("<13f", *values) for values in bodies)
    component = struct.pack("<II", 8 + len(content), _6D_RES) + content
    return struct.pack("<IIqII", 24 + len(component), _DATA, round(number * PERIOD_S * 1e6), number, 1) + component


def _send(writer: asyncio.StreamWriter, kind: int, content: bytes) -> None:
    writer.write(struct.pack("<II", 8 + len(content), kind) + content)


@contextmanager
def streaming(*bodies: Body) -> Iterator[Qtm]:
    """Run a QTM with these bodies."""
    qtm, ready, stop = Qtm(bodies), threading.Event(), asyncio.Event()
    thread = threading.Thread(target=lambda: qtm._loop.run_until_complete(qtm.run(ready, stop)))
    thread.start()
    try:
        ready.wait()
        yield qtm
    finally:
        qtm._loop.call_soon_threadsafe(stop.set)
        thread.join()
        qtm._loop.close()
