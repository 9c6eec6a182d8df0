"""From what monitors find in one tick to events: each finding becomes one event when it has lasted long enough."""

from __future__ import annotations

import math
from dataclasses import dataclass

from companion.config.vehicle import Safety
from companion.model.negative_zero import without_negative_zero
from companion.model.types import ControlLog, Event, SafetyAction, Severity, TetherState
from companion.safety.rules import BY_PEOPLE, REATTACHED, RULES, Rule

QUIET_S = 1.0
"""What comes and goes is told again only after it was gone for so long; until then it stands."""
_Found = tuple[Rule, str, tuple[object, ...]]
"""By which rule, a text with braces, and what belongs into them."""


@dataclass(slots=True)
class Situation:
    """What the core is doing, as far as monitors must know. One object, kept up to date: making one per tick costs time."""

    airborne: bool
    """Rotors may be lifting: from arming to touch-down."""
    offboard_expected: bool
    """The companion believes that it commands the vehicle."""
    tracking_error_m: float | None
    control: ControlLog | None = None
    """What the law computed in the last tick; None: the law does not fly."""
    caught: bool = False
    """A payload is on board."""
    tether: TetherState | None = None
    found_armed: str | None = None
    """PX4 is armed though the companion has not asked for it, in words; `airborne` then says whether it flies."""
    waiting: bool = False
    """Inputs are still missing on the ground: only people and broken values are judged."""


class Age:
    """Age of an input in time that this process was awake.

    When the process itself is held up, every stamp grows old though nothing was lost: what arrived meanwhile is read a moment
    later. The hold-up is a finding of its own (`loop_late`, `loop_stalled`), not the device's fault.
    """

    __slots__ = ("_seen_awake_s", "_stamp_s")

    def __init__(self) -> None:
        self._stamp_s: float | None = None
        self._seen_awake_s = -math.inf

    def update(self, awake_s: float, stamp_s: float | None) -> float:
        """Awake seconds since the stamp last changed; infinite before the first. No stamp: the last one grows older."""
        if stamp_s is not None and stamp_s != self._stamp_s:
            self._stamp_s, self._seen_awake_s = stamp_s, awake_s
        return awake_s - self._seen_awake_s


class Findings:
    """Collects what is found in a tick and remembers since when. Costs next to nothing while nothing is found."""

    def __init__(self, safety: Safety) -> None:
        self._hold_s = {
            rule.id: float(getattr(safety, rule.hold) if isinstance(rule.hold, str) else rule.hold) for rule in RULES
        }
        self._now: dict[str, _Found] = {}
        self._since: dict[str, float] = {}
        self._told: dict[str, tuple[SafetyAction, float, _Found]] = {}
        """With which action, when it was last seen, and what was found then."""

    def found(self, rule: Rule, text: str, *values: object) -> None:
        """A finding of this tick; the text's braces are filled in only when it is told."""
        self._now[rule.id] = (rule, text, values)

    def forget(self) -> None:
        """Tell again what is still there: somebody took back what was done about it."""
        self._told = {id_: told for id_, told in self._told.items() if told[1] == math.inf}

    def standing(self) -> str | None:
        """In words, why the vehicle must hold, or worse: the gravest finding of that kind that is not gone; None: there is none."""
        gravest: SafetyAction | None = None
        words = None
        for action, _, (_, text, values) in self._told.values():
            if action.rank >= SafetyAction.HOLD.rank and (gravest is None or action.rank > gravest.rank):
                gravest, words = action, text.format(*values)
        return words

    def events(self, t_s: float, airborne: bool) -> tuple[Event, ...]:
        """Events that begin in this tick; the next tick's collection starts empty."""
        now = self._now
        if not now:
            if self._since:
                self._since = {}
            if self._told:
                self._drop_gone(t_s)
            return ()
        self._now = {}
        self._since = {id_: since_s for id_, since_s in self._since.items() if id_ in now}
        events = []
        for id_, found in now.items():
            rule, text, values = found
            action = rule.air if airborne else rule.ground
            if action is None:
                continue
            began_s = self._since.setdefault(id_, t_s)
            told = self._told.get(id_)
            if told is not None and told[0] is action:
                self._told[id_] = (action, max(told[1], t_s), found)
            elif t_s - began_s >= self._hold_s[id_]:
                self._told[id_] = (action, t_s if rule.clears else math.inf, found)
                words = without_negative_zero(text.format(*values))
                events.append(Event(t_s, id_, _severity(rule, action, airborne), action, words))
        self._drop_gone(t_s)
        return tuple(events)

    def _drop_gone(self, t_s: float) -> None:
        gone = [id_ for id_, (_, seen_s, _) in self._told.items() if t_s - seen_s > QUIET_S or id_ in BY_PEOPLE]
        for id_ in gone:
            del self._told[id_]


def _severity(rule: Rule, action: SafetyAction, airborne: bool) -> Severity:
    if rule.id in BY_PEOPLE:
        return Severity.INFO
    grave = (airborne or rule.id == REATTACHED.id) and action.rank >= SafetyAction.RETRACT.rank
    return Severity.CRITICAL if grave else Severity.WARNING
