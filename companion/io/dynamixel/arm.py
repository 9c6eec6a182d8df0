"""Driver of the arm: one thread owns the servo bus and exchanges data with the event loop."""

from __future__ import annotations

import asyncio
import functools
import queue
import time
from collections import deque
from collections.abc import Callable
from dataclasses import dataclass
from types import TracebackType
from typing import Self

from msgspec.structs import replace

from companion.config.arm import Arm
from companion.config.devices import ArmDevice
from companion.io.device_thread import DeviceThread, resolve
from companion.io.dynamixel.bus import SETUP_ATTEMPTS, ArmBus, Counts
from companion.io.dynamixel.registers import WATCHDOG_TRIPPED, Block, JointScale
from companion.io.protocols import DeviceError
from companion.model.observations import ServoReport
from companion.model.servos import WATCHDOG_ERROR
from companion.model.types import ArmState, Joints
from companion.runtime.clock import Clock

_OPEN_TIMEOUT_S = 8.0
_KEEPALIVES_PER_WATCHDOG = 3.0
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


class DynamixelArm:
    """The arm's Dynamixel servos in current mode behind the `Arm` protocol.

    Without read requests the thread reads by itself, often enough that the servos' bus watchdogs do not trip. A torque that is not
    renewed within `device.watchdog_ms` is set to 0. The watchdogs themselves cover the case that the whole process stops. A tripped one
    is restarted and reported once as `WATCHDOG_ERROR` in `ArmState.hardware_error`; a servo with a hardware error of its own is not
    restarted.

    Args:
        device: port, baud rate, watchdog.
        arm: joints and torque constants.
        clock: the flight clock, source of all stamps.
    """

    def __init__(self, device: ArmDevice, arm: Arm, clock: Clock) -> None:
        self._device = device
        self._arm = arm
        self._clock = clock
        self._jobs: queue.SimpleQueue[object] = queue.SimpleQueue()
        """Queue of `_Read` objects and of the markers above."""
        self._goals: deque[Counts] = deque(maxlen=1)
        self._goal_handed_s = 0.0
        self._state: ArmState | None = None
        self._failures = 0
        self._written_s: float | None = None
        self._problem = ""
        self._scales: tuple[JointScale, ...] | None = None
        self._servos: tuple[ServoReport, ...] = ()
        self._thread = DeviceThread(
            "arm-bus", self._open, self._serve, lambda: self._bus.close(), lambda: self._jobs.put(_STOP)
        )
        self._bus = ArmBus(device, arm, self._thread.stopping.is_set)
        self._loop: asyncio.AbstractEventLoop | None = None
        self._reading: _Read | None = None
        self._read_s, self._read_deviation_s = _FIRST_READ_S, 0.0

    # --- event loop --------------------------------------------------------------------------------------------------

    async def __aenter__(self) -> Self:
        self._loop = asyncio.get_running_loop()
        too_late = f"arm bus {self._device.port}: the port did not open within {_OPEN_TIMEOUT_S:g} s"
        await self._thread.start(_OPEN_TIMEOUT_S + 1.0, too_late)
        return self

    async def __aexit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        await self._thread.stop()

    def latest(self) -> ArmState | None:
        """Return the newest joint state."""
        return self._state

    @property
    def servos(self) -> tuple[ServoReport, ...]:
        """Return the state of all servos at the time when the driver was opened."""
        return self._servos

    @property
    def problem(self) -> str:
        """Return the newest error of the port; empty if it has not failed."""
        return self._problem

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
                await asyncio.wait((waiter,), timeout=timeout_s)
            if not reading.done:
                return self._state
        self._reading = None
        return self._state

    def write_torque(self, torque_nm: Joints) -> Joints:
        """Pass one command to the bus thread.

        Args:
            torque_nm: joint torques with the paper's signs, N m.

        Returns:
            The torques that will be sent, after rounding to current counts and clipping, N m.

        Raises:
            ValueError: a torque is not finite.
        """
        assert self._scales is not None, "the arm is not open"
        scales = self._scales
        counts = tuple([scale.current_counts(nm) for scale, nm in zip(scales, torque_nm, strict=True)])
        self._goal_handed_s = time.monotonic()
        self._goals.append(counts)
        self._jobs.put(_WRITE)
        return tuple([scale.torque_nm(count) for scale, count in zip(scales, counts, strict=True)])

    # --- bus thread --------------------------------------------------------------------------------------------------

    def _open(self) -> DeviceError | None:
        try:
            self._scales = self._bus.open(_OPEN_TIMEOUT_S)
            self._servos = self._bus.reports
            for _ in range(SETUP_ATTEMPTS):
                self._read_once()
                if self._state is not None:
                    break
        except DeviceError as error:
            return error
        except Exception as error:  # an unplugged port raises any exception of its driver; preflight needs one line
            return DeviceError(f"arm bus {self._device.port}: failed while being set up: {_describe(error)}")
        if self._state is None:
            return DeviceError(
                f"arm bus {self._device.port}: the servos stopped answering right after set-up; check the cables"
            )
        return None

    def _serve(self) -> None:
        watchdog_s = self._device.watchdog_ms * 1e-3
        limp: Counts = (0,) * len(self._arm.joints)
        sent = limp
        later: _Read | None = None
        while True:
            wait_s = watchdog_s / _KEEPALIVES_PER_WATCHDOG
            if later is not None:
                wait_s = min(wait_s, later.at_s - self._clock())
            try:
                job = self._jobs.get(timeout=max(0.0, wait_s))
            except queue.Empty:
                job = None
            if job is _STOP:
                return
            if job is _WRITE:
                sent = self._write_newest(sent)
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
            tripped = self._read_once()
            if reading is not None:
                reading.done = True
                if reading.waiter is not None:
                    self._thread.post(functools.partial(resolve, reading.waiter, None))
            if tripped:
                sent = limp
                self._try(self._bus.restart_watchdogs)
            elif self._goal_handed_s > 0.0 and time.monotonic() - self._goal_handed_s > watchdog_s:
                # Repeated, because a sync write has no reply and our reads keep the servos' watchdogs from tripping.
                sent = limp
                self._try(lambda: self._bus.write_currents(limp))

    def _write_newest(self, sent: Counts) -> Counts:
        try:
            goal = self._goals.pop()
        except IndexError:
            return sent  # an earlier pass has already taken the newest
        self._try(lambda: self._bus.write_currents(goal))
        self._written_s = self._clock()
        return goal

    def _read_once(self) -> bool:
        """Read and publish the state. Return whether a bus watchdog had tripped."""
        asked_s = self._clock()
        try:
            blocks = self._bus.read()
        except Exception as error:  # as in `_try`
            self._problem = _describe(error)
            blocks = None
        if blocks is None:
            self._failures += 1
            if self._state is not None:
                self._state = replace(self._state, read_failures=self._failures)
            return False
        self._failures = 0
        self._state = state = self._to_state(blocks, asked_s)
        off_s = state.stamp_s - asked_s - self._read_s
        self._read_s += _SMOOTHING * off_s
        self._read_deviation_s += _SMOOTHING * (abs(off_s) - self._read_deviation_s)
        return any(block.bus_watchdog == WATCHDOG_TRIPPED for block in blocks)

    def _to_state(self, blocks: tuple[Block, ...], asked_s: float) -> ArmState:
        assert self._scales is not None
        servos = list(zip(self._scales, blocks, strict=True))
        return ArmState(
            stamp_s=self._clock(),
            angle_rad=tuple([scale.angle_rad(block.position_count) for scale, block in servos]),
            velocity_rad_s=tuple([scale.velocity_rad_s(block.velocity_count) for scale, block in servos]),
            torque_nm=tuple([scale.torque_nm(block.current_count) for scale, block in servos]),
            hardware_error=tuple([_errors(block) for block in blocks]),
            temperature_c=tuple([float(block.temperature_c) for block in blocks]),
            read_failures=0,
            written_s=self._written_s,
            asked_s=asked_s,
        )

    def _try(self, transaction: Callable[[], None]) -> None:
        # A lost port raises any exception of its driver; the thread must survive it to release the arm at the end.
        try:
            transaction()
        except Exception as error:
            self._problem = _describe(error)


def _errors(block: Block) -> int:
    return block.hardware_error | (WATCHDOG_ERROR if block.bus_watchdog == WATCHDOG_TRIPPED else 0)


def _describe(error: Exception) -> str:
    return f"{type(error).__name__}: {error}"
