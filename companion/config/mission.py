"""The mission file: start pose of the vehicle, motion limits, and the phases of the flight.

Positions are those of the body origin in the world frame (z up, 0 on the floor); joint angles are defined as in the paper.
"""

from __future__ import annotations

from typing import Annotated, Any, Literal, Self

from pydantic import AfterValidator, Field, model_validator
from pydantic_core import PydanticCustomError

from companion.config.base import Location, Model, NonNegative, Positive, Vector2, refuse
from companion.config.controller import PRESETS
from companion.config.phase import AnyPhase, ArmPose, Name, phase_classes


class Start(Model):
    """Pose of the vehicle before take-off, which the measured pose must match."""

    position_m: Vector2
    """x and y, world frame."""
    tolerance_m: Positive = 0.15
    """Tolerance of the position, and of the height, which must equal the vehicle's airframe.ground_clearance_m."""
    yaw_deg: Annotated[float, Field(ge=-180, le=180)] = 0.0
    yaw_tolerance_deg: Positive = 15.0
    arm_deg: ArmPose
    arm_tolerance_deg: Positive = 10.0
    takeoff: Literal["at_once", "by_operator"] = "at_once"
    """at_once: take off as soon as everything is ready. by_operator: wait on the ground until an operator commands `start`."""


class Limits(Model):
    """Limits of the planned motion."""

    speed_max_m_s: Positive
    acceleration_max_m_s2: Positive
    jerk_max_m_s3: Positive = 8.0
    arm_speed_max_deg_s: Positive
    arm_acceleration_max_deg_s2: Positive
    arm_jerk_max_deg_s3: Positive = 600.0
    thrust_share_max: Annotated[float, Field(gt=0, le=1)] = 0.8
    """Largest fraction of airframe.thrust_max_n that the plan may need with the largest payload."""


class Catch(Model):
    """The expected payload. Checks and reports use it; the controller does not know it."""

    expected_at_m: Vector2
    """x and y of the vehicle when the payload arrives."""
    payload_max_kg: NonNegative


def _installed(law: str) -> str:
    if law not in PRESETS:
        raise PydanticCustomError("enum", "not an installed law")
    return law


def _laws(schema: dict[str, Any]) -> None:
    schema["enum"] = list(PRESETS)


class ControllerChoice(Model):
    """A controller file, or a law and one of its presets."""

    law: Annotated[str, AfterValidator(_installed), Field(json_schema_extra=_laws)] = "adaptive"
    preset: str | None = None
    """Built-in preset. If neither preset nor file is given, the law's default preset is used."""
    file: str | None = None
    """Path of a controller file, relative to the mission file."""

    @model_validator(mode="after")
    def _one_source(self) -> Self:
        if self.file is not None and self.preset is not None:
            refuse("controller", [(("preset",), "give either a preset or a file, not both")])
        if self.preset is not None and self.preset not in PRESETS[self.law]:
            text = f"'{self.law}' has no preset \"{self.preset}\"; available: {', '.join(PRESETS[self.law])}"
            refuse("controller", [(("preset",), text)])
        return self


class Mission(Model):
    """One flight."""

    schema_version: Literal[1]
    name: Name
    vehicle: str
    """Path of the vehicle file, relative to this file, or the name of a shipped one."""
    controller: ControllerChoice = ControllerChoice()
    start: Start
    limits: Limits
    catch: Catch | None = None
    repeat: Annotated[int, Field(ge=1, le=1000)] = 1
    """Number of times that the phases between take-off and landing are flown."""
    phases: Annotated[tuple[AnyPhase, ...], Field(min_length=2, max_length=200)]

    @model_validator(mode="after")
    def _up_first_down_last(self) -> Self:
        problems: list[tuple[Location, str]] = []
        last = len(self.phases) - 1
        for index, phase in enumerate(self.phases):
            for name, place in (("first", 0), ("last", last)):
                if (phase.place == name) != (index == place):
                    kinds = [kind for kind, found in phase_classes().items() if found.place == name]
                    must = f"the {name} phase must be" if index == place else f"only the {name} phase can be"
                    problems.append((("phases", index, "type"), f"{must} of type {' or '.join(kinds)}"))
                    break
        if self.repeat > 1 and last < 2:
            problems.append((("repeat",), "there is nothing between take-off and landing to repeat"))
        refuse("mission", problems)
        return self

    @model_validator(mode="after")
    def _phases_follow_each_other(self) -> Self:
        pairs = enumerate(zip((None, *self.phases), self.phases, strict=False))
        found = [(("phases", index, "type"), phase.order_problem(before)) for index, (before, phase) in pairs]
        refuse("mission", [(at, text) for at, text in found if text is not None])
        return self

    @model_validator(mode="after")
    def _paths_go_somewhere(self) -> Self:
        problems: dict[Location, str] = {}
        start_m = self.start.position_m
        at_m = (*start_m, 0.0)
        # The first phase of a later repetition begins where the previous one ended.
        again = range(1, len(self.phases) - 1) if self.repeat > 1 else ()
        for index in (*range(len(self.phases)), *again):
            phase = self.phases[index]
            problems.update({("phases", index, *key): text for key, text in phase.way_problems(at_m)})
            at_m = (at_m, *phase.points_m(start_m))[-1]
        refuse("mission", list(problems.items()))
        return self
