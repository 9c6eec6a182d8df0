"""The driver of PX4 over links that are streams of bytes: a serial port and a TCP connection, with a real PX4 peer behind a bridge."""

from __future__ import annotations

import asyncio
import contextlib
import os
import select
import socket
import threading
from collections.abc import Callable, Iterator
from contextlib import AbstractContextManager, ExitStack, closing, contextmanager

import pytest

from companion.config.devices import AutopilotDevice
from companion.io.px4.driver import MavsdkAutopilot
from companion.model.types import AttitudeSetpoint
from companion.runtime.clock import flight_clock
from tests.io.px4_peer import PARAMS, Px4Peer
from tests.support import DEADLINE_S, eventually, serial_line

PIECE_BYTES = 17
"""Bytes that a bridge passes at once: no message arrives whole."""


@contextmanager
def bridged(open_stream: Callable[[], int]) -> Iterator[None]:
    """Pass bytes between a stream, given by its descriptor, and a PX4 peer on UDP."""
    ended = threading.Event()

    def run(udp: socket.socket, px4: Px4Peer) -> None:
        stream = open_stream()
        while not ended.is_set():
            ready = select.select([stream, udp.fileno()], [], [], 0.01)[0]
            with contextlib.suppress(OSError):  # the driver has closed its end
                if stream in ready:
                    udp.sendto(os.read(stream, 4096), px4.address)
                if udp.fileno() in ready:
                    data = udp.recv(4096)
                    for at in range(0, len(data), PIECE_BYTES):
                        os.write(stream, data[at : at + PIECE_BYTES])

    with closing(socket.socket(type=socket.SOCK_DGRAM)) as udp:
        udp.bind(("127.0.0.1", 0))
        with Px4Peer(udp.getsockname()[1]) as px4:
            thread = threading.Thread(target=run, args=(udp, px4), name="bridge")
            thread.start()
            try:
                yield
            finally:
                ended.set()
                thread.join(DEADLINE_S)


@contextmanager
def serial_link() -> Iterator[str]:
    with serial_line() as (far, port), bridged(lambda: far):
        yield f"serial://{port}:921600"


@contextmanager
def tcp_link() -> Iterator[str]:
    with ExitStack() as stack:
        server = stack.enter_context(socket.create_server(("127.0.0.1", 0)))
        with bridged(lambda: stack.enter_context(server.accept()[0]).fileno()):
            yield f"tcpout://127.0.0.1:{server.getsockname()[1]}"


@pytest.mark.parametrize("link", [serial_link, tcp_link])
def test_px4_behind_a_stream_of_bytes(link: Callable[[], AbstractContextManager[str]]) -> None:
    async def fly(address: str) -> None:
        device = AutopilotDevice(address=address, discovery_timeout_s=DEADLINE_S)
        async with MavsdkAutopilot(device, flight_clock()) as autopilot:
            await eventually(lambda: autopilot.vehicle() is not None, "the vehicle's state")
            assert await autopilot.read_param("MPC_THR_HOVER") == PARAMS["MPC_THR_HOVER"]
            assert autopilot.send_attitude(AttitudeSetpoint((1.0, 0.0, 0.0, 0.0), 0.5))
            before = autopilot.counts()
            await eventually(lambda: _read(autopilot) > before.attitude + 50, "50 more attitudes")

    with link() as address:
        asyncio.run(fly(address))


def _read(autopilot: MavsdkAutopilot) -> int:
    autopilot.vehicle()
    return autopilot.counts().attitude
