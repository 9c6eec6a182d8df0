"""The driver of PX4 over links that are streams of bytes: a serial port and a TCP connection, with a real PX4 peer behind a bridge."""

from __future__ import annotations

import asyncio
import contextlib
import socket
from collections.abc import Callable, Iterator
from contextlib import AbstractContextManager, ExitStack, closing, contextmanager
from pathlib import Path

import pytest
from pymavlink.dialects.v20 import common as mavlink

from companion.io.px4.driver import MavsdkAutopilot
from companion.model.types import AttitudeSetpoint, AutopilotRequest
from tests.io.px4_peer import PARAMS, Px4Peer
from tests.io.test_px4 import edge
from tests.support import eventually
from tests.wires import bridged, plugged, serial_line

LEVEL = AttitudeSetpoint((1.0, 0.0, 0.0, 0.0), 0.5)
PIECE_BYTES = 17
"""Bytes that a bridge passes at once: no message arrives whole."""


@contextmanager
def peer_behind(open_stream: Callable[[], int]) -> Iterator[Px4Peer]:
    """A PX4 peer at the end of a stream, given by its descriptor."""
    with closing(socket.socket(type=socket.SOCK_DGRAM)) as udp:
        udp.bind(("127.0.0.1", 0))
        with Px4Peer(udp.getsockname()[1]) as px4, bridged(udp, px4.address, open_stream, PIECE_BYTES):
            yield px4


@contextmanager
def serial_link() -> Iterator[str]:
    with serial_line() as (far, port), peer_behind(lambda: far):
        yield f"serial://{port}:921600"


@contextmanager
def tcp_link() -> Iterator[str]:
    with ExitStack() as stack:
        server = stack.enter_context(socket.create_server(("127.0.0.1", 0)))
        with peer_behind(lambda: stack.enter_context(server.accept()[0]).fileno()):
            yield f"tcpout://127.0.0.1:{server.getsockname()[1]}"


@pytest.mark.parametrize("link", [serial_link, tcp_link])
def test_px4_behind_a_stream_of_bytes(link: Callable[[], AbstractContextManager[str]]) -> None:
    async def fly(address: str) -> None:
        async with edge(address) as autopilot:
            await eventually(lambda: autopilot.vehicle() is not None, "the vehicle's state")
            assert await autopilot.read_param("MPC_THR_HOVER") == PARAMS["MPC_THR_HOVER"]
            assert autopilot.send_attitude(LEVEL)
            before = autopilot.counts()
            await eventually(lambda: _read(autopilot) > before.attitude + 50, "50 more attitudes")

    with link() as address:
        asyncio.run(fly(address))


async def test_a_serial_port_that_comes_back_under_its_name_is_used_again_and_the_streams_are_requested_again(
    tmp_path: Path,
) -> None:
    async with contextlib.AsyncExitStack() as stack:
        with px4_cable(tmp_path / "px4"):
            autopilot = await stack.enter_async_context(edge(f"serial://{tmp_path / 'px4'}:921600"))
            await eventually(lambda: autopilot.vehicle() is not None, "the vehicle's state")
        await eventually(lambda: has_hung_up(autopilot), "the loss")
        before = autopilot.counts()
        assert not autopilot.send_attitude(LEVEL)
        with px4_cable(tmp_path / "px4") as px4:  # a restarted end of the link: PX4 has forgotten the rates
            await eventually(lambda: _read(autopilot) > before.attitude + 50, "50 more attitudes")
            assert autopilot.send_attitude(LEVEL)
            await eventually(lambda: bool(px4.of("SET_ATTITUDE_TARGET")), "a setpoint")
            autopilot.request(AutopilotRequest.LAND)
            await eventually(lambda: bool(px4.commands(mavlink.MAV_CMD_NAV_LAND)), "LAND")


@contextmanager
def px4_cable(name: Path) -> Iterator[Px4Peer]:
    with serial_line() as (far, port), plugged(name, port), peer_behind(lambda: far) as px4:
        yield px4


def has_hung_up(autopilot: MavsdkAutopilot) -> bool:
    return any("the connection has ended" in text for text in autopilot.take_messages())


def _read(autopilot: MavsdkAutopilot) -> int:
    autopilot.vehicle()
    return autopilot.counts().attitude
