"""The operator's commands, one row each: the ground station's keys, help and limits, and which of them make a flight safer.

A new command is a member of `OperatorCommand`, a row here, a rule in `companion.safety.rules`, what the core does about it, and a
button in index.html.
"""

from __future__ import annotations

from typing import Final, NamedTuple

from companion.model.types import OperatorCommand


class CommandRow(NamedTuple):
    """One command."""

    command: OperatorCommand
    key: str
    """Key of the ground station's text display."""
    safer: bool
    """Every operator may give it, it is repeated until it is answered, and it overtakes all that are not safer. Any other needs a
    confirmation: a second key, or a long press.
    """
    age_max_s: float
    """Age above which it is refused."""
    per_s: int
    """Maximum number that is accepted from one operator in a second; a flood of one command does not block another."""
    what: str


TABLE: Final = (
    CommandRow(OperatorCommand.ABORT, "a", True, 5.0, 20, "abort the mission and land immediately"),
    CommandRow(OperatorCommand.LAND, "l", True, 5.0, 20, "land"),
    CommandRow(OperatorCommand.HOLD, "h", True, 5.0, 20, "stop and hold position"),
    CommandRow(OperatorCommand.RESUME, "r", False, 2.0, 1, "continue after a hold, if the supervisor allows it"),
    CommandRow(OperatorCommand.START, "s", False, 2.0, 1, "take off; for flights that wait for START"),
)
"""Gravest first."""
COMMANDS: Final = {row.command.value: row.command for row in TABLE}
"""Each command by its name, gravest first."""
SAFER_COMMANDS: Final = frozenset(row.command for row in TABLE if row.safer)
