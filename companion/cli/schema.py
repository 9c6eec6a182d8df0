"""JSON Schemas of the configuration files, for editors; generated from the models that check the files."""

from __future__ import annotations

import json
from typing import Any

from pydantic import TypeAdapter

from companion.config.controller import ControllerConfig
from companion.config.mission import Mission
from companion.config.vehicle import Vehicle
from companion.sitl_config.laboratory import Normal, Uniform
from companion.sitl_config.world import World

KINDS: dict[str, TypeAdapter[Any]] = {
    "mission": TypeAdapter(Mission),
    "vehicle": TypeAdapter(Vehicle),
    "controller": TypeAdapter(ControllerConfig),
    "world": TypeAdapter(World),
}


def schema_json(kind: str) -> str:
    """JSON Schema (2020-12) of one kind of file, as text without a final newline.

    Raises:
        KeyError: if the kind is none of `KINDS`.
    """
    schema: dict[str, Any] = {"$schema": "https://json-schema.org/draft/2020-12/schema"}
    schema |= KINDS[kind].json_schema()
    if kind == "world":
        schema = _with_distributions(schema)
        schema["$defs"] |= {model.__name__: model.model_json_schema() for model in (Uniform, Normal)}
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
    about = {key: node.pop(key) for key in ("title", "description", "default") if key in node}
    return {**about, "anyOf": [node, *({"$ref": f"#/$defs/{model.__name__}"} for model in (Uniform, Normal))]}
