"""Exclusive use of a UDP link to PX4: only this process has the local end, and only PX4's verified address is the remote end."""

from __future__ import annotations

import asyncio
import contextlib
import socket
from collections.abc import AsyncIterator

from pymavlink.dialects.v20 import common as mavlink

from companion.io.px4.frames import autopilot_heartbeat
from companion.io.px4.link import (
    bind_alone,
    device_error,
    no_heartbeat,
)
from companion.model.link_address import parse_address

Peer = tuple[str, int]
"""IPv4 address and UDP port."""

_DATAGRAM_MAX_BYTES = 65535
_DRAIN_DATAGRAMS = 1000
_RIVALS_REPORTED_MAX = 4
_CALL_PERIOD_S = 1.0


class ExclusiveLink:
    """This process's hold on a link, besides the wire that carries the data.

    A `udpin` port is bound without SO_REUSEADDR, so that no other program has it, and only then shared with the wire. The wire is
    connected to PX4's address once that is verified; from then on the kernel delivers datagrams of all other senders to the socket
    held here.

    Args:
        address: as in `devices.autopilot.address`, checked.

    Raises:
        DeviceError: another program holds the port.
    """

    def __init__(self, address: str) -> None:
        self._address = address
        self._parts = parse_address(address)
        self._port: socket.socket | None = None
        self._rivals: set[Peer] = set()
        self._reported = 0
        self._system = 0
        self._armed = False
        self.peer: Peer | None = None
        """PX4's UDP address; None before it is verified, and on TCP and serial links, which have one peer."""
        if self._parts.kind == "udpin":
            self._port = bind_alone(address, self._parts.host, self._parts.port, socket.SOCK_DGRAM)
            self._port.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
            self._port.setblocking(False)

    async def find_px4(self, timeout_s: float) -> None:
        """On a `udpin` link wait for a valid HEARTBEAT of an autopilot and store its sender as PX4's address; on `udpout` resolve the
        address.

        Raises:
            DeviceError: no HEARTBEAT within `timeout_s`, or HEARTBEATs from two addresses while PX4 is not armed.
        """
        if self._parts.kind == "udpout":
            with contextlib.suppress(OSError):  # opening the wire reports a host name that does not resolve
                self.peer = (socket.gethostbyname(self._parts.host), self._parts.port)
        if self._port is None:
            return
        loop = asyncio.get_running_loop()
        with contextlib.suppress(TimeoutError):
            async with asyncio.timeout(timeout_s):
                while self.peer is None:
                    self._hear(*await loop.sock_recvfrom(self._port, _DATAGRAM_MAX_BYTES))
        if self.peer is None:
            raise no_heartbeat(self._address, timeout_s)
        self.refuse_rivals()

    @contextlib.asynccontextmanager
    async def calling(self, own: tuple[int, int]) -> AsyncIterator[None]:
        """While the context is open, send PX4 a HEARTBEAT from the port of a `udpin` link every second until MAVSDK has received
        one from PX4.

        PX4 on Ethernet may broadcast until it has received a partner's message (MAV_x_BROADCAST), and the wire's connected socket
        receives no broadcasts. Several HEARTBEATs are needed, because PX4 accepts no partner in the first 3 s after it has opened
        its port.

        Args:
            own: system and component id of MAVSDK.
        """
        calls = asyncio.create_task(self._call(own))
        try:
            yield
        finally:
            calls.cancel()
            await asyncio.wait([calls])  # the port may be closed next, and so may the event loop

    def refuse_rivals(self) -> None:
        """Reject a second sender that has claimed to be PX4. If PX4 was found armed, and so may be in the air, `take_rival` handles
        such senders instead.

        Raises:
            DeviceError: there is such a sender, and PX4 was found disarmed.
        """
        for _ in range(_DRAIN_DATAGRAMS):
            if not self._read_one():
                break
        if self._rivals and not self._armed:
            found = f"{_text(self.peer)} and {', '.join(sorted(map(_text, self._rivals)))}"
            fix = "stop the other sender, or use a link of PX4's own (serial, or a port that only PX4 sends to)"
            raise device_error(self._address, f"PX4 (system {self._system}) at one address", found, fix)

    def take_rival(self) -> str | None:
        """Read one datagram from another sender. Never waits.

        Returns:
            A line for the log if a new sender claims to be PX4.
        """
        self._read_one()
        if len(self._rivals) == self._reported:
            return None
        self._reported = len(self._rivals)
        newest = ", ".join(sorted(map(_text, self._rivals)))
        return f"{newest} claims to be PX4 (system {self._system}), which is at {_text(self.peer)}; ignored"

    def close(self) -> None:
        """Release the port."""
        if self._port is not None:
            self._port.close()
            self._port = None

    def _read_one(self) -> bool:
        if self._port is None:
            return False
        try:
            self._hear(*self._port.recvfrom(_DATAGRAM_MAX_BYTES))
        except BlockingIOError:
            return False
        except OSError:  # an ICMP error: nothing was read, but more may be waiting
            return True
        return True

    def _hear(self, datagram: bytes, sender: Peer) -> None:
        if sender == self.peer or sender in self._rivals or len(self._rivals) >= _RIVALS_REPORTED_MAX:
            return
        heard = autopilot_heartbeat(datagram)
        if heard is None:
            return
        if self.peer is None:
            self.peer, self._system, self._armed = sender, heard.system, heard.armed
        elif heard.system == self._system:
            self._rivals.add(sender)

    async def _call(self, own: tuple[int, int]) -> None:
        message = mavlink.MAVLink_heartbeat_message(
            mavlink.MAV_TYPE_ONBOARD_CONTROLLER, mavlink.MAV_AUTOPILOT_INVALID, 0, 0, mavlink.MAV_STATE_UNINIT, 3
        )
        data = message.pack(mavlink.MAVLink(None, srcSystem=own[0], srcComponent=own[1]))
        while self._port is not None and self.peer is not None:
            with contextlib.suppress(OSError):  # no route at this moment; the next datagram may get through
                self._port.sendto(data, self.peer)
            await asyncio.sleep(_CALL_PERIOD_S)


def _text(peer: Peer | None) -> str:
    return "an unknown address" if peer is None else f"{peer[0]}:{peer[1]}"
