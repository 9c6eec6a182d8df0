"""Simulated time as the launcher sets it up for a flight's processes, and how fast it runs."""

from __future__ import annotations

import contextlib
import os
import socket
import time
from typing import Final

from companion.runtime.simulated_time import Descriptors, Page
from companion.runtime.subprocesses import LaunchError

PACE_PERIOD_S: Final = 2.0
"""Wall time over which the pace is measured."""
_PROCESSES: Final = ("flight", "guardian")


class SharedTime:
    """The page of simulated time, and a channel to the world for each process of the flight.

    Args:
        speed: simulated seconds in a second of real time at most; infinity for as fast as the computer can.

    Raises:
        LaunchError: the kernel gives no shared memory or no sockets.
    """

    def __init__(self, speed: float) -> None:
        self._speed = speed
        self._channels: dict[str, tuple[socket.socket, socket.socket]] = {}
        try:
            self._page_fd = Page.create()
            self._page = Page(self._page_fd)
            for name in _PROCESSES:
                self._channels[name] = socket.socketpair(socket.AF_UNIX, socket.SOCK_SEQPACKET)
        except (OSError, ValueError) as error:
            raise LaunchError(f"simulated time: no memory or sockets to share: {error}; fly with --real-time") from None
        self.restart_pace()

    def of_world(self) -> tuple[tuple[str, ...], tuple[int, ...]]:
        """Return the world's arguments, and the descriptors that it inherits."""
        ends = [self._channels[name][0].fileno() for name in _PROCESSES]
        inherited = (self._page_fd, *ends)
        return ("--time", ",".join(map(str, inherited)), "--speed", repr(self._speed)), inherited

    def of(self, name: str) -> tuple[tuple[str, ...], tuple[int, ...]]:
        """Return the arguments of the process `flight` or `guardian`, and the descriptors that it inherits."""
        channel = self._channels[name][1].fileno()
        return ("--time", str(Descriptors(self._page_fd, channel))), (self._page_fd, channel)

    def world_started(self) -> None:
        """Close the world's ends, so that the others notice its end."""
        for world_end, _ in self._channels.values():
            world_end.close()

    def started(self, name: str) -> None:
        """Close the end of a process that was started, or that never will be."""
        self._channels[name][1].close()

    def all_started(self) -> None:
        """Close the ends of the processes that were never started."""
        for name in _PROCESSES:
            self.started(name)

    def close(self) -> None:
        """Close everything that is open."""
        self.world_started()
        self.all_started()
        with contextlib.suppress(OSError):
            os.close(self._page_fd)
        self._page_fd = -1

    def now_s(self) -> float:
        """Return the simulated time."""
        return self._page.now_s

    def restart_pace(self) -> None:
        """Measure the pace from here."""
        self._measured = (time.monotonic(), self._page.now_s)

    def pace(self) -> float | None:
        """Return simulated seconds per second since the last measurement; None before `PACE_PERIOD_S` have passed."""
        wall_s, now_s = time.monotonic(), self._page.now_s
        begun_wall_s, begun_s = self._measured
        if wall_s - begun_wall_s < PACE_PERIOD_S:
            return None
        self._measured = (wall_s, now_s)
        return (now_s - begun_s) / (wall_s - begun_wall_s)
