"""Joining Motive's multicast group for one sender only."""

from __future__ import annotations

import socket

_IP_ADD_SOURCE_MEMBERSHIP = 39
"""linux/in.h; the name is in `socket` from Python 3.12 on."""


def join_source(opened: socket.socket, group: str, interface: str, source: str) -> None:
    """Join `group` on `interface` for datagrams of `source` alone: the kernel (and a switch with IGMPv3) drops those of other senders.

    Args:
        opened: UDP socket, bound to the group.
        group: multicast address, IPv4.
        interface: this computer's address on the camera network.
        source: address of the Motive machine.

    Raises:
        OSError: no such interface, or not a multicast address.
    """
    request = socket.inet_aton(group) + socket.inet_aton(interface) + socket.inet_aton(source)  # struct ip_mreq_source
    opened.setsockopt(socket.IPPROTO_IP, _IP_ADD_SOURCE_MEMBERSHIP, request)
