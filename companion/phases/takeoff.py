"""Phase `takeoff`."""

from __future__ import annotations

import math
from collections.abc import Iterator
from typing import ClassVar, Literal

from companion.config.base import Positive, Vector2, Vector3
from companion.config.phase import Duration
from companion.mission.phase import Checking, Phase, Planning
from companion.model.types import PhaseKind

RISE_MIN_M = 0.2


class Takeoff(Phase):
    """Climb vertically from the start position."""

    place: ClassVar[Literal["first", "last"] | None] = "first"
    kind = PhaseKind.TAKEOFF

    type: Literal["takeoff"]
    height_m: Positive
    """Final height of the body origin above the floor."""
    duration_s: Duration

    @property
    def description(self) -> str:
        """What the phase does, for a phase without a name."""
        return "take-off"

    def points_m(self, start_m: Vector2) -> tuple[Vector3, ...]:
        """Return the point above the start."""
        return ((*start_m, self.height_m),)

    def plan(self, p: Planning) -> None:
        """Append the climb to the mission's start pose, from which the measured one may differ."""
        start, builder = p.mission.start, p.builder
        x_m, y_m = start.position_m
        builder.move_vehicle((x_m, y_m, self.height_m), self.duration_s)
        builder.turn(math.radians(start.yaw_deg), self.duration_s)
        builder.move_arm(tuple(map(math.radians, start.arm_deg)), 0.0, self.duration_s, p.arm_limits)
        builder.t_s += self.duration_s

    def problems(self, c: Checking) -> Iterator[str]:
        """Check that the vehicle leaves the floor."""
        top_m, clearance_m = c.end.position_world_m[2], c.vehicle.airframe.ground_clearance_m
        if top_m < clearance_m + RISE_MIN_M:
            yield (
                f"ends at {top_m:g} m, but the body's origin is {clearance_m:g} m above the floor when the vehicle is on the ground; "
                f"set height_m to {clearance_m + RISE_MIN_M:g} or more"
            )
