"""Durations as percentiles."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass

RATE_HZ = 200.0
"""Rate of every measured loop."""
WARM_UP = 100
"""Cycles at the start of each bare loop that are not counted."""
DEADLINE_S = 30.0
"""Deadline for everything that a bare loop waits for."""


@dataclass(frozen=True, slots=True)
class Latency:
    """Percentiles in ms."""

    p50: float
    p99: float
    max: float
    samples: int | None = None
    p999: float | None = None

    @classmethod
    def of(cls, seconds: Iterable[float]) -> Latency:
        """Return the percentiles of samples in s.

        Raises:
            ValueError: there are no samples.
        """
        ordered = sorted(seconds)
        if not ordered:
            raise ValueError("no samples: no answer arrived over the wire")
        last = len(ordered) - 1
        p50, p99, p999, worst = (float(1e3 * ordered[round(part * last)]) for part in (0.5, 0.99, 0.999, 1.0))
        return cls(p50=p50, p99=p99, max=worst, samples=len(ordered), p999=p999)
