"""Sums the external forces and torques that different causes exert on the bodies of the world."""

from __future__ import annotations

from typing import NamedTuple

import mujoco

from companion.model.types import Vec3
from sitl.world.views import Writer

EFFECT_PERIOD_S = 0.01
"""Time between two updates of the loads that effects exert."""
ZERO: Vec3 = (0.0, 0.0, 0.0)


class Loads:
    """The external forces and torques on bodies, by cause; each acts until its cause sets a new one.

    Args:
        data: MuJoCo's data, whose `xfrc_applied` is written only here.
    """

    def __init__(self, data: mujoco.MjData) -> None:
        self._rows = [Writer(row) for row in data.xfrc_applied]
        self._loads: tuple[dict[str, tuple[Vec3, Vec3]], ...] = tuple({} for _ in self._rows)
        self._changed: set[int] = set()

    def set(self, body: int, cause: str, force_n: Vec3, torque_nm: Vec3 = ZERO) -> None:
        """Set the force (N) and torque (N m) that one cause exerts on the centre of mass of a body, world frame."""
        self._loads[body][cause] = (force_n, torque_nm)
        self._changed.add(body)

    def write(self) -> None:
        """Write the summed loads of each body whose loads have changed to MuJoCo."""
        for body in self._changed:
            fx = fy = fz = tx = ty = tz = 0.0
            for (ax, ay, az), (bx, by, bz) in self._loads[body].values():
                fx, fy, fz, tx, ty, tz = fx + ax, fy + ay, fz + az, tx + bx, ty + by, tz + bz
            self._rows[body].write((fx, fy, fz, tx, ty, tz))
        self._changed.clear()


class Bodies(NamedTuple):
    """The model of a scene, as one machine sees it."""

    model: mujoco.MjModel
    data: mujoco.MjData
    loads: Loads
    prefix: str
    """Prefix of the machine's names in the model."""

    def body(self, name: str) -> int:
        """Return the index of one of the machine's bodies."""
        index: int = self.model.body(self.prefix + name).id
        return index
