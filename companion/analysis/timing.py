"""Timing of every tick of a flight. It is small enough to be kept for every tick even if the log is otherwise thinned."""

from __future__ import annotations

from array import array
from collections.abc import Iterable
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from companion.model.types import Inputs, Outputs, Sent

Array = npt.NDArray[np.float64]


@dataclass(frozen=True)
class Timing:
    """Timing of consecutive recorded ticks; durations in s."""

    ticks: int
    first_tick: int
    last_tick: int
    span_s: float
    """Time from the start of the first tick to the start of the last."""
    period_s: float
    """Nominal period of the loop: the median interval between ticks; NaN for fewer than two ticks."""
    lateness_s: Array
    """Delay of the tick's start after its deadline."""
    joint_read_to_write_s: Array
    """Time from the last servo's answer until the currents are written, both measured in the bus thread, for ticks that wrote
    currents.
    """
    mocap_to_setpoint_s: Array
    """Time from the arrival of the mocap datagram until the setpoint is sent, for ticks with a new frame that sent a setpoint."""
    wait_for_joints_s: Array
    """Time from the tick's start to the joint state's arrival."""
    core_s: Array
    """Time from the joint state's arrival to the end of the core's step."""
    send_s: Array
    """Time from the end of the core's step until the setpoint is sent and the bus thread has the currents."""
    whole_s: Array
    """Time from the tick's start until the setpoint is sent and the bus thread has the currents."""
    bus_read_s: Array
    """Time from the start of the joint read to the last servo's answer, both measured in the bus thread, for ticks with a new
    joint state.
    """
    bus_cycle_s: Array
    """Time from the start of the joint read until the resulting currents are written, both measured in the bus thread, for the
    same ticks as `joint_read_to_write_s`.
    """


class Stopwatch:
    """Collects the timing of ticks; needs 80 bytes of memory per tick."""

    def __init__(self) -> None:
        self._t_s, self._lateness_s = array("d"), array("d")
        self._joint_s, self._mocap_s = array("d"), array("d")
        self._wait_s, self._core_s, self._send_s, self._whole_s = array("d"), array("d"), array("d"), array("d")
        self._read_s, self._cycle_s = array("d"), array("d")
        self._first: tuple[int, float] | None = None
        self._before: tuple[Inputs, Sent] | None = None
        self._frame_s: float | None = None

    def take(self, inputs: Inputs, sent: Sent) -> None:
        """Add the next tick."""
        self._t_s.append(inputs.t_s)
        self._lateness_s.append(sent.lateness_s)
        self._wait_s.append(sent.joint_read_s - sent.start_s)
        self._core_s.append(sent.core_s - sent.joint_read_s)
        self._send_s.append(end_s(sent) - sent.core_s)
        self._whole_s.append(end_s(sent) - sent.start_s)
        if self._first is None:
            self._first = (inputs.tick, sent.start_s)
        arm, before = inputs.arm, self._before[0].arm if self._before is not None else None
        if arm is not None and arm.asked_s is not None and (before is None or before.stamp_s != arm.stamp_s):
            self._read_s.append(arm.stamp_s - arm.asked_s)
        if self._before is not None:
            self._joint(*self._before, inputs)
        self._before = (inputs, sent)
        mocap = inputs.mocap
        if mocap is not None and mocap.stamp_s != self._frame_s:
            # The first frame seen may have waited for the loop to begin.
            if self._frame_s is not None and sent.attitude_sent:
                self._mocap_s.append(sent.setpoint_sent_s - mocap.stamp_s)
            self._frame_s = mocap.stamp_s

    def _joint(self, tick: Inputs, sent: Sent, after: Inputs) -> None:
        """Add the times of the joint read and write. The write is reported with the next tick's joint state."""
        if sent.arm_torque_sent_nm is None or tick.arm is None or after.arm is None or after.arm.written_s is None:
            return
        if after.arm.written_s >= sent.core_s and after.arm.stamp_s > tick.arm.stamp_s:
            self._joint_s.append(after.arm.written_s - tick.arm.stamp_s)
            if tick.arm.asked_s is not None:
                self._cycle_s.append(after.arm.written_s - tick.arm.asked_s)

    def read(self) -> Timing:
        """Return the timing of the ticks added so far."""
        first_tick, first_s = self._first or (0, 0.0)
        last, sent = self._before or (None, None)
        t_s = np.array(self._t_s)
        return Timing(
            ticks=len(t_s),
            first_tick=first_tick,
            last_tick=last.tick if last is not None else -1,
            span_s=sent.start_s - first_s if sent is not None else 0.0,
            period_s=float(np.median(np.diff(t_s))) if len(t_s) > 1 else np.nan,
            lateness_s=np.array(self._lateness_s),
            joint_read_to_write_s=np.array(self._joint_s),
            mocap_to_setpoint_s=np.array(self._mocap_s),
            wait_for_joints_s=np.array(self._wait_s),
            core_s=np.array(self._core_s),
            send_s=np.array(self._send_s),
            whole_s=np.array(self._whole_s),
            bus_read_s=np.array(self._read_s),
            bus_cycle_s=np.array(self._cycle_s),
        )


def end_s(sent: Sent) -> float:
    """Return the time at which a tick had sent everything: setpoint to PX4 and currents to the bus thread, in either order."""
    return max(sent.setpoint_sent_s, sent.current_sent_s)


def timing_of(rows: Iterable[tuple[Inputs, Outputs, Sent]]) -> Timing:
    """Return the timing of ticks in order."""
    stopwatch = Stopwatch()
    for inputs, _, sent in rows:
        stopwatch.take(inputs, sent)
    return stopwatch.read()
