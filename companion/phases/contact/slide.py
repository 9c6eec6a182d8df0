"""Phase `slide`."""

from __future__ import annotations

import math
from collections.abc import Iterator
from itertools import takewhile
from typing import Annotated, Any, ClassVar, Literal, Self

from msgspec.structs import replace
from pydantic import Field, model_validator

from companion.config.base import Vector2, refuse
from companion.mission.air import Air, Expectation
from companion.mission.phase import Checking, Planning
from companion.model.contact import ContactMode, ContactState
from companion.phases.contact import checks, machine
from companion.phases.contact.base import ContactSpeed, Pressing, opening_of
from companion.phases.contact.force import PRESS_RAMP_S
from companion.phases.contact.sliding import Stroke
from companion.phases.contact.way import Way, travel_s

SLIDE_MIN_M = 0.01


class Slide(Pressing):
    """Move the tip straight along the surface while the force along its normal is held."""

    slides: ClassVar[bool] = True
    renamed: ClassVar[dict[str, str]] = {"by_m": "displacement_m"}

    type: Literal["slide"]
    displacement_m: Vector2
    """Way to the right and up in the surface, as seen from the vehicle, from where the tip is."""
    speed_m_s: ContactSpeed
    friction_max: Annotated[float, Field(ge=0, le=2)] = 0.8
    """Largest coefficient of friction that the surface may have. From it follows the largest force along the surface; the check of the
    mission refuses a slide for which the joints or the rotors' yaw torque have too little reserve.
    """

    @model_validator(mode="after")
    def _goes_somewhere(self) -> Self:
        if math.hypot(*self.displacement_m) < SLIDE_MIN_M:
            refuse("slide", [(("displacement_m",), f"is shorter than {SLIDE_MIN_M:g} m")])
        return self

    @property
    def description(self) -> str:
        """What the phase does, for a phase without a name."""
        return f"slide by ({', '.join(f'{value:g}' for value in self.displacement_m)}) m with {self.force_n:g} N"

    @property
    def stroke(self) -> Stroke:
        """The keys as the record of `sliding`."""
        return Stroke(self.force_n, self.displacement_m, self.speed_m_s, self.friction_max)

    def plan(self, p: Planning) -> None:
        """Append the time of the ramp and of the way."""
        p.builder.t_s += PRESS_RAMP_S + travel_s(math.hypot(*self.displacement_m), self.speed_m_s)

    def problems(self, c: Checking) -> Iterator[str]:
        """Check the reserves for force and friction, and the room for the way since the touch."""
        opening, (right_m, up_m) = opening_of(c.earlier), self.displacement_m
        for phase in takewhile(lambda phase: phase is not opening, reversed(c.earlier)):
            if isinstance(phase, Slide):
                right_m, up_m = right_m + phase.displacement_m[0], up_m + phase.displacement_m[1]
        yield from checks.force_problems(c.vehicle, opening.way.direction_world, self.force_n)
        yield from checks.slide_problems(
            c.vehicle, c.mission.limits, c.begin, opening.way, self.stroke, (right_m, up_m)
        )

    def touching(self, air: Air, contact: ContactState, way: Way) -> ContactState:
        """Return the state after one tick of the slide."""
        return machine.slid(air, contact, way, self.stroke)

    def expects(self, own: Any) -> Expectation:
        """Return the forces that the contact expects, with the largest friction while the tip slides."""
        found = super().expects(own)
        return replace(found, friction_max_n=self.stroke.most_n) if own.mode is ContactMode.SLIDE else found
