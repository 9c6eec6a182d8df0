"""Time at which the kernel received a datagram, which may be well before a busy process reads it."""

from __future__ import annotations

import contextlib
import socket
import struct
import time
from typing import Final

from companion.runtime import simulated_time
from companion.runtime.clock import Clock

_SO_TIMESTAMPNS: Final = 35  # from <asm-generic/socket.h>, valid on x86 and ARM; Python has no name for it
_TIMESPEC: Final = struct.Struct("=qq")
STAMP_ROOM_BYTES: Final = socket.CMSG_SPACE(_TIMESPEC.size)
_WAITED_MAX_S = 0.1
"""A longer wait is ignored: the wall clock may have been set in between, and that must not make a valid frame stale."""


def stamp_arrivals(opened: socket.socket) -> None:
    """Make the kernel timestamp datagrams on arrival (SO_TIMESTAMPNS). If it cannot, and in simulated time, which does not pass while a
    datagram waits, `arrived_s` returns the time of the read.
    """
    if simulated_time.current() is not None:
        return
    with contextlib.suppress(OSError):
        opened.setsockopt(socket.SOL_SOCKET, _SO_TIMESTAMPNS, 1)


def arrived_s(notes: list[tuple[int, int, bytes]], clock: Clock) -> float:
    """Return the arrival of a datagram that has just been read, on `clock`.

    Args:
        notes: ancillary data of `recvmsg`, read with a buffer of `STAMP_ROOM_BYTES`.

    Returns:
        The current time if there is no kernel timestamp, or if the wall clock has been set since.
    """
    now_s = clock()
    for level, kind, data in notes:
        if level == socket.SOL_SOCKET and kind == _SO_TIMESTAMPNS and len(data) == _TIMESPEC.size:
            seconds, nanoseconds = _TIMESPEC.unpack(data)
            waited_s = (time.time_ns() - seconds * 1_000_000_000 - nanoseconds) * 1e-9
            return now_s - waited_s if 0.0 <= waited_s <= _WAITED_MAX_S else now_s
    return now_s
