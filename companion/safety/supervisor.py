"""The safety ladder: one pure update, latched.

NOMINAL -> WARN -> HOLD -> RETRACT -> LAND -> AUTOPILOT_LAND -> TERMINATE. An event carries the rung it asks for; the ladder goes to the
highest rung asked for. Of itself it only goes on upwards: a HOLD that lasts too long becomes a LAND, and so does a RETRACT. The one way
down is people's: `operator_resume` ends a HOLD, and nothing else, and only if nothing stands that it must hold for.
"""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass

from companion.config.vehicle import Safety
from companion.model.types import Event, SafetyAction

RESUME = "operator_resume"
HOLD_EXPIRED, RETRACT_EXPIRED = "hold_expired", "retract_expired"
"""Causes of a LAND that no event asked for."""
RETRACT_DONE = "retract_done"
"""The event by which the core says that a RETRACT has arrived."""


@dataclass(frozen=True, slots=True)
class LadderTimes:
    """How long the rungs may last that are no end in themselves."""

    hold_max_s: float
    retract_max_s: float

    @classmethod
    def of(cls, safety: Safety) -> LadderTimes:
        """As the vehicle file says."""
        return cls(safety.hold_max_s, safety.retract_max_s)


@dataclass(frozen=True, slots=True)
class SupervisorState:
    """Where the ladder stands."""

    action: SafetyAction = SafetyAction.NOMINAL
    cause: str | None = None
    """Id of the event that brought it there."""
    since_s: float = 0.0


def update(
    state: SupervisorState, events: Iterable[Event], t_s: float, times: LadderTimes, standing: str | None = None
) -> SupervisorState:
    """The ladder after these events, at this time. The same object if nothing changes.

    Args:
        state: where it stands.
        events: of this tick.
        t_s: flight clock.
        times: how long rungs may last.
        standing: what the vehicle must hold for now, in words; None: nothing, and people may let it go on.
    """
    held = (
        state.action is SafetyAction.HOLD
    )  # nobody ends a hold that begins in this very tick: it was not there when they spoke
    for event in events:
        if event.action.rank > state.action.rank:
            state = SupervisorState(event.action, event.id, event.t_s)
        elif event.id == RESUME and held and state.action is SafetyAction.HOLD and standing is None:
            state = SupervisorState(SafetyAction.NOMINAL, event.id, event.t_s)
    if state.action is SafetyAction.HOLD and t_s - state.since_s > times.hold_max_s:
        return SupervisorState(SafetyAction.LAND, HOLD_EXPIRED, t_s)
    if state.action is SafetyAction.RETRACT and t_s - state.since_s > times.retract_max_s:
        return SupervisorState(SafetyAction.LAND, RETRACT_EXPIRED, t_s)
    return state
