"""The peer of a connected UDP socket when it falls silent."""

from __future__ import annotations

import ctypes
import os
import socket

REPIN_SILENCE_S = 1.0
"""PX4 may be looked for at another port of its address after so long without a datagram; it sends hundreds each second."""

_libc = ctypes.CDLL(None, use_errno=True)
_ANY_PEER = bytes(16)
"""A sockaddr of family AF_UNSPEC."""


def disconnect_udp(connected: socket.socket) -> None:
    """Let the socket hear every sender again; it keeps a local port that it was bound to.

    Raises:
        OSError: the kernel refuses.
    """
    if _libc.connect(connected.fileno(), _ANY_PEER, len(_ANY_PEER)) != 0:
        number = ctypes.get_errno()
        raise OSError(number, os.strerror(number))
