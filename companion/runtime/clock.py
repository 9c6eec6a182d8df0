"""The flight clock: seconds since the flight process started, or since the flight began in simulated time. The drivers and the flight
process read it; the core never does.

It is CLOCK_MONOTONIC_RAW, whose rate nothing changes. `time.monotonic` also runs faster or slower while NTP corrects the computer's
time, by up to 0.5 ms per second, with chrony by more. The delays of motion capture and PX4 are measured against the clocks of the
other devices, so that a correction of 0.1 s would count as 0.08 s of delay (limits: 0.12 s and 0.035 s).
"""

from __future__ import annotations

import time
from collections.abc import Callable

from companion.runtime import simulated_time

Clock = Callable[[], float]


def monotonic() -> float:
    """Return the time that this process lives in, s: CLOCK_MONOTONIC_RAW, or simulated time."""
    simulated = simulated_time.current()
    return time.clock_gettime(time.CLOCK_MONOTONIC_RAW) if simulated is None else simulated.now()


def clock_origin_s() -> float:
    """Return the reading of `monotonic` at which the flight clock is zero: now, or zero in simulated time."""
    return monotonic() if simulated_time.current() is None else 0.0


def flight_clock(origin_s: float | None = None) -> Clock:
    """Return a clock that counts seconds since `origin_s` of `monotonic` (default: `clock_origin_s`)."""
    simulated = simulated_time.current()
    if simulated is not None:
        return simulated.now
    start_s = monotonic() if origin_s is None else origin_s
    read, raw = time.clock_gettime, time.CLOCK_MONOTONIC_RAW

    def now_s() -> float:
        return read(raw) - start_s

    return now_s
