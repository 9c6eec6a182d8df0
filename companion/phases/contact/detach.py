"""Phase `detach`."""

from __future__ import annotations

from typing import Literal

from companion.config.phase import PhaseSettings
from companion.mission.air import Air
from companion.mission.phase import Planning
from companion.model.contact import ContactState
from companion.phases.contact import machine
from companion.phases.contact.base import ContactPhase, ContactSpeed, Pressing, opening_of
from companion.phases.contact.force import RELEASE_S
from companion.phases.contact.way import Way, travel_s


class Detach(ContactPhase):
    """Release the force and move back to where the approach began."""

    type: Literal["detach"]
    speed_m_s: ContactSpeed

    def order_problem(self, before: PhaseSettings | None) -> str | None:
        """Return that there must be something to detach from."""
        return None if isinstance(before, Pressing) else "a detach must follow a press or a slide"

    def plan(self, p: Planning) -> None:
        """Append the largest duration of the way back."""
        p.builder.t_s += RELEASE_S + travel_s(opening_of(p.earlier).distance_max_m, self.speed_m_s)

    def leave_m_s(self, way: Way) -> float:
        """Return the speed of the way back from the surface."""
        return self.speed_m_s

    def touching(self, air: Air, contact: ContactState, way: Way) -> ContactState:
        """Return the state at the beginning of the way back."""
        return machine.detached(air, contact)
