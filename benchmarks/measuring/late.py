"""Separates ticks that were late alone from ticks that were late together with an empty loop."""

from __future__ import annotations

from bisect import bisect_left
from collections.abc import Sequence

WITHIN_S = 0.1
"""A stall of the whole computer delays both loops within this time of each other."""


def alone_late(late_s: Sequence[float], beside_late_s: Sequence[float], within_s: float = WITHIN_S) -> list[float]:
    """Return the times of late ticks without a late tick of the loop beside.

    Args:
        late_s: start times of late ticks.
        beside_late_s: start times of late ticks of the loop beside, on the same clock, in order.
        within_s: largest time between two ticks that count as late together.
    """
    found = []
    for time_s in late_s:
        next_one = bisect_left(beside_late_s, time_s - within_s)
        if next_one == len(beside_late_s) or beside_late_s[next_one] > time_s + within_s:
            found.append(time_s)
    return found
