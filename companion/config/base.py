"""Base class of all configuration models, which are frozen and reject unknown keys, NaN and implicit conversions."""

from __future__ import annotations

from typing import Annotated

from pydantic import AfterValidator, BaseModel, ConfigDict, Field, GetJsonSchemaHandler, ValidationError
from pydantic.json_schema import JsonSchemaValue
from pydantic_core import CoreSchema, InitErrorDetails, PydanticCustomError

Location = tuple[str | int, ...]
"""Keys and indices that lead from a model to a value."""


class Model(BaseModel):
    """A frozen configuration record."""

    model_config = ConfigDict(frozen=True, extra="forbid", allow_inf_nan=False)


def refuse(title: str, problems: list[tuple[Location, str]]) -> None:
    """Raise the problems that a model validator has found, each with its own location, so that the message names the right line.

    Raises:
        ValidationError: there is at least one problem. Pydantic prepends the model's own location in the document.
    """
    if not problems:
        return
    details: list[InitErrorDetails] = [
        {"type": PydanticCustomError("condition", "{text}", {"text": text}), "loc": location, "input": None}
        for location, text in problems
    ]
    raise ValidationError.from_exception_data(title, details)


Positive = Annotated[float, Field(gt=0)]
NonNegative = Annotated[float, Field(ge=0)]
Fraction = Annotated[float, Field(ge=0, le=1)]
RelativeError = Annotated[float, Field(ge=-0.5, le=0.5)]
Vector2 = tuple[float, float]
Vector3 = tuple[float, float, float]
Positive2 = tuple[Positive, Positive]
Positive3 = tuple[Positive, Positive, Positive]


def _ordered(span: Vector2) -> Vector2:
    if not span[0] < span[1]:
        raise ValueError(f"expected the first number to be below the second, got {list(span)}")
    return span


JOINTS_MAX = 7
PerJoint = Annotated[tuple[float, ...], Field(max_length=JOINTS_MAX)]
"""One value for each joint, from the shoulder outwards."""
PositivePerJoint = Annotated[tuple[Positive, ...], Field(max_length=JOINTS_MAX)]


Span = Annotated[Vector2, AfterValidator(_ordered)]


def _direction(axis: Vector3) -> Vector3:
    if not sum(value * value for value in axis) > 1e-12:
        raise ValueError(f"expected a direction, got {list(axis)}")
    return axis


Axis = Annotated[Vector3, AfterValidator(_direction)]
"""Direction of any length."""


class OrElse:
    """Annotation that adds an alternative to a field's JSON Schema, for a value that is replaced before the field is validated."""

    def __init__(self, alternative: dict[str, str]) -> None:
        self._alternative = alternative

    def __get_pydantic_json_schema__(self, core: CoreSchema, handler: GetJsonSchemaHandler) -> JsonSchemaValue:
        return {"anyOf": [handler(core), self._alternative]}
