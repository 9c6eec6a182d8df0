"""Simulated time: the clock of a flight in the simulated world, which owns the time and waits for the flight.

The world writes the time on a page of memory that all processes of the flight share. Time stands while a process works: the world
*grants* a process the present instant and goes on when the process *reports* that it has done everything until then, and when it wants
to go on next. A busy computer makes such a flight slower and changes nothing in it. On a vehicle `current()` is None.

Grants and reports are packets on a SOCK_SEQPACKET pair for each process. If the world ends, time follows the computer's clock.
"""

from __future__ import annotations

import ctypes
import mmap
import os
import select
import socket
import struct
import time
from dataclasses import dataclass
from typing import Final, NamedTuple, Self

GRANT: Final = struct.Struct("<Q")
REPORT: Final = struct.Struct("<QdQB")
"""Number of the newest grant, `wake_s`, bytes written to the servo bus, `Flags`."""
_PAGE_BYTES: Final = 24


class Flags:
    """Bits of a report."""

    THREADS = 1
    """A thread of the process works on the computer's clock: time must not run faster than real time."""
    BEGIN = 2
    """The flight begins: the world shall start over, at time zero."""
    DATA = 4
    """The process wants a grant whenever motion capture has sent a frame."""


class Report(NamedTuple):
    """Report of a process: it has done everything until now."""

    grant: int
    wake_s: float
    """Simulated time at which it wants the next grant."""
    bus_bytes: int
    flags: int


class Page:
    """The shared page.

    Args:
        descriptor: an open memfd of `create`; it may be closed afterwards.
    """

    def __init__(self, descriptor: int) -> None:
        self._map = mmap.mmap(descriptor, _PAGE_BYTES)
        self._now = ctypes.c_double.from_buffer(self._map, 0)
        self._bus = (ctypes.c_uint64 * 2).from_buffer(self._map, 8)

    @staticmethod
    def create() -> int:
        """Return the descriptor of a new page.

        Raises:
            OSError: the kernel has no memory for it.
        """
        descriptor = os.memfd_create("time")
        os.truncate(descriptor, _PAGE_BYTES)
        return descriptor

    @property
    def now_s(self) -> float:
        """Simulated time."""
        return self._now.value

    @now_s.setter
    def now_s(self, now_s: float) -> None:
        self._now.value = now_s

    @property
    def bus_sent_bytes(self) -> int:
        """Bytes that the world has sent on the servo bus."""
        return self._bus[0]

    @bus_sent_bytes.setter
    def bus_sent_bytes(self, count: int) -> None:
        self._bus[0] = count

    @property
    def bus_answered_bytes(self) -> int:
        """Bytes of instructions on the servo bus that the world has handled; their answers are among the bytes sent."""
        return self._bus[1]

    @bus_answered_bytes.setter
    def bus_answered_bytes(self, count: int) -> None:
        self._bus[1] = count


@dataclass(frozen=True, slots=True)
class Descriptors:
    """Descriptors that a process of the flight inherits; `str()` returns them for its command line."""

    page: int
    channel: int

    def __str__(self) -> str:
        return f"{self.page},{self.channel}"

    @classmethod
    def parse(cls, text: str) -> Self:
        """Return the descriptors of a command line."""
        page, _, channel = text.partition(",")
        return cls(int(page), int(channel))


class SimulatedTime:
    """Simulated time of one process."""

    def __init__(self, descriptors: Descriptors) -> None:
        self._page = Page(descriptors.page)
        self._channel = socket.socket(fileno=descriptors.channel)
        self._channel.setblocking(False)
        self._grant = 0
        self._lost: tuple[float, float] | None = None
        """Simulated time and `time.monotonic` at the end of the world."""
        self.bus_bytes = self.bus_received_bytes = 0
        """Bytes that this process has written to the servo bus, and read from it."""
        self.threads = 0
        """Number of calls that threads of this process carry out on the computer's clock."""
        self.begins = False
        """Whether the next report asks the world to start over."""

    def now(self) -> float:
        """Return the simulated time in s."""
        if self._lost is None:
            return self._page.now_s
        at_s, wall_s = self._lost
        return at_s + time.monotonic() - wall_s

    def close(self) -> None:
        """Close the channel: the world does not wait for this process any more."""
        self._channel.close()

    def fileno(self) -> int:
        """Return the descriptor that is readable when a grant has arrived."""
        return self._channel.fileno()

    @property
    def known_lost(self) -> bool:
        """Whether the end of the world has been noticed, at the latest by the next `report` or `take_grants`. Asks no kernel."""
        return self._lost is not None

    @property
    def lost(self) -> bool:
        """Whether the world has ended. Called from any thread."""
        if self._lost is None:
            hang_up = select.poll()  # of its own, because threads cannot share one
            hang_up.register(self._channel, 0)  # a hang-up is always reported
            if hang_up.poll(0):
                self._lost = (self._page.now_s, time.monotonic())
        return self._lost is not None

    @property
    def bus_is_silent(self) -> bool:
        """Whether nothing more will arrive on the servo bus in reply to what was written."""
        page = self._page
        if page.bus_answered_bytes >= self.bus_bytes and self.bus_received_bytes >= page.bus_sent_bytes:
            return True
        return self.lost

    def report(self, wake_s: float, *, data: bool = True) -> None:
        """Report that everything until now is done.

        Args:
            wake_s: simulated time at which this process wants to go on; infinity if only for data.
            data: whether to go on as well when motion capture has sent a frame.
        """
        flags = Flags.THREADS * (self.threads > 0) | Flags.BEGIN * self.begins | Flags.DATA * data
        self.begins = False
        try:
            self._channel.send(REPORT.pack(self._grant, wake_s, self.bus_bytes, flags))
        except OSError:  # the world has ended, or does not read because it does not wait for this process
            _ = self.lost

    def take_grants(self) -> bool:
        """Read the grants that have arrived; return whether there was one."""
        taken = False
        while True:
            try:
                (self._grant,) = GRANT.unpack(self._channel.recv(GRANT.size))
            except BlockingIOError:
                return taken
            except (OSError, struct.error):  # the world has ended
                _ = self.lost
                return taken
            taken = True

    def wait(self, waiting: select.poll, timeout_s: float, *, data: bool) -> list[tuple[int, int]]:
        """Wait like `waiting.poll`, with a timeout in simulated time; for a process without an event loop.

        Args:
            waiting: descriptors to wait on; that of this object is registered as well.
            timeout_s: simulated time, s.
            data: as for `report`.

        Returns:
            The descriptors that are ready, as `poll` returns them, without that of this object.
        """
        waiting.register(self._channel, select.POLLIN)
        wake_s = self.now() + timeout_s
        own = self._channel.fileno()
        while True:
            if self.lost:
                waiting.unregister(own)
                return waiting.poll(max(0.0, wake_s - self.now()) * 1e3)
            ready = [one for one in waiting.poll(0) if one[0] != own]
            if ready or self.now() >= wake_s - 1e-9:
                return ready
            self.report(wake_s, data=data)
            waiting.poll()
            self.take_grants()


_current: SimulatedTime | None = None


def current() -> SimulatedTime | None:
    """Return the simulated time that this process lives in; None if it lives in real time, as on a vehicle."""
    return _current


def wait(waiting: select.poll, timeout_s: float, *, data: bool) -> list[tuple[int, int]]:
    """Wait like `waiting.poll`, in the time that this process lives in.

    Args:
        data: whether a frame of motion capture ends the wait, if it is simulated time.
    """
    if _current is None:
        return waiting.poll(timeout_s * 1e3)
    return _current.wait(waiting, timeout_s, data=data)


def enter(text: str) -> SimulatedTime:
    """Let this process live in simulated time; called first of all.

    Args:
        text: descriptors of its command line (`Descriptors`).
    """
    global _current
    _current = SimulatedTime(Descriptors.parse(text))
    return _current
