"""Who is at the two ends of the link to PX4: one process at the near one, one address that has proved to be PX4 at the far one."""

from __future__ import annotations

import asyncio
import os
import socket
from collections import Counter
from collections.abc import Callable
from contextlib import closing
from pathlib import Path
from typing import Any

import pytest
import serial
from pymavlink.dialects.v20 import common as mavlink

from companion.io.protocols import DeviceError
from companion.io.px4 import frames as px4_frames
from companion.io.px4.exclusive_link import ExclusiveLink
from companion.io.px4.frames import AutopilotHeartbeat
from tests.io.px4_peer import Px4Peer
from tests.io.test_px4 import armed, edge, pose_of, refused
from tests.support import DEADLINE_S, eventually, free_udp_port
from tests.wires import serial_line

ARMED = mavlink.MAV_MODE_FLAG_CUSTOM_MODE_ENABLED | mavlink.MAV_MODE_FLAG_SAFETY_ARMED


def forged_heartbeat() -> bytes:
    message = mavlink.MAVLink_heartbeat_message(mavlink.MAV_TYPE_QUADROTOR, 12, ARMED, 4 << 16 | 6 << 24, 4, 3)
    packed: bytes = message.pack(mavlink.MAVLink(None, srcSystem=1, srcComponent=1))
    return packed


WRONG_HEARTBEAT = forged_heartbeat()[:-2] + b"\0\0"


def test_a_serial_port_that_another_program_has_locked_is_refused_by_every_name(tmp_path: Path) -> None:
    with serial_line() as (_, port), serial.Serial(port, exclusive=True):
        by_id = tmp_path / "by-id"
        by_id.symlink_to(port)
        for name in (port, by_id):
            text = asyncio.run(refused(f"serial://{name}:921600", 0.2))
            assert f"expected the serial port {name} to be free, found another program on it; stop that program" in text


def test_a_second_flight_on_the_same_serial_port_is_refused_and_the_first_keeps_it() -> None:
    async def main(port: str) -> str:
        address = f"serial://{port}:921600"
        entering = asyncio.create_task(edge(address).__aenter__())
        await eventually(lambda: _is_held(port), "the first has the port")
        text = await refused(address, 0.2)
        assert not entering.done()
        entering.cancel()
        with pytest.raises(asyncio.CancelledError):
            await entering
        return text

    with serial_line() as (_, port):
        assert "to be free, found another program on it" in asyncio.run(main(port))
        assert not _is_locked(port), "what was refused or ended holds nothing"


def _is_held(port: str) -> bool:
    """Look at the kernel's list of locks. To try the lock would take it, for a moment, from the flight that opens the port."""
    file = os.stat(port)
    locked = f" {os.major(file.st_dev):02x}:{os.minor(file.st_dev):02x}:{file.st_ino} "
    return locked in Path("/proc/locks").read_text(encoding="ascii")


def _is_locked(port: str) -> bool:
    try:
        serial.Serial(port, exclusive=True).close()
    except serial.SerialException:
        return True
    return False


def test_two_senders_that_claim_to_be_px4_are_refused_by_address() -> None:
    port = free_udp_port()
    # So often that each is heard while the link opens, however short that is.
    with Px4Peer(port, beat_period_s=0.01) as one, Px4Peer(port, beat_period_s=0.01) as other:
        with pytest.raises(DeviceError) as caught:
            asyncio.run(_enter(port))
        text = str(caught.value)
        assert "expected PX4 (system 1) at one address, found " in text
        assert all(f"{host}:{at}" in text for host, at in (one.address, other.address))


async def test_beside_an_armed_px4_the_other_sender_is_reported_and_the_flight_goes_on() -> None:
    port = free_udp_port()
    one, other = Px4Peer(port), Px4Peer(port)
    one.base_mode = other.base_mode = ARMED
    with one, other:
        async with edge(port) as autopilot:
            peer = autopilot.identity().peer
            rival = next(each.address for each in (one, other) if each.address != peer)
            texts: list[str] = []

            def reported() -> bool:
                texts.extend(autopilot.take_messages())
                return any(f"{rival[0]}:{rival[1]} claims to be PX4 (system 1)" in text for text in texts)

            await eventually(reported, "the rival is reported")
            texts.extend(text for _ in range(10) for text in autopilot.take_messages())
            assert sum("claims to be PX4" in text for text in texts) == 1


class _Broadcasting(Px4Peer):
    """PX4 with MAV_x_BROADCAST 1: it broadcasts until it has a partner, and takes none in its first time, here the first HEARTBEAT."""

    def __init__(self, port: int) -> None:
        super().__init__(port)
        self._partner = self.remote
        self.remote = ("127.255.255.255", port)
        self._socket.setsockopt(socket.SOL_SOCKET, socket.SO_BROADCAST, 1)

    def _take(self, message: Any) -> None:
        super()._take(message)
        if len(self.of("HEARTBEAT")) > 1:
            self.remote = self._partner


async def test_px4_that_broadcasts_until_it_has_a_partner_is_found() -> None:
    port = free_udp_port()
    with _Broadcasting(port) as px4:
        async with edge(f"udpin://0.0.0.0:{port}") as autopilot:
            assert autopilot.identity().peer == px4.address
            await eventually(lambda: autopilot.status() is not None, "a heartbeat")


async def test_calling_px4_leaves_no_task_behind() -> None:
    """It was cancelled and not waited for: it still ran when its port was closed."""

    port = free_udp_port()
    with Px4Peer(port) as px4, closing(ExclusiveLink(f"udpin://127.0.0.1:{port}")) as claim:
        await claim.find_px4(DEADLINE_S)
        async with claim.calling((1, 191)):
            await eventually(lambda: bool(px4.of("HEARTBEAT")), "a call")
        assert asyncio.all_tasks() == {asyncio.current_task()}


@pytest.mark.parametrize(
    ("data", "frames_max", "checksums_max"),
    [
        pytest.param(WRONG_HEARTBEAT * 3000, 0, 0, id="60 kB of heartbeats with wrong checksums"),
        pytest.param(WRONG_HEARTBEAT * 70, 3, 2, id="an Ethernet frame of them"),
        pytest.param(b"\xfe\0\0\1\1\0\0\0" * 187, 32, 2, id="an Ethernet frame of empty ones"),
        pytest.param(b"\xfe\0\0\1\1\1\0\0" * 187, 32, 0, id="an Ethernet frame of other messages"),
    ],
)
def test_little_of_a_strangers_datagram_is_read(
    data: bytes, frames_max: int, checksums_max: int, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Counted in the control loop's own call: frames cut out, and checksums computed."""
    counted: Counter[str] = Counter()
    for name in ("_frame_at", "_checksum"):
        monkeypatch.setattr(px4_frames, name, _counting(counted, name, getattr(px4_frames, name)))
    port = free_udp_port()
    with (
        closing(ExclusiveLink(f"udpin://127.0.0.1:{port}")) as claim,
        closing(socket.socket(type=socket.SOCK_DGRAM)) as stranger,
    ):
        stranger.sendto(data, ("127.0.0.1", port))
        assert claim.take_rival() is None
        assert (counted["_frame_at"] <= frames_max, counted["_checksum"] <= checksums_max) == (True, True), counted
        stranger.sendto(forged_heartbeat(), ("127.0.0.1", port))
        claim.take_rival()
        assert claim.peer is not None and claim.peer[1] == stranger.getsockname()[1], "a valid HEARTBEAT is still read"


def test_a_heartbeat_among_the_messages_that_a_bridge_puts_into_one_datagram_is_read() -> None:
    other = mavlink.MAVLink_attitude_message(0, 0.1, 0.2, 0.3, 0.4, 0.5, 0.6).pack(mavlink.MAVLink(None, 1, 1))
    assert px4_frames.autopilot_heartbeat(other * 20 + forged_heartbeat()) == AutopilotHeartbeat(1, True)


def _counting(counted: Counter[str], name: str, real: Callable[..., Any]) -> Callable[..., Any]:
    def count(*values: Any) -> Any:
        counted[name] += 1
        return real(*values)

    return count


async def _enter(port: int) -> None:
    async with edge(port):
        pass


async def test_a_stranger_in_px4s_name_changes_nothing_and_is_reported_once() -> None:
    port = free_udp_port()
    with Px4Peer(port) as px4, closing(socket.socket(type=socket.SOCK_DGRAM)) as stranger:
        async with edge(port) as autopilot:
            assert autopilot.identity().peer == px4.address
            await eventually(lambda: autopilot.status() is not None, "a heartbeat")
            texts: list[str] = []
            seen: list[bool] = []

            def forged() -> bool:
                stranger.sendto(forged_heartbeat(), ("127.0.0.1", port))
                texts.extend(autopilot.take_messages())
                seen.append(armed(autopilot))
                return len(seen) > 100

            await eventually(forged, "a hundred forged heartbeats")
            _, at = stranger.getsockname()
            assert [text for text in texts if f":{at} claims to be PX4 (system 1)" in text] == texts
            assert (len(texts), any(seen)) == (1, False)


async def test_px4_that_a_router_moved_to_another_port_is_heard_there() -> None:
    """Only after it was silent at its own port, and only at its own IP address: rivals elsewhere send all the time."""

    port = free_udp_port()
    with closing(socket.socket(type=socket.SOCK_DGRAM)) as elsewhere, Px4Peer(port) as px4:
        elsewhere.bind(("127.0.0.9", 0))
        async with edge(port) as autopilot:
            where = px4.address
            await eventually(lambda: autopilot.status() is not None, "a heartbeat")
            px4.__exit__(None, None, None)
            with Px4Peer(port) as moved:
                assert moved.address[1] != where[1]
                moved.base_mode = ARMED
                texts: list[str] = []

                def heard() -> bool:
                    elsewhere.sendto(forged_heartbeat(), ("127.0.0.1", port))
                    texts.extend(autopilot.take_messages())
                    return armed(autopilot)

                await eventually(heard, "PX4 is heard at its new port")
                assert autopilot.identity().peer == moved.address
                reports = [text for text in texts if "the link uses that port" in text]
                assert len(reports) == 1 and f"now sends from port {moved.address[1]}" in reports[0]


async def test_what_is_not_mavlink_from_a_stranger_is_not_reported() -> None:
    port = free_udp_port()
    with Px4Peer(port), closing(socket.socket(type=socket.SOCK_DGRAM)) as stranger:
        async with edge(port) as autopilot:
            for data in (b"\xfd", forged_heartbeat()[:-1], b"", os.urandom(100)):
                stranger.sendto(data, ("127.0.0.1", port))
            assert [autopilot.take_messages() for _ in range(10)] == [[]] * 10


async def test_px4_that_restarts_at_the_same_address_is_heard_again() -> None:
    port = free_udp_port()
    with Px4Peer(port) as px4:
        where = px4.address
        async with edge(port) as autopilot:
            px4.__exit__(None, None, None)
            for tick in range(20):  # what is sent now comes back as ICMP errors
                autopilot.send_vision(pose_of(tick, stamp_s=1.0 + tick))
                await asyncio.sleep(0.005)
            with Px4Peer(port, at=where) as again:
                again.base_mode = ARMED
                await eventually(lambda: armed(autopilot), "PX4 is heard after its restart")
