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
"""Period at which a chunk is closed; newer data is lost if the recorder itself is killed. A shorter period is costly: the
index at the end of the file takes 180 bytes per chunk, and with chunks of 16 kB it grew by 30 MB in an hour.
"""
_QUEUE_PACKETS = 8192
_RECEIVE_BYTES = 2**20


class Channel:
    """Reads the flight's packets in its own thread, so that a slow disk does not fill the socket.

    Attributes:
        copy_to: if set, called with every packet as soon as it is read; must neither wait nor raise.
    """

    def __init__(self, channel: socket.socket) -> None:
        self._socket = channel
        self.copy_to: Callable[[bytes], None] | None = None
        self._packets: queue.Queue[bytes | None] = queue.Queue(_QUEUE_PACKETS)
        self._thread = threading.Thread(target=self._read, name="channel", daemon=True)

    def start(self) -> None:
        """Start reading."""
        self._thread.start()

    def packets(self) -> Iterator[bytes | None]:
        """Yield packets in order, and None when no packet has arrived for a flush period; end when the channel ends."""
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
        """Read the packets that remain in the socket, then end."""
        with contextlib.suppress(OSError):
            self._socket.shutdown(socket.SHUT_RD)

    def send(self, message: dict[str, Any]) -> bool:
        """Send a message to the flight process; never waits. Return False if the process is gone or does not read."""
        try:
            self._socket.send(json.dumps(message).encode(), socket.MSG_DONTWAIT | socket.MSG_NOSIGNAL)
        except OSError:
            return False
        return True

    def inject(self, packet: bytes) -> bool:
        """Queue a packet as if the flight process had sent it; never waits. Return False if the queue is full."""
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
                continue  # the flight process died before it read a message; its packets are still there
            except OSError:
                packet = b""
            if packet and self.copy_to is not None:
                self.copy_to(packet)
            self._packets.put(packet or None)
            if not packet:
                return
