"""What the phases of a contact have in common."""

from __future__ import annotations

import functools
import math
from collections.abc import Iterator, Sequence
from typing import Annotated, Any, ClassVar

from pydantic import Field, model_validator

from companion.config.base import Vector3, refuse
from companion.config.phase import PhaseSettings
from companion.mission.air import Air, Expectation
from companion.mission.phase import Checking, Phase, Planning
from companion.model.contact import ContactState
from companion.model.types import Reference, Vec2
from companion.phases.contact import checks, force, machine, points
from companion.phases.contact.way import Way, approach_s

ContactForce = Annotated[float, Field(gt=0, le=50)]
ContactSpeed = Annotated[float, Field(ge=0.02, le=0.2)]


class ContactPhase(Phase):
    """A phase that shares the state of a contact."""

    acts: ClassVar[bool] = True
    slides: ClassVar[bool] = False
    """Whether the tip moves along the surface."""

    def touching(self, air: Air, contact: ContactState, way: Way) -> ContactState:
        """Return the state after one tick in which the tool touches the surface."""
        return contact

    def leave_m_s(self, way: Way) -> float:
        """Return the speed of the way back from the surface."""
        return way.speed_m_s

    def step(self, air: Air, own: Any) -> ContactState | None:
        """Advance the contact, with what the phase at the plan's time does in it; one that begins during a hold is left at once."""
        opening, phase = opening_of(air.phases[: air.segment.index + 1]), air.phases[air.segment.index]
        now = phase if isinstance(phase, ContactPhase) else opening
        own = machine.leave(own, air.t_s) if air.holds else own
        return machine.advance(air, own, opening.way, now.touching, now.leave_m_s(opening.way), now.slides)

    def leave(self, own: Any, t_s: float) -> ContactState:
        """Leave the surface."""
        return machine.leave(own, t_s)

    def reference(self, reference: Reference, own: Any) -> Reference:
        """Return the reference with the contact's offset and push."""
        return force.along(reference, own)

    def expects(self, own: Any) -> Expectation:
        """Return the forces that the contact expects."""
        contact: ContactState = own
        (nx, ny, nz), d, touches = contact.direction_world, contact.offset_m, contact.touches > 0
        return Expectation(
            into_world=contact.direction_world,
            touches=touches,
            force_n=contact.force_n,
            contact_n=max(contact.force_n, force.sensed_n(contact)) if touches else None,
            back_m=(-d * nx, -d * ny, -d * nz),
            contact=contact,
        )


class Opening(ContactPhase):
    """Way to a surface."""

    touches: ClassVar[bool] = True
    goes_on: ClassVar[bool] = False
    """Whether a press or a slide follows."""

    direction: Vector3
    """Direction of the motion and of the force, world frame, of any length: into the surface, as far as its position is known."""
    distance_max_m: Annotated[float, Field(gt=0, le=2)]
    """Largest distance. If the surface was not touched by then, the vehicle moves back and skips the contact."""
    speed_m_s: ContactSpeed
    touch_n: Annotated[float, Field(ge=0.5, le=10)] = 1.0
    """Force against the direction that counts as a touch."""

    @model_validator(mode="after")
    def _has_a_direction(self) -> Opening:
        if math.hypot(*self.direction) < 1e-3:
            refuse(self.type, [(("direction",), "has no length")])
        return self

    @property
    def way(self) -> Way:
        """The way to the surface."""
        return _way_of(self)

    @property
    def points_of_surface_m(self) -> tuple[Vec2, ...]:
        """Points that are touched to find the surface, right and up of the way straight ahead, m."""
        return ()

    def plan(self, p: Planning) -> None:
        """Append the largest duration of an approach, or about that of what touches points."""
        p.builder.t_s += approach_s(self.way)

    def problems(self, c: Checking) -> Iterator[str]:
        """Check the tool and the room for its way."""
        yield from checks.way_problems(c.vehicle, c.begin, self.way)

    def begin(self, air: Air) -> ContactState:
        """Return the state at the beginning of the contact."""
        return points.begun(air, self.way)


class Pressing(ContactPhase):
    """A phase in which the tool presses."""

    presses: ClassVar[bool] = True

    force_n: ContactForce
    """Force along the direction of the approach."""

    def order_problem(self, before: PhaseSettings | None) -> str | None:
        """Return the problem if no surface was touched before, else None."""
        touched = isinstance(before, Pressing) or (isinstance(before, Opening) and before.goes_on)
        return None if touched else f"a {self.type} must follow an approach, a press or a slide"

    def unfinished(self, after: PhaseSettings) -> str | None:
        """Return the problem: the tool must be detached first."""
        return f"a detach must come before this {after.type}: the tool still touches the surface"


@functools.lru_cache(maxsize=16)  # read in every tick
def _way_of(phase: Opening) -> Way:
    x, y, z = phase.direction
    length = math.hypot(x, y, z)
    return Way(
        direction_world=(x / length, y / length, z / length),
        distance_max_m=phase.distance_max_m,
        speed_m_s=phase.speed_m_s,
        touch_n=phase.touch_n,
        points=phase.points_of_surface_m,
        presses=phase.goes_on,
    )


def opening_of(phases: Sequence[Any]) -> Opening:
    """Return the newest phase that began a contact."""
    return next(phase for phase in reversed(phases) if isinstance(phase, Opening))
