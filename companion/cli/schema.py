"""JSON Schemas of the configuration files, for editors; generated from the models that check the files."""

from __future__ import annotations

import ast
import inspect
import json
import textwrap
from collections.abc import Callable
from functools import reduce
from itertools import pairwise
from operator import or_
from typing import Annotated, Any

from pydantic import BaseModel, Field, TypeAdapter
from pydantic.json_schema import GenerateJsonSchema

from companion.config.base import Model
from companion.config.controller import LAWS
from companion.config.mission import Mission
from companion.config.team import Team
from companion.config.vehicle import Vehicle
from companion.sitl_config.distributions import Distribution
from companion.sitl_config.world import World


def _controller() -> TypeAdapter[Any]:
    union: Any = reduce(or_, LAWS.values())
    return TypeAdapter(Annotated[union, Field(discriminator="law")])


KINDS: dict[str, Callable[[], TypeAdapter[Any]]] = {
    "mission": lambda: TypeAdapter(Mission),
    "vehicle": lambda: TypeAdapter(Vehicle),
    "controller": _controller,
    "team": lambda: TypeAdapter(Team),
    "world": lambda: TypeAdapter(World),
}
"""Type of each kind of file; the type of a controller file depends on the installed control laws."""


def _descriptions(model: type[BaseModel]) -> dict[str, str]:
    """Return the docstring of each field. Pydantic's `use_attribute_docstrings` would read the source at each start of a flight."""
    found: dict[str, str] = {}
    for base in reversed(model.__mro__):
        if issubclass(base, Model) and base is not Model:
            (body,) = ast.parse(textwrap.dedent(inspect.getsource(base))).body
            assert isinstance(body, ast.ClassDef)
            for field, text in pairwise(body.body):
                match field, text:
                    case ast.AnnAssign(target=ast.Name(name)), ast.Expr(ast.Constant(str(words))):
                        found[name] = inspect.cleandoc(words)
    return found


class Described(GenerateJsonSchema):
    """Generates schemas whose fields have their docstrings as descriptions."""

    def model_schema(self, schema: Any) -> dict[str, Any]:
        """Return the schema of a model, each field with its docstring."""
        found = super().model_schema(schema)
        for name, text in _descriptions(schema["cls"]).items():
            if name in found.get("properties", {}):
                found["properties"][name]["description"] = text
        return found


class _Brief(Described):
    """Generates schemas without field titles, which repeat the keys, and with the schema of a vector's elements only once."""

    def field_title_should_be_set(self, schema: Any) -> bool:
        """Return False: fields get no title."""
        return False

    def tuple_schema(self, schema: Any) -> dict[str, Any]:
        """Return the schema of a list with as many elements as the tuple has."""
        found = super().tuple_schema(schema)
        first, *others = found.get("prefixItems", [None])
        if first is not None and all(other == first for other in others):
            found["items"] = found.pop("prefixItems")[0]
        return found


def schema_json(kind: str) -> str:
    """Return the JSON Schema (2020-12) of one kind of file, as text without a final newline.

    Raises:
        KeyError: the kind is not one of `KINDS`.
    """
    schema: dict[str, Any] = {"$schema": "https://json-schema.org/draft/2020-12/schema"}
    schema |= KINDS[kind]().json_schema(schema_generator=_Brief)
    if kind == "world":
        schema = _with_distributions(schema)
        distributions = TypeAdapter(Distribution).json_schema(schema_generator=_Brief)
        schema["$defs"] |= {**distributions.pop("$defs"), "Distribution": distributions}
    schema["title"] = f"companion {kind}"
    return json.dumps(schema, indent=2, ensure_ascii=False)


def _with_distributions(node: Any) -> Any:
    """Return a schema in which every number may also be a distribution."""
    if isinstance(node, list):
        return [_with_distributions(item) for item in node]
    if not isinstance(node, dict):
        return node
    node = {key: _with_distributions(value) for key, value in node.items()}
    if node.get("type") != "number":
        return node
    about = {key: node.pop(key) for key in ("description", "default") if key in node}
    return {**about, "anyOf": [node, {"$ref": "#/$defs/Distribution"}]}
