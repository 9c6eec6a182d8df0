"""The world's side of simulated time (`companion.runtime.simulated_time`): it grants the present instant to the processes of a flight,
waits for their reports, and keeps the pace.
"""

from __future__ import annotations

import asyncio
import contextlib
import math
import select
import selectors
import socket
import struct
import time
from collections.abc import Iterator, Mapping, Sequence
from typing import Final

from companion.runtime.simulated_time import GRANT, REPORT, Flags, Page, Report
from sitl.servo.bus import ServoBus

PATIENCE_S: Final = 2.0
"""Wall time that the world waits for a process before it goes on without it, at the pace of real time: the process hangs. It is
counted in pieces of `_LOOK_S` that the world itself has run: a computer that stands still stops both.
"""
_LOOK_S: Final = 0.1
STARTING_SPEED: Final = 0.1
"""Simulated seconds in a second of real time while a process of the flight still starts: nobody needs what the world does, and each
process would start later beside a busy one.
"""
CATCH_UP_S: Final = 0.03
"""A world that is further behind its pace does not catch up."""
_EPSILON_S: Final = 1e-9


class CountingSelector(selectors.SelectSelector):
    """Counts the descriptors that were ready when the event loop last asked."""

    ready = 0

    def select(self, timeout: float | None = None) -> list[tuple[selectors.SelectorKey, int]]:
        """Select as usual, and count."""
        found = super().select(timeout)
        self.ready = len(found)
        return found


class LockstepLoop(asyncio.SelectorEventLoop):
    """Event loop of a world in lockstep."""

    def __init__(self) -> None:
        self._counts = CountingSelector()
        super().__init__(self._counts)

    async def handle_all(self) -> None:
        """Handle everything that has arrived at the descriptors of this loop."""
        while True:
            await asyncio.sleep(0)
            if not self._counts.ready:
                return


class Process:
    """A process of the flight.

    Args:
        channel: the world's end of its channel.
    """

    def __init__(self, channel: socket.socket) -> None:
        channel.setblocking(False)
        self._channel = channel
        self._granted = 0
        self._report: Report | None = None
        self.begins = False
        """Whether it has asked the world to start over."""
        self.waited_for = True
        """Whether the world waits for its reports: it does not hang."""
        self.ended = False

    def fileno(self) -> int:
        """Return the channel's descriptor."""
        return self._channel.fileno()

    @property
    def bus_bytes(self) -> int:
        """Bytes that it had written to the servo bus at its last report."""
        return 0 if self._report is None else self._report.bus_bytes

    @property
    def starts(self) -> bool:
        """Whether it has not reported yet."""
        return self._report is None and not self.ended

    @property
    def busy(self) -> bool:
        """Whether it has begun to work at the granted instant and has not reported."""
        return self._report is not None and self._report.grant < self._granted and not self.ended

    @property
    def hurried(self) -> bool:
        """Whether simulated time may run faster than real time, as far as this process is concerned."""
        if self.ended:
            return True
        return self._report is not None and self.waited_for and not self._report.flags & Flags.THREADS

    def wants(self, now_s: float, data: bool) -> bool:
        """Return whether it wants to work at this instant.

        Args:
            data: whether a frame of motion capture was sent.
        """
        report = self._report
        if report is None or self.ended or self.busy:
            return False
        return report.wake_s <= now_s + _EPSILON_S or (data and bool(report.flags & Flags.DATA))

    def grant(self) -> None:
        """Let it work at the present instant."""
        self._granted += 1
        try:
            self._channel.send(GRANT.pack(self._granted))
        except BlockingIOError:
            self._granted -= 1
        except OSError:
            self.ended = True

    def read(self) -> None:
        """Read its reports."""
        while not self.ended:
            try:
                data = self._channel.recv(REPORT.size)
            except BlockingIOError:
                return
            except OSError:
                data = b""
            if not data:
                self.ended = True
                return
            with contextlib.suppress(struct.error):
                self._report = report = Report(*REPORT.unpack(data))
                self.begins = self.begins or bool(report.flags & Flags.BEGIN)
                self.waited_for = self.waited_for or report.grant == self._granted


class MachineTime:
    """Simulated time as the processes of one machine share it.

    Args:
        channels: the world's ends of the channels to the processes of the flight, by name.
    """

    def __init__(self, page: Page, channels: Mapping[str, socket.socket]) -> None:
        self.page = page
        self.processes = {name: Process(channel) for name, channel in channels.items()}
        self.bus: ServoBus | None = None
        """The servo bus, which is served while a process works; None without an arm."""

    def do_not_wait_for(self, name: str) -> None:
        """Go on without a process that is known to hang, until it reports again."""
        self.processes[name].waited_for = False

    @property
    def bus_bytes(self) -> int:
        """Bytes that the flight has written to the servo bus."""
        return max(process.bus_bytes for process in self.processes.values())

    @property
    def begins(self) -> bool:
        """Whether a process has asked the world to start over."""
        return any(process.begins for process in self.processes.values())

    @property
    def ended(self) -> bool:
        """Whether every process has ended."""
        return all(process.ended for process in self.processes.values())


class TimeKeeper:
    """Simulated time, owned by the world.

    Args:
        speed: simulated seconds in a second of real time at most.
    """

    def __init__(self, machines: Sequence[MachineTime], speed: float) -> None:
        self.machines = tuple(machines)
        self._processes = [process for machine in machines for process in machine.processes.values()]
        self._speed, self._starting_speed = speed, STARTING_SPEED
        self._from: tuple[float, float] | None = None
        """Simulated time and wall time from which the pace is kept."""

    @contextlib.contextmanager
    def listening(self) -> Iterator[None]:
        """Read the reports while this context is open."""
        loop = asyncio.get_running_loop()
        for process in self._processes:
            loop.add_reader(process, self._on_report, process)
        try:
            yield
        finally:
            for process in self._processes:
                loop.remove_reader(process)

    def _on_report(self, process: Process) -> None:
        process.read()
        if process.ended:
            asyncio.get_running_loop().remove_reader(process)

    def begins(self) -> bool:
        """Return whether the world shall start over, once: each machine that has not ended has asked for it."""
        begins = any(each.begins for each in self.machines) and all(each.begins or each.ended for each in self.machines)
        if begins:
            for process in self._processes:
                process.begins = False
        return begins

    def limit_to_real_time(self) -> None:
        """Run at real time until the flight begins, and never faster."""
        self._speed, self._starting_speed = min(1.0, self._speed), 1.0

    def set(self, now_s: float) -> None:
        """Set the simulated time, which may jump."""
        self._write(now_s)
        self._from = None

    def _write(self, now_s: float) -> None:
        for machine in self.machines:
            machine.page.now_s = now_s

    async def advance(self, now_s: float, data: bool) -> None:
        """Advance simulated time, let every process that wants to work do so, and keep the pace.

        Args:
            data: whether a frame of motion capture was sent.
        """
        self._write(now_s)
        processes = self._processes
        granted = [process for process in processes if process.wants(now_s, data)]
        for process in granted:
            process.grant()
        self._reports(processes)
        await self._keep_pace(now_s, processes)

    def _reports(self, processes: Sequence[Process]) -> None:
        """Wait for the reports. Meanwhile only the servo buses are served: a process waits for nothing else at this instant, and each
        wake-up takes longer than most of the work that follows.
        """
        waited_s = 0.0
        served = [machine.bus for machine in self.machines if machine.bus is not None]
        while working := [process for process in processes if process.busy and process.waited_for]:
            waiting: list[Process | ServoBus] = [*working, *served]
            ready = select.select(waiting, (), (), _LOOK_S)[0]
            for one in ready:
                self._on_report(one) if isinstance(one, Process) else one.on_readable()
            if not ready:
                waited_s += _LOOK_S
                if waited_s >= PATIENCE_S:
                    for process in working:
                        process.waited_for = False

    async def _keep_pace(self, now_s: float, processes: Sequence[Process]) -> None:
        # Before the flight begins MAVSDK connects, which lives on the computer's clock and is impatient.
        wanted = max(1.0, self._speed) if now_s < 0.0 else self._speed
        speed = wanted if all(process.hurried for process in processes) else min(1.0, wanted)
        if now_s < 0.0 and any(process.starts for process in processes):
            speed = min(speed, self._starting_speed)
        if math.isinf(speed):
            self._from = None
            return
        wall_s = time.monotonic()
        from_s, from_wall_s = self._from or (now_s, wall_s)
        ahead_s = (now_s - from_s) / speed - (wall_s - from_wall_s)
        if ahead_s > 0.0:
            await asyncio.sleep(ahead_s)
            self._from = (from_s, from_wall_s)
        else:
            # Late: the pace is kept from here, at most `CATCH_UP_S` behind.
            behind_s = max(0.0, -ahead_s - CATCH_UP_S)
            self._from = (from_s, from_wall_s + behind_s)
