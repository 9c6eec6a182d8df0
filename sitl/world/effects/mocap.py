"""Errors of motion capture: pivot offset, hidden markers, lost frames and delivery jitter.

The yaw and tilt errors of the rigid body are in `sitl.world.mocap_misalignment`.
"""

from __future__ import annotations

import math

import numpy as np

from companion.model.frames import quat_from_euler_zyx, quat_multiply, quat_rotate
from companion.model.types import Quat, Vec3
from companion.sitl_config.effects.mocap import Mocap

_STREAM = 12
"""Second part of the seed of this effect's random numbers."""


class MocapErrors:
    """Converts true poses to tracked poses."""

    def __init__(self, config: Mocap, seed: int) -> None:
        self._config, self._seed = config, seed
        burst_s, share = config.lost_burst_s, config.lost_share
        self._burst_s = burst_s
        self._tracked_s = burst_s * (1.0 - share) / share if share > 0.0 else math.inf
        self._wobble_rad = math.radians(config.wobble_deg)
        self._sent_s = 0.0
        self.restart(0.0)

    def restart(self, t_s: float) -> None:
        """Restart the random sequence of events and delays at world time `t_s`."""
        self._rng = np.random.default_rng((self._seed, _STREAM))
        self._lost = False
        self._loss_changes_s = t_s + self._after(self._tracked_s)
        self._hidden_s = t_s + self._after(self._config.wobble_every_s)
        """World time at which markers are next hidden."""
        self._draw_wobble()

    def _after(self, mean_s: float) -> float:
        return float(self._rng.exponential(mean_s)) if math.isfinite(mean_s) else math.inf

    def _draw_wobble(self) -> None:
        x, y, z, roll, pitch, yaw = self._rng.standard_normal(6).tolist()
        m, rad = self._config.wobble_m, self._wobble_rad
        self._wobble = ((m * x, m * y, m * z), (rad * roll, rad * pitch, rad * yaw))

    def pose(self, t_s: float, position_world_m: Vec3, attitude_wxyz: Quat) -> tuple[Vec3, Quat, bool]:
        """Return the measured pose at world time `t_s`, and whether the body is tracked."""
        config = self._config
        x, y, z = quat_rotate(attitude_wxyz, config.pivot_offset_m)
        x, y, z = position_world_m[0] + x, position_world_m[1] + y, position_world_m[2] + z
        while t_s >= self._loss_changes_s:
            self._lost = not self._lost
            self._loss_changes_s += self._after(self._burst_s if self._lost else self._tracked_s)
        while t_s >= self._hidden_s + config.wobble_s:
            self._hidden_s += config.wobble_s + self._after(config.wobble_every_s)
            self._draw_wobble()
        if t_s > self._hidden_s:
            share = math.sin(math.pi * (t_s - self._hidden_s) / config.wobble_s) ** 2
            (ox, oy, oz), (roll, pitch, yaw) = self._wobble
            x, y, z = x + share * ox, y + share * oy, z + share * oz
            attitude_wxyz = quat_multiply(attitude_wxyz, quat_from_euler_zyx(share * roll, share * pitch, share * yaw))
        return (x, y, z), attitude_wxyz, not self._lost

    def sent_s(self, due_s: float) -> float:
        """Return the transmission time of the next frame; without jitter it would be `due_s`."""
        late_s = due_s + float(self._rng.standard_exponential()) * self._config.delivery_jitter_s
        self._sent_s = late_s if late_s > self._sent_s else self._sent_s
        return self._sent_s
