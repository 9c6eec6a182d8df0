"""Constants of an exact zero-order hold for each step length."""

from __future__ import annotations

from collections.abc import Callable
from typing import TypeVar

_MOST = 64
"""Largest number of stored step lengths: a simulation has a few, a real clock a new one in every tick."""


Held = TypeVar("Held")


class HoldTable(dict[float, Held]):
    """Values that depend on the step length only, stored by its exact value.

    Args:
        compute: returns the values for a step length in seconds.
    """

    def __init__(self, compute: Callable[[float], Held]) -> None:
        super().__init__()
        self._compute = compute

    def __missing__(self, dt_s: float) -> Held:
        """Compute and store the values of a new step length."""
        if len(self) >= _MOST:
            self.clear()
        held = self[dt_s] = self._compute(dt_s)
        return held
