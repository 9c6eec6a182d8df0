"""The guardian's link, and its messages compared with those of the flight process."""

from __future__ import annotations

import asyncio
import os
import socket
import time
from contextlib import closing

from pymavlink.dialects.v20 import common as mavlink

from companion.config.devices import AutopilotDevice
from companion.guardian.link import Link
from companion.io.px4.driver import MavsdkAutopilot
from companion.model.frames import quat_from_euler_zyx
from companion.model.types import MocapPose
from tests.io.px4_peer import Px4Peer
from tests.io.test_px4_wire import heartbeat, opened
from tests.support import free_udp_port, wait_until

POSE = MocapPose(
    stamp_s=12.345678,
    frame_number=7,
    position_world_m=(1.25, -2.5, 0.75),
    attitude_wxyz=quat_from_euler_zyx(0.1, -0.2, 2.3),
    tracking_valid=True,
    marker_error_m=0.0002,
)


def test_only_px4_itself_is_listened_to_and_noise_does_no_harm() -> None:
    with closing(socket.socket(type=socket.SOCK_DGRAM)) as px4:
        px4.bind(("127.0.0.1", 0))
        with opened(f"udpout://127.0.0.1:{px4.getsockname()[1]}") as wire:
            link = Link(wire, (1, 195), 1)
            link.send_heartbeat()
            _, ours = px4.recvfrom(1000)
            cut = heartbeat()[:-5]
            for data in (
                b"\xfd",
                cut,
                os.urandom(300),
                heartbeat(255, 190),
                heartbeat(1, 154),
                heartbeat(2, 1),
                heartbeat(),
            ):
                px4.sendto(data, ours)
            found = []

            def heard() -> bool:
                found.extend(link.receive())
                return bool(found)

            wait_until(heard, lambda: "nothing came")
            assert [(m.get_type(), m.get_srcSystem(), m.get_srcComponent()) for m in found] == [("HEARTBEAT", 1, 1)]


def test_it_says_what_mavsdk_says() -> None:
    """VISION_POSITION_ESTIMATE and HEARTBEAT of the flight process and of the guardian, field by field."""
    port = free_udp_port()

    async def by_mavsdk() -> tuple[int, int, int]:
        async with MavsdkAutopilot(AutopilotDevice(address=f"udpin://127.0.0.1:{port}"), time.monotonic) as autopilot:
            assert autopilot.send_vision(POSE)
            await asyncio.to_thread(peer.wait_for, "VISION_POSITION_ESTIMATE")
            await asyncio.to_thread(peer.wait_for, "HEARTBEAT")
            identity = autopilot.identity()
            assert identity.local_port == port
            return identity.autopilot_system, identity.own_system, identity.own_component

    with Px4Peer(port) as peer:
        system, *own = asyncio.run(by_mavsdk())
        with opened(f"udpin://127.0.0.1:{port}") as wire:
            link = Link(wire, (own[0], own[1]), system)
            wait_until(lambda: bool(link.receive()), lambda: "PX4 is not heard")
            before = len(peer.of("HEARTBEAT"))
            link.send_heartbeat()
            link.send_vision(POSE)
            peer.wait_for("VISION_POSITION_ESTIMATE", 2)
            peer.wait_for("HEARTBEAT", before + 1)
        for name in ("VISION_POSITION_ESTIMATE", "HEARTBEAT"):
            # The flight process beats as a ground station, too: for PX4's words (type 6).
            said = [message for message in peer.of(name) if getattr(message, "type", None) != mavlink.MAV_TYPE_GCS]
            theirs, ours = said[0], said[-1]
            assert str(ours) == str(theirs)
            assert (ours.get_srcSystem(), ours.get_srcComponent()) == (
                theirs.get_srcSystem(),
                theirs.get_srcComponent(),
            )
