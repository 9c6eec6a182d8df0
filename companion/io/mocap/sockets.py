"""UDP sockets of a NatNet client: opened for one server, read without blocking."""

from __future__ import annotations

import ctypes
import os
import socket
from collections.abc import Iterator
from typing import Final, NamedTuple

from companion.io.arrival import STAMP_ROOM_BYTES, stamp_arrivals

_IP_ADD_SOURCE_MEMBERSHIP: Final = 39
"""From linux/in.h; `socket` defines the name since Python 3.12."""
_libc = ctypes.CDLL(None, use_errno=True)
_MAX_DATAGRAMS: Final = 256
"""Limit per call of `waiting`, so that a flood does not block the caller."""
_MAX_BYTES: Final = 65535


class Datagram(NamedTuple):
    """One received datagram."""

    data: bytes
    ancillary: list[tuple[int, int, bytes]]
    sender_ip: str


def open_udp(address: str, port: int = 0, *, shared: bool = False) -> socket.socket:
    """Open a non-blocking UDP socket whose datagrams the kernel stamps on arrival.

    Args:
        address: IPv4 address to bind to: that of an interface, or of a multicast group, which excludes other traffic.
        port: 0 for any free port.
        shared: other processes may bind to the same address and port.

    Raises:
        OSError: the address is not one of this computer, or the port is in use.
    """
    opened = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
    try:
        opened.setblocking(False)
        stamp_arrivals(opened)
        if shared:
            opened.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
        opened.bind((address, port))
    except OSError:
        opened.close()
        raise
    return opened


def join_source(opened: socket.socket, group: str, interface: str, source: str) -> None:
    """Join a multicast group for datagrams from one sender: the kernel (and a switch with IGMPv3 snooping) drops those from others.

    Args:
        group: multicast address, IPv4.
        interface: this computer's address on the camera network.

    Raises:
        OSError: no such interface, or not a multicast address.
    """
    request = socket.inet_aton(group) + socket.inet_aton(interface) + socket.inet_aton(source)  # struct ip_mreq_source
    # Unlike `socket.setsockopt`, ctypes releases the interpreter while the kernel waits for an interface that is being set up.
    if _libc.setsockopt(opened.fileno(), socket.IPPROTO_IP, _IP_ADD_SOURCE_MEMBERSHIP, request, len(request)):
        number = ctypes.get_errno()
        raise OSError(number, os.strerror(number))


def waiting(opened: socket.socket) -> Iterator[Datagram]:
    """Return the pending datagrams, at most 256."""
    for _ in range(_MAX_DATAGRAMS):
        try:
            data, ancillary, _, address = opened.recvmsg(_MAX_BYTES, STAMP_ROOM_BYTES)
        except (BlockingIOError, InterruptedError):
            return
        except OSError:  # an ICMP error from an earlier send
            continue
        yield Datagram(data, ancillary, str(address[0]))
