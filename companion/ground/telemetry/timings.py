"""Longest durations of the loop and the links since the previous stream message. Pure."""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import Any

from companion.ground.protocol.messages import Timing
from companion.ground.telemetry.health import UNKNOWN_S
from companion.model.types import Inputs, Outputs, Sent


class WorstTimings:
    """The longest durations in a group of ticks, s."""

    def __init__(self) -> None:
        self._lateness_s = self._core_s = 0.0
        self._mocap_s = self._setpoint_s = self._joint_s = self._whole_s = self._read_s = UNKNOWN_S

    def add_tick(self, before: tuple[Inputs, Outputs, Sent] | None, i: Inputs, sent: Sent, fresh: bool) -> None:
        """Include one tick; durations as in `companion.analysis.timing.Stopwatch`."""
        self._lateness_s = max(self._lateness_s, sent.lateness_s)
        self._core_s = max(self._core_s, sent.core_s - sent.joint_read_s)
        if i.mocap is not None:
            self._mocap_s = max(self._mocap_s, i.t_s - i.mocap.stamp_s + (i.mocap.latency_s or 0.0))
            if fresh and before is not None and sent.attitude_sent:
                self._setpoint_s = max(self._setpoint_s, sent.setpoint_sent_s - i.mocap.stamp_s)
        self._whole_s = max(self._whole_s, max(sent.setpoint_sent_s, sent.current_sent_s) - sent.start_s)
        earlier, now = before[0].arm if before is not None else None, i.arm
        if now is not None and now.asked_s is not None and (earlier is None or earlier.stamp_s != now.stamp_s):
            self._read_s = max(self._read_s, now.stamp_s - now.asked_s)
        if before is None or before[2].arm_torque_sent_nm is None:
            return
        if earlier is None or now is None or now.written_s is None:
            return
        if now.written_s >= before[2].core_s and now.stamp_s > earlier.stamp_s:
            self._joint_s = max(self._joint_s, now.written_s - earlier.stamp_s)

    def message(self, missed: int, dropped: int) -> Timing:
        """Return the durations as a message."""
        return Timing(
            lateness_ms=_ms(self._lateness_s) or 0.0,
            mocap_age_ms=_ms(self._mocap_s),
            mocap_to_setpoint_ms=_ms(self._setpoint_s),
            joint_read_to_write_ms=_ms(self._joint_s),
            core_ms=_ms(self._core_s) or 0.0,
            missed=missed,
            dropped=dropped,
            whole_ms=_ms(self._whole_s),
            bus_read_ms=_ms(self._read_s),
        )


def merge_timings(timings: Sequence[Timing]) -> Timing:
    """Return the worst timings of consecutive messages."""
    columns = {name: [getattr(timing, name) for timing in timings] for name in Timing.__struct_fields__}
    worst: dict[str, Any] = {
        name: max((value for value in values if value is not None), default=None) for name, values in columns.items()
    }
    return Timing(**worst)


def _ms(duration_s: float) -> float | None:
    duration_ms = duration_s * 1e3
    return round(duration_ms, 3) if math.isfinite(duration_ms) else None
