"""The flight process as the guardian sees it: whether it lives, and what it sends. Only `wait` and `watch` wait."""

from __future__ import annotations

import contextlib
import os
import select
import signal
import socket

from companion.guardian import heartbeat
from companion.guardian.heartbeat import Heartbeat
from companion.runtime import simulated_time

_MAX_DATAGRAMS = 512


class FlightProcess:
    """The flight process, referenced by pidfd: a reused process id cannot be mistaken for it."""

    def __init__(self, pidfd: int) -> None:
        self.pidfd = pidfd
        self._end = select.poll()
        self._end.register(pidfd, select.POLLIN)

    def wait(self, timeout_s: float) -> bool:
        """Wait up to `timeout_s`; return whether the process is dead. The kernel has then closed its sockets."""
        return bool(self._end.poll(max(0, round(timeout_s * 1e3))))

    def watch(self, period_s: float) -> bool:
        """Wait for one period, or for the end of the process; return whether it is dead."""
        simulated_time.wait(self._end, period_s, data=False)
        return self.wait(0.0)

    def kill(self) -> None:
        """Send SIGKILL, the only signal that ends a hung process in every case."""
        with contextlib.suppress(ProcessLookupError):
            signal.pidfd_send_signal(self.pidfd, signal.SIGKILL)


class HeartbeatReceiver:
    """The guardian's end of the socket to the flight process."""

    def __init__(self, channel: socket.socket) -> None:
        channel.setblocking(False)
        self._channel = channel
        self.last: Heartbeat | None = None
        self.count = self.missed = 0
        """Heartbeats received, and ticks for which the heartbeat is missing."""
        self.recorder: socket.socket | None = None
        """The recorder's channel, once the flight process has shared it."""

    def receive(self) -> bool:
        """Read all waiting datagrams; return whether a heartbeat was among them."""
        heard = False
        for _ in range(_MAX_DATAGRAMS):
            try:
                datagram, descriptors, _, _ = socket.recv_fds(self._channel, heartbeat.MAX_BYTES, 1)
            except OSError:  # nothing more, or the flight process is gone, which its pidfd shows
                break
            if not datagram:
                break
            for descriptor in descriptors:
                if datagram[:1] == heartbeat.RECORDER_CHANNEL and self.recorder is None:
                    self.recorder = socket.socket(fileno=descriptor)
                else:
                    os.close(descriptor)
            received = heartbeat.unpack(datagram)
            if received is not None:
                if self.last is not None:
                    self.missed += max(0, received.tick - self.last.tick - 1)
                self.count += 1
                self.last, heard = received, True
        return heard

    def send_status(self, problem: str | None) -> None:
        """Send READY, or PROBLEM with its reason; never waits."""
        text = heartbeat.READY if problem is None else heartbeat.PROBLEM + problem.encode()[: heartbeat.MAX_BYTES - 1]
        with contextlib.suppress(OSError):
            self._channel.send(text, socket.MSG_DONTWAIT | socket.MSG_NOSIGNAL)
