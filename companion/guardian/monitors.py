"""Detects a stalled flight process. Pure; time is an argument."""

from __future__ import annotations

AWAKE_STEP_MAX_S = 0.02
"""Maximum silence that one pass of the guardian's loop (10 ms) may add: time in which the guardian itself was not running proves
nothing.
"""


class StallWatch:
    """Measures the flight process's silence, counting only time in which the guardian itself was running.

    Args:
        timeout_s: silence after which the flight process counts as stalled.
    """

    def __init__(self, timeout_s: float) -> None:
        self._timeout_s = timeout_s
        self._last_s: float | None = None
        self.silent_s = 0.0

    def update(self, now_s: float, heard: bool) -> bool:
        """Update after one pass of the loop; return whether the flight process hangs."""
        step_s = 0.0 if self._last_s is None else min(now_s - self._last_s, AWAKE_STEP_MAX_S)
        self._last_s = now_s
        self.silent_s = 0.0 if heard else self.silent_s + step_s
        return self.silent_s > self._timeout_s
