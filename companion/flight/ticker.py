"""Ticks of the control loop: absolute deadlines synchronised with the frames of motion capture."""

from __future__ import annotations

import asyncio
import math
import time
from collections import deque
from dataclasses import dataclass

from companion.runtime.clock import Clock

EARLY_S, LATE_S = 0.0015, 0.001
"""Window around the expected time of a frame. A frame in the window starts the tick; without one the tick starts at the
window's end.
"""
MATCH = 0.02
"""Largest relative difference between frame rate and tick rate at which ticks follow the frames."""
_GAIN, _SLEW_S = 0.1, 0.00025
"""Fraction of a frame's timing error by which the next deadline moves, and the largest such step."""
_PATIENCE = 3.0
"""Number of periods without a frame in its window after which ticks no longer wait for frames."""
SIMULATED_START_S = 0.5
"""Time from the beginning of a simulated flight to its first tick: every device has sent new data by then."""
STEP_S = 0.002
"""Step of simulated time: a tick that starts that much after its deadline is not late."""
JOINT_LEAD_MAX_S = 0.003
"""Longest time before a tick at which the read of its joint state begins."""
_SLOW_TICKS = 4


@dataclass(frozen=True, slots=True)
class TickTime:
    """Start of a tick."""

    start_s: float
    lateness_s: float
    """Delay of the tick after the frame that started it, or after its deadline if no frame did."""


class Ticker:
    """Times the ticks by absolute deadlines: a late tick does not move the next one. Deadlines in the past are skipped.

    Frames that arrive at the tick rate move the deadlines, by at most `_SLEW_S` per tick, and each tick begins when its frame
    arrives. A tick does not wait longer than `LATE_S` for its frame, and a frame outside its window starts no tick. Ticks are
    therefore always about half to one and a half periods apart.

    Args:
        frame_rate_hz: rate of motion capture; frames are ignored if it is 0 or too far from the tick rate.
    """

    def __init__(self, period_s: float, clock: Clock, frame_rate_hz: float = 0.0) -> None:
        self._period_s = period_s
        self._clock = clock
        self._rides = abs(frame_rate_hz * period_s - 1.0) <= MATCH
        self.due_s = clock() + period_s
        """Time at which the next tick is expected to begin."""
        self._frame_s: float | None = None
        """Arrival of the newest frame since the last tick."""
        self._in_place_s = -math.inf
        """Arrival of the last frame inside its window."""
        self._waiter: asyncio.Future[None] | None = None
        self.skipped = 0

    def frame(self, arrived_s: float) -> None:
        """Report the arrival of a motion-capture frame; call it from the event loop."""
        if not self._rides:
            return
        self._frame_s = arrived_s
        if self._waiter is not None and not self._waiter.done() and self._in_place(arrived_s):
            self._waiter.set_result(None)

    async def next(self) -> TickTime:
        """Wait for the next frame or deadline."""
        self._skip()
        if self._frame_s is None or not self._in_place(self._frame_s):  # else the loop has just served its sockets
            await self._frame_or_deadline()
        start_s, frame_s = self._clock(), self._frame_s
        behind_s = start_s - self.due_s
        if frame_s is not None:
            if self._in_place(frame_s):
                behind_s = start_s - frame_s
            # Relative to the nearest deadline: the frame may have arrived just after a tick that did not wait for it.
            error_s = math.remainder(frame_s - self.due_s, self._period_s)
            if -EARLY_S <= error_s <= LATE_S:
                self._in_place_s = frame_s
            self.due_s += max(-_SLEW_S, min(_SLEW_S, _GAIN * error_s))
            self._frame_s = None
        self.due_s += self._period_s
        return TickTime(start_s, max(0.0, behind_s))

    def _in_place(self, frame_s: float) -> bool:
        return -EARLY_S <= frame_s - self.due_s <= LATE_S

    def _skip(self) -> None:
        late_periods = int((self._clock() - self.due_s) / self._period_s)
        if late_periods > 0:
            self.skipped += late_periods
            self.due_s += late_periods * self._period_s

    async def _frame_or_deadline(self) -> None:
        now_s = self._clock()
        waits = self.due_s - self._in_place_s < _PATIENCE * self._period_s
        deadline_s = self.due_s + LATE_S if waits else self.due_s
        loop = asyncio.get_running_loop()
        waiter = self._waiter = loop.create_future()
        timer = loop.call_later(max(0.0, deadline_s - now_s), _wake, waiter)
        try:
            await waiter
        finally:
            timer.cancel()
            self._waiter = None


class SimulatedTicker:
    """Times the ticks in simulated time, at multiples of their period. The world lets time stand while a tick works.

    If each of the last `_SLOW_TICKS` took more than a period of processor time, as on no vehicle that may fly, a tick is late by what
    the fastest of them took. A single slow tick says nothing: the time in which a virtual machine stands still is counted as well.
    """

    def __init__(self, period_s: float, clock: Clock) -> None:
        self._period_s = period_s
        self._clock = clock
        self.due_s = period_s * math.floor(clock() / period_s)
        self._begun_cpu_s = 0.0
        self._took_s = deque([0.0], maxlen=_SLOW_TICKS)
        self.skipped = 0

    async def next(self) -> TickTime:
        """Wait until the next tick is due."""
        self.due_s += self._period_s
        late_periods = int((self._clock() - self.due_s) / self._period_s)
        if late_periods > 0:
            self.skipped += late_periods
            self.due_s += late_periods * self._period_s
        due_s = self.due_s
        await asyncio.sleep(max(0.0, due_s - self._clock()))
        start_s = self._clock()
        self._begun_cpu_s = time.thread_time()
        return TickTime(start_s, max(0.0, start_s - due_s - STEP_S))

    async def computed(self) -> None:
        """Let the processor time of slow ticks pass; called between a tick's computation and its outputs."""
        self._took_s.append(time.thread_time() - self._begun_cpu_s)
        took_s = min(self._took_s)
        if took_s > self._period_s:
            await asyncio.sleep(took_s)


def _wake(waiter: asyncio.Future[None]) -> None:
    if not waiter.done():
        waiter.set_result(None)
