"""The loop over the event table: evaluates in every tick which rules hold and for how long, and returns the events."""

from __future__ import annotations

import math
from collections.abc import Mapping
from typing import Any

from companion.config.vehicle import Vehicle
from companion.model.negative_zero import without_negative_zero
from companion.model.outputs import ActiveRule
from companion.model.types import Event, SafetyAction
from companion.safety.flight_context import Values
from companion.safety.rule import Repeat, Rule, Subject, hold_time_s, thresholds_of
from companion.safety.rules import RULES

QUIET_S = 1.0
"""A rule that held raises its event again only after it has not held for this long; until then it is active."""
_Bound = tuple[Rule, Any, Any, Any]
"""A rule, its predicate, and the predicate's two arguments."""


class Evaluation:
    """Evaluates the rules in every tick. Its state is the time since which each rule has held, and the active rules.

    Args:
        vehicle: vehicle file with thresholds and hold times.
        trackers: tracker of each subject, which is the first argument of the predicates of its rules. Rules of a subject that the
            vehicle does not have, and that therefore has no tracker, are off.
    """

    def __init__(self, vehicle: Vehicle, trackers: Mapping[Subject, object]) -> None:
        bound = [
            (rule, rule.predicate, trackers[rule.subject], thresholds_of(rule, vehicle))
            for rule in RULES
            if rule.subject in trackers
        ]
        self._air: list[_Bound] = [row for row in bound if row[0].air is not None]
        self._ground: list[_Bound] = [row for row in bound if row[0].ground is not None]
        self._air_waiting = [row for row in self._air if row[0].while_waiting]
        self._ground_waiting = [row for row in self._ground if row[0].while_waiting]
        self._hold_time_s = {rule.id: hold_time_s(rule, vehicle) for rule in RULES}
        self._since_s: dict[str, float] = {}
        self._active: dict[str, tuple[SafetyAction, float, Rule, Values]] = {}
        """Action, newest time at which the rule held (infinite for a rule that is reported once), and the values at that time."""

    def forget(self) -> None:
        """Make all active rules raise their events again, because the operator has ended the reaction to them."""
        self._active = {id_: active for id_, active in self._active.items() if active[1] == math.inf}

    def standing(self, besides: str | None = None) -> str | None:
        """Return the message of the active rule with the most severe action, other than `besides`; None if none of them requires HOLD
        or more.
        """
        holding = [
            row for row in self.active() or () if row.action.rank >= SafetyAction.HOLD.rank and row.id != besides
        ]
        return max(holding, key=lambda row: row.action.rank).text if holding else None

    def active(self) -> tuple[ActiveRule, ...] | None:
        """Return the active rules, the oldest first; None if there is none."""
        if not self._active:
            return None
        return tuple(
            ActiveRule(id=id_, action=action, text=_text(rule, values))
            for id_, (action, _, rule, values) in self._active.items()
        )

    def events(self, t_s: float, airborne: bool, waiting: bool) -> tuple[Event, ...]:
        """Evaluate the rules of this tick and return the new events.

        Args:
            t_s: flight clock.
            airborne: if True, evaluate the rules with an action in the air and request that action; if False, those with an action
                on the ground.
            waiting: if True, evaluate only rules with `while_waiting`.
        """
        if airborne:
            rows = self._air_waiting if waiting else self._air
        else:
            rows = self._ground_waiting if waiting else self._ground
        found = [
            (rule, values)
            for rule, predicate, tracker, thresholds in rows
            if (values := predicate(tracker, thresholds)) is not None
        ]
        if self._since_s:
            ids = {rule.id for rule, _ in found}
            self._since_s = {id_: since_s for id_, since_s in self._since_s.items() if id_ in ids}
        events = []
        for rule, values in found:
            id_ = rule.id
            action, severity = rule.verdict(airborne)
            since_s = self._since_s.setdefault(id_, t_s)
            active = self._active.get(id_)
            if active is not None and active[0] is action:
                self._active[id_] = (action, max(active[1], t_s), rule, values)
            elif t_s - since_s >= self._hold_time_s[id_]:
                last_s = math.inf if rule.repeat is Repeat.NEVER else t_s
                self._active[id_] = (action, last_s, rule, values)
                events.append(Event(t_s=t_s, id=id_, severity=severity, action=action, text=_text(rule, values)))
        if self._active:
            self._expire(t_s)
        return tuple(events)

    def _expire(self, t_s: float) -> None:
        for id_, (_, last_s, rule, _) in list(self._active.items()):
            if t_s - last_s > QUIET_S or rule.repeat is Repeat.AT_ONCE:
                del self._active[id_]


def _text(rule: Rule, values: Values) -> str:
    return without_negative_zero(rule.message.format(*values))
