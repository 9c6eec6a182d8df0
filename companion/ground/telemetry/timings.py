"""Longest durations of the loop and the links since the previous stream message. Pure."""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import Any

from companion.ground.protocol.messages import Timing
from companion.model.outputs import Sent
from companion.model.tick_times import TickTimes
from companion.model.types import Inputs


class WorstTimings:
    """Collects the longest durations of the ticks between two messages."""

    def __init__(self) -> None:
        self._times = TickTimes()
        self._worst_s: dict[str, float] = {}

    def add_tick(self, inputs: Inputs, sent: Sent) -> None:
        """Include the next tick."""
        for name, duration_s in self._times.take(inputs, sent).items():
            if duration_s > self._worst_s.get(name, -math.inf):
                self._worst_s[name] = duration_s

    def message(self, missed: int, dropped: int) -> Timing:
        """Return the durations since the last call as a message."""
        worst_s, self._worst_s = self._worst_s, {}

        def ms(name: str) -> float | None:
            duration_ms = 1e3 * worst_s.get(name, math.nan)
            return round(duration_ms, 3) if math.isfinite(duration_ms) else None

        return Timing(
            lateness_ms=ms("lateness_s") or 0.0,
            mocap_age_ms=ms("mocap_age_s"),
            mocap_to_setpoint_ms=ms("mocap_to_setpoint_s"),
            joint_read_to_write_ms=ms("joint_read_to_write_s"),
            core_ms=ms("core_s") or 0.0,
            missed=missed,
            dropped=dropped,
            whole_ms=ms("whole_s"),
            bus_read_ms=ms("bus_read_s"),
        )


def merge_timings(timings: Sequence[Timing]) -> Timing:
    """Return the worst timings of consecutive messages."""
    columns = {name: [getattr(timing, name) for timing in timings] for name in Timing.__struct_fields__}
    worst: dict[str, Any] = {
        name: max((value for value in values if value is not None), default=None) for name, values in columns.items()
    }
    return Timing(**worst)
