"""The flight clock: seconds since the flight process started, or since the flight began in simulated time. The drivers and the flight
process read it; the core never does.
"""

from __future__ import annotations

import time
from collections.abc import Callable

from companion.runtime import simulated_time

Clock = Callable[[], float]


def monotonic() -> float:
    """Return the time that this process lives in, s: `time.monotonic`, or simulated time."""
    simulated = simulated_time.current()
    return time.monotonic() if simulated is None else simulated.now()


def clock_origin_s() -> float:
    """Return the reading of `monotonic` at which the flight clock is zero: now, or zero in simulated time."""
    return time.monotonic() if simulated_time.current() is None else 0.0


def flight_clock(origin_s: float | None = None) -> Clock:
    """Return a clock that counts seconds since `origin_s` of `monotonic` (default: `clock_origin_s`)."""
    simulated = simulated_time.current()
    if simulated is not None:
        return simulated.now
    start_s = time.monotonic() if origin_s is None else origin_s

    def now_s() -> float:
        return time.monotonic() - start_s

    return now_s
