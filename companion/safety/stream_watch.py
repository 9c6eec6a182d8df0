"""Is motion capture one stream? Two servers at one address, one of them forged, number their frames in two sequences. Pure."""

from __future__ import annotations

from collections import deque

STEPS_BACK_MAX = 2
"""A server that is restarted starts its numbers anew: one step back, and perhaps another with a second restart."""
WINDOW_S = 1.0
_HALF = 0x80000000


class StreamWatch:
    """Counts frames whose number does not follow the one before (uint32, so it wraps)."""

    def __init__(self) -> None:
        self._number: int | None = None
        self._back_s: deque[float] = deque(maxlen=STEPS_BACK_MAX + 1)

    def update(self, number: int, t_s: float) -> bool:
        """Take a new frame; True: more than STEPS_BACK_MAX steps back within WINDOW_S, so there are two streams."""
        before, self._number = self._number, number
        if before is not None and not 0 < (number - before) & 0xFFFFFFFF < _HALF:
            self._back_s.append(t_s)
        return self.two(t_s)

    def two(self, t_s: float) -> bool:
        """Two streams were seen within the last WINDOW_S."""
        return len(self._back_s) > STEPS_BACK_MAX and t_s - self._back_s[0] <= WINDOW_S
