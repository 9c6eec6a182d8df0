"""A ground station's estimate of a vehicle's flight clock, used to date commands. Pure."""

from __future__ import annotations

from collections import deque


class FlightClock:
    """Estimates the flight clock of one session on a ground station. A new session needs a new instance. A message carries the
    flight clock at which it was sent, so the estimate is late, never early. Of the recent messages, the one with the largest
    difference from the local clock had the shortest delay and sets the estimate.
    """

    WINDOW_S = 10.0

    def __init__(self) -> None:
        self._samples: deque[tuple[float, float]] = deque()
        """(local time, flight clock - local clock): increasing in time, decreasing in difference."""

    def add(self, t_s: float, monotonic_s: float) -> None:
        """Add the time of one message.

        Args:
            t_s: `Stream.t_s`.
            monotonic_s: local monotonic clock at receipt, s.
        """
        difference_s = t_s - monotonic_s
        samples = self._samples
        while samples and samples[-1][1] <= difference_s:
            samples.pop()
        samples.append((monotonic_s, difference_s))
        while samples[0][0] < monotonic_s - self.WINDOW_S:
            samples.popleft()

    def now_ms(self, monotonic_s: float) -> int | None:
        """Return the current flight clock, ms; None before the first message. The clock continues while the vehicle is silent."""
        return None if not self._samples else int((monotonic_s + self._samples[0][1]) * 1000.0)
