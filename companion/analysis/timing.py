"""Timing of every tick of a flight. It is small enough to be kept for every tick even if the log is otherwise thinned."""

from __future__ import annotations

from array import array
from collections.abc import Iterable
from dataclasses import dataclass, fields

import numpy as np
import numpy.typing as npt

from companion.model.outputs import Outputs, Sent
from companion.model.tick_times import TickTimes
from companion.model.types import Inputs

Array = npt.NDArray[np.float64]


@dataclass(frozen=True)
class Timing:
    """Timing of consecutive recorded ticks; durations in s."""

    ticks: int
    first_tick: int
    last_tick: int
    span_s: float
    """Time from the start of the first tick to the start of the last."""
    lateness_s: Array
    """Delay of the tick's start after its deadline."""
    joint_read_to_write_s: Array
    """Time from the last servo's answer until the currents are written, by the bus thread's clock, for ticks that wrote currents."""
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
    """Time from the start of the joint read to the last servo's answer, by the bus thread's clock, for ticks with a new joint state."""
    bus_cycle_s: Array
    """Time from the start of the joint read until the currents are written, for the same ticks as `joint_read_to_write_s`."""


_LARGEST = 1e12
_KEPT = tuple(field.name for field in fields(Timing) if field.type == "Array")


class Stopwatch:
    """Collects the timing of ticks; needs 72 bytes of memory per tick."""

    def __init__(self) -> None:
        self._times = TickTimes()
        self._ticks = 0
        self._kept = {name: array("d") for name in _KEPT}
        self._first: tuple[int, float] | None = None
        self._last: tuple[int, float] | None = None

    def take(self, inputs: Inputs, sent: Sent) -> None:
        """Add the next tick."""
        self._ticks += 1
        self._last = (inputs.tick, sent.start_s)
        self._first = self._first or self._last
        for name, duration_s in self._times.take(inputs, sent).items():
            if name in self._kept:
                self._kept[name].append(duration_s)

    def read(self) -> Timing:
        """Return the timing of the ticks added so far."""
        (first_tick, first_s), (last_tick, last_s) = self._first or (0, 0.0), self._last or (-1, 0.0)
        durations = {name: plausible(np.array(kept)) for name, kept in self._kept.items()}
        return Timing(self._ticks, first_tick, last_tick, last_s - first_s, **durations)


def plausible(values: Array) -> Array:
    """Return the array after NaN has replaced infinity and numbers so large that no quantity of a flight has them."""
    values[np.abs(values) > _LARGEST] = np.nan
    return values


def timing_of(rows: Iterable[tuple[Inputs, Outputs, Sent]]) -> Timing:
    """Return the timing of ticks in order."""
    stopwatch = Stopwatch()
    for inputs, _, sent in rows:
        stopwatch.take(inputs, sent)
    return stopwatch.read()
