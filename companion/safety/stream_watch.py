"""Detects a second, perhaps forged, motion-capture server at the same address by its separate sequence of frame numbers. Pure."""

from __future__ import annotations

from collections import deque
from typing import Final

STEPS_BACK_MAX: Final = 2
"""A server that restarts begins its numbers again: one step back, and another one at a second restart."""
WINDOW_S: Final = 1.0
REORDERED_MAX: Final = 8
"""A network may deliver a frame up to this many numbers behind the newest one."""
_MASK: Final = 0xFFFFFFFF
_HALF: Final = 0x80000000


class StreamWatch:
    """Counts frames whose number (uint32, so it wraps) steps back.

    A frame that the network reordered or duplicated does not count as a step back: it is at most REORDERED_MAX behind the newest one,
    and its number was skipped before or was received with the same content. A second stream with numbers close to those of the first
    repeats them with different content.
    """

    def __init__(self) -> None:
        self._newest: int | None = None
        self._recent: dict[int, object] = {}
        """Content by number, of the frames up to REORDERED_MAX behind the newest one."""
        self._back_s: deque[float] = deque(maxlen=STEPS_BACK_MAX + 1)

    def update(self, number: int, content: object, t_s: float) -> bool:
        """Process a frame.

        Args:
            number: frame number.
            content: pose of the body in the frame; compared with that of another frame with the same number.
            t_s: arrival time.

        Returns:
            True if more than STEPS_BACK_MAX steps back within WINDOW_S show that there are two streams.
        """
        behind = _HALF if self._newest is None else (self._newest - number) & _MASK
        if behind > REORDERED_MAX:
            if behind < _HALF:
                self._back_s.append(t_s)
            self._newest = number
            if behind == _MASK:  # the next number: only the oldest frame leaves
                self._recent.pop((number - REORDERED_MAX - 1) & _MASK, None)
            else:
                self._recent = {n: c for n, c in self._recent.items() if (number - n) & _MASK <= REORDERED_MAX}
            self._recent[number] = content
        elif self._recent.setdefault(number, content) != content:
            self._back_s.append(t_s)
        return self.two(t_s)

    def two(self, t_s: float) -> bool:
        """Return whether two streams were seen within the last WINDOW_S."""
        return len(self._back_s) > STEPS_BACK_MAX and t_s - self._back_s[0] <= WINDOW_S
