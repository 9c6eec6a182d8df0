"""Releases a connected UDP socket whose peer has fallen silent."""

from __future__ import annotations

import ctypes
import os
import socket

REPIN_SILENCE_S = 1.0
"""Silence after which PX4 is looked for at other ports of its address; PX4 sends hundreds of datagrams per second."""

_libc = ctypes.CDLL(None, use_errno=True)
_ANY_PEER = bytes(16)
"""A sockaddr of family AF_UNSPEC."""


def disconnect_udp(connected: socket.socket) -> None:
    """Let the socket receive from every sender again. It keeps its local port.

    Raises:
        OSError: the kernel refuses.
    """
    if _libc.connect(connected.fileno(), _ANY_PEER, len(_ANY_PEER)) != 0:
        number = ctypes.get_errno()
        raise OSError(number, os.strerror(number))
