"""One identified quantity with its 95 % interval, and its presentation as text and as JSON."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Any

SIGMAS_95 = 1.96
"""Half the width of a 95 % interval, in standard errors."""


@dataclass(frozen=True, slots=True)
class Quantity:
    """A value that was found in a flight, or the reason why it was not."""

    key: str
    """Name for scripts; contains the unit, such as `thrust_lag_s`."""
    title: str
    unit: str
    digits: int
    """Decimal places in the text."""
    how: str = ""
    """How it was found, or what the flight lacked and which flight would show it; one line."""
    value: float | None = None
    """None if this flight does not show the quantity."""
    sigma: float = 0.0
    """Standard error, which combines the error of the fit (with correlated residuals) and that of the method's assumptions."""
    now: str = ""
    """What the vehicle file or the laboratory has now; empty if neither has such a key."""
    scale: float = 1.0
    """Factor from the value to the unit of the text."""

    @property
    def known(self) -> bool:
        """Whether the flight shows this quantity."""
        return self.value is not None

    @property
    def interval(self) -> tuple[float, float]:
        """The 95 % interval; may be read only if the value is known."""
        assert self.value is not None, f"{self.key} is not known"
        half = SIGMAS_95 * self.sigma
        return self.value - half, self.value + half

    def contains(self, value: float) -> bool:
        """Return whether the 95 % interval contains this value."""
        low, high = self.interval
        return low <= value <= high

    def line(self) -> str:
        """Return the quantity as a line of the table."""
        if self.value is None:
            return f"{self.title:<36} not excited in this flight: {self.how}"
        low, high = self.interval
        k, n = self.scale, self.digits
        shown = f"{k * self.value:.{n}f} {self.unit}".rstrip()
        span = f"{k * low:.{n}f} to {k * high:.{n}f}"
        now = f"now {self.now}; " if self.now else ""
        return f"{self.title:<36} {shown:<14} {span:<18} {now}{self.how}"

    def as_json(self) -> dict[str, Any]:
        """Return the quantity as part of the JSON document; the value is in the unit that the key names."""
        low, high = self.interval if self.known else (None, None)
        return {
            "key": self.key,
            "title": self.title,
            "value": self.value,
            "low_95": low,
            "high_95": high,
            "now": self.now or None,
            "how": self.how,
        }


def combined(*sigmas: float) -> float:
    """Return the standard error of a sum of independent errors."""
    return math.hypot(*sigmas)
