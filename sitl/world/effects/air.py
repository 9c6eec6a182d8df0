"""Gusts on the base: an Ornstein-Uhlenbeck force and torque, scaled with thrust and height above the floor."""

from __future__ import annotations

from collections.abc import Sequence

from companion.model.types import Vec3
from companion.sitl_config.effects.air import Air as AirConfig
from sitl.world.effects.rotors import Thrusts
from sitl.world.loads import EFFECT_PERIOD_S, Bodies
from sitl.world.ornstein_uhlenbeck import OrnsteinUhlenbeck

_NOISE = 13


class Air:
    """Gusts on the base.

    Args:
        weight_n: weight of the vehicle, equal to its thrust in hover.
    """

    def __init__(self, config: AirConfig, seed: int, bodies: Bodies, weight_n: float) -> None:
        self._config, self._seed, self._weight_n = config, seed, weight_n
        self._loads, self._base = bodies.loads, bodies.body("base")
        self.restart_noise()

    def restart_noise(self) -> None:
        """Restart the noise sequence."""
        self._gust = OrnsteinUhlenbeck(2, self._config.correlation_time_s, EFFECT_PERIOD_S, self._seed, _NOISE)

    def apply(self, thrust_n: Thrusts, q: Sequence[float], v: Sequence[float]) -> None:
        """Set the gusts' force and torque on the base."""
        (x, y, z), (roll, pitch, _) = self._gust.step()
        strength = self.strength(sum(thrust_n), q[2])
        force, torque = strength * self._config.force_rms_n, strength * self._config.torque_rms_nm
        load: tuple[Vec3, Vec3] = ((force * x, force * y, force * z), (torque * roll, torque * pitch, 0.0))
        self._loads.set(self._base, "air", *load)

    def strength(self, thrust_n: float, height_m: float) -> float:
        """Return the gusts' strength relative to hover far from the floor."""
        near = max(0.0, 1.0 - height_m / self._config.floor_range_m)
        return thrust_n / self._weight_n * (1.0 + self._config.floor_increase * near)
