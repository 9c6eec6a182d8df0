"""The taut tether of a machine, which is a tendon with a limited length, and a line that is snagged."""

from __future__ import annotations

import math
from collections.abc import Sequence

from companion.model.types import Vec3
from sitl.world.loads import Bodies
from sitl.world.views import vec3_of

SNAG_STIFFNESS_N_M, SNAG_DAMPING_NS_M = 400.0, 30.0


class Tether:
    """The tether of one machine.

    Args:
        exists: whether the machine has a tether; without one, the length is infinite and the attachment is the body's origin.
    """

    def __init__(self, bodies: Bodies, exists: bool) -> None:
        model, data, _, prefix = bodies
        self._model = model
        self._tendon = model.tendon(f"{prefix}tether").id if exists else None
        self._attached = data.site_xpos[model.site(f"{prefix}tether").id]
        self.snag: tuple[Vec3, float] | None = None
        """Point where the tether is snagged and its free length from there to the vehicle; None if it is not snagged."""

    @property
    def attachment_world_m(self) -> Vec3:
        """Point where the tether is attached to the vehicle, world frame."""
        return vec3_of(self._attached)

    @property
    def length_m(self) -> float:
        """Present length of the tether."""
        return math.inf if self._tendon is None else float(self._model.tendon_range[self._tendon, 1])

    @length_m.setter
    def length_m(self, length_m: float) -> None:
        self._model.tendon_range[self._tendon, 1] = length_m

    def snag_pull_n(self, velocity_m_s: Sequence[float]) -> Vec3:
        """Return the pull of a stiff, damped line from the snag point on the vehicle in N, world frame; zero without a snag.

        Args:
            velocity_m_s: velocity of the vehicle, world frame.
        """
        if self.snag is None:
            return (0.0, 0.0, 0.0)
        point_m, length_m = self.snag
        x, y, z = (p - a for p, a in zip(point_m, self.attachment_world_m, strict=True))
        distance_m = math.sqrt(x * x + y * y + z * z)
        if distance_m <= length_m or distance_m == 0.0:
            return (0.0, 0.0, 0.0)
        x, y, z = x / distance_m, y / distance_m, z / distance_m
        vx, vy, vz = velocity_m_s
        away_m_s = -(vx * x + vy * y + vz * z)
        pull_n = max(0.0, SNAG_STIFFNESS_N_M * (distance_m - length_m) + SNAG_DAMPING_NS_M * away_m_s)
        return (pull_n * x, pull_n * y, pull_n * z)
