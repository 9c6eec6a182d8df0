"""The flight clock: monotonic seconds since the flight process started. The drivers and the flight process read it; the core never
does.
"""

from __future__ import annotations

import time
from collections.abc import Callable

Clock = Callable[[], float]


def flight_clock(origin_s: float | None = None) -> Clock:
    """Return a clock that counts seconds since `origin_s` of `time.monotonic` (default: now)."""
    start_s = time.monotonic() if origin_s is None else origin_s

    def now_s() -> float:
        return time.monotonic() - start_s

    return now_s
