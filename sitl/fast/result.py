"""The record of a flight in the fast closed loop."""

from __future__ import annotations

import contextlib
import gc
from collections.abc import Iterator
from dataclasses import dataclass, field

from companion.model.outputs import Outputs
from companion.model.types import Event, Inputs
from sitl.world.state import Layout, Snapshot, Truth


@dataclass
class FastResult:
    """Record of one flight."""

    inputs: list[Inputs] = field(default_factory=list)
    outputs: list[Outputs] = field(default_factory=list)
    crashed: bool = False
    caught: bool = False
    miss_m: float | None = None
    """Distance of the first throw from the net's centre (`Payload.miss_m`); None if nothing was thrown."""
    snapshots: list[Snapshot] = field(default_factory=list)
    """States of the world, one after each tick."""
    layout: Layout | None = None
    after: list[Snapshot] = field(default_factory=list)
    """States of the world every 5 ms after the last tick, while the guardian or PX4 lands the vehicle."""
    guardian_events: list[Event] = field(default_factory=list)
    """Events of the guardian; empty if it did not act."""
    guardian_landed: bool | None = None
    """Whether the guardian landed the vehicle; None if it did not act or has not finished."""
    armed: bool = False
    """Whether the vehicle is still armed at the end."""
    _truth: list[Truth] | None = field(default=None, repr=False)  # mypyc sets no default with init=False

    @property
    def truth(self) -> list[Truth]:
        """True state after each tick; computed on first access."""
        if self._truth is None:
            layout = self.layout
            self._truth = [] if layout is None else [layout.truth(snapshot) for snapshot in self.snapshots]
        return self._truth


@contextlib.contextmanager
def garbage_collection_paused() -> Iterator[None]:
    """Pause garbage collection: a flight creates many records and no reference cycles, so collecting only costs time."""
    was_on = gc.isenabled()
    gc.disable()
    try:
        yield
    finally:
        if was_on:
            # Moves the records to the oldest generation, so that the next collection does not traverse all of them.
            gc.freeze()
            gc.unfreeze()
            gc.enable()
