"""Tracker of the other vehicle of a team and of the bar between the two, and the predicates of their rules.

The rows of these rules, with the actions and the texts for the operator, are in `companion.safety.rules`. What a landing does with the
bar is in `companion.core.let_go`.
"""

from __future__ import annotations

import math
from typing import Final

from companion.model.frames import quat_rotate
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
        self.late_s = 0.0
        """How old the newest announcement was said to be, on the motion-capture server's clock; 0 if that is unknown."""
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
        self._bar_age = Age()
        self.bar_unseen_s = 0.0
        """Awake time since motion capture has seen the bar that both carry; 0 while they carry none, and without a body of the bar."""
        self.bar_tilt_deg = 0.0
        """Angle between the bar that both carry and the horizontal; 0 if it is unknown."""

    def update(self, i: Inputs, context: FlightContext, awake_s: float) -> None:
        """Update with the inputs of one tick."""
        partner = i.partner
        self.said = None if partner is None else partner.said
        self.age_s = self._age.update(awake_s, None if partner is None else partner.stamp_s)
        self.late_s = 0.0
        if self.said is not None and self.said.server_s is not None and i.mocap is not None:
            self.late_s = (i.mocap.exposure_server_s or 0.0) - self.said.server_s
        self.done = self.done or (self.grip in HELD and context.grip not in HELD)
        self.grip = context.grip
        log = context.control
        self.force_n = 0.0 if log is None or self.grip not in HELD else math.hypot(*log.force_ext_world_n)
        self.apart_m = math.inf
        if self.said is not None and i.vehicle is not None:
            (x, y, _), (px, py, _) = i.vehicle.position_world_m, self.said.position_world_m
            self.apart_m = math.hypot(x - px, y - py)
        bar = i.bar
        age_s = self._bar_age.update(awake_s, bar.stamp_s if bar is not None and bar.tracking_valid else None)
        self.bar_unseen_s = self.bar_tilt_deg = 0.0
        if self.grip is Grip.CARRYING and (bar is not None or age_s < math.inf):
            self.bar_unseen_s = age_s
            if bar is not None and age_s <= BAR_UNSEEN_S:
                _, _, up = quat_rotate(bar.attitude_wxyz, (1.0, 0.0, 0.0))
                self.bar_tilt_deg = math.degrees(math.asin(max(-1.0, min(1.0, abs(up)))))


def strangers(i: Inputs, agreed: str | None) -> list[str]:
    """Return why this vehicle and the other cannot take off together, from what the other announces; an empty list if they can.

    Args:
        agreed: `FlightConfig.agreed` of this vehicle.
    """
    if i.partner is None:
        return []
    said, found = i.partner.said, list[str]()
    if said.agreed != agreed:
        found.append(
            "the other vehicle flies another mission, from other places or by another version of companion: copy the team's files to "
            "both computers, and give both the same options"
        )
    if said.system_id is not None and i.status is not None and said.system_id == i.status.system_id:
        found.append(
            f"PX4 of the other vehicle has MAV_SYS_ID {said.system_id}, too: set it to another number in one of the two, and restart it"
        )
    own_s = None if i.mocap is None else i.mocap.exposure_server_s
    if own_s is not None and said.server_s is not None and abs(own_s - said.server_s) > CLOCKS_APART_S:
        found.append(
            f"motion capture's clock shows {own_s:.1f} s here and {said.server_s:.1f} s at the other vehicle (limit "
            f"{CLOCKS_APART_S:g} s apart): let both receive the frames of one server (devices.mocap.server)"
        )
    return found


def _both_hold(t: TeamTracker) -> bool:
    """Return whether both hold the bar, as far as is known."""
    return t.grip in HELD and (t.said is None or t.said.grip in HELD)


def partner_quiet(t: TeamTracker, timeout_s: float) -> Values | None:
    """Fires if the other vehicle is silent while one of the two holds nothing yet."""
    before = t.grip in (Grip.FREE, Grip.READY) and not _both_hold(t) and not t.done
    return (timeout_s,) if before and t.age_s > timeout_s else None


def partner_silent(t: TeamTracker, timeout_s: float) -> Values | None:
    """Fires if the other vehicle is silent while both hold the bar."""
    return (timeout_s,) if t.age_s > timeout_s and _both_hold(t) else None


def partner_late(t: TeamTracker, timeout_s: float) -> Values | None:
    """Fires if what the other vehicle says was said long ago, as on a jammed network, while both hold the bar."""
    return (t.late_s, timeout_s) if t.late_s > timeout_s and _both_hold(t) else None


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


def bar_tilted(t: TeamTracker, _: None) -> Values | None:
    """Fires if one end of the bar in the air is much higher than the other."""
    return (t.bar_tilt_deg, BAR_TILT_MAX_DEG) if t.bar_tilt_deg > BAR_TILT_MAX_DEG else None


def bar_unseen(t: TeamTracker, _: None) -> Values | None:
    """Fires if motion capture has lost the bar in the air, whose tilt is then not judged."""
    return (BAR_UNSEEN_S,) if t.bar_unseen_s > BAR_UNSEEN_S else None


BAR_TILT_MAX_DEG: Final = 10.0
"""Largest tilt of a bar that is carried: 0.2 m between the ends of the shipped one. A lift in a drawn laboratory tilts it by 4 deg."""
BAR_UNSEEN_S: Final = 0.5
"""Time after which a bar that motion capture does not see is reported; bodies are hidden for moments."""
CLOCKS_APART_S: Final = 1.0
"""Largest difference between the newest frames of both vehicles before take-off; those of one server are 20 ms apart."""
ROTORS_APART_M: Final = 0.05
"""Least distance of the rotor circles in flight."""
