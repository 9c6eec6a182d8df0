"""Exclusive use of the link to PX4: only this process holds the local end, and only the address verified as PX4's is the remote end."""

from __future__ import annotations

import asyncio
import contextlib
import errno
import fcntl
import os
import socket
from collections.abc import AsyncIterator

from pymavlink.dialects.v20 import common as mavlink

from companion.io.px4.link import (
    bind_alone,
    device_error,
    no_heartbeat,
    parse_address,
    pin_new_udp,
    udp_sockets,
)
from companion.io.px4.udp_peer import REPIN_SILENCE_S
from companion.io.qgroundcontrol.frames import autopilot_heartbeat

Peer = tuple[str, int]
"""IPv4 address and UDP port."""

_DATAGRAM_MAX_BYTES = 65535
_DRAIN_DATAGRAMS = 1000
_RIVALS_REPORTED_MAX = 4
_CALL_PERIOD_S = 1.0


class LinkClaim:
    """This process's hold on a link, besides MAVSDK's own descriptor.

    A serial port is locked with flock on the device itself, so that the lock applies under every name of the device and pyserial's
    `exclusive` mode conflicts with it. A `udpin` port is bound without SO_REUSEADDR and only then shared with MAVSDK, which sets
    that option and would join any program on the port. MAVSDK's socket is connected to PX4's address once that is verified; from
    then on the kernel delivers datagrams of all other senders to the socket held here. When PX4 is silent for REPIN_SILENCE_S and
    another port of the same IPv4 address sends a HEARTBEAT with PX4's system id, MAVSDK's socket is connected to that port, because
    a restarted router sends from a new one.

    Args:
        address: as in `devices.autopilot.address`, checked.

    Raises:
        DeviceError: another program holds the port.
    """

    def __init__(self, address: str) -> None:
        self._address = address
        self._parts = parse_address(address)
        self._lock: int | None = None
        self._port: socket.socket | None = None
        self._mavsdk: socket.socket | None = None
        self._moved: str | None = None
        self._rivals: set[Peer] = set()
        self._reported = 0
        self._system = 0
        self._armed = False
        self._before: frozenset[int] = frozenset()
        self.peer: Peer | None = None
        """PX4's UDP address; None before it is verified, and on TCP and serial links, which have one peer."""
        if self._parts.serial:
            self._lock = _lock(address, self._parts.host)
        elif self._parts.kind == "udpin":
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
            with contextlib.suppress(OSError):  # MAVSDK reports a host name that does not resolve
                self.peer = (socket.gethostbyname(self._parts.host), self._parts.port)
        self._before = frozenset(udp_sockets())
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

        PX4 on Ethernet may broadcast until it has received a partner's message (MAV_x_BROADCAST), and MAVSDK's connected socket
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

    def pin(self) -> int:
        """Connect the UDP socket that MAVSDK opened since `find_px4` to PX4's address; return its local port, or 0 if the link is not
        UDP.

        Raises:
            DeviceError: /proc does not show the socket.
        """
        if self.peer is None:
            return 0
        try:
            twin, port = pin_new_udp(self._before, self.peer)
            if self._port is None:
                twin.close()
            else:
                self._mavsdk = twin
            return port
        except OSError as error:
            found = error.strerror or str(error)
            raise device_error(self._address, "MAVSDK's socket in /proc", found, "mount /proc") from None

    def refuse_rivals(self) -> None:
        """Reject a second sender that has claimed to be PX4. If PX4 was found armed, and so may be in the air, `take_rival` handles
        such senders instead.

        Raises:
            DeviceError: there is such a sender, and PX4 was found disarmed.
        """
        self._drain(silent=False)
        if self._rivals and not self._armed:
            found = f"{_text(self.peer)} and {', '.join(sorted(map(_text, self._rivals)))}"
            fix = "stop the other sender, or use a link of PX4's own (serial, or a port that only PX4 sends to)"
            raise device_error(self._address, f"PX4 (system {self._system}) at one address", found, fix)

    def take_rival(self, silent_s: float) -> str | None:
        """Read one datagram from another sender, or all of them while PX4 is silent. Never waits.

        Args:
            silent_s: time since the newest message of PX4.

        Returns:
            A line for the log if a new sender claims to be PX4, or if PX4 is received at another port from now on.
        """
        if silent_s > REPIN_SILENCE_S:
            self._drain(silent=True)
            if self._moved is not None:
                moved, self._moved = self._moved, None
                return moved
        else:
            self._read_one()
        if len(self._rivals) == self._reported:
            return None
        self._reported = len(self._rivals)
        newest = ", ".join(sorted(map(_text, self._rivals)))
        return f"{newest} claims to be PX4 (system {self._system}), which is at {_text(self.peer)}; ignored"

    def close(self) -> None:
        """Release the port. MAVSDK's descriptor must be closed first."""
        if self._mavsdk is not None:
            self._mavsdk.close()
            self._mavsdk = None
        if self._port is not None:
            self._port.close()
            self._port = None
        if self._lock is not None:
            os.close(self._lock)
            self._lock = None

    def _drain(self, *, silent: bool) -> None:
        for _ in range(_DRAIN_DATAGRAMS):
            if self._moved is not None or not self._read_one(silent):
                break

    def _read_one(self, silent: bool = False) -> bool:
        if self._port is None:
            return False
        try:
            datagram, sender = self._port.recvfrom(_DATAGRAM_MAX_BYTES)
            if not (silent and self._repin(datagram, sender)):
                self._hear(datagram, sender)
        except BlockingIOError:
            return False
        except OSError:  # an ICMP error: nothing was read, but more may be waiting
            return True
        return True

    def _repin(self, datagram: bytes, sender: Peer) -> bool:
        """Return whether the datagram shows PX4 at another port of its address; MAVSDK then receives from that port only."""
        if self._mavsdk is None or self.peer is None or sender == self.peer or sender[0] != self.peer[0]:
            return False
        heard = autopilot_heartbeat(datagram)
        if heard is None or heard.system != self._system:
            return False
        self._mavsdk.connect(sender)
        self._moved = (
            f"PX4 (system {self._system}) was silent at {_text(self.peer)} for {REPIN_SILENCE_S:g} s and is heard at {_text(sender)}; "
            "messages are now accepted from there only"
        )
        self.peer = sender
        self._rivals.discard(sender)
        self._reported = len(self._rivals)
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


def _lock(address: str, path: str) -> int:
    """Lock a serial port and return the descriptor that holds the lock. No child process inherits it."""
    try:
        descriptor = os.open(path, os.O_RDONLY | os.O_NONBLOCK | os.O_NOCTTY)
    except OSError as error:
        fix = "check the cable and that no other program holds it"
        raise device_error(address, f"to open {path}", error.strerror or str(error), fix) from None
    try:
        fcntl.flock(descriptor, fcntl.LOCK_EX | fcntl.LOCK_NB)
    except OSError as error:
        os.close(descriptor)
        busy = error.errno in (errno.EWOULDBLOCK, errno.EACCES)
        found = "another program on it" if busy else error.strerror or str(error)
        fix = f"stop that program (another companion? `fuser {path}` names it)"
        raise device_error(address, f"the serial port {path} to be free", found, fix) from None
    return descriptor


def _text(peer: Peer | None) -> str:
    return "an unknown address" if peer is None else f"{peer[0]}:{peer[1]}"
