"""Constants of an exact zero-order hold, by the length of the step."""

from __future__ import annotations

from collections.abc import Callable

_MOST = 64
"""Steps remembered: the clock of a simulation knows a handful, a real one as many as ticks."""


class HoldTable(dict[float, tuple[float, ...]]):
    """Numbers that depend on the length of a step alone, remembered by its exact value: what is found is what would be computed.

    Args:
        compute: the numbers of a step of so many seconds.
    """

    def __init__(self, compute: Callable[[float], tuple[float, ...]]) -> None:
        super().__init__()
        self._compute = compute

    def __missing__(self, dt_s: float) -> tuple[float, ...]:
        """Computed, and remembered."""
        if len(self) >= _MOST:
            self.clear()
        numbers = self[dt_s] = self._compute(dt_s)
        return numbers
