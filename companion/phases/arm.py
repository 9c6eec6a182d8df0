"""Phase `arm`."""

from __future__ import annotations

import math
from collections.abc import Iterator
from typing import Literal

from companion.config.phase import ArmPose, Duration
from companion.mission.phase import Checking, Phase, Planning


class ArmMove(Phase):
    """Move the arm while the vehicle hovers in place."""

    type: Literal["arm"]
    arm_deg: ArmPose
    duration_s: Duration | None = None
    """Duration. If it is absent, the shortest duration that the limits allow is used."""

    @property
    def description(self) -> str:
        """What the phase does, for a phase without a name."""
        return f"arm to ({', '.join(f'{value:g}' for value in self.arm_deg)}) deg"

    def plan(self, p: Planning) -> None:
        """Append the arm's motion."""
        to_rad = tuple(map(math.radians, self.arm_deg))
        duration_s = self.duration_s or p.builder.least_arm_s(to_rad, p.arm_limits)
        p.builder.move_arm(to_rad, 0.0, duration_s, p.arm_limits)
        p.builder.t_s += duration_s

    def problems(self, c: Checking) -> Iterator[str]:
        """Check that there is an arm."""
        if not c.vehicle.arm.joints:
            yield (
                f"moves the arm, but vehicle '{c.vehicle.name}' has no arm; add arm to the vehicle file, or remove the phase from the "
                "mission"
            )
