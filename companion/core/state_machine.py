"""The flight's state machine, a pure transition function. Time is part of the inputs.

A transition updates the supervisor with the tick's events and reacts to its action (`companion.core.reactions`); then it advances the
sequence of stages (`companion.core.sequence`, `companion.model.flight_stage`).
"""

from __future__ import annotations

from companion.core.flight_state import FlightState, Request
from companion.core.let_go import let_go_if_better
from companion.core.reactions import supervise
from companion.core.sequence import advance
from companion.core.transition import Parameters, Transition
from companion.mission.air import Observation
from companion.model.types import Event
from companion.safety.rules import OPERATOR_START


def transition(
    parameters: Parameters, state: FlightState, events: tuple[Event, ...], observation: Observation
) -> tuple[FlightState, Request]:
    """Return the state after a tick, and its requests.

    Args:
        parameters: constants of the flight.
        state: state after the previous tick; `Parameters.initial_state` in the first tick.
        events: events of the monitors in this tick.
        observation: other inputs of this tick.
    """
    t = Transition(parameters, state, events, observation)
    if state.entered_s is None:
        t.change(entered_s=observation.inputs.t_s)
    if observation.armed_by_others and not state.armed_by_others:
        t.change(armed_by_others=True)
    if events:
        t.start_asked = any(event.id == OPERATOR_START for event in events)
    supervise(t)
    request = advance(t)
    if t.state.bar is not None:
        let_go_if_better(t)
    return t.state, Request(request, tuple(t.events), tuple(t.tare), t.resumed)
