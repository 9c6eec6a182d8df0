"""What becomes of the operator's command of a tick, judged on the states before and after it, and the sentence for it. Pure."""

from __future__ import annotations

from collections.abc import Mapping
from typing import assert_never

from companion.core.flight_state import FlightState
from companion.model.flight_stage import ROTORS_MAY_START, Stage
from companion.model.types import Event, OperatorCommand, PhaseKind, SafetyAction
from companion.model.verdict import Answer, Verdict
from companion.safety.notices import NO_ROOM_TO_STAY, RESUME_REFUSED, START_DECLINED

_RISING = frozenset({Stage.OFFBOARD, Stage.ARM, Stage.SPOOL})
"""Stages between the start command and take-off."""
_DOWN = frozenset({OperatorCommand.LAND, OperatorCommand.ABORT})


_SENTENCES = {
    Answer.TAKING_OFF: "taking off",
    Answer.ALREADY_TAKING_OFF: "already taking off",
    Answer.WAITS_FOR_START: "the vehicle stays on the ground until start is commanded",
    Answer.CANCELLED: "not taking off: the start is cancelled",
    Answer.CANCELLED_WHILE_ARMING: f"not taking off: the start is cancelled; PX4 was asked to arm: {ROTORS_MAY_START}",
    Answer.SPOOLING_DOWN: "not taking off: the rotors are spooling down",
    Answer.HOLDING: "holding",
    Answer.ALREADY_HOLDING: "already holding",
    Answer.TOO_LOW_TO_HOLD: "too low to hold: landing",
    Answer.CONTINUING: "continuing",
    Answer.CONTINUING_TOGETHER: "continuing as soon as the other vehicle may continue, too",
    Answer.LANDING_CONTINUES: "the landing continues",
    Answer.LANDING: "landing",
    Answer.ABORTED: "aborted: landing and folding the arm",
    Answer.ALREADY_LANDING: "already landing",
    Answer.RECORDED: "recorded; PX4's own landing continues",
    Answer.ALREADY_DOWN: "already down",
    Answer.PILOT_FLIES: "a pilot has control; nothing is sent",
    Answer.FLIGHT_IS_OVER: "the flight is over",
    Answer.PX4_LANDS: "PX4 is landing on its own",
    Answer.RETURNS: "the vehicle is returning along the tether and will land",
    Answer.LANDS: "the vehicle is landing",
    Answer.ON_THE_GROUND: "on the ground",
    Answer.NOT_HOLDING: "not holding",
    Answer.START_CANCELLED: "the start has been cancelled",
    Answer.IN_THE_AIR: "already in the air",
}


def sentence_of(verdict: Verdict, command: OperatorCommand) -> str:
    """Return a verdict in words, for the operator."""
    text = verdict.reason or _SENTENCES[verdict.answer]
    return text if verdict.accepted else f"{command.value} refused: {text}"


def verdict_of(
    command: OperatorCommand, before: FlightState, after: FlightState, events: tuple[Event, ...], t_s: float
) -> Verdict:
    """Return the verdict on a command.

    Args:
        command: the command, not NONE.
        before: state before the tick.
        after: state after the tick.
        events: all events of the tick.
        t_s: flight clock.
    """
    kind = after.phase(t_s)[1]
    down = command in _DOWN
    if after.pilot_flies:
        return Verdict(accepted=False, answer=Answer.PILOT_FLIES)
    if kind is PhaseKind.DONE and before.phase(t_s)[1] is not PhaseKind.GROUND:
        return Verdict(accepted=down, answer=Answer.ALREADY_DOWN if down else Answer.FLIGHT_IS_OVER)
    if after.stage is Stage.AUTOPILOT_LAND:
        return Verdict(accepted=down, answer=Answer.RECORDED if down else Answer.PX4_LANDS)
    texts = {event.id: event.text for event in events}
    if command is OperatorCommand.RESUME:
        return _resume(before, after, kind, texts)
    if command is OperatorCommand.START:
        return _start(before, after, kind, texts)
    if kind is PhaseKind.DONE:
        cancelled = Answer.CANCELLED_WHILE_ARMING if before.stage is Stage.ARM else Answer.CANCELLED
        return Verdict(accepted=True, answer=cancelled)
    if command is OperatorCommand.HOLD and kind is PhaseKind.GROUND:
        return Verdict(accepted=True, answer=Answer.WAITS_FOR_START)
    if before.stage is Stage.SPOOL:
        return Verdict(accepted=True, answer=Answer.SPOOLING_DOWN)
    if command is OperatorCommand.HOLD:
        return _hold(before, after, kind, texts)
    if before.supervisor.action.rank >= SafetyAction.LAND.rank:
        return Verdict(accepted=True, answer=Answer.ALREADY_LANDING)
    if command is OperatorCommand.LAND:
        return Verdict(accepted=True, answer=Answer.LANDING)
    if command is OperatorCommand.ABORT:
        return Verdict(accepted=True, answer=Answer.ABORTED)
    if command is OperatorCommand.NONE:
        raise ValueError("no command has no verdict")
    assert_never(command)  # a new command needs an answer of its own


def _hold(before: FlightState, after: FlightState, kind: PhaseKind, texts: Mapping[str, str]) -> Verdict:
    action = after.supervisor.action
    if NO_ROOM_TO_STAY.id in texts:
        return Verdict(accepted=True, answer=Answer.TOO_LOW_TO_HOLD)
    if action.rank > SafetyAction.HOLD.rank or kind is PhaseKind.LANDING:
        return Verdict(accepted=False, answer=_instead(after, kind))
    held = before.supervisor.action is SafetyAction.HOLD
    return Verdict(accepted=True, answer=Answer.ALREADY_HOLDING if held else Answer.HOLDING)


def _resume(before: FlightState, after: FlightState, kind: PhaseKind, texts: Mapping[str, str]) -> Verdict:
    if (standing := texts.get(RESUME_REFUSED.id)) is not None:
        return Verdict(accepted=False, answer=Answer.RULE_HOLDS, reason=standing)
    held = before.supervisor.action is SafetyAction.HOLD
    if not held or after.supervisor.action.rank > SafetyAction.HOLD.rank:
        return Verdict(accepted=False, answer=_instead(after, kind))
    if kind is PhaseKind.LANDING:
        return Verdict(accepted=True, answer=Answer.LANDING_CONTINUES)
    waits = after.supervisor.action is SafetyAction.HOLD
    return Verdict(accepted=True, answer=Answer.CONTINUING_TOGETHER if waits else Answer.CONTINUING)


def _start(before: FlightState, after: FlightState, kind: PhaseKind, texts: Mapping[str, str]) -> Verdict:
    if (unready := texts.get(START_DECLINED.id)) is not None:
        return Verdict(accepted=False, answer=Answer.NOT_READY, reason=unready)
    if before.stage in _RISING and kind is PhaseKind.GROUND:
        return Verdict(accepted=True, answer=Answer.ALREADY_TAKING_OFF)
    if before.stage not in _RISING and after.stage in _RISING:
        return Verdict(accepted=True, answer=Answer.TAKING_OFF)
    over = kind is PhaseKind.DONE and before.stage not in _RISING
    return Verdict(accepted=False, answer=Answer.START_CANCELLED if over else Answer.IN_THE_AIR)


def _instead(after: FlightState, kind: PhaseKind) -> Answer:
    """Return what the vehicle does instead of holding."""
    if kind is PhaseKind.GROUND:
        return Answer.ON_THE_GROUND
    if after.supervisor.action is SafetyAction.RETRACT:
        return Answer.RETURNS
    lands = after.supervisor.action.rank > SafetyAction.HOLD.rank or kind is PhaseKind.LANDING
    return Answer.LANDS if lands else Answer.NOT_HOLDING
