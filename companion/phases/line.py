"""Phase `line`."""

from __future__ import annotations

import math
from typing import Literal, Self

from pydantic import model_validator

from companion.config.base import Location, Vector2, Vector3, refuse
from companion.config.phase import ArmPose, Delay, Duration
from companion.mission.minsnap import least_line_s
from companion.mission.phase import Phase, Planning


class Line(Phase):
    """Fly straight to a point, from rest to rest with minimum snap; the arm can move at the same time."""

    type: Literal["line"]
    to_m: Vector3
    duration_s: Duration | None = None
    """Duration. If it is absent, the shortest duration that the limits allow is used."""
    arm_deg: ArmPose | None = None
    """Final joint angles, or the name of a pose of the vehicle file. If they are absent, the arm keeps its pose."""
    arm_delay_s: Delay | None = None
    """Time from the start of the line to the start of the arm's motion; 0 if it is absent."""
    arm_duration_s: Duration | None = None
    """Duration of the arm's motion. If it is absent, the motion ends with the line."""

    @model_validator(mode="after")
    def _arm_moves_within_the_line(self) -> Self:
        problems: list[tuple[Location, str]] = []
        if self.arm_deg is None:
            for key in ("arm_delay_s", "arm_duration_s"):
                if getattr(self, key) is not None:
                    problems.append(((key,), "sets the time of an arm motion, but its target, arm_deg, is missing"))
        else:
            end_s = (self.arm_delay_s or 0.0) + (self.arm_duration_s or 0.0)
            if self.duration_s is not None and (
                end_s > self.duration_s or (self.arm_delay_s or 0.0) >= self.duration_s
            ):
                key = "arm_delay_s" if self.arm_duration_s is None else "arm_duration_s"
                text = f"the arm's motion would end {end_s:g} s into a line of {self.duration_s:g} s; it must end within the line"
                problems.append(((key,), text))
        refuse("line", problems)
        return self

    @property
    def description(self) -> str:
        """What the phase does, for a phase without a name."""
        return f"line to ({', '.join(f'{value:g}' for value in self.to_m)}) m"

    def points_m(self, start_m: Vector2) -> tuple[Vector3, ...]:
        """Return the end of the line."""
        return (self.to_m,)

    def plan(self, p: Planning) -> None:
        """Append the line and the arm's simultaneous move."""
        arm_rad = None if self.arm_deg is None else tuple(map(math.radians, self.arm_deg))
        delay_s, duration_s = self.arm_delay_s or 0.0, self.duration_s
        if duration_s is None:
            duration_s = least_line_s(p.builder.line_m(self.to_m), p.limits)
            if arm_rad is not None:
                arm_s = self.arm_duration_s or p.builder.least_arm_s(arm_rad, p.arm_limits)
                duration_s = max(duration_s, delay_s + arm_s)
        p.builder.move_vehicle(self.to_m, duration_s)
        if arm_rad is not None:
            p.builder.move_arm(arm_rad, delay_s, self.arm_duration_s or duration_s - delay_s, p.arm_limits)
        p.builder.t_s += duration_s
