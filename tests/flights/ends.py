"""When a flight of the fast loop may end, because what is judged has happened, and a flight with changed inputs."""

from __future__ import annotations

import math
from collections.abc import Callable

from companion.model.outputs import Outputs
from companion.model.types import Inputs
from companion.sitl_config.loader import SitlConfig
from sitl.fast.loop import FastFlight
from sitl.fast.result import FastResult


class Changed(FastFlight):
    """A flight whose core receives changed inputs."""

    def __init__(self, config: SitlConfig, change: Callable[[Inputs], Inputs]) -> None:
        super().__init__(config)
        self._change = change

    def _inputs(self, tick: int) -> Inputs:
        return self._change(super()._inputs(tick))


def flown_until(flight: FastFlight, until: Callable[[Outputs], bool]) -> FastResult:
    """Fly until `until` returns True; PX4 does not finish a landing then, as it does after `FastFlight.run` with faults."""
    result = FastResult()
    for outputs in flight.ticks(result):
        if until(outputs):
            break
    result.crashed, result.caught = flight.plant.machine.crashed, flight.plant.scene.payload.caught_t_s is not None
    return result


def after(event_id: str, seconds: float = 0.0) -> Callable[[Outputs], bool]:
    """The flight ends this long after the first event with this id."""
    end_s = math.inf

    def ended(o: Outputs) -> bool:
        nonlocal end_s
        if any(event.id == event_id for event in o.events):
            end_s = min(end_s, o.t_s + seconds)
        return o.t_s >= end_s

    return ended


def contact_over() -> Callable[[Outputs], bool]:
    """The flight ends with its contact phases."""
    begun = False

    def ended(o: Outputs) -> bool:
        nonlocal begun
        begun = begun or o.contact is not None
        return begun and o.contact is None

    return ended
