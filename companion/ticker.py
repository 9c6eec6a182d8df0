"""Absolute-deadline ticks of the control loop."""

from __future__ import annotations

import asyncio
from dataclasses import dataclass

from companion.clock import Clock


@dataclass(frozen=True, slots=True)
class TickTime:
    """When a tick began."""

    start_s: float
    lateness_s: float
    """Behind its deadline."""


class Ticker:
    """Absolute deadlines: an error of one tick does not move the next. Deadlines that are past are skipped, not made up for."""

    def __init__(self, period_s: float, clock: Clock) -> None:
        self._period_s = period_s
        self._clock = clock
        self._deadline_s = clock() + period_s
        self.skipped = 0

    async def next(self) -> TickTime:
        """Wait for the next deadline."""
        now_s = self._clock()
        late_periods = int((now_s - self._deadline_s) / self._period_s)
        if late_periods > 0:
            self.skipped += late_periods
            self._deadline_s += late_periods * self._period_s
        # Even when late: the loop must serve its sockets once a tick.
        await asyncio.sleep(max(0.0, self._deadline_s - now_s))
        start_s = self._clock()
        tick = TickTime(start_s, max(0.0, start_s - self._deadline_s))
        self._deadline_s += self._period_s
        return tick
