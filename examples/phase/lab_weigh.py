"""A phase in a package of its own: hover, and report the mass of what is in the net."""

from collections.abc import Iterator
from typing import Any, ClassVar, Literal

from msgspec.structs import replace

from companion.api.phases import (
    GRAVITY_M_S2,
    Air,
    Checking,
    Duration,
    EventDefinition,
    Phase,
    Planning,
    Record,
    SafetyAction,
    Severity,
)

WEIGHED = EventDefinition(
    "weighed", Severity.INFO, SafetyAction.NOMINAL, "the phase `weigh` has ended; the text gives the mass"
)


class Weighing(Record, frozen=True):
    """The state in the air."""

    since_s: float
    samples: int
    mean_n: float
    """Mean force downwards on the tool."""


class Weigh(Phase):
    """Hover, and report the mass of what is in the net."""

    acts: ClassVar[bool] = True

    type: Literal["weigh"]
    duration_s: Duration

    def plan(self, p: Planning) -> None:
        """Append the time."""
        p.builder.t_s += self.duration_s

    def problems(self, c: Checking) -> Iterator[str]:
        """Check that there is a force sensor."""
        if c.vehicle.devices.force is None:
            yield f"weighs, but vehicle '{c.vehicle.name}' has no force sensor; add devices.force to the vehicle file"

    def begin(self, air: Air) -> Weighing:
        """Return the state at the start."""
        return Weighing(air.t_s, 0, 0.0)

    def step(self, air: Air, own: Any) -> Weighing | None:
        """Return the state after one tick; None when the time is over."""
        air.stay(air.engaged)
        state: Weighing = own
        if air.o.force_world_n is not None:
            count, down_n = state.samples + 1, -air.o.force_world_n[2]
            state = replace(state, samples=count, mean_n=state.mean_n + (down_n - state.mean_n) / count)
        if air.t_s - state.since_s < self.duration_s:
            return state
        air.report(WEIGHED, f"the payload weighs {state.mean_n / GRAVITY_M_S2:.2f} kg")
        return None
