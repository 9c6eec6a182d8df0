"""Checks the parts of a log's metadata that evaluations read as plain data: its configuration and planned path.

The models of `companion.config` check the values that are there. A log of another version may lack keys, have others, and not meet the
conditions between keys, so none of these is an error.
"""

from __future__ import annotations

import json
from typing import Any

from pydantic import BaseModel, TypeAdapter, ValidationError

from companion.config.base import Vector3
from companion.config.document import key_path
from companion.config.loader import Sources
from companion.config.vehicle import Vehicle


class _World(BaseModel):
    """What evaluations read of the simulated world, whose models no flight imports (`companion.sitl_config`)."""

    name: str | None = None
    seed: int | None = None
    model_error: float | None = None
    payload_kg: float | None = None
    throw_velocity_m_s: Vector3 | None = None


_MODELS: dict[str, type[BaseModel]] = {"vehicle": Vehicle, "sources": Sources, "world": _World}
_OBJECTS = (*_MODELS, "mission", "controller")
_OF_OTHER_VERSIONS = {"missing", "extra_forbidden", "condition", "value_error"}
_LARGEST = 1e12
"""No quantity of a flight is larger; drawing one would overflow."""
_PATH = TypeAdapter(list[Vector3])


def checked_config(config_json: str) -> dict[str, Any]:
    """Return the effective configuration of a log as plain nested data; that of the simulated world is in older logs only.

    Raises:
        ValueError: the text is not JSON, or a value has another type or is out of range; the text names its key.
    """
    config = _parsed(config_json)
    if not isinstance(config, dict):
        raise ValueError("expected an object")
    for name in _OBJECTS:
        if not isinstance(config.get(name, {}), dict):
            raise ValueError(f"{name}: expected an object")
    for name in _MODELS.keys() & config.keys():
        try:
            _MODELS[name].model_validate_json(json.dumps(config[name]), strict=True)
        except ValidationError as error:
            for found in error.errors():
                location = (name, *found["loc"])
                of_a_tuple = found["type"] == "missing" and isinstance(location[-1], int)
                if of_a_tuple or found["type"] not in _OF_OTHER_VERSIONS:
                    raise ValueError(f"{key_path(location)}: {found['msg']}") from None
    return config


def checked_path(path_json: str) -> list[list[float]]:
    """Return the points of a planned path, world frame, m.

    Raises:
        ValueError: the text is not JSON, or not a list of points.
    """
    path = _parsed(path_json)
    try:
        _PATH.validate_python(path)
    except ValidationError:
        raise ValueError("expected a list of points") from None
    return list(path)


def _parsed(text: str) -> Any:
    def number(digits: str) -> float:
        if not abs(value := float(digits)) <= _LARGEST:
            raise ValueError(f"{digits[:40]} is too large for a quantity of a flight")
        return value

    try:
        return json.loads(text, parse_float=number, parse_constant=number)
    except RecursionError:
        raise ValueError("its JSON is nested too deeply") from None
