"""What the mission file needs of a phase: its key `type`, its place among the other phases, and which types are installed.

Types of phases are plug-ins (`companion.plugins.PHASES`). An entry point names a class that implements `companion.mission.phase.Phase`.
"""

from __future__ import annotations

import functools
import json
from collections.abc import Mapping
from typing import Annotated, Any, ClassVar, Literal, get_args

from pydantic import BeforeValidator, Field, GetJsonSchemaHandler, SerializeAsAny
from pydantic.json_schema import JsonSchemaValue
from pydantic_core import CoreSchema, PydanticCustomError, SchemaValidator, core_schema

from companion import plugins
from companion.config.base import Location, Model, OrElse, PerJoint, Vector2, Vector3

ArmPose = Annotated[PerJoint, OrElse({"type": "string"})]
"""Joint angles. A mission file may name a pose of its vehicle file instead, which the loader replaces by its angles."""
Duration = Annotated[float, Field(gt=0, le=600)]
Delay = Annotated[float, Field(ge=0, le=600)]
Name = Annotated[str, Field(min_length=1, max_length=60)]


class PhaseSettings(Model):
    """Keys that every phase has. `companion.mission.phase.Phase` adds what it does."""

    renamed: ClassVar[dict[str, str]] = {}
    """Old spellings of keys that are still accepted, and the present ones."""
    place: ClassVar[Literal["first", "last"] | None] = None
    """The only place in a mission at which phases of this type can be; None for every place between the first and the last."""

    type: str
    name: Name | None = None

    def order_problem(self, before: PhaseSettings | None) -> str | None:
        """Return why this phase cannot follow another one (None: it is the first), or None if it can."""
        return None if before is None else before.unfinished(self)

    def unfinished(self, after: PhaseSettings) -> str | None:
        """Return what must come between this phase and `after`, or None if nothing must."""
        return None

    def points_m(self, start_m: Vector2) -> tuple[Vector3, ...]:
        """Return the points to which the vehicle flies, world frame, m; `start_m` is where it takes off."""
        return ()

    def way_problems(self, from_m: Vector3) -> list[tuple[Location, str]]:
        """Return the problems of the way from the end of the previous phase, world frame, m."""
        return []


@functools.cache
def phase_class(name: str) -> Any:
    """Return the class of an installed type of phase.

    Raises:
        PluginError: the type is not installed or cannot be imported, or is no type of phase.
    """
    plugin = plugins.find(plugins.PHASES, name)
    found = plugin.load()
    if not (isinstance(found, type) and issubclass(found, PhaseSettings) and hasattr(found, "plan")):
        raise plugin.error("it is not a subclass of companion.mission.phase.Phase")
    if get_args(found.model_fields["type"].annotation) != (name,):
        raise plugin.error(f"the field 'type' of {found.__name__} is not Literal[\"{name}\"]")
    return found


def usable_class(name: str) -> Any | None:
    """Return the class of a type of phase; None if it is not installed or cannot be used."""
    try:
        return phase_class(name)
    except plugins.PluginError:  # `companion plugins` and a mission that names it report it
        return None


@functools.cache
def phase_classes() -> dict[str, Any]:
    """Return the classes of the installed types that can be used, by type."""
    usable = {name: usable_class(name) for name in plugins.installed(plugins.PHASES)}
    return {name: found for name, found in usable.items() if found is not None}


def _schema(classes: Mapping[str, Any]) -> CoreSchema:
    choices = {name: found.__pydantic_core_schema__ for name, found in classes.items()}
    return core_schema.tagged_union_schema(choices, discriminator="type")


@functools.cache
def _validator(name: str | None) -> SchemaValidator:
    """Return the validator of one type, so that no other one is imported; of all installed types if `name` is None."""
    return SchemaValidator(_schema(phase_classes() if name is None else {name: phase_class(name)}))


def forget_phases() -> None:
    """Forget the installed types of phases, for tests that install some."""
    for cached in (phase_class, phase_classes, _validator):
        cached.cache_clear()


def _of_its_type(value: Any) -> Any:
    if isinstance(value, PhaseSettings):
        return value
    name = value.get("type") if isinstance(value, dict) else None
    known = isinstance(name, str) and name in plugins.installed(plugins.PHASES)
    try:
        validator = _validator(name if known else None)
    except plugins.PluginError as error:
        raise PydanticCustomError("condition", "{text}", {"text": str(error)}) from None
    return validator.validate_json(json.dumps(value), strict=True)


class _AnyType:
    """Annotation with the JSON Schema of a phase: that of any installed type."""

    def __get_pydantic_json_schema__(self, _: CoreSchema, handler: GetJsonSchemaHandler) -> JsonSchemaValue:
        return handler(_schema(phase_classes()))


AnyPhase = Annotated[SerializeAsAny[PhaseSettings], BeforeValidator(_of_its_type), _AnyType()]
"""Type for a field of another model: a phase of the type that its key `type` names."""
