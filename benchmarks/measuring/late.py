"""Ticks that were late beside a loop that does nothing: whose fault was it?"""

from __future__ import annotations

from bisect import bisect_left
from collections.abc import Sequence

WITHIN_S = 0.1
"""What holds up the computer as a whole makes both late within so much of each other."""


def alone_late(late_s: Sequence[float], beside_late_s: Sequence[float], within_s: float = WITHIN_S) -> list[float]:
    """Which ticks were late when nothing beside them was.

    Args:
        late_s: when late ticks began.
        beside_late_s: the same of the loop beside, by the same clock, in order.
        within_s: how far apart they may lie.
    """
    found = []
    for time_s in late_s:
        next_one = bisect_left(beside_late_s, time_s - within_s)
        if next_one == len(beside_late_s) or beside_late_s[next_one] > time_s + within_s:
            found.append(time_s)
    return found
