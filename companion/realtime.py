"""What the flight process asks of the operating system, and absolute-deadline ticks."""

from __future__ import annotations

import asyncio
import contextlib
import gc
import os
import sys
from dataclasses import dataclass
from pathlib import Path

from companion.clock import Clock

GIL_SWITCH_S = 0.0005
"""The bus thread gets the interpreter this soon from a tick that computes on; Python's default is 5 ms, a whole period."""
FLIGHT_PRIORITY = 50
WORLD_PRIORITY = 40
"""Of the simulated world: below the flight that it must not disturb."""


def claim_realtime(priority: int) -> str:
    """Switch garbage collection off and ask for real-time scheduling of every thread of this process.

    Returns:
        One line that says what was got. Without the permission (rtprio) the flight goes on at normal priority.
    """
    gc.collect()
    gc.freeze()
    gc.disable()
    sys.setswitchinterval(GIL_SWITCH_S)
    try:
        # Every thread: the tick waits for the bus thread, and what MAVSDK's threads receive is what it flies on.
        for thread in Path("/proc/self/task").iterdir():
            with contextlib.suppress(ProcessLookupError):  # it has just ended
                os.sched_setscheduler(int(thread.name), os.SCHED_FIFO, os.sched_param(priority))
    except (OSError, AttributeError) as error:
        return f"normal priority ({error.__class__.__name__}: no permission for SCHED_FIFO); garbage collection off"
    return f"SCHED_FIFO {priority}; garbage collection off"


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
