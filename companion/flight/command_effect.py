"""Describes the effect of an operator's command, derived from the outputs of the tick that executes it and of the tick before.
Pure.
"""

from __future__ import annotations

from companion.model.flight_stage import PILOT_FLIES, ROTORS_MAY_START, Stage
from companion.model.types import OperatorCommand, Outputs, PhaseKind, SafetyAction

Effect = tuple[bool, str]
"""Whether the command was accepted (executed, or already in effect), and a text: the action, or the reason for the refusal."""

_RISING = frozenset({Stage.OFFBOARD.value, Stage.ARM.value, Stage.SPOOL.value})
"""Phases between the start command and take-off."""


def effect_of(command: OperatorCommand, before: Outputs | None, after: Outputs) -> Effect:
    """Return the effect of a command.

    Args:
        command: the operator's command, even if an earlier request to land has taken its place in `Inputs.command`.
        before: outputs of the tick before the command; None if there was no such tick.
        after: outputs of the tick that executes the command.
    """
    if after.phase == PILOT_FLIES:
        return False, "a pilot has control: nothing is sent"
    stood = before is None or before.phase_kind is PhaseKind.GROUND
    if after.phase_kind is PhaseKind.DONE and not stood:
        return command in _DOWN, "already down" if command in _DOWN else f"{_NOTHING[command]}: the flight is over"
    if after.phase == Stage.AUTOPILOT_LAND.value:
        if command in _DOWN:
            return True, "recorded; PX4's own landing continues"
        return False, f"{_NOTHING[command]}: PX4 is landing on its own"
    return _JUDGES[command](before, after)


def _land(before: Outputs | None, after: Outputs) -> Effect:
    if after.phase_kind is PhaseKind.DONE:
        return True, _cancelled(before)
    if before is not None and before.phase == Stage.SPOOL.value:
        return True, "not taking off: the rotors are spooling down"
    landed_already = before is not None and before.action.rank >= SafetyAction.LAND.rank
    return True, "already landing" if landed_already else "landing"


def _cancelled(before: Outputs | None) -> str:
    arming = before is not None and before.phase == Stage.ARM.value
    return f"not taking off: the start is cancelled{f'; PX4 was asked to arm: {ROTORS_MAY_START}' if arming else ''}"


def _abort(before: Outputs | None, after: Outputs) -> Effect:
    accepted, text = _land(before, after)
    return accepted, "aborted: landing and folding the arm" if text == "landing" else text


def _hold(before: Outputs | None, after: Outputs) -> Effect:
    if after.phase_kind is PhaseKind.DONE:
        return True, _cancelled(before)
    if after.phase_kind is PhaseKind.GROUND:
        return True, "the vehicle stays on the ground until start is commanded"
    if before is not None and before.phase == Stage.SPOOL.value:
        return True, "not taking off: the rotors are spooling down"
    if "no_room_to_stay" in _events(after):
        return True, "too low to hold: landing"
    action = after.action
    if action is SafetyAction.RETRACT:
        return False, "HOLD rejected: the vehicle is in RETRACT and will land"
    if action.rank > SafetyAction.HOLD.rank or after.phase_kind is PhaseKind.LANDING:
        return False, "hold rejected: the vehicle is landing"
    held_already = before is not None and before.action is SafetyAction.HOLD
    return True, "already holding" if held_already else "holding"


def _resume(before: Outputs | None, after: Outputs) -> Effect:
    refused = _events(after).get("resume_refused")
    if refused is not None:
        return False, f"resume refused: {refused}"
    if before is None or before.action is not SafetyAction.HOLD:
        return False, f"nothing to resume: {_instead(after)}"
    if after.action.rank > SafetyAction.HOLD.rank:
        return False, f"resume refused: {_instead(after)}"
    if after.phase_kind is PhaseKind.LANDING:
        return True, "the landing continues"
    return True, "continuing"


def _start(before: Outputs | None, after: Outputs) -> Effect:
    declined = _events(after).get("start_declined")
    if declined is not None:
        return False, f"start refused: {declined}"
    if before is not None and before.phase in _RISING:
        return (True, "already taking off") if after.phase_kind is PhaseKind.GROUND else (False, _NOT_GROUNDED)
    if after.phase in _RISING:
        return True, "taking off"
    if after.phase_kind is PhaseKind.DONE:
        return False, "start refused: the start has been cancelled"
    return False, _NOT_GROUNDED


def _instead(after: Outputs) -> str:
    """Return what the vehicle is doing instead of holding."""
    if after.phase_kind is PhaseKind.GROUND:
        return "on the ground"
    if after.action is SafetyAction.RETRACT:
        return "the vehicle is returning along the tether and will land"
    if after.action.rank > SafetyAction.HOLD.rank or after.phase_kind is PhaseKind.LANDING:
        return "the vehicle is landing"
    return "not holding"


def _events(outputs: Outputs) -> dict[str, str]:
    return {event.id: event.text for event in outputs.events}


_DOWN = frozenset({OperatorCommand.LAND, OperatorCommand.ABORT})
_NOT_GROUNDED = "start refused: already in the air"
_NOTHING = {
    OperatorCommand.HOLD: "hold rejected",
    OperatorCommand.RESUME: "nothing to resume",
    OperatorCommand.START: "start refused",
}
_JUDGES = {
    OperatorCommand.LAND: _land,
    OperatorCommand.ABORT: _abort,
    OperatorCommand.HOLD: _hold,
    OperatorCommand.RESUME: _resume,
    OperatorCommand.START: _start,
}
