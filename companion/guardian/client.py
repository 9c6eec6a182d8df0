"""The flight process's side of the guardian: one datagram per tick out, "ready" in. No call waits, except `wait_ready`."""

from __future__ import annotations

import asyncio
import contextlib
import socket

from companion.guardian import heartbeat as words
from companion.guardian.heartbeat import Beat
from companion.io.protocols import DeviceError
from companion.runtime.clock import Clock

READY_TIMEOUT_S = 10.0
SILENT_S = 1.0
"""A guardian that says nothing for this long is as good as dead."""
_LISTEN_PERIOD_S = 0.02


class GuardianClient:
    """The guardian, seen from the flight process.

    Args:
        channel: one end of the SOCK_SEQPACKET pair whose other end the guardian inherited.
        clock: the flight clock.
    """

    def __init__(self, channel: socket.socket, clock: Clock) -> None:
        channel.setblocking(False)
        self._channel = channel
        self._clock = clock
        self._ready_s: float | None = None
        self._gone = False
        self._problem: str | None = None

    @property
    def ready(self) -> bool:
        """It said within the last second that it could take over."""
        return not self._gone and self._ready_s is not None and self._clock() - self._ready_s < SILENT_S

    def beat(self, beat: Beat) -> None:
        """Tell of one tick."""
        self._send(words.pack(beat))

    def share_recorder(self, descriptor: int) -> None:
        """Give the guardian the recorder's channel: the log goes on when this process cannot."""
        with contextlib.suppress(OSError):
            socket.send_fds(self._channel, [words.ADOPT], [descriptor], socket.MSG_DONTWAIT | socket.MSG_NOSIGNAL)

    def listen(self) -> None:
        """Take in what the guardian has said."""
        while not self._gone:
            try:
                datagram = self._channel.recv(words.MAX_BYTES)
            except (BlockingIOError, InterruptedError):
                return
            except OSError:
                datagram = b""
            if datagram[:1] == words.READY:
                self._ready_s, self._problem = self._clock(), None
            elif datagram[:1] == words.PROBLEM:
                self._ready_s, self._problem = None, datagram[1:].decode("utf-8", "replace")
            elif not datagram:
                self._gone = True

    async def wait_ready(self, timeout_s: float = READY_TIMEOUT_S) -> None:
        """Until the guardian could take over.

        Raises:
            DeviceError: it could not within the time; nothing takes off without it.
        """
        deadline_s = self._clock() + timeout_s
        while True:
            self.listen()
            if self.ready:
                return
            if self._gone:
                raise DeviceError("guardian: expected it to stand by, found that its process ended; see guardian.log")
            if self._clock() > deadline_s:
                found = self._problem or "it says nothing; see guardian.log"
                raise DeviceError(f"guardian: not ready within {timeout_s:g} s: {found}")
            await asyncio.sleep(_LISTEN_PERIOD_S)

    def _send(self, datagram: bytes) -> None:
        if self._gone:
            return
        try:
            self._channel.send(datagram, socket.MSG_DONTWAIT | socket.MSG_NOSIGNAL)
        except BlockingIOError:
            pass  # it does not read: `ready` tells
        except OSError:
            self._gone = True
