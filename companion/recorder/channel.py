"""The recorder's end of the flight's channel."""

from __future__ import annotations

import contextlib
import json
import queue
import socket
import threading
from collections.abc import Callable, Iterator
from typing import Any

FLUSH_PERIOD_S = 0.4
"""A chunk is closed so often: what a recorder that is killed itself loses. Not much more often: the writer keeps 180 bytes of each
for the index at the end of the file, and with chunks of 16 kB it grew by 30 MB in an hour.
"""
_QUEUE_PACKETS = 8192
_RECEIVE_BYTES = 2**20


class Channel:
    """Reads the flight's packets in a thread of its own, so that a slow disk does not fill the socket.

    Attributes:
        copy_to: if set, given every packet as soon as it is read; must not wait and not raise.
    """

    def __init__(self, channel: socket.socket) -> None:
        self._socket = channel
        self.copy_to: Callable[[bytes], None] | None = None
        self._packets: queue.Queue[bytes | None] = queue.Queue(_QUEUE_PACKETS)
        self._thread = threading.Thread(target=self._read, name="channel", daemon=True)

    def start(self) -> None:
        """Begin to read."""
        self._thread.start()

    def packets(self) -> Iterator[bytes | None]:
        """Packets in order; None when none came for a flush period; ends with the channel."""
        while True:
            try:
                packet = self._packets.get(timeout=FLUSH_PERIOD_S)
            except queue.Empty:
                yield None
                continue
            if packet is None:
                return
            yield packet

    def stop(self) -> None:
        """Read what the socket still holds and end."""
        with contextlib.suppress(OSError):
            self._socket.shutdown(socket.SHUT_RD)

    def say(self, message: dict[str, Any]) -> bool:
        """Let the flight know; never waits. False: it is gone, or has not listened for long."""
        try:
            self._socket.send(json.dumps(message).encode(), socket.MSG_DONTWAIT | socket.MSG_NOSIGNAL)
        except OSError:
            return False
        return True

    def inject(self, packet: bytes) -> bool:
        """A packet of this process, as if the flight had sent it; never waits. False: no room for it."""
        try:
            self._packets.put_nowait(packet)
        except queue.Full:
            return False
        return True

    def _read(self) -> None:
        while True:
            try:
                packet = self._socket.recv(_RECEIVE_BYTES)
            except ConnectionResetError:
                continue  # the flight died with a word of ours unread; its packets are still there
            except OSError:
                packet = b""
            if packet and self.copy_to is not None:
                self.copy_to(packet)
            self._packets.put(packet or None)
            if not packet:
                return
