"""The flight process's side of the guardian: sends a heartbeat per tick and receives READY. Only `wait_ready` waits."""

from __future__ import annotations

import asyncio
import contextlib
import math
import socket

from companion.guardian import heartbeat
from companion.guardian.heartbeat import Heartbeat
from companion.io.protocols import DeviceError
from companion.runtime.clock import Clock

READY_TIMEOUT_S = 10.0
SILENT_S = 1.0
"""Silence after which the guardian is treated as dead."""
_LISTEN_PERIOD_S = 0.02
_NEVER_WAIT = int(socket.MSG_DONTWAIT | socket.MSG_NOSIGNAL)
"""Computed once, because `|` of two enum members takes 2 us."""
_QUIET_S = 0.8 * heartbeat.READY_PERIOD_S
"""Time after a message in which the guardian sends no other."""


class GuardianClient:
    """Connection to the guardian, used by the flight process.

    Args:
        channel: one end of the SOCK_SEQPACKET pair whose other end the guardian inherited.
        clock: the flight clock.
    """

    def __init__(self, channel: socket.socket, clock: Clock) -> None:
        channel.setblocking(False)
        self._channel = channel
        self._clock = clock
        self._ready_s: float | None = None
        self._quiet_until_s = -math.inf
        self._gone = False
        self._problem: str | None = None

    @property
    def ready(self) -> bool:
        """Whether the guardian reported READY within the last second."""
        return not self._gone and self._ready_s is not None and self._clock() - self._ready_s < SILENT_S

    def send_heartbeat(self, message: Heartbeat) -> None:
        """Send the heartbeat of one tick."""
        self._send(heartbeat.pack(message))

    def share_recorder(self, descriptor: int) -> None:
        """Send the descriptor of the recorder's channel, so that the guardian can log when this process cannot."""
        with contextlib.suppress(OSError):
            socket.send_fds(self._channel, [heartbeat.RECORDER_CHANNEL], [descriptor], _NEVER_WAIT)

    def listen(self) -> None:
        """Read all messages that the guardian has sent. A heartbeat detects its death; so in most ticks a read is not needed."""
        if self._clock() < self._quiet_until_s:
            return
        while not self._gone:
            try:
                datagram = self._channel.recv(heartbeat.MAX_BYTES)
            except (BlockingIOError, InterruptedError):
                return
            except OSError:
                datagram = b""
            self._quiet_until_s = self._clock() + _QUIET_S
            if datagram[:1] == heartbeat.READY:
                self._ready_s, self._problem = self._clock(), None
            elif datagram[:1] == heartbeat.PROBLEM:
                self._ready_s, self._problem = None, datagram[1:].decode("utf-8", "replace")
            elif not datagram:
                self._gone = True

    async def wait_ready(self, timeout_s: float = READY_TIMEOUT_S) -> None:
        """Wait until the guardian reports READY.

        Raises:
            DeviceError: the guardian's process ended, or it was not ready within the timeout. The flight must not take off.
        """
        deadline_s = self._clock() + timeout_s
        while True:
            self.listen()
            if self.ready:
                return
            if self._gone:
                raise DeviceError("guardian: its process ended before it was ready; see guardian.log")
            if self._clock() > deadline_s:
                found = self._problem or "it has sent no message; see guardian.log"
                raise DeviceError(f"guardian: not ready within {timeout_s:g} s: {found}")
            await asyncio.sleep(_LISTEN_PERIOD_S)

    def _send(self, datagram: bytes) -> None:
        if self._gone:
            return
        try:
            self._channel.send(datagram, _NEVER_WAIT)
        except BlockingIOError:
            pass  # it does not read: `ready` becomes false
        except OSError:
            self._gone = True
