"""Writes the tables of docs/internals/safety.md from the code: `python -m tools.docs.safety docs/internals/safety.md`."""

from __future__ import annotations

import re
import sys
from typing import Any

from pydantic import BaseModel

from companion.config.devices import ForceDevice
from companion.config.safety import Safety
from companion.config.tether import Tether
from companion.model.types import Event, SafetyAction, Severity
from companion.safety.notices import HOLD_EXPIRED, NO_ROOM_TO_STAY, NOTICES, RETRACT_DONE, RETRACT_EXPIRED
from companion.safety.rule import Repeat, Rule, Subject
from companion.safety.rules import RULES
from companion.safety.supervisor import EscalationTimeouts, SupervisorState, update
from tools.docs.tables import markdown, write_generated

_SECTIONS: dict[str, type[BaseModel]] = {"": Safety, "tether.": Tether, "devices.force.": ForceDevice}
_TIMES = EscalationTimeouts(1.0, 1.0)


def _default(key: str) -> str:
    """Return a threshold as "`key` = default", or as the key alone if it has no default."""
    section, _, name = key.rpartition(".")
    model = _SECTIONS.get(f"{section}." if section else "")
    default: Any = model.model_fields[name].default if model is not None else None
    return f"`{key}`" if default is None else f"`{key}` = {default:g}"


def _hold_time(rule: Rule) -> str:
    return _default(rule.hold_time) if isinstance(rule.hold_time, str) else f"{rule.hold_time:g} s"


def _action(action: SafetyAction | None) -> str:
    return "" if action is None else f"`{action.value}`"


def _message(rule: Rule) -> str:
    """Return the rule's message with `...` in place of its values."""
    return re.sub(r"\{[^}]*\}", "...", rule.message)


def monitors_table() -> str:
    """Return the table of rules by subject, with one row per rule in the order of the code."""
    head = ("id", "what is found", "thresholds", "hold time", "on the ground", "in the air", "message")
    rows: list[tuple[str, ...]] = []
    for subject in Subject:
        rows.append((f"**{subject.value}**", *[""] * (len(head) - 1)))
        for rule in RULES:
            if rule.subject is subject:
                cells = (
                    f"`{rule.id}`",
                    rule.what + (" (once in a flight)" if rule.repeat is Repeat.NEVER else ""),
                    ", ".join(map(_default, rule.thresholds + rule.tracked_by)),
                    _hold_time(rule),
                    _action(rule.ground),
                    _action(rule.air)
                    + ("; while the pilot is flying, only an event, no command to PX4" if rule.pilot_flies else ""),
                    _message(rule),
                )
                rows.append(cells)
    return markdown(head, rows)


def after(state: SafetyAction, event_id: str, asks: SafetyAction) -> SafetyAction:
    """Return the safety state after an event in the given state, as the supervisor computes it."""
    event = Event(t_s=0.0, id=event_id, severity=Severity.INFO, action=asks, text="")
    return update(SupervisorState(state, "before", 0.0), [event], 0.0, _TIMES).action


def ladder_table() -> str:
    """Return the table of the safety state after each event in each state in the air. Events with the same effect share a row."""
    states = list(SafetyAction)
    events = [(rule.id, rule.air) for rule in RULES if rule.air is not None]
    events += [(notice.id, notice.action) for notice in (RETRACT_DONE, NO_ROOM_TO_STAY)]
    effects: dict[tuple[str, ...], list[str]] = {}
    for event_id, asks in events:
        cells = [after(state, event_id, asks) for state in states]
        shown = tuple("" if cell is state else cell.value for cell, state in zip(cells, states, strict=True))
        effects.setdefault(shown, []).append(f"`{event_id}`")
    for notice, key, start in (
        (HOLD_EXPIRED, "hold_max_s", SafetyAction.HOLD),
        (RETRACT_EXPIRED, "retract_max_s", SafetyAction.RETRACT),
    ):
        end = update(SupervisorState(start, "before", 0.0), [], 2.0, _TIMES)
        shown = tuple(end.action.value if state is start else "" for state in states)
        effects.setdefault(shown, []).append(f"`{notice.id}`, after {_default(key)} s")
    rows = ((*shown, ", ".join(ids)) for shown, ids in effects.items())
    return markdown((*(state.value for state in states), "events"), rows)


def notices_table() -> str:
    """Return the table of notices, with one row per notice."""
    return markdown(("id", "when"), ((f"`{notice.id}`", notice.when) for notice in NOTICES))


def tables() -> dict[str, str]:
    """Return the tables by name."""
    return {"monitors": monitors_table(), "notices": notices_table(), "ladder": ladder_table()}


if __name__ == "__main__":
    sys.exit(write_generated("tools.docs.safety", tables()))
