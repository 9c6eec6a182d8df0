"""The safety ladder: a pure, latched state machine.

NOMINAL -> WARN -> HOLD -> RETRACT -> LAND -> AUTOPILOT_LAND -> TERMINATE. An event carries the action that it requests; the ladder
adopts the most severe one. By itself it only escalates: a HOLD or RETRACT that exceeds its time limit becomes a LAND. Only the operator
de-escalates: `operator_resume` ends a HOLD and no other state, and only if no active rule requires a HOLD or more.
"""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass

from companion.config.safety import Safety
from companion.model.types import Event, SafetyAction
from companion.safety.notices import HOLD_EXPIRED, RETRACT_EXPIRED
from companion.safety.rules import OPERATOR_RESUME


@dataclass(frozen=True, slots=True)
class EscalationTimeouts:
    """Maximum durations of a HOLD and of a RETRACT, s."""

    hold_max_s: float
    retract_max_s: float

    @classmethod
    def of(cls, safety: Safety) -> EscalationTimeouts:
        """Return the times of the vehicle file."""
        return cls(safety.hold_max_s, safety.retract_max_s)


@dataclass(frozen=True, slots=True)
class SupervisorState:
    """State of the safety ladder."""

    action: SafetyAction = SafetyAction.NOMINAL
    cause: str | None = None
    """Id of the event that requested the action."""
    since_s: float = 0.0


def update(
    state: SupervisorState, events: Iterable[Event], t_s: float, times: EscalationTimeouts, standing: str | None = None
) -> SupervisorState:
    """Return the ladder's state after the events of a tick; the same object if nothing changes.

    Args:
        state: state before the tick.
        events: events of this tick.
        t_s: flight clock.
        times: maximum durations of a HOLD and of a RETRACT.
        standing: message of the active rule that requires a HOLD or more; the operator may end a HOLD only if it is None.
    """
    held = state.action is SafetyAction.HOLD  # a RESUME does not end a HOLD that begins in the same tick
    for event in events:
        if event.action.rank > state.action.rank:
            state = SupervisorState(event.action, event.id, event.t_s)
        elif event.id == OPERATOR_RESUME and held and state.action is SafetyAction.HOLD and standing is None:
            state = SupervisorState(SafetyAction.NOMINAL, event.id, event.t_s)
    if state.action is SafetyAction.HOLD and t_s - state.since_s > times.hold_max_s:
        return SupervisorState(SafetyAction.LAND, HOLD_EXPIRED.id, t_s)
    if state.action is SafetyAction.RETRACT and t_s - state.since_s > times.retract_max_s:
        return SupervisorState(SafetyAction.LAND, RETRACT_EXPIRED.id, t_s)
    return state
