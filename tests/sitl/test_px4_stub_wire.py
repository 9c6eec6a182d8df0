"""The PX4 stub on real UDP sockets: partner, sequence numbers, STATUSTEXT rule, link fault, busy port."""

from __future__ import annotations

import asyncio
import contextlib
import socket
from collections import Counter
from collections.abc import Iterator
from typing import Any, Self

import pytest
from pymavlink.dialects.v20 import common as mavlink

from sitl.autopilot.mavlink import LinkError, MavlinkServer, Ports
from tests.sitl.px4_rig import Rig
from tests.support import DEADLINE_S


class Peer:
    """A MAVLink node on its own UDP socket."""

    def __init__(self, component: int = 190) -> None:
        self._socket = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
        self._socket.bind(("127.0.0.1", 0))
        self._socket.setblocking(False)
        self.port: int = self._socket.getsockname()[1]
        self._codec = mavlink.MAVLink(None, srcSystem=245, srcComponent=component)
        self.received: list[Any] = []

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        self._socket.close()

    def send_bytes(self, data: bytes, port: int) -> None:
        self._socket.sendto(data, ("127.0.0.1", port))

    def send(self, message: Any, port: int) -> None:
        self.send_bytes(message.pack(self._codec), port)

    def heartbeat(self, port: int, kind: int) -> None:
        self.send(mavlink.MAVLink_heartbeat_message(kind, mavlink.MAV_AUTOPILOT_INVALID, 0, 0, 4, 3), port)

    def arm(self, port: int) -> None:
        number = mavlink.MAV_CMD_COMPONENT_ARM_DISARM
        self.send(mavlink.MAVLink_command_long_message(1, 1, number, 0, 1, 0, 0, 0, 0, 0, 0), port)

    def drain(self) -> None:
        with contextlib.suppress(BlockingIOError):
            while True:
                self.received.extend(self._codec.parse_buffer(self._socket.recv(2048)) or ())

    def forget(self) -> None:
        self.drain()
        self.received.clear()

    def types(self) -> Counter[str]:
        return Counter(message.get_type() for message in self.received)

    def texts(self) -> list[tuple[int, int, str]]:
        """Return id, number and text of each piece of a STATUSTEXT."""
        pieces = [message for message in self.received if message.get_type() == "STATUSTEXT"]
        return [(piece.id, piece.chunk_seq, piece.text) for piece in pieces]


DENIED = [(0, 0, "Arming denied: Resolve system health failures first"[:50]), (0, 1, "t\t")]


@pytest.fixture
def rig() -> Rig:
    return Rig()


@pytest.fixture
def peer() -> Iterator[Peer]:
    with Peer() as peer:
        yield peer


@pytest.fixture
def second() -> Iterator[Peer]:
    with Peer() as second:
        yield second


async def run(rig: Rig, server: MavlinkServer, peer: Peer, world_s: float) -> None:
    """Advance world time, and pump and read the link."""
    until_s = rig.t_s + world_s
    while rig.t_s < until_s:
        rig.step()
        server.pump(rig.t_s)
        await asyncio.sleep(0)
        peer.drain()


async def run_until_handled(rig: Rig, server: MavlinkServer, peer: Peer, messages: int) -> None:
    """Wait until the stub has decoded this many messages."""
    async with asyncio.timeout(DEADLINE_S):
        while server.messages_in < messages:
            await run(rig, server, peer, 0.004)


async def test_the_partner_is_the_first_sender_until_px4_restarts_and_links_are_separate(
    rig: Rig, peer: Peer, second: Peer
) -> None:
    with Peer() as unheard, Peer() as ground:
        async with MavlinkServer(rig.stub, Ports(0, unheard.port), Ports(0, ground.port)) as server:
            await run(rig, server, unheard, 0.5)
            assert unheard.received, "before the first message from a partner"
            for number, sender in enumerate((peer, second), 1):
                sender.heartbeat(server.onboard_port, mavlink.MAV_TYPE_ONBOARD_CONTROLLER)
                await run_until_handled(rig, server, peer, number)
                unheard.forget()
            await run(rig, server, peer, 1.0)
            for other in (unheard, second, ground):
                other.drain()
            assert not unheard.received and not second.received
            assert peer.types()["ODOMETRY"] > 20
            assert ground.types()["ATTITUDE"] > 0
            assert ground.types()["ODOMETRY"] == 0, "not a ground station's stream"
            rig.stub.reboot(0.1)
            rig.run(0.2)
            second.heartbeat(server.onboard_port, mavlink.MAV_TYPE_ONBOARD_CONTROLLER)
            await run_until_handled(rig, server, second, 3)
            await run(rig, server, second, 1.0)
            assert second.types()["HEARTBEAT"] > 0, "a new start, a new partner"


async def test_a_ground_station_receives_the_texts_of_the_last_seconds_and_no_other_partner(
    rig: Rig, peer: Peer
) -> None:
    async with MavlinkServer(rig.stub, Ports(0, 0)) as server:
        peer.heartbeat(server.onboard_port, mavlink.MAV_TYPE_ONBOARD_CONTROLLER)
        peer.arm(server.onboard_port)
        await run_until_handled(rig, server, peer, 2)
        await run(rig, server, peer, 5.1)  # now it is stale
        peer.arm(server.onboard_port)
        await run_until_handled(rig, server, peer, 3)
        await run(rig, server, peer, 1.0)
        acks = [message.result for message in peer.received if message.get_type() == "COMMAND_ACK"]
        assert acks == [mavlink.MAV_RESULT_TEMPORARILY_REJECTED] * 2
        assert not peer.texts()
        peer.heartbeat(server.onboard_port, mavlink.MAV_TYPE_GCS)
        await run_until_handled(rig, server, peer, 4)
        await run(rig, server, peer, 0.1)
        assert peer.texts() == DENIED


async def test_a_busy_port_is_one_clear_line(rig: Rig, peer: Peer) -> None:
    with pytest.raises(LinkError, match=rf"^.*127\.0\.0\.1:{peer.port} is in use.*$"):
        async with MavlinkServer(rig.stub, Ports(0, 0), Ports(peer.port, 0)):
            pass
