"""Checks the parts of a log's metadata that evaluations read as plain data: its configuration and planned path.

The models of `companion.config` do not fit older logs, which lack keys and have others. Here every key may be absent and unknown keys
are ignored, but a key that an evaluation reads has the expected type and a value in the expected range.
"""

from __future__ import annotations

from typing import Annotated, Any

import msgspec
from msgspec import UNSET, Meta, UnsetType

Number = Annotated[float, Meta(ge=-1e6, le=1e6)]
Positive = Annotated[float, Meta(ge=1e-6, le=1e6)]
Vector = tuple[Number, Number, Number]
Range = tuple[Number, Number]


class _Rotor(msgspec.Struct):
    position_body_m: Vector
    spin: str


class _Airframe(msgspec.Struct):
    mass_kg: Positive | UnsetType = UNSET
    hover_thrust: Number | UnsetType | None = UNSET
    radius_m: Positive | UnsetType = UNSET
    ground_clearance_m: Number | UnsetType = UNSET
    layout: str | UnsetType = UNSET
    rotor_arm_m: Positive | UnsetType = UNSET
    rotor_height_m: Number | UnsetType = UNSET
    rotors: list[_Rotor] | None = None


class _Arm(msgspec.Struct):
    joints: list[Any] | None = None
    link_lengths_m: list[Number] | None = None


class _Tool(msgspec.Struct):
    length_m: Number | None = None
    net_radius_m: Number | None = None
    tip_radius_m: Number | None = None


class _Tether(msgspec.Struct):
    anchor_world_m: Vector | UnsetType = UNSET
    attachment_body_m: Vector | UnsetType = UNSET
    length_m: Number | UnsetType = UNSET
    margin_m: Number | UnsetType = UNSET
    taut_slack_m: Number | UnsetType = UNSET


class _Room(msgspec.Struct):
    x_m: Range
    y_m: Range
    z_m: Range


class _Safety(msgspec.Struct):
    force_timeout_s: Number | UnsetType = UNSET


class _Vehicle(msgspec.Struct):
    name: str | UnsetType = UNSET
    airframe: _Airframe | UnsetType = UNSET
    arm: _Arm | None = None
    tool: _Tool | None = None
    tether: _Tether | None = None
    room: _Room | UnsetType = UNSET
    safety: _Safety | UnsetType = UNSET
    devices: dict[str, dict[str, Any] | None] | UnsetType = UNSET


class _Mission(msgspec.Struct):
    name: str | UnsetType = UNSET
    phases: list[dict[str, Any]] | None = None


class _Sources(msgspec.Struct):
    vehicle: str | None = None
    overrides: list[str] | None = None


class _World(msgspec.Struct):
    name: str | UnsetType = UNSET
    seed: int | None = None
    model_error: Number | None = None
    payload_kg: Number | None = None
    throw_velocity_m_s: Vector | None = None


class _Config(msgspec.Struct):
    vehicle: _Vehicle | UnsetType = UNSET
    mission: _Mission | UnsetType = UNSET
    controller: dict[str, Any] | UnsetType = UNSET
    sources: _Sources | None = None
    world: _World | None = None


def checked_config(config_json: str) -> dict[str, Any]:
    """Return the effective configuration of a log as plain nested data.

    Raises:
        ValueError: the text is not JSON, or a key that evaluations read has another type or is out of range; the text names it.
    """
    return dict(_checked(config_json, _Config))


def checked_path(path_json: str) -> list[list[float]]:
    """Return the points of a planned path, world frame, m.

    Raises:
        ValueError: the text is not JSON, or not a list of points.
    """
    return list(_checked(path_json, list[Vector]))


def _checked(text: str, kind: Any) -> Any:
    try:
        data = msgspec.json.decode(text)
        msgspec.convert(data, kind)
    except RecursionError:
        raise ValueError("its JSON is nested too deeply") from None
    return data
