"""The age of a frame on one clock: exposure is stamped by the server, arrival by this computer.

The server answers an echo request with its clock at the reception. That was after the request was sent, so the time at which it was
sent is the earliest flight clock that belongs to the server's stamp. With it the age of a frame is never understated, whatever delays
frames, requests or answers, and overstated by the shortest time that a request took.
"""

from __future__ import annotations

from collections import deque
from typing import Final

ECHOES: Final = 20
"""Number of newest answers that are used, of 10 s: clocks drift by less than 1 ms in that time."""
ECHO_AGE_MAX_S: Final = 10.0
"""Without an answer for this long the age is unknown."""
STEP_S: Final = 0.002
"""A frame that seems to be sent this much after its arrival shows that a clock has been set."""


class ServerClock:
    """Estimates the offset between the server's clock and the flight clock from the answers to echo requests."""

    def __init__(self) -> None:
        self._offsets_s: deque[float] = deque(maxlen=ECHOES)
        self._offset_s: float | None = None
        self._echo_s = 0.0

    def echo(self, sent_s: float, server_s: float) -> None:
        """Process an answer.

        Args:
            sent_s: flight clock at which the request was sent.
            server_s: the server's clock at which it received the request.
        """
        self._offsets_s.append(sent_s - server_s)
        self._offset_s, self._echo_s = max(self._offsets_s), sent_s

    def age_s(self, exposure_server_s: float, latency_s: float, arrived_s: float) -> float:
        """Return the time from a frame's exposure to its arrival; `latency_s`, up to the transmission, without a recent echo."""
        offset_s = self._offset_s
        if offset_s is None:
            return latency_s
        age_s = arrived_s - exposure_server_s - offset_s
        if age_s < latency_s - STEP_S or not 0.0 <= arrived_s - self._echo_s <= ECHO_AGE_MAX_S:
            self._offsets_s.clear()
            self._offset_s = None
            return latency_s
        return max(age_s, latency_s)
