"""The safety ladder: one pure update, latched.

NOMINAL -> WARN -> HOLD -> RETRACT -> LAND -> AUTOPILOT_LAND -> TERMINATE. An event carries the rung it asks for; the ladder goes to the
highest rung asked for and never back by itself.
"""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass

from companion.types import Event, SafetyAction


@dataclass(frozen=True, slots=True)
class SupervisorState:
    """Where the ladder stands."""

    action: SafetyAction = SafetyAction.NOMINAL
    cause: str | None = None
    """Id of the event that brought it there."""
    since_s: float = 0.0


def update(state: SupervisorState, events: Iterable[Event]) -> SupervisorState:
    """The ladder after these events."""
    for event in events:
        if event.action.rank > state.action.rank:
            state = SupervisorState(event.action, event.id, event.t_s)
    return state
