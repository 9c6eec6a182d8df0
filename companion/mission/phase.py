"""The interface of a type of mission phase. `companion.phases` has a module for each of the companion's own; others are plug-ins.

A phase is one frozen record: its fields are its keys in the mission file, its class attributes state what it needs and does, and its
methods plan it, check it before take-off and, if it `acts`, fly it with a state of its own. All are pure: a log replays bit for bit.
"""

from __future__ import annotations

from abc import abstractmethod
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from typing import Any, ClassVar

from companion.config.mission import Mission
from companion.config.phase import PhaseSettings
from companion.config.vehicle import Vehicle
from companion.mission.air import NOTHING, Air, Expectation
from companion.mission.arm_motion import ArmLimits
from companion.mission.minsnap import VehicleLimits
from companion.mission.plan_builder import PlanBuilder
from companion.model.codec import Record
from companion.model.types import PhaseKind, Reference


@dataclass(frozen=True, slots=True)
class Planning:
    """What a phase needs to append its motion to a plan."""

    builder: PlanBuilder
    """The phase adds its motion and its duration (`t_s`)."""
    mission: Mission
    vehicle: Vehicle
    limits: VehicleLimits
    arm_limits: ArmLimits
    earlier: Sequence[Phase]
    """Phases before this one in the mission, the newest last."""


@dataclass(frozen=True, slots=True)
class Checking:
    """What a phase is checked with before take-off."""

    mission: Mission
    vehicle: Vehicle
    begin: Reference
    end: Reference
    earlier: Sequence[Phase]
    """Phases before this one in the mission, the newest last."""


class Phase(PhaseSettings):
    """One phase of a mission. A type narrows `type` to `Literal[NAME]`, adds its keys, and overrides what it needs."""

    kind: ClassVar[PhaseKind] = PhaseKind.FLIGHT
    touches: ClassVar[bool] = False
    """Whether the tool begins to touch a surface."""
    presses: ClassVar[bool] = False
    """Whether the tool presses on a surface."""
    surveys: ClassVar[bool] = False
    """Whether it measures the place of a surface and does nothing else."""
    acts: ClassVar[bool] = False
    """Whether it has a state of its own in the air. Without that state the phase is skipped."""

    @property
    def title(self) -> str:
        """The phase's name, or a description."""
        return self.name or self.description

    @property
    def description(self) -> str:
        """What the phase does, for a phase without a name."""
        return self.type

    @abstractmethod
    def plan(self, p: Planning) -> None:
        """Append the motion. It begins and ends at rest."""

    def problems(self, c: Checking) -> Iterator[str]:
        """Yield each reason not to fly the phase: what was found, the limit, and what to do. Without its place in the file."""
        yield from ()

    def begin(self, air: Air) -> Record | None:
        """Return the state at the start; None to be skipped."""
        return None

    def step(self, air: Air, own: Any) -> Record | None:
        """Return the state after one tick, in which the phase may report events and move the plan's time; None when it is over."""
        return None

    def leave(self, own: Any, t_s: float) -> Record | None:
        """Return the state in which the vehicle leaves what it does, because the flight is to hold; None ends it."""
        return own  # type: ignore[no-any-return]

    def reference(self, reference: Reference, own: Any) -> Reference:
        """Return the plan's reference with what the state adds to it."""
        return reference

    def expects(self, own: Any) -> Expectation:
        """Return what the state expects of the flight."""
        return NOTHING


def phases_of(mission: Mission) -> tuple[Phase, ...]:
    """Return the phases of a mission."""
    phases = tuple(phase for phase in mission.phases if isinstance(phase, Phase))
    assert len(phases) == len(mission.phases), "every installed type implements the interface"
    return phases
