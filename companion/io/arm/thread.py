"""The part of an arm's driver that does not depend on its bus: one thread owns the bus and exchanges data with the event loop."""

from __future__ import annotations

import asyncio
import functools
import math
import queue
import threading
from abc import ABC, abstractmethod
from collections import deque
from collections.abc import Callable
from dataclasses import dataclass
from typing import ClassVar, Final, Generic, Self, TypeVar

from msgspec.structs import replace

from companion.io.device_thread import DeviceThread, resolve
from companion.io.protocols import DeviceError
from companion.model.observations import ArmStatement, ServoReport
from companion.model.servos import WATCHDOG_ERROR
from companion.model.team import ClampCommand, ClampState
from companion.model.types import ArmState, Joints
from companion.runtime.clock import Clock
from companion.runtime.event_loop import time_stands

OPEN_TIMEOUT_S: Final = 8.0
_FIRST_READS = 5
KEEPALIVES_PER_WATCHDOG: Final = 3.0
_FIRST_READ_S = 0.002
_SMOOTHING, _DEVIATIONS = 0.05, 2.0
"""Smoothing of the estimated read duration, as in TCP's round-trip estimate (RFC 6298) but slower."""

_WRITE = object()
_STOP = object()
_NOW = object()
"""Queue entry that starts a scheduled read at once."""


@dataclass(slots=True)
class _Read:
    """One read. The bus thread reports its progress by assignment and wakes the event loop only if a caller waits."""

    at_s: float
    begun: bool = False
    done: bool = False
    waiter: asyncio.Future[None] | None = None


Answer = TypeVar("Answer")
Goal = TypeVar("Goal")


class ThreadedArm(ABC, Generic[Answer, Goal]):
    """An arm on a bus behind the `Arm` protocol. The methods at the end are the bus, which the thread calls.

    The thread makes all transactions but one: with `writes_at_once` a goal is sent by the event loop itself, unless the thread is using
    the bus at that moment. That costs one system call, less than waking the thread, which would then compete for the interpreter.

    Without read requests the thread reads by itself, often enough that the bus watchdogs do not trip. A torque that is not renewed
    within the timeout of the watchdog is set to 0. The watchdogs themselves cover the case that the whole process stops.

    Args:
        where: device and address, for errors.
        limp: goal without torque.
    """

    writes_at_once: ClassVar[bool] = False
    """Whether `_write_bus` never waits and may be called in the event loop."""

    def __init__(self, where: str, watchdog_ms: int, limp: Goal, clock: Clock) -> None:
        self._where = where
        self._watchdog_s = watchdog_ms * 1e-3
        self._limp = limp
        self._clock = clock
        self._jobs: queue.SimpleQueue[object] = queue.SimpleQueue()
        """Queue of `_Read` objects and of the markers above."""
        self._goals: deque[Goal] = deque(maxlen=1)
        self._goal_handed_s = math.inf
        self._bus_in_use = threading.Lock()
        self._state: ArmState | None = None
        self._failures = 0
        self._written_s: float | None = None
        self.problem = ""
        """Newest error of the port or of the clamp's servo; empty if neither has failed."""
        self._servos: tuple[ServoReport, ...] = ()
        self._thread = DeviceThread("arm-bus", self._open, self._serve, self._close_bus, lambda: self._jobs.put(_STOP))
        self._loop: asyncio.AbstractEventLoop | None = None
        self._reading: _Read | None = None
        self._read_s, self._read_deviation_s = _FIRST_READ_S, 0.0

    # --- event loop --------------------------------------------------------------------------------------------------

    async def __aenter__(self) -> Self:
        self._loop = asyncio.get_running_loop()
        await self._thread.start(
            OPEN_TIMEOUT_S + 1.0, f"{self._where}: the port did not open within {OPEN_TIMEOUT_S:g} s"
        )
        return self

    async def __aexit__(self, *_: object) -> None:
        await self._thread.stop()

    def latest(self) -> ArmState | None:
        """Return the newest joint state."""
        return self._state

    @property
    def servos(self) -> tuple[ServoReport, ...]:
        """Return the state of all servos at the time when the driver was opened."""
        return self._servos

    @property
    def statement(self) -> ArmStatement | None:
        """Return what a plug-in states about its arm; None for servos, which are read instead."""
        return None

    def clamp(self) -> ClampState | None:
        """Return the newest state of the clamp; None without one."""
        return None

    def command_clamp(self, command: ClampCommand | None) -> None:
        """Command the clamp, which keeps the last command; without one nothing happens. Never waits."""

    @property
    def read_takes_s(self) -> float:
        """Return the time within which most reads complete, s."""
        return self._read_s + _DEVIATIONS * self._read_deviation_s

    def begin_read(self, at_s: float = 0.0) -> None:
        """Start a read in the bus thread without waiting for it. Nothing is started while an earlier read is in progress.

        Args:
            at_s: start on the flight clock; a past time means now.
        """
        if self._reading is None or self._reading.done:
            self._reading = _Read(at_s)
            self._jobs.put(self._reading)

    async def read(self, timeout_s: float) -> ArmState | None:
        """Wait for the read in progress, or for one that starts now, and return the newest state, whose `read_failures` counts all
        failed reads.

        A read that takes longer than `timeout_s` continues in the bus thread, and the next call waits for it.
        """
        if self._reading is None:
            self.begin_read()
        reading = self._reading
        assert reading is not None
        if not reading.done:
            if not reading.begun:
                self._jobs.put(_NOW)
            assert self._loop is not None, "the arm is not open"
            waiter = reading.waiter = self._loop.create_future()
            if not reading.done:  # otherwise the thread may have checked for a waiter before there was one
                with time_stands():
                    await asyncio.wait((waiter,), timeout=timeout_s)
            if not reading.done:
                return self._state
        self._reading = None
        return self._state

    def write_torque(self, torque_nm: Joints) -> Joints:
        """Send one command, or pass it to the bus thread; never waits.

        Args:
            torque_nm: joint torques with the paper's signs, N m.

        Returns:
            The torques that will be sent, after rounding and clipping, N m.

        Raises:
            ValueError: a torque is not finite.
        """
        goal, sent_nm = self._encode(torque_nm)
        self._goal_handed_s = self._clock()
        if self.writes_at_once and self._bus_in_use.acquire(blocking=False):
            try:
                self._goals.clear()  # an older one that the thread has not sent yet
                self._write(goal)
            finally:
                self._bus_in_use.release()
        else:
            self._goals.append(goal)
            self._jobs.put(_WRITE)
        return sent_nm

    # --- bus thread --------------------------------------------------------------------------------------------------

    def _open(self) -> DeviceError | None:
        try:
            self._open_bus()
            for _ in range(_FIRST_READS):
                self._read_once()
                if self._state is not None:
                    return None
        except DeviceError as error:
            return error
        except Exception as error:  # an unplugged port raises any exception of its driver; preflight needs one line
            return DeviceError(f"{self._where}: failed while being set up: {_describe(error)}")
        found = self.problem or "the servos stopped answering right after set-up; check the cables"
        return DeviceError(f"{self._where}: {found}")

    def _serve(self) -> None:
        watchdog_s, limp = self._watchdog_s, self._limp
        later: _Read | None = None
        while True:
            due_s = self._clock() + watchdog_s / KEEPALIVES_PER_WATCHDOG
            job = self._next_job(due_s if later is None else min(due_s, later.at_s))
            if job is _STOP:
                return
            if job is _WRITE:
                self._write_newest()
                continue
            if isinstance(job, _Read):
                later = job
                if job.at_s > self._clock():
                    continue
            elif job is _NOW and later is None:
                continue  # it has begun since
            reading = later
            if job is None and later is not None and later.at_s > self._clock():
                reading = None  # far in the future: until then feed the watchdogs and withdraw an expired torque
            if reading is not None:
                later = None
                reading.begun = True
            with self._bus_in_use:
                tripped = self._read_once()
            if reading is not None:
                reading.done = True
                if reading.waiter is not None:
                    self._thread.post(functools.partial(resolve, reading.waiter, None))
            if tripped:
                with self._bus_in_use:
                    self._try(self._restart_watchdogs)
            elif self._clock() - self._goal_handed_s > watchdog_s:
                # Repeated, because a sync write has no reply and our reads keep the servos' watchdogs from tripping.
                with self._bus_in_use:
                    self._try(lambda: self._write_bus(limp))

    def _next_job(self, due_s: float) -> object:
        """Return the next job; None if none has come by `due_s` on the flight clock, which may be slower than the computer's."""
        while True:
            try:
                return self._jobs.get(timeout=max(0.0, due_s - self._clock()))
            except queue.Empty:
                if self._clock() >= due_s:
                    return None

    def _write_newest(self) -> None:
        with self._bus_in_use:
            if self._goals:  # otherwise an earlier pass, or the event loop, has sent a newer one
                self._write(self._goals.pop())

    def _write(self, goal: Goal) -> None:
        self._try(lambda: self._write_bus(goal))
        self._written_s = self._clock()

    def _read_once(self) -> bool:
        """Read and publish the state. Return whether a bus watchdog had tripped."""
        asked_s = self._clock()
        try:
            answer = self._read_bus()
        except Exception as error:  # as in `_try`
            self.problem = _describe(error)
            answer = None
        if answer is None:
            self._failures += 1
            if self._state is not None:
                self._state = replace(self._state, read_failures=self._failures)
            return False
        self._failures = 0
        self._state = state = self._to_state(answer, asked_s)
        off_s = state.stamp_s - asked_s - self._read_s
        self._read_s += _SMOOTHING * off_s
        self._read_deviation_s += _SMOOTHING * (abs(off_s) - self._read_deviation_s)
        return any(error & WATCHDOG_ERROR for error in state.hardware_error)

    def _try(self, transaction: Callable[[], None]) -> None:
        # A lost port raises any exception of its driver; the thread must survive it to release the arm at the end.
        try:
            transaction()
        except Exception as error:
            self.problem = _describe(error)

    # --- bus ---------------------------------------------------------------------------------------------------------

    @abstractmethod
    def _open_bus(self) -> None:
        """Open the bus, check the arm and switch its torque on, with torque 0; raises DeviceError if it fails a requirement."""

    @abstractmethod
    def _read_bus(self) -> Answer | None:
        """Read all joints; None or an exception if not all of them answer."""

    @abstractmethod
    def _to_state(self, answer: Answer, asked_s: float) -> ArmState:
        """Return an answer as joint state."""

    @abstractmethod
    def _encode(self, torque_nm: Joints) -> tuple[Goal, Joints]:
        """Return the goal for these torques, and the torques that it stands for; called in the event loop."""

    @abstractmethod
    def _write_bus(self, goal: Goal) -> None:
        """Send a goal to all joints; with `writes_at_once` also called in the event loop."""

    @abstractmethod
    def _restart_watchdogs(self) -> None:
        """Switch the torque on again after `WATCHDOG_ERROR`, with torque 0."""

    @abstractmethod
    def _close_bus(self) -> None:
        """Switch the torque off as far as the bus still works, and close it; never raises."""


def _describe(error: Exception) -> str:
    return f"{type(error).__name__}: {error}"
