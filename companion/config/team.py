"""The team file: two vehicles, the mission that both fly, and what each member has of its own."""

from __future__ import annotations

from typing import Literal

from pydantic import Field, JsonValue

from companion.config.base import Model
from companion.config.phase import Name


class Member(Model):
    """One vehicle of the team."""

    vehicle: str | None = None
    """Path of the vehicle file, relative to this file; null for that of the mission."""
    controller: str | None = None
    """Path of a controller file, relative to this file; null for that of the mission."""
    set: dict[str, JsonValue] = Field(default={})
    """Values of single keys, as with `--set`: of the mission, the vehicle, the controller and, in simulation, the world."""


class Members(Model):
    """The two vehicles, by the end of the bar that they hold."""

    left: Member
    """It also says when the bar is lifted."""
    right: Member


class Team(Model):
    """Two vehicles that carry one bar."""

    schema_version: Literal[1]
    name: Name
    mission: str
    """Path of the mission file that both fly, relative to this file; each member grips its end of the bar."""
    members: Members
