"""Estimate of a vehicle's flight clock from what the vehicle has sent, to date commands and to judge their age. Pure."""

from __future__ import annotations

from collections import deque


class FlightClock:
    """Estimates the flight clock of one session. A new session needs a new instance. A message carries the flight clock at which it was
    sent, so the estimate is late, never early. Of the recent messages, the one with the largest difference from the local clock had the
    shortest delay and sets the estimate.

    Simulated time has any pace and may stand still, so the local clock says nothing about it: then the newest message is the estimate.
    """

    WINDOW_S = 10.0

    def __init__(self) -> None:
        self._samples: deque[tuple[float, float]] = deque()
        """(local time, flight clock - local clock): increasing in time, decreasing in difference."""
        self._newest_s = float("-inf")
        """Largest flight clock of all messages."""

    def add(self, t_s: float, monotonic_s: float) -> None:
        """Add the time of one message.

        Args:
            monotonic_s: local monotonic clock at receipt, s.
        """
        self._newest_s = max(self._newest_s, t_s)
        difference_s = t_s - monotonic_s
        samples = self._samples
        while samples and samples[-1][1] <= difference_s:
            samples.pop()
        samples.append((monotonic_s, difference_s))
        while samples[0][0] < monotonic_s - self.WINDOW_S:
            samples.popleft()

    def now_s(self, monotonic_s: float, simulated: bool = False) -> float | None:
        """Return the flight clock, s, None before the first message; it goes on in silence, unless the vehicle is simulated."""
        if not self._samples:
            return None
        return self._newest_s if simulated else monotonic_s + self._samples[0][1]

    def now_ms(self, monotonic_s: float, simulated: bool = False) -> int | None:
        """Return the current flight clock, ms, as `now_s` does."""
        now_s = self.now_s(monotonic_s, simulated)
        return None if now_s is None else int(now_s * 1000.0)
