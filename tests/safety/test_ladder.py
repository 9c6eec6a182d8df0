"""The ladder: every state x every event, its times, and that no way leads down but people's."""

from __future__ import annotations

import itertools

import pytest
from hypothesis import given
from hypothesis import strategies as st

from companion.model.types import Event, SafetyAction, Severity
from companion.safety.notices import HOLD_EXPIRED, RETRACT_EXPIRED
from companion.safety.rules import OPERATOR_RESUME as RESUME
from companion.safety.rules import RULES
from companion.safety.supervisor import EscalationTimeouts, SupervisorState, update

TIMES = EscalationTimeouts(hold_max_s=20.0, retract_max_s=12.0)
EVENTS = [(rule.id, rule.air) for rule in RULES if rule.air is not None]


def event(id_: str, asks: SafetyAction, t_s: float = 2.0) -> Event:
    return Event(t_s=t_s, id=id_, severity=Severity.CRITICAL, action=asks, text="")


@pytest.mark.parametrize("now", SafetyAction)
def test_every_state_and_every_event(now: SafetyAction) -> None:
    state = SupervisorState(now, "before", 1.0)
    for id_, asks in EVENTS:
        after = update(state, [event(id_, asks)], 2.0, TIMES)
        if asks.rank > now.rank:
            assert after == SupervisorState(asks, id_, 2.0)
        elif id_ == RESUME and now is SafetyAction.HOLD:
            assert after == SupervisorState(SafetyAction.NOMINAL, RESUME, 2.0)
        else:
            assert after is state, id_


@pytest.mark.parametrize(
    ("action", "t_s", "cause"),
    [
        (SafetyAction.HOLD, 20.9, None),
        (SafetyAction.HOLD, 21.1, HOLD_EXPIRED.id),
        (SafetyAction.RETRACT, 12.9, None),
        (SafetyAction.RETRACT, 13.1, RETRACT_EXPIRED.id),
        (SafetyAction.WARN, 1e6, None),
        (SafetyAction.LAND, 1e6, None),
        (SafetyAction.AUTOPILOT_LAND, 1e6, None),
    ],
)
def test_a_rung_that_is_no_end_in_itself_becomes_a_landing(action: SafetyAction, t_s: float, cause: str | None) -> None:
    state = SupervisorState(action, "before", 1.0)
    after = update(state, [], t_s, TIMES)
    assert after == (state if cause is None else SupervisorState(SafetyAction.LAND, cause, t_s))


def test_the_same_event_again_does_not_prolong_a_hold() -> None:
    state = update(SupervisorState(), [event("too_fast", SafetyAction.HOLD, 1.0)], 1.0, TIMES)
    for t_s in range(2, 22):
        state = update(state, [event("too_fast", SafetyAction.HOLD, float(t_s))], float(t_s), TIMES)
    assert state.cause == "too_fast"
    assert update(state, [], 21.1, TIMES).cause == HOLD_EXPIRED.id


def test_resume_in_the_tick_of_a_more_severe_action_changes_nothing() -> None:
    state = SupervisorState(SafetyAction.HOLD, "before", 1.0)
    for events in itertools.permutations([event(RESUME, SafetyAction.NOMINAL), event("arm_lost", SafetyAction.LAND)]):
        assert update(state, events, 2.0, TIMES).action is SafetyAction.LAND


def test_a_resume_does_not_end_a_hold_that_begins_in_the_same_tick() -> None:
    for events in itertools.permutations([event(RESUME, SafetyAction.NOMINAL), event("too_fast", SafetyAction.HOLD)]):
        assert update(SupervisorState(), events, 2.0, TIMES).action is SafetyAction.HOLD


@pytest.mark.parametrize("now", SafetyAction)
def test_resume_is_refused_while_a_finding_is_active(now: SafetyAction) -> None:
    state = SupervisorState(now, "before", 1.0)
    assert update(state, [event(RESUME, SafetyAction.NOMINAL)], 2.0, TIMES, "too little tether left") is state


any_event = st.sampled_from(EVENTS).map(lambda pair: event(*pair))


@given(st.lists(st.tuples(st.lists(any_event, max_size=4), st.floats(0.0, 40.0)), max_size=30))
def test_no_way_leads_down_from_a_landing(ticks: list[tuple[list[Event], float]]) -> None:
    state, t_s = SupervisorState(), 0.0
    for events, pause_s in ticks:
        before, t_s = state, t_s + pause_s
        state = update(before, events, t_s, TIMES)
        lower = state.action.rank < before.action.rank
        assert not (lower and before.action.rank > SafetyAction.HOLD.rank)
        if lower:
            assert RESUME in [e.id for e in events]
