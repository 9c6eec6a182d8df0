"""Collects external forces and torques on the bodies of the world, by cause."""

from __future__ import annotations

import mujoco

from companion.model.types import Vec3

EFFECT_PERIOD_S = 0.01
"""Time between two updates of the loads of effects."""
ZERO: Vec3 = (0.0, 0.0, 0.0)


class Loads:
    """The external forces and torques on bodies; each acts until its cause sets it again.

    Args:
        data: MuJoCo's data, whose `xfrc_applied` is written only here.
    """

    def __init__(self, data: mujoco.MjData) -> None:
        self._rows = tuple(data.xfrc_applied)  # views: looking them up in every step costs more
        self._loads: tuple[dict[str, tuple[Vec3, Vec3]], ...] = tuple({} for _ in self._rows)
        self._changed: set[int] = set()

    def set(self, body: int, cause: str, force_n: Vec3, torque_nm: Vec3 = ZERO) -> None:
        """Set force and torque of one cause on the centre of mass of a body, world frame."""
        self._loads[body][cause] = (force_n, torque_nm)
        self._changed.add(body)

    def write(self) -> None:
        """Write to MuJoCo the sums for the bodies whose loads have changed."""
        for body in self._changed:
            fx = fy = fz = tx = ty = tz = 0.0
            for (ax, ay, az), (bx, by, bz) in self._loads[body].values():
                fx, fy, fz, tx, ty, tz = fx + ax, fy + ay, fz + az, tx + bx, ty + by, tz + bz
            self._rows[body][:] = (fx, fy, fz, tx, ty, tz)
        self._changed.clear()
