"""All of motion capture: every rigid body of every frame, the route to the server, servers found by broadcast. I/O only."""

from __future__ import annotations

import array
import asyncio
import contextlib
import fcntl
import socket
import struct
from collections.abc import Callable
from pathlib import Path
from typing import Final

from companion.commissioning.mocap.judge import FrameSeen, Route
from companion.config.vehicle import MocapDevice
from companion.io.mocap import natnet
from companion.io.mocap.driver import NatNetMocap
from companion.io.mocap.natnet import Frame, Malformed, Message, ServerInfo
from companion.io.protocols import DeviceError
from companion.runtime.clock import Clock

_SIOCGIFADDR, _SIOCGIFNETMASK = 0x8915, 0x891B
_ASK_PERIOD_S: Final = 0.25


class MocapWatch(NatNetMocap):
    """The motion-capture driver, which reports every body instead of waiting for one.

    Args:
        device: addresses, transport, version.
        clock: the flight clock.
        on_frame: called with every frame in order of arrival, also with those that are read together.
    """

    def __init__(
        self,
        device: MocapDevice,
        clock: Clock,
        on_frame: Callable[[FrameSeen], None],
    ) -> None:
        super().__init__(device, clock, lambda _: None)
        self._on_frame = on_frame
        self._any_frame = asyncio.Event()

    @property
    def server_ip(self) -> str:
        """Numeric address of the server; empty until it is resolved."""
        return self._server_ip

    @property
    def names(self) -> dict[int, str]:
        """Rigid bodies by streaming id, as the server describes them."""
        return dict(self._names)

    async def _wait_for_body(self) -> None:
        """Wait for any frame; without one the driver's own error says what is wrong."""
        with contextlib.suppress(TimeoutError):
            async with asyncio.timeout(self._body_timeout_s):
                await self._any_frame.wait()
            return
        self._body_timeout_s, waited_s = 0.0, self._body_timeout_s
        try:
            await super()._wait_for_body()
        except DeviceError as error:
            raise DeviceError(str(error).replace("within 0 s", f"within {waited_s:g} s")) from None

    def _take_frame(self, datagram: bytes, arrived_s: float) -> Frame | None:
        before = self._last_number
        frame = super()._take_frame(datagram, arrived_s)
        if self._last_number != before and self._version is not None and self._info is not None:
            self._any_frame.set()
            self._show(datagram, arrived_s)
        return frame

    def _show(self, datagram: bytes, arrived_s: float) -> None:
        assert self._version is not None and self._info is not None
        frequency_hz, found = self._info.clock_frequency_hz, []
        seen: Frame | Malformed | None = None
        for number in self._seen_ids or (self._device.rigid_body_id,):
            seen = natnet.parse_frame(datagram, self._version, number, frequency_hz)
            if isinstance(seen, Frame) and seen.body is not None:
                found.append(seen.body)
        if isinstance(seen, Frame):
            self._on_frame(
                FrameSeen(
                    arrived_s=arrived_s,
                    number=seen.number,
                    timestamp_s=seen.timestamp_s,
                    latency_s=seen.latency_s,
                    bodies=tuple(found),
                )
            )


async def discover(interface: str, command_port: int, within_s: float = 1.0) -> dict[str, ServerInfo]:
    """Return the NatNet servers of the segment by address: a connect request is broadcast and the answers are collected.

    Args:
        interface: address of this computer in that segment; 0.0.0.0: all segments.
        command_port: NatNet's, 1510 unless it was changed in Motive.
        within_s: how long to wait.
    """
    found: dict[str, ServerInfo] = {}
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as opened:
        opened.setblocking(False)
        opened.setsockopt(socket.SOL_SOCKET, socket.SO_BROADCAST, 1)
        try:
            opened.bind((interface, 0))
        except OSError:
            return found  # not an address of this computer; the driver has reported it
        with contextlib.suppress(TimeoutError):
            async with asyncio.timeout(within_s):
                while True:
                    for target in _broadcast_addresses(interface):
                        with contextlib.suppress(OSError):  # a segment that is down
                            opened.sendto(natnet.encode_connect(), (target, command_port))
                    with contextlib.suppress(TimeoutError):
                        async with asyncio.timeout(_ASK_PERIOD_S):
                            await _collect(opened, found)
        for address in found:  # a unicast server took the request for a client's
            with contextlib.suppress(OSError):
                opened.sendto(natnet.encode_message(Message.DISCONNECT), (address, command_port))
    return found


async def _collect(opened: socket.socket, found: dict[str, ServerInfo]) -> None:
    while True:
        datagram, address = await asyncio.get_running_loop().sock_recvfrom(opened, 65535)
        info = natnet.parse_server_info(datagram) if natnet.message_id(datagram) == Message.SERVER_INFO else None
        if isinstance(info, ServerInfo):
            found[address[0]] = info


def path_to(server_ip: str, device: MocapDevice) -> Route:
    """Return the route to the server as the kernel chooses it."""
    local = device.interface
    with contextlib.suppress(OSError), socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as probe:
        if device.interface != "0.0.0.0":
            probe.bind((device.interface, 0))
        probe.connect((server_ip, device.command_port))
        local = probe.getsockname()[0]
    name = next((name for name, (address, _) in _interfaces().items() if address == local), "")
    if not name and local.startswith("127."):
        name = "lo"
    how = f"multicast {device.multicast_group}:{device.data_port}" if device.transport == "multicast" else "unicast"
    return Route(how, local, name, bool(name) and Path(f"/sys/class/net/{name}/wireless").exists())


def _broadcast_addresses(interface: str) -> list[str]:
    """Return the broadcast addresses of the interface's segments, and the limited broadcast."""
    found = []
    for address, mask in _interfaces().values():
        if interface in ("0.0.0.0", address) or (interface.startswith("127.") and address.startswith("127.")):
            (a,), (m,) = (struct.unpack("!I", socket.inet_aton(text)) for text in (address, mask))
            found.append(socket.inet_ntoa(struct.pack("!I", a | (~m & 0xFFFFFFFF))))
    if interface.startswith("127."):
        return found or ["127.255.255.255"]
    return [*found, "255.255.255.255"]


def _interfaces() -> dict[str, tuple[str, str]]:
    """Return IPv4 address and netmask of each network interface (ioctl SIOCGIFADDR, SIOCGIFNETMASK)."""
    found = {}
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as probe:
        for _, name in socket.if_nameindex():
            with contextlib.suppress(OSError):  # no IPv4 address
                found[name] = (_ioctl(probe, _SIOCGIFADDR, name), _ioctl(probe, _SIOCGIFNETMASK, name))
    return found


def _ioctl(probe: socket.socket, request: int, name: str) -> str:
    answer = array.array("B", struct.pack("256s", name.encode()[:15]))
    fcntl.ioctl(probe.fileno(), request, answer)
    return socket.inet_ntoa(answer[20:24].tobytes())
