"""Byte transports to PX4: UDP, TCP client and serial port. No call waits; the flight process and the guardian use the same."""

from __future__ import annotations

import contextlib
import ctypes
import errno
import logging
import os
import socket
import termios
import time
from collections.abc import Callable
from typing import Any, Protocol

from companion.io.arrival import STAMP_ROOM_BYTES, arrived_s, stamp_arrivals
from companion.io.px4.frames import autopilot_heartbeat
from companion.model.link_address import parse_address
from companion.runtime.clock import Clock

_LOG = logging.getLogger(__name__)
_MAX_BYTES = 65535
ROUND_DATAGRAMS = 200
"""Most datagrams read in one call, so that a flood from PX4's own address does not hold up a tick; PX4 sends some 600 per second."""
_CONNECT_TIMEOUT_S = 0.5
_UNSENT_MAX_S = 0.5
"""Time after which a TCP connection that delivers nothing ends, and with it what waits to be sent."""
REPIN_SILENCE_S = 1.0
"""Silence after which PX4 is looked for at other ports of its address; PX4 sends hundreds of datagrams per second."""
_ANY_PEER = bytes(16)
"""A sockaddr of family AF_UNSPEC."""

_libc = ctypes.CDLL(None, use_errno=True)


class Wire(Protocol):
    """Byte transport to PX4."""

    @property
    def ready(self) -> bool:
        """Whether PX4's address is known."""

    @property
    def lost(self) -> bool:
        """Whether the connection has ended. A lost wire ends every wait on it and transfers no data."""

    def fileno(self) -> int:
        """Return the descriptor to wait on."""

    def send(self, data: bytes) -> bool:
        """Send one message. Return False if the transport does not accept the whole of it; the rest is dropped."""

    def receive(self) -> list[tuple[float, bytes]]:
        """Return the data that has arrived, with the time of its arrival, or of this call where the kernel gives none."""

    def close(self) -> None:
        """Close the transport."""


class _ChannelWire:
    """A wire over a socket or serial port."""

    ready = True
    lost = False
    remote: tuple[str, int] | None = None
    """PX4's UDP address; None while it is unknown, and on TCP and serial links, which have one peer."""
    local_port = 0
    """Own UDP port; 0 on TCP and serial links."""

    def __init__(self, channel: Any, clock: Clock) -> None:
        self._channel = channel
        self._clock = clock

    def fileno(self) -> int:
        """Return the descriptor to wait on."""
        return int(self._channel.fileno())

    def close(self) -> None:
        """Close the transport."""
        with contextlib.suppress(OSError):
            self._channel.close()


class UdpWire(_ChannelWire):
    """UDP transport: bound to the port that PX4 sends to (`udpin`), or sending to PX4 from the flight process's port (`udpout`).
    PX4 only sends to the first peer of a UDP link, so the port must stay the same. Once PX4's address is known the socket is
    connected to it and the kernel drops datagrams of all other senders. After REPIN_SILENCE_S without a datagram the socket is
    disconnected, then connected to the next sender at the same IPv4 address that sends a HEARTBEAT with PX4's system id: a
    restarted router sends from a new port.

    Args:
        local: address to bind; None for any.
        remote: PX4's address; None to use the sender of the first valid HEARTBEAT of an autopilot.
        share_port: another socket that reads nothing holds the port as well: that of the process's claim, or of a killed flight
            process. Of several sockets connected to PX4, the newest receives the datagrams (measured, Linux 6.18).
        report: called with a line when PX4 is received at another port.
    """

    def __init__(
        self,
        local: tuple[str, int] | None,
        remote: tuple[str, int] | None,
        clock: Clock = time.monotonic,
        *,
        share_port: bool = False,
        report: Callable[[str], None] = _LOG.warning,
    ) -> None:
        self._socket = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
        super().__init__(self._socket, clock)
        stamp_arrivals(self._socket)
        self._report = report
        self._bound = local is not None
        self._connected = False
        self._heard_s = 0.0
        self.system: int | None = None
        """MAVLink system id of PX4; None accepts any."""
        self.ready = False
        """PX4's address is known."""
        try:
            self._socket.setblocking(False)
            if share_port:
                self._socket.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
            if local is not None:
                self._socket.bind(local)
            if remote is not None:
                self._connect(remote)
            self.local_port = self._socket.getsockname()[1]
        except OSError:
            self._socket.close()
            raise

    def send(self, data: bytes) -> bool:
        """Send to PX4; do nothing before its address is known."""
        if self.remote is not None:
            with contextlib.suppress(OSError):
                return self._socket.sendto(data, self.remote) == len(data)
        return False

    def receive(self) -> list[tuple[float, bytes]]:
        """Return datagrams from PX4's address; while the address is unknown, only the HEARTBEAT that reveals it."""
        # Disconnecting would take an unbound socket's port away from it.
        if self._connected and self._bound and self._clock() - self._heard_s > REPIN_SILENCE_S:
            with contextlib.suppress(OSError):  # tried again at the next call; it must not end the flight
                _disconnect(self._socket)
                self._connected = False
        found: list[tuple[float, bytes]] = []
        for _ in range(ROUND_DATAGRAMS):
            try:
                data, notes, _, sender = self._socket.recvmsg(_MAX_BYTES, STAMP_ROOM_BYTES)
            except (BlockingIOError, InterruptedError):
                break
            except OSError:  # an ICMP error of an earlier send
                continue
            if not self._connected and self._is_from_px4(data, sender):
                with contextlib.suppress(OSError):
                    self._connect(sender)
            if sender == self.remote:
                found.append((arrived_s(notes, self._clock), data))
        if found:
            self._heard_s = self._clock()
        return found

    def _is_from_px4(self, data: bytes, sender: tuple[str, int]) -> bool:
        """Whether the datagram identifies its sender as PX4."""
        if self.remote is not None and sender[0] != self.remote[0]:
            return False
        heard = autopilot_heartbeat(data)
        return heard is not None and (self.system is None or heard.system == self.system)

    def _connect(self, remote: tuple[str, int]) -> None:
        self._socket.connect(remote)
        before, self.remote = self.remote, remote
        self._heard_s = self._clock()
        self._connected = self.ready = True
        if before is not None and remote != before:
            self._report(
                f"PX4 sent nothing from {before[0]}:{before[1]} for {REPIN_SILENCE_S:g} s and now sends from port {remote[1]}; "
                "the link uses that port"
            )


def _disconnect(connected: socket.socket) -> None:
    """Let the socket receive from every sender again, on the same local port; raises OSError."""
    if _libc.connect(connected.fileno(), _ANY_PEER, len(_ANY_PEER)) != 0:
        number = ctypes.get_errno()
        raise OSError(number, os.strerror(number))


class TcpWire(_ChannelWire):
    """TCP client transport. A connection that is interrupted is lost after `_UNSENT_MAX_S`: TCP would deliver all that was sent
    meanwhile once the network is back, such as an old request to arm. No message waits for others to share a packet with.
    """

    def __init__(self, remote: tuple[str, int], clock: Clock) -> None:
        self._socket = socket.create_connection(remote, _CONNECT_TIMEOUT_S)
        super().__init__(self._socket, clock)
        self._socket.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)
        self._socket.setsockopt(socket.IPPROTO_TCP, socket.TCP_USER_TIMEOUT, round(_UNSENT_MAX_S * 1e3))
        self._socket.setblocking(False)

    def send(self, data: bytes) -> bool:
        """Send what fits into the send buffer; the receiver resynchronises on the next message."""
        with contextlib.suppress(OSError):
            return self._socket.send(data) == len(data)
        return False

    def receive(self) -> list[tuple[float, bytes]]:
        """Return the data that has arrived. End of stream or an error marks the wire as lost."""
        try:
            data = self._socket.recv(_MAX_BYTES)
        except (BlockingIOError, InterruptedError):
            return []
        except OSError:
            data = b""
        self.lost = not data
        return [(self._clock(), data)] if data else []


class SerialWire(_ChannelWire):
    """Serial transport, 8N1."""

    def __init__(self, path: str, baud: int, flow_control: bool, clock: Clock) -> None:
        import serial  # imported here because the other links do not need it

        if baud not in serial.Serial.BAUDRATES:
            raise OSError(errno.EINVAL, "no usual baud rate")
        # exclusive: a lock (flock) on the device itself, so it applies under every name of the device
        self._port = serial.Serial(path, baud, timeout=0, write_timeout=0, rtscts=flow_control, exclusive=True)
        super().__init__(self._port, clock)

    def send(self, data: bytes) -> bool:
        """Write as many bytes as the port accepts, without waiting; pyserial's `write` would retry for ever while PX4 does not read.

        Once the port accepts no more, all that waits in it is dropped: PX4 must not receive it when it reads again.
        """
        with contextlib.suppress(OSError, termios.error):
            with contextlib.suppress(BlockingIOError):
                if os.write(self._port.fileno(), data) == len(data):
                    return True
            termios.tcflush(self._port.fileno(), termios.TCOFLUSH)
        return False

    def receive(self) -> list[tuple[float, bytes]]:
        """Return the data that has arrived. A port that is readable but has no data (unplugged, hung up) is lost."""
        try:
            data = self._port.read(_MAX_BYTES)
        except OSError:  # serial.SerialException is one
            self.lost = True
            return []
        return [(self._clock(), data)] if data else []


OpenWire = UdpWire | TcpWire | SerialWire


def is_udp(address: str) -> bool:
    """Whether the address is a UDP link. A UDP link can be opened while the killed flight process still holds it."""
    return address.startswith(("udpin://", "udpout://"))


def open_wire(
    address: str,
    local_port: int = 0,
    peer: tuple[str, int] | None = None,
    clock: Clock = time.monotonic,
    *,
    share_port: bool = False,
    report: Callable[[str], None] = _LOG.warning,
) -> OpenWire:
    """Open the link to PX4.

    Args:
        address: value of `devices.autopilot.address`.
        local_port: own UDP port of a `udpout` link; 0 for any.
        peer: PX4's UDP address as a HEARTBEAT has confirmed it; None if unknown.
        share_port: another socket that reads nothing holds the port as well; only for UDP links (`is_udp`).
        report: see `UdpWire`.

    Raises:
        OSError: the link does not exist, or another process holds it.
    """
    parts = parse_address(address)
    if parts.serial:
        return SerialWire(parts.host, parts.port, parts.kind == "serial_flowcontrol", clock)
    if parts.kind == "tcpout":
        return TcpWire((parts.host, parts.port), clock)
    if parts.kind == "udpin":
        return UdpWire((parts.host, parts.port), peer, clock, share_port=share_port, report=report)
    remote = peer or (socket.gethostbyname(parts.host), parts.port)
    local = ("", local_port) if local_port else None
    return UdpWire(local, remote, clock, share_port=share_port, report=report)
