"""JSON Schemas of the configuration files, for editors; generated from the models that check the files."""

from __future__ import annotations

import json
from typing import Any

from pydantic import TypeAdapter

from companion.config.controller import ControllerConfig
from companion.config.mission import Mission
from companion.config.vehicle import Vehicle
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
    schema["title"] = f"companion {kind}"
    return json.dumps(schema, indent=2, ensure_ascii=False)
