"""The motion-capture driver against the SITL's NatNet server: real sockets, both transports, both versions, and every refusal.

What the client makes of datagrams: test_natnet_client.py.
"""

from __future__ import annotations

import asyncio
import dataclasses
import logging
import resource
import socket
from collections.abc import AsyncIterator, Callable, Sequence
from contextlib import asynccontextmanager, closing
from typing import Any, Literal

import pytest

from companion.config.devices import MocapDevice
from companion.io.mocap import natnet
from companion.io.mocap.client import FRAMES_SILENCE_S
from companion.io.mocap.driver import MocapDriver
from companion.io.mocap.natnet import Message
from companion.io.protocols import Mocap
from companion.model.types import MocapPose, Vec3
from companion.runtime.clock import flight_clock, monotonic
from sitl.natnet import BodyPose, NatNetServer
from tests.io.natnet_bytes import LATER, VERSIONS
from tests.io.refusal import refusal
from tests.support import DEADLINE_S

GROUP = "239.255.42.99"
IP_DROP_SOURCE_MEMBERSHIP = 40
"""From linux/in.h."""
POSE = BodyPose(1, (-1.25, 0.5, 1.0), (0.5, -0.5, 0.5, 0.5), error_m=0.00025)
STRANGER = BodyPose(4, (3.0, 3.0, 0.0), (1.0, 0.0, 0.0, 0.0))
Transport = Literal["multicast", "unicast"]


def device_for(server: NatNetServer, transport: Transport = "unicast", **changes: Any) -> MocapDevice:
    fields: dict[str, object] = {
        "server": "127.0.0.1",
        "interface": "127.0.0.1",
        "transport": transport,
        "multicast_group": GROUP,
        "command_port": server.command_port,
        "data_port": server.data_port,
        "rigid_body_id": 1,
    }
    return MocapDevice.model_validate(fields | changes)


@asynccontextmanager
async def streaming(
    server: NatNetServer, *poses: BodyPose, held_s: float = 0.0, single: Sequence[Vec3] = ()
) -> AsyncIterator[None]:
    """Publish poses and single markers at about 200 Hz, 4 ms after exposure; the network holds each frame for `held_s`."""

    async def publish() -> None:
        while True:
            t_s = monotonic() - held_s
            server.publish(t_s, poses, t_s - 0.004, single)
            await asyncio.sleep(0.005)

    publisher = asyncio.create_task(publish())
    try:
        yield
    finally:
        publisher.cancel()
        await asyncio.gather(publisher, return_exceptions=True)


class Inbox:
    """An `on_pose` that keeps what it got."""

    def __init__(self) -> None:
        self.queue: asyncio.Queue[MocapPose] = asyncio.Queue()

    def __call__(self, pose: MocapPose) -> None:
        self.queue.put_nowait(pose)

    async def next(self) -> MocapPose:
        return await asyncio.wait_for(self.queue.get(), DEADLINE_S)

    def clear(self) -> None:
        while not self.queue.empty():
            self.queue.get_nowait()


def mocap(
    device: MocapDevice, on_pose: Callable[[MocapPose], None] | None = None, body_timeout_s: float = DEADLINE_S
) -> MocapDriver:
    return MocapDriver(
        device, flight_clock(), on_pose or Inbox(), connect_timeout_s=DEADLINE_S, body_timeout_s=body_timeout_s
    )


@pytest.mark.parametrize("version", VERSIONS)
@pytest.mark.parametrize("transport", ["unicast", "multicast"])
async def test_pose_arrives(version: str, transport: Transport) -> None:
    group = GROUP if transport == "multicast" else None
    inbox = Inbox()
    async with NatNetServer(version, multicast_group=group) as server, streaming(server, STRANGER, POSE):
        edge = mocap(device_for(server, transport, natnet_version=None if version == LATER else version), inbox)
        assert edge.latest() is None
        async with edge:
            latest: Mocap = edge
            pose = latest.latest()
            assert pose is not None
            assert pose.position_world_m == (-1.25, 0.5, 1.0)
            assert pose.attitude_wxyz == (0.5, -0.5, 0.5, 0.5)
            assert pose.tracking_valid
            assert pose.marker_error_m == pytest.approx(0.00025)
            assert pose.latency_s is not None and pose.latency_s > 0.004 - 1e-6
            first, second = await inbox.next(), await inbox.next()
            assert second.frame_number > first.frame_number
            assert second.stamp_s >= first.stamp_s
            assert edge.server is not None and edge.server.protocol_version == version
            assert set(edge.bodies) == {STRANGER.id, POSE.id}


async def test_the_latency_contains_the_delay_on_the_network() -> None:
    """The server has stamped each frame 0.15 s before it arrives; the server's answers to echo requests show it."""

    inbox = Inbox()
    async with NatNetServer() as server, streaming(server, POSE, held_s=0.15), mocap(device_for(server), inbox):
        latencies_s = [(await inbox.next()).latency_s or 0.0 for _ in range(300)]
        assert max(latencies_s) >= 0.15


async def test_a_multicast_server_also_serves_a_unicast_client() -> None:
    async with (
        NatNetServer(multicast_group=GROUP) as server,
        streaming(server, POSE),
        mocap(device_for(server)) as edge,
    ):
        assert edge.latest() is not None


async def test_multicast_of_another_sender_is_dropped_by_the_kernel() -> None:
    inbox = Inbox()
    async with (
        NatNetServer(multicast_group=GROUP) as server,
        streaming(server, POSE),
        mocap(device_for(server, "multicast"), inbox) as edge,
    ):
        with closing(socket.socket(type=socket.SOCK_DGRAM)) as stranger:
            stranger.bind(("127.0.0.9", 0))
            stranger.setsockopt(socket.IPPROTO_IP, socket.IP_MULTICAST_IF, socket.inet_aton("127.0.0.1"))
            for _ in range(20):
                stranger.sendto(b"anything", (GROUP, server.data_port))
                await inbox.next()
        assert edge.counts().foreign == 0


async def test_two_listeners_share_the_multicast_port() -> None:
    async with NatNetServer(multicast_group=GROUP) as server, streaming(server, POSE):
        device = device_for(server, "multicast")
        async with mocap(device) as flight, mocap(device) as guardian:
            assert flight.latest() is not None
            assert guardian.latest() is not None


@pytest.mark.parametrize("descriptors", [True, False], ids=["at once", "once a file descriptor is free"])
async def test_a_socket_that_has_lost_its_multicast_group_joins_it_again(descriptors: bool) -> None:
    """As after a USB network adapter was unplugged and plugged in again: the kernel forgets its groups."""
    inbox = Inbox()
    async with (
        NatNetServer(multicast_group=GROUP) as server,
        streaming(server, POSE),
        mocap(device_for(server, "multicast"), inbox) as edge,
    ):
        member = socket.inet_aton(GROUP) + socket.inet_aton("127.0.0.1") * 2  # struct ip_mreq_source
        edge.client.extended.sockets[-1].setsockopt(socket.IPPROTO_IP, IP_DROP_SOURCE_MEMBERSHIP, member)
        edge.client.poses()  # those that arrived before
        inbox.clear()
        if not descriptors:
            limits = resource.getrlimit(resource.RLIMIT_NOFILE)
            resource.setrlimit(resource.RLIMIT_NOFILE, (3, limits[1]))
            try:
                await asyncio.sleep(2.0 * FRAMES_SILENCE_S)
                assert edge.client.problem is None, "it is not the server's fault"
                assert not inbox.queue.qsize()
            finally:
                resource.setrlimit(resource.RLIMIT_NOFILE, limits)
        await inbox.next()


async def test_leaving_unsubscribes_and_frees_the_sockets() -> None:
    async with NatNetServer() as server, streaming(server, POSE):
        for _ in range(3):
            async with mocap(device_for(server)):
                assert len(server.unicast_clients) == 1
            await until(lambda: not server.unicast_clients)


@asynccontextmanager
async def quiet_after_opening(
    on_pose: Callable[[MocapPose], None], **changes: Any
) -> AsyncIterator[tuple[NatNetServer, MocapDriver]]:
    """A server that has stopped publishing and an edge that has read everything: what comes next is the test's own."""
    async with NatNetServer() as server:
        async with streaming(server, POSE):
            edge = await mocap(device_for(server, **changes), on_pose).__aenter__()
        try:
            # The last frame is answered for before the test begins.
            await until(lambda: (pose := edge.latest()) is not None and pose.frame_number == server.frame_number)
            yield server, edge
        finally:
            await edge.__aexit__(None, None, None)


async def until(condition: Callable[[], bool]) -> None:
    """Wait for something that a socket callback does."""
    async with asyncio.timeout(DEADLINE_S):
        while not condition():  # noqa: ASYNC110 - datagrams set no event
            await asyncio.sleep(0.001)


async def test_newest_of_the_waiting_frames_wins() -> None:
    inbox = Inbox()
    async with quiet_after_opening(inbox) as (server, edge):
        with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as witness:
            witness.bind(("127.0.0.1", 0))
            witness.settimeout(DEADLINE_S)
            witness.sendto(natnet.encode_connect(), ("127.0.0.1", server.command_port))
            await until(lambda: len(server.unicast_clients) == 2)
            inbox.clear()
            before = edge.counts()
            for k in range(5):
                server.publish(10.0 + k, [BodyPose(1, (float(k), 0.0, 0.0), (1.0, 0.0, 0.0, 0.0))], None)
            # The loop stands still here. Frames go to the edge first: when the witness has five, so has the edge's socket.
            while natnet.message_id(witness.recv(65535)) != Message.FRAME:
                pass
            for _ in range(4):
                witness.recv(65535)
        assert (await inbox.next()).position_world_m == (4.0, 0.0, 0.0)
        assert inbox.queue.empty()
        assert edge.counts().superseded - before.superseded == 4
        assert edge.counts().frames - before.frames == 1


async def test_unicast_server_that_was_restarted_is_connected_again() -> None:
    inbox = Inbox()
    async with quiet_after_opening(inbox) as (server, _):
        port = server.command_port
        await server.__aexit__(None, None, None)
        inbox.clear()
        moved = BodyPose(1, (9.0, 0.0, 1.0), (1.0, 0.0, 0.0, 0.0))
        async with NatNetServer(command_port=port) as successor, streaming(successor, moved):
            assert (await inbox.next()).position_world_m == (9.0, 0.0, 1.0)


def test_callback_that_fails_does_not_stop_reception(caplog: pytest.LogCaptureFixture) -> None:
    async def run() -> None:
        seen: list[int] = []

        def fails(pose: MocapPose) -> None:
            seen.append(pose.frame_number)
            raise RuntimeError("link refused")

        async with quiet_after_opening(fails) as (server, edge):
            known = len(seen)
            for k in range(3):
                server.publish(10.0 + k, [POSE], None)
                await until(lambda k=k: len(seen) == known + k + 1)  # type: ignore[misc]
            latest = edge.latest()
            assert latest is not None
            assert latest.frame_number == seen[-1]
            assert edge.counts().callback_error == "RuntimeError: link refused"

    with caplog.at_level(logging.ERROR):
        asyncio.run(run())
    assert len([record for record in caplog.records if "on_pose failed" in record.message]) == 1


# -- what can be wrong ---------------------------------------------------------------------------------------------------------


async def test_no_answer() -> None:
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as deaf:
        deaf.bind(("127.0.0.1", 0))
        port = deaf.getsockname()[1]
        device = MocapDevice(
            server="127.0.0.1", interface="127.0.0.1", transport="unicast", command_port=port, rigid_body_id=1
        )
        text = await refusal(MocapDriver(device, flight_clock(), Inbox(), connect_timeout_s=0.3))
        assert f"127.0.0.1:{port}: no answer to the NatNet connect request within 0.3 s" in text


async def test_version_that_is_not_supported_or_not_wanted() -> None:
    async with NatNetServer("2.9") as ancient:
        assert "speaks NatNet 2.9, expected 3.0 or later" in await refusal(mocap(device_for(ancient)))
    async with NatNetServer("4.1") as server:
        text = await refusal(mocap(device_for(server, natnet_version="3.0")))
        assert "Motive speaks NatNet 4.1, expected 3.0" in text
        await until(lambda: server.requests > 1 and server.unicast_clients == ())


async def test_body_never_seen_lists_the_others() -> None:
    async with NatNetServer(bodies=[(1, "quad"), (4, "wand")]) as server, streaming(server, POSE, STRANGER):
        text = await refusal(mocap(device_for(server, rigid_body_id=7), body_timeout_s=1.0))
        assert "rigid body id 7 was never seen within 1 s" in text
        assert '1 "quad", 4 "wand"' in text


async def test_two_bodies_with_one_streaming_id() -> None:
    twin = dataclasses.replace(STRANGER, id=1)
    async with NatNetServer(bodies=[(1, "quad")]) as server, streaming(server, POSE, twin):
        text = await refusal(mocap(device_for(server)))
        assert 'two rigid bodies have the streaming id 1 "quad"; give each its own id in Motive' in text


async def test_body_never_tracked() -> None:
    lost = BodyPose(1, (0.0, 0.0, 0.0), (0.0, 0.0, 0.0, 0.0), valid=False)
    async with NatNetServer(bodies=[(1, "quad")]) as server, streaming(server, lost):
        text = await refusal(mocap(device_for(server), body_timeout_s=1.0))
        assert 'rigid body 1 "quad" is streamed but was not tracked' in text


@pytest.mark.parametrize("transport", ["unicast", "multicast"])
async def test_server_that_does_not_stream(transport: Transport) -> None:
    group = GROUP if transport == "multicast" else None
    async with NatNetServer(multicast_group=group) as server:
        text = await refusal(mocap(device_for(server, transport), body_timeout_s=0.2))
        assert "no frame of data arrived within 0.2 s" in text
        assert transport in text


async def test_transport_or_group_that_the_server_does_not_use() -> None:
    async with NatNetServer() as server:
        assert "the server streams unicast, expected multicast" in await refusal(mocap(device_for(server, "multicast")))
    async with NatNetServer(multicast_group=GROUP) as server:
        device = device_for(server, "multicast", multicast_group="239.255.42.98")
        text = await refusal(mocap(device))
        assert f"streams to {GROUP}:{server.data_port}, expected 239.255.42.98:{server.data_port}" in text


async def test_port_in_use() -> None:
    async with NatNetServer(multicast_group=GROUP) as server:
        with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as selfish:
            selfish.bind((GROUP, server.data_port))
            text = await refusal(mocap(device_for(server, "multicast")))
            assert f"cannot open UDP {GROUP}:{server.data_port}: another program holds the port" in text


async def test_an_interface_address_of_another_computer_is_refused() -> None:
    async with NatNetServer() as server:
        text = await refusal(mocap(device_for(server, interface="192.0.2.1")))
        assert "set devices.mocap.interface to an address of this computer" in text


async def test_a_server_name_that_cannot_be_resolved_is_refused() -> None:
    device = MocapDevice(server="256.256.256.256", interface="127.0.0.1", rigid_body_id=1)
    assert "the name cannot be resolved" in await refusal(mocap(device))
