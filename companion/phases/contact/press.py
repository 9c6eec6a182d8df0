"""Phase `press`."""

from __future__ import annotations

from collections.abc import Iterator
from typing import Literal

from companion.config.phase import Duration
from companion.mission.air import Air
from companion.mission.phase import Checking, Planning
from companion.model.contact import ContactState
from companion.phases.contact import checks, machine
from companion.phases.contact.base import Pressing, opening_of
from companion.phases.contact.force import PRESS_RAMP_S
from companion.phases.contact.way import Way


class Press(Pressing):
    """Press on the surface that the approach has touched."""

    type: Literal["press"]
    duration_s: Duration

    @property
    def description(self) -> str:
        """What the phase does, for a phase without a name."""
        return f"press with {self.force_n:g} N"

    def plan(self, p: Planning) -> None:
        """Append the time of the ramp and of the press."""
        p.builder.t_s += PRESS_RAMP_S + self.duration_s

    def problems(self, c: Checking) -> Iterator[str]:
        """Check the reserves for the force."""
        way = opening_of(c.earlier).way
        yield from checks.force_problems(c.vehicle, way.direction_world, self.force_n)
        yield from checks.torque_problems(c.vehicle, c.begin, way, self.force_n)

    def touching(self, air: Air, contact: ContactState, way: Way) -> ContactState:
        """Return the state after one tick of the press."""
        return machine.pressed(air, contact, way, self.force_n)
