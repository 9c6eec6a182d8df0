"""The PX4 stub on real UDP sockets: partner, sequence numbers, parameter list, STATUSTEXT rule, link fault, busy port."""

from __future__ import annotations

import asyncio
import socket
from collections import Counter
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

    def send(self, message: Any, port: int) -> None:
        self._socket.sendto(message.pack(self._codec), ("127.0.0.1", port))

    def heartbeat(self, port: int, kind: int) -> None:
        self.send(mavlink.MAVLink_heartbeat_message(kind, mavlink.MAV_AUTOPILOT_INVALID, 0, 0, 4, 3), port)

    def drain(self) -> None:
        while True:
            try:
                data = self._socket.recv(2048)
            except BlockingIOError:
                return
            self.received.extend(self._codec.parse_buffer(data) or ())

    def types(self) -> Counter[str]:
        return Counter(message.get_type() for message in self.received)


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


def test_streams_reach_the_remote_port_unasked_and_in_sequence() -> None:
    async def scenario() -> None:
        rig = Rig()
        with Peer() as peer:
            async with MavlinkServer(rig.stub, Ports(0, peer.port)) as server:
                await run(rig, server, peer, 3.0)
        types = peer.types()
        assert types["HEARTBEAT"] == 3
        assert types["ODOMETRY"] == pytest.approx(90, abs=3)
        assert types["ATTITUDE"] == pytest.approx(300, abs=6)
        assert types["LOCAL_POSITION_NED"] == pytest.approx(90, abs=5)
        sequence = [message.get_seq() for message in peer.received]
        assert sequence == [(sequence[0] + i) % 256 for i in range(len(sequence))]
        assert {(message.get_srcSystem(), message.get_srcComponent()) for message in peer.received} == {(1, 1)}

    asyncio.run(scenario())


def test_the_partner_is_whoever_spoke_first_until_px4_restarts_and_links_are_separate() -> None:
    async def scenario() -> None:
        rig = Rig()
        with Peer() as nobody, Peer() as first, Peer() as second, Peer() as ground:
            async with MavlinkServer(rig.stub, Ports(0, nobody.port), Ports(0, ground.port)) as server:
                await run(rig, server, nobody, 0.5)
                assert nobody.received, "before anybody speaks"
                first.heartbeat(server.onboard_port, mavlink.MAV_TYPE_ONBOARD_CONTROLLER)
                await run_until_handled(rig, server, first, 1)
                nobody.drain()
                nobody.received.clear()
                second.heartbeat(server.onboard_port, mavlink.MAV_TYPE_ONBOARD_CONTROLLER)
                await run_until_handled(rig, server, first, 2)
                await run(rig, server, first, 1.0)
                for peer in (nobody, second, ground):
                    peer.drain()
                assert not nobody.received
                assert not second.received
                assert first.types()["ODOMETRY"] > 20
                assert ground.types()["ATTITUDE"] > 0
                assert ground.types()["ODOMETRY"] == 0, "not a ground station's stream"
                rig.stub.reboot(0.1)
                rig.run(0.2)
                second.heartbeat(server.onboard_port, mavlink.MAV_TYPE_ONBOARD_CONTROLLER)
                await run_until_handled(rig, server, second, 3)
                await run(rig, server, second, 1.0)
                assert second.types()["HEARTBEAT"] > 0, "a new start, a new partner"

    asyncio.run(scenario())


def test_a_link_without_a_remote_port_sends_to_whoever_spoke_last() -> None:
    async def scenario() -> None:
        rig = Rig()
        with Peer() as first, Peer() as second:
            async with MavlinkServer(rig.stub, Ports(0, 0), None) as server:
                for number, peer in enumerate((first, second), 1):
                    peer.heartbeat(server.onboard_port, mavlink.MAV_TYPE_ONBOARD_CONTROLLER)
                    await run_until_handled(rig, server, peer, number)
                first.drain()
                first.received.clear()
                await run(rig, server, second, 1.0)
                first.drain()
                assert not first.received
                assert second.types()["ODOMETRY"] > 20

    asyncio.run(scenario())


def test_the_whole_parameter_list_arrives_once() -> None:
    async def scenario() -> None:
        rig = Rig()
        with Peer() as peer:
            async with MavlinkServer(rig.stub, Ports(0, 0)) as server:
                peer.send(mavlink.MAVLink_param_request_list_message(1, 1), server.onboard_port)
                await run_until_handled(rig, server, peer, 1)
                await run(rig, server, peer, 1.0)
        values = [message for message in peer.received if message.get_type() == "PARAM_VALUE"]
        names = [value.param_id for value in values]
        assert names[0] == "_HASH_CHECK"
        assert names[1:] == list(rig.params)
        assert {value.param_count for value in values} == {len(rig.params)}

    asyncio.run(scenario())


@pytest.mark.parametrize(
    ("kind", "texts"),
    [(mavlink.MAV_TYPE_GCS, True), (mavlink.MAV_TYPE_ONBOARD_CONTROLLER, False)],
)
def test_statustext_needs_a_ground_station_on_the_link(kind: int, texts: bool) -> None:
    async def scenario() -> None:
        rig = Rig()
        with Peer() as peer:
            async with MavlinkServer(rig.stub, Ports(0, 0)) as server:
                peer.heartbeat(server.onboard_port, kind)
                await run_until_handled(rig, server, peer, 1)
                peer.send(
                    mavlink.MAVLink_command_long_message(
                        1, 1, mavlink.MAV_CMD_COMPONENT_ARM_DISARM, 0, 1, 0, 0, 0, 0, 0, 0
                    ),
                    server.onboard_port,
                )
                await run_until_handled(rig, server, peer, 2)
                await run(rig, server, peer, 0.1)
        acks = [message for message in peer.received if message.get_type() == "COMMAND_ACK"]
        assert [ack.result for ack in acks] == [mavlink.MAV_RESULT_TEMPORARILY_REJECTED]
        chunks = [message for message in peer.received if message.get_type() == "STATUSTEXT"]
        if not texts:
            assert not chunks
            return
        assert "".join(chunk.text for chunk in chunks) == "Arming denied: Resolve system health failures first\t"
        assert [(chunk.id, chunk.chunk_seq) for chunk in chunks] == [(0, 0), (0, 1)]

    asyncio.run(scenario())


def test_a_new_ground_station_receives_recent_texts() -> None:
    async def scenario() -> None:
        rig = Rig()

        def arm() -> None:
            message = mavlink.MAVLink_command_long_message(
                1, 1, mavlink.MAV_CMD_COMPONENT_ARM_DISARM, 0, 1, 0, 0, 0, 0, 0, 0
            )
            peer.send(message, server.onboard_port)

        with Peer() as peer:
            async with MavlinkServer(rig.stub, Ports(0, 0)) as server:
                arm()
                await run_until_handled(rig, server, peer, 1)
                await run(rig, server, peer, 5.1)  # now it is stale
                arm()
                await run_until_handled(rig, server, peer, 2)
                await run(rig, server, peer, 1.0)
                assert "STATUSTEXT" not in peer.types()
                peer.heartbeat(server.onboard_port, mavlink.MAV_TYPE_GCS)
                await run_until_handled(rig, server, peer, 3)
                await run(rig, server, peer, 0.1)
        chunks = [message for message in peer.received if message.get_type() == "STATUSTEXT"]
        assert [(chunk.id, chunk.chunk_seq) for chunk in chunks] == [(0, 0), (0, 1)]

    asyncio.run(scenario())


def test_link_down_drops_both_ways_and_comes_back() -> None:
    async def scenario() -> None:
        rig = Rig()
        with Peer() as peer:
            async with MavlinkServer(rig.stub, Ports(0, peer.port)) as server:
                await run(rig, server, peer, 0.2)
                server.link_down = True
                peer.received.clear()
                for _ in range(5):
                    peer.heartbeat(server.onboard_port, mavlink.MAV_TYPE_GCS)
                await run(rig, server, peer, 2.0)
                assert not peer.received
                assert server.messages_in == 0
                server.link_down = False
                peer.heartbeat(server.onboard_port, mavlink.MAV_TYPE_GCS)
                await run_until_handled(rig, server, peer, 1)
                await run(rig, server, peer, 1.5)
                assert peer.types()["HEARTBEAT"] >= 1

    asyncio.run(scenario())


def test_garbage_and_cut_datagrams_do_no_harm() -> None:
    async def scenario() -> None:
        rig = Rig()
        with Peer() as peer, socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as raw:
            async with MavlinkServer(rig.stub, Ports(0, peer.port)) as server:
                whole = mavlink.MAVLink_heartbeat_message(6, 8, 0, 0, 4, 3).pack(mavlink.MAVLink(None, 245, 190))
                for data in (b"", b"\xfd", b"\x00" * 300, bytes(range(256)), whole[:-3], whole[:-1] + b"\x00"):
                    raw.sendto(data, ("127.0.0.1", server.onboard_port))
                for _ in range(3):
                    peer.heartbeat(server.onboard_port, mavlink.MAV_TYPE_GCS)
                await run_until_handled(rig, server, peer, 1)
                await run(rig, server, peer, 1.1)
                assert peer.types()["HEARTBEAT"] >= 1

    asyncio.run(scenario())


def test_a_busy_port_is_one_clear_line() -> None:
    async def scenario() -> None:
        with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as holder:
            holder.bind(("127.0.0.1", 0))
            port = holder.getsockname()[1]
            with pytest.raises(LinkError, match=rf"127\.0\.0\.1:{port} is in use") as caught:
                async with MavlinkServer(Rig().stub, Ports(0, 0), Ports(port, 0)):
                    pass
            assert "\n" not in str(caught.value)

    asyncio.run(scenario())
