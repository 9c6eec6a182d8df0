"""Device access of `companion mocap`: records every rigid body of every frame, finds the route to the server, and searches for servers
by broadcast. I/O only.
"""

from __future__ import annotations

import array
import asyncio
import contextlib
import dataclasses
import fcntl
import socket
import struct
from collections.abc import Callable
from ipaddress import IPv4Interface
from pathlib import Path
from typing import Final

from companion.commissioning.mocap.judge import FrameSeen, Route
from companion.config.devices import MocapDevice
from companion.io.mocap import natnet
from companion.io.mocap.frames import Frame
from companion.io.mocap.natnet import Message, ServerInfo
from companion.io.mocap.optitrack import OptiTrack
from companion.io.mocap.system import MocapSettings

_SIOCGIFADDR, _SIOCGIFNETMASK = 0x8915, 0x891B
_ASK_PERIOD_S: Final = 0.25
_ANSWERS_S: Final = 1.0
"""Time to wait for the answers to a broadcast."""


class WatchedTrack(OptiTrack):
    """The flight's client, which also reports every rigid body and single marker of every frame and requires none."""

    def __init__(self, settings: MocapSettings, on_frame: Callable[[FrameSeen], None]) -> None:
        super().__init__(dataclasses.replace(settings, ball=settings.ball or {"kind": "marker", "id": None}))
        self._on_frame = on_frame

    def refusal(self) -> str | None:
        """Return why the server's version or transport is not that of the settings."""
        return self.server_refusal()

    def take(self, frame: Frame, datagram: bytes, stamp_s: float) -> None:
        """Report a frame."""
        marker_frame = self.protocol.markers(frame, datagram, stamp_s)
        bodies = (self.protocol.other_body(datagram, number) for number in frame.body_ids)
        self._on_frame(
            FrameSeen(
                arrived_s=stamp_s,
                number=frame.number,
                timestamp_s=frame.timestamp_s,
                latency_s=frame.latency_s,
                bodies=tuple(body for body in bodies if body is not None),
                markers=marker_frame,
            )
        )


async def discover(interface: str, command_port: int) -> dict[str, ServerInfo]:
    """Return the NatNet servers of the segment by address: a connect request is broadcast and the answers are collected.

    Args:
        interface: address of this computer in that segment; 0.0.0.0 for all segments.
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
            async with asyncio.timeout(_ANSWERS_S):
                while True:
                    for target in _broadcast_addresses(interface):
                        with contextlib.suppress(OSError):  # a segment that is down
                            opened.sendto(natnet.encode_connect(), (target, command_port))
                    with contextlib.suppress(TimeoutError):
                        async with asyncio.timeout(_ASK_PERIOD_S):
                            await _collect(opened, found)
        for address in found:  # a unicast server treated the request as a client's
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
    name = next((name for name, one in _interfaces().items() if str(one.ip) == local), "")
    if not name and local.startswith("127."):
        name = "lo"
    how = f"multicast {device.multicast_group}:{device.data_port}" if device.transport == "multicast" else "unicast"
    return Route(how, local, name, bool(name) and Path(f"/sys/class/net/{name}/wireless").exists())


def _broadcast_addresses(interface: str) -> list[str]:
    """Return the broadcast addresses of the interface's segments, and the limited broadcast."""
    loopback = interface.startswith("127.")
    found = [
        str(one.network.broadcast_address)
        for one in _interfaces().values()
        if interface in ("0.0.0.0", str(one.ip)) or (loopback and one.ip.is_loopback)
    ]
    if loopback:
        return found or ["127.255.255.255"]
    return [*found, "255.255.255.255"]


def _interfaces() -> dict[str, IPv4Interface]:
    """Return IPv4 address and netmask of each network interface (ioctl SIOCGIFADDR, SIOCGIFNETMASK)."""
    found = {}
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as probe:
        for _, name in socket.if_nameindex():
            with contextlib.suppress(OSError):  # no IPv4 address
                address, mask = (_ioctl(probe, request, name) for request in (_SIOCGIFADDR, _SIOCGIFNETMASK))
                found[name] = IPv4Interface(f"{address}/{mask}")
    return found


def _ioctl(probe: socket.socket, request: int, name: str) -> str:
    answer = array.array("B", struct.pack("256s", name.encode()[:15]))
    fcntl.ioctl(probe.fileno(), request, answer)
    return socket.inet_ntoa(answer[20:24].tobytes())
