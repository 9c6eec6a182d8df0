"""The flight clock in real time."""

from __future__ import annotations

import time

from companion.runtime.clock import clock_origin_s, flight_clock, monotonic


def raw_s() -> float:
    return time.clock_gettime(time.CLOCK_MONOTONIC_RAW)


def test_no_correction_of_the_computers_time_changes_the_rate_of_the_flight_clock() -> None:
    """CLOCK_MONOTONIC differs from CLOCK_MONOTONIC_RAW by the corrections since the computer was started."""
    clock = flight_clock(0.0)
    for read in (monotonic, clock_origin_s, clock):
        before_s = raw_s()
        assert before_s <= read() <= raw_s()
