"""Tracker of the other vehicle of a team and of the bar between the two, and the predicates of their rules.

The rows of these rules, with the actions and the texts for the operator, are in `companion.safety.rules`. What a landing does with the
bar is in `companion.core.let_go`.
"""

from __future__ import annotations

import math
from typing import Final

from companion.model.team import Grip, TeamState
from companion.model.types import Inputs
from companion.safety.flight_context import HOLDS, Age, FlightContext, Values

HELD: Final = frozenset({Grip.READY, Grip.CARRYING, Grip.STANDING})


class TeamTracker:
    """Tracks the other vehicle's announcements and what the bar pulls with."""

    def __init__(self) -> None:
        self._age = Age()
        self.age_s = math.inf
        """Awake time since the newest announcement arrived."""
        self.said: TeamState | None = None
        """The newest announcement."""
        self.grip = Grip.FREE
        """What this vehicle has in its clamp."""
        self.done = False
        """Whether this vehicle has let go of the bar: the other may end its flight first."""
        self.force_n = 0.0
        """Force of the bar on the clamp; 0 while it holds nothing."""
        self.apart_m = math.inf
        """Horizontal distance of the two vehicles; infinite if it is unknown."""

    def update(self, i: Inputs, context: FlightContext, awake_s: float) -> None:
        """Update with the inputs of one tick."""
        partner = i.partner
        self.said = None if partner is None else partner.said
        self.age_s = self._age.update(awake_s, None if partner is None else partner.stamp_s)
        self.done = self.done or (self.grip in HELD and context.grip not in HELD)
        self.grip = context.grip
        log = context.control
        self.force_n = 0.0 if log is None or self.grip not in HELD else math.hypot(*log.force_ext_world_n)
        self.apart_m = math.inf
        if self.said is not None and i.vehicle is not None:
            (x, y, _), (px, py, _) = i.vehicle.position_world_m, self.said.position_world_m
            self.apart_m = math.hypot(x - px, y - py)


def partner_quiet(t: TeamTracker, timeout_s: float) -> Values | None:
    """Fires if the other vehicle is silent while this one holds nothing."""
    return (timeout_s,) if t.age_s > timeout_s and t.grip not in HELD and not t.done else None


def partner_silent(t: TeamTracker, timeout_s: float) -> Values | None:
    """Fires if the other vehicle is silent while this one holds its end of the bar."""
    return (timeout_s,) if t.age_s > timeout_s and t.grip in HELD else None


def partner_holds(t: TeamTracker, _: None) -> Values | None:
    """Fires if the other vehicle has stopped, for a reason of its own, while both carry the bar."""
    if t.said is None or not t.said.holds or t.said.together.waits:
        return None
    return HOLDS if t.grip is Grip.CARRYING else None


def partner_lands(t: TeamTracker, _: None) -> Values | None:
    """Fires if the other vehicle lands because of an event, or PX4 lands it, while this one holds the bar."""
    if t.said is None or t.grip not in HELD:
        return None
    return HOLDS if t.said.lands or t.said.px4_lands else None


def partner_let_go(t: TeamTracker, _: None) -> Values | None:
    """Fires if the other vehicle has let go of a bar that is in the air."""
    if t.said is None or t.said.px4_lands:
        return None
    return HOLDS if t.said.grip is Grip.FREE and t.grip is Grip.CARRYING else None


def partner_near(t: TeamTracker, radius_m: float) -> Values | None:
    """Fires if the rotor circles of the two vehicles nearly touch."""
    least_m = 2.0 * radius_m + ROTORS_APART_M
    return (t.apart_m, least_m) if t.apart_m < least_m else None


def bar_force_high(t: TeamTracker, limit_n: float) -> Values | None:
    """Fires if the bar pulls with more than the limit."""
    return (t.force_n, limit_n) if t.force_n > limit_n else None


ROTORS_APART_M: Final = 0.05
"""Least distance of the rotor circles in flight."""
