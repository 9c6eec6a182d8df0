"""Phase `path`."""

from __future__ import annotations

import math
from itertools import pairwise
from typing import Annotated, ClassVar, Literal

from pydantic import Field

from companion.config.base import Location, Vector2, Vector3
from companion.config.phase import Duration
from companion.mission.phase import Phase, Planning

POINTS_APART_M = 0.01
"""Smallest distance between consecutive points of a path."""


class Path(Phase):
    """Fly through points without stopping, from rest to rest with minimum snap; the arm keeps its pose."""

    renamed: ClassVar[dict[str, str]] = {"through_m": "waypoints_m"}

    type: Literal["path"]
    waypoints_m: Annotated[tuple[Vector3, ...], Field(min_length=1, max_length=30)]
    """Points of the path in order, with its end but without its start."""
    duration_s: Duration | None = None
    """Duration. If it is absent, the shortest duration that the limits allow is used."""

    @property
    def description(self) -> str:
        """What the phase does, for a phase without a name."""
        return f"path to ({', '.join(f'{value:g}' for value in self.waypoints_m[-1])}) m"

    def points_m(self, start_m: Vector2) -> tuple[Vector3, ...]:
        """Return the points of the path."""
        return self.waypoints_m

    def way_problems(self, from_m: Vector3) -> list[tuple[Location, str]]:
        """Return the points that repeat the one before them."""
        text = f"repeats the previous point of the path; points must be {POINTS_APART_M:g} m apart or more"
        pairs = enumerate(pairwise((from_m, *self.waypoints_m)))
        return [(("waypoints_m", number), text) for number, (a, b) in pairs if math.dist(a, b) < POINTS_APART_M]

    def plan(self, p: Planning) -> None:
        """Append the path."""
        p.builder.t_s += p.builder.follow(self.waypoints_m, self.duration_s, p.limits)
