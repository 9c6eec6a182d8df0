"""The mission file: start pose of the vehicle, motion limits, and the phases of the flight.

Positions are those of the body origin in the world frame (z up, 0 on the floor); joint angles are defined as in the paper.
"""

from __future__ import annotations

import math
from typing import Annotated, Any, Literal, Self

from pydantic import AfterValidator, Field, model_validator
from pydantic_core import PydanticCustomError

from companion.config.base import Location, Model, NonNegative, OrElse, PerJoint, Positive, Vector2, Vector3, refuse
from companion.config.controller import PRESETS

ArmPose = Annotated[PerJoint, OrElse({"type": "string"})]
"""Joint angles. A mission file may name a pose of its vehicle file instead, which the loader replaces by its angles."""
Duration = Annotated[float, Field(gt=0, le=600)]
Delay = Annotated[float, Field(ge=0, le=600)]
POINTS_APART_M = 0.01
"""Smallest distance between consecutive points of a path."""
Name = Annotated[str, Field(min_length=1, max_length=60)]


class Takeoff(Model):
    """Climb vertically from the start position."""

    type: Literal["takeoff"]
    name: Name | None = None
    height_m: Positive
    """Final height of the body origin above the floor."""
    duration_s: Duration


class Hold(Model):
    """Hover in place."""

    type: Literal["hold"]
    name: Name | None = None
    duration_s: Duration


class Line(Model):
    """Fly straight to a point, from rest to rest with minimum snap; the arm can move at the same time."""

    type: Literal["line"]
    name: Name | None = None
    to_m: Vector3
    duration_s: Duration | None = None
    """Duration. If it is absent, the shortest duration that the limits allow is used."""
    arm_deg: ArmPose | None = None
    """Final joint angles, or the name of a pose of the vehicle file. If they are absent, the arm keeps its pose."""
    arm_delay_s: Delay | None = None
    """Time from the start of the line to the start of the arm's motion; 0 if it is absent."""
    arm_duration_s: Duration | None = None
    """Duration of the arm's motion. If it is absent, the motion ends with the line."""

    @model_validator(mode="after")
    def _arm_moves_within_the_line(self) -> Self:
        problems: list[tuple[Location, str]] = []
        if self.arm_deg is None:
            for key in ("arm_delay_s", "arm_duration_s"):
                if getattr(self, key) is not None:
                    problems.append(((key,), "sets the time of an arm motion, but its target, arm_deg, is missing"))
        else:
            end_s = (self.arm_delay_s or 0.0) + (self.arm_duration_s or 0.0)
            if self.duration_s is not None and (
                end_s > self.duration_s or (self.arm_delay_s or 0.0) >= self.duration_s
            ):
                key = "arm_delay_s" if self.arm_duration_s is None else "arm_duration_s"
                text = f"the arm's motion would end {end_s:g} s into a line of {self.duration_s:g} s; it must end within the line"
                problems.append(((key,), text))
        refuse("line", problems)
        return self


class Path(Model):
    """Fly through points without stopping, from rest to rest with minimum snap; the arm keeps its pose."""

    type: Literal["path"]
    name: Name | None = None
    through_m: Annotated[tuple[Vector3, ...], Field(min_length=1, max_length=30)]
    """Points of the path in order, with its end but without its start."""
    duration_s: Duration | None = None
    """Duration. If it is absent, the shortest duration that the limits allow is used."""


class ArmMove(Model):
    """Move the arm while the vehicle hovers in place."""

    type: Literal["arm"]
    name: Name | None = None
    arm_deg: ArmPose
    duration_s: Duration | None = None
    """Duration. If it is absent, the shortest duration that the limits allow is used."""


class Land(Model):
    """Descend vertically until touchdown."""

    type: Literal["land"]
    name: Name | None = None
    speed_m_s: Annotated[float, Field(ge=0.05, le=1.0)]


SLIDE_MIN_M = 0.01
ContactForce = Annotated[float, Field(gt=0, le=50)]
ContactSpeed = Annotated[float, Field(ge=0.02, le=0.2)]


class _Contact(Model):
    """Way to a surface."""

    name: Name | None = None
    direction: Vector3
    """Direction of the motion and of the force, world frame, of any length: into the surface, as far as its position is known."""
    distance_max_m: Annotated[float, Field(gt=0, le=2)]
    """Largest distance. If the surface was not touched by then, the vehicle moves back and skips the contact."""
    speed_m_s: ContactSpeed
    touch_n: Annotated[float, Field(ge=0.5, le=10)] = 1.0
    """Force against the direction that counts as a touch."""

    @model_validator(mode="after")
    def _has_a_direction(self) -> Self:
        if math.hypot(*self.direction) < 1e-3:
            refuse("approach", [(("direction",), "has no length")])
        return self


class Approach(_Contact):
    """Move in one direction until the tool touches a surface; the arm keeps its pose. A press or a slide must follow."""

    type: Literal["approach"]
    face_m: Annotated[float, Field(ge=0.1, le=0.5)] | None = None
    """Side of a triangle of three light touches, by which the vehicle finds the surface's normal. It then turns to the surface and
    presses along its normal. If it is absent, the force acts along `direction`, and friction must keep the tool from slipping.
    """


class Probe(_Contact):
    """Touch a grid of points, find the plane through them, and move back to where the probe began; the arm keeps its pose."""

    type: Literal["probe"]
    rows: Annotated[int, Field(ge=2, le=10)] = 3
    columns: Annotated[int, Field(ge=2, le=10)] = 3
    spacing_m: Annotated[float, Field(ge=0.05, le=0.5)]
    """Distance between neighbouring points. The middle of the grid is straight ahead in the direction."""


class Press(Model):
    """Press on the surface that the approach has touched."""

    type: Literal["press"]
    name: Name | None = None
    force_n: ContactForce
    """Force along the direction of the approach."""
    duration_s: Duration


class Slide(Model):
    """Move the tip straight along the surface while the force along its normal is held."""

    type: Literal["slide"]
    name: Name | None = None
    force_n: ContactForce
    """Force along the direction of the approach."""
    by_m: Vector2
    """Way to the right and up in the surface, as seen from the vehicle, from where the tip is."""
    speed_m_s: ContactSpeed
    friction_max: Annotated[float, Field(ge=0, le=2)] = 0.8
    """Largest coefficient of friction that the surface may have. From it follows the largest force along the surface; the check of the
    mission refuses a slide for which the joints or the rotors' yaw torque have too little reserve.
    """

    @model_validator(mode="after")
    def _goes_somewhere(self) -> Self:
        if math.hypot(*self.by_m) < SLIDE_MIN_M:
            refuse("slide", [(("by_m",), f"is shorter than {SLIDE_MIN_M:g} m")])
        return self


class Detach(Model):
    """Release the force and move back to where the approach began."""

    type: Literal["detach"]
    name: Name | None = None
    speed_m_s: ContactSpeed


Phase = Annotated[
    Takeoff | Hold | Line | Path | ArmMove | Approach | Press | Slide | Detach | Probe | Land,
    Field(discriminator="type"),
]
_PRESSING = ("press", "slide")
_TOUCHING = ("approach", *_PRESSING)
"""Phases during which, or at whose end, the tool touches a surface."""


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
    """Path of the vehicle file, relative to this file."""
    controller: ControllerChoice = ControllerChoice()
    start: Start
    limits: Limits
    catch: Catch | None = None
    repeat: Annotated[int, Field(ge=1, le=1000)] = 1
    """Number of times that the phases between take-off and landing are flown."""
    phases: Annotated[tuple[Phase, ...], Field(min_length=2, max_length=200)]

    @model_validator(mode="after")
    def _up_first_down_last(self) -> Self:
        problems: list[tuple[Location, str]] = []
        last = len(self.phases) - 1
        for index, phase in enumerate(self.phases):
            for kind, place, name in (("takeoff", 0, "first"), ("land", last, "last")):
                if (phase.type == kind) != (index == place):
                    must = f"the {name} phase must be" if index == place else f"only the {name} phase can be"
                    problems.append((("phases", index, "type"), f"{must} of type {kind}"))
                    break
        if self.repeat > 1 and last < 2:
            problems.append((("repeat",), "there is nothing between take-off and landing to repeat"))
        refuse("mission", problems)
        return self

    @model_validator(mode="after")
    def _contact_is_left(self) -> Self:
        problems: list[tuple[Location, str]] = []
        before = ""
        for index, phase in enumerate(self.phases):
            at = ("phases", index, "type")
            if isinstance(phase, Press | Slide):
                if before not in _TOUCHING:
                    problems.append((at, f"a {phase.type} must follow an approach, a press or a slide"))
            elif isinstance(phase, Detach):
                if before not in _PRESSING:
                    problems.append((at, "a detach must follow a press or a slide"))
            elif before == "approach":
                problems.append((at, f"a press or a slide must follow the approach, not a {phase.type}"))
            elif before in _PRESSING:
                problems.append(
                    (at, f"a detach must come before this {phase.type}: the tool still touches the surface")
                )
            before = phase.type
        refuse("mission", problems)
        return self

    @model_validator(mode="after")
    def _paths_go_somewhere(self) -> Self:
        problems: dict[Location, str] = {}
        at_m = (*self.start.position_m, 0.0)
        # The first phase of a later repetition begins where the previous one ended.
        again = range(1, len(self.phases) - 1) if self.repeat > 1 else ()
        for index in (*range(len(self.phases)), *again):
            phase = self.phases[index]
            if isinstance(phase, Takeoff):
                at_m = (*self.start.position_m, phase.height_m)
            elif isinstance(phase, Line):
                at_m = phase.to_m
            elif isinstance(phase, Path):
                for number, point_m in enumerate(phase.through_m):
                    if math.dist(at_m, point_m) < POINTS_APART_M:
                        text = (
                            f"repeats the previous point of the path; points must be {POINTS_APART_M:g} m apart or more"
                        )
                        problems[("phases", index, "through_m", number)] = text
                    at_m = point_m
        refuse("mission", list(problems.items()))
        return self
