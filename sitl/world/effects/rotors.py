"""Thrust of the true rotors: static curve, differences between rotors, lag, ground effect and drag.

Sources: static curve of PX4's THR_MDL_FAC (`FunctionMotors::updateValues`); drag linear in thrust and airspeed (Faessler, Franchi,
Scaramuzza, RA-L 2018); ground effect of several rotors (Sanchez-Cuevas, Heredia, Ollero, Int. J. Aerospace Eng. 2017; the equation for
the quadrotor, which adds the images of the other rotors and the fountain below the body to Cheeseman and Bennett 1955, with the images
of all other rotors, averaged over the rotors).
"""

from __future__ import annotations

import math
from collections.abc import Sequence

from companion.model.rotors import RotorLayout, motor_signal, thrust_share
from companion.model.types import Vec3
from companion.sitl_config.effects.rotors import Rotors as RotorsConfig
from companion.sitl_config.effects.rotors import of_rotors

Thrusts = tuple[float, ...]
"""Thrust of each rotor in N, in PX4's order."""
LOWEST_RADII = 0.5
"""Height in rotor radii below which the ground effect is held constant; the formula is valid only above it."""


class LinearRotors:
    """Rotors with thrust linear in the motor signal and a single lag, used in a world in which the effect is off."""

    def __init__(self, count: int, lag_s: float, dt_s: float) -> None:
        self._gain = 1.0 - math.exp(-dt_s / lag_s)
        self._thrust: Thrusts = (0.0,) * count

    def step(self, signals: Sequence[float], full_n: float) -> Thrusts:
        """Advance by one physics step, like `Rotors.step`."""
        k = self._gain
        self._thrust = thrust = tuple([a + k * (to * full_n - a) for a, to in zip(self._thrust, signals, strict=True)])
        return thrust

    def hover_command(self, each_n: float, full_n: float, thr_mdl_fac: float) -> float:
        """Return the thrust setpoint, like `Rotors.hover_command`."""
        return each_n / full_n

    def ground_effect(self, height_m: float) -> float:
        """Return 1, because there is no ground effect."""
        return 1.0

    def drag_n(self, thrust_n: float, airspeed_m_s: Vec3, q: Sequence[float]) -> Vec3:
        """Return a zero force, because these rotors have no drag."""
        return (0.0, 0.0, 0.0)


class Rotors:
    """The rotors, in PX4's order; call `step` once per physics step."""

    def __init__(self, config: RotorsConfig, layout: RotorLayout, dt_s: float) -> None:
        self._factor = config.thrust_curve
        self._up = 1.0 - math.exp(-dt_s / config.lag_up_s)
        self._down = 1.0 - math.exp(-dt_s / config.lag_down_s)
        self._gain = [1.0 + error for error in of_rotors(config.thrust_error, layout.count)]
        self._drag_s_m = config.drag_s_m
        self._radius_m, self._diagonal_m = config.radius_m, 2.0 * layout.arm_m
        self._images = _images(layout, config.ground_body_lift)
        self._root = [0.0] * layout.count
        """Square root of each rotor's thrust in N^0.5, which is proportional to the rotor's speed."""

    def step(self, signals: Sequence[float], full_n: float) -> Thrusts:
        """Advance by one physics step and return the thrust of each rotor in N, without the ground effect.

        Args:
            signals: motor signals, 0 to 1.
            full_n: thrust of one rotor at full signal and the present voltage.
        """
        f, up, down = self._factor, self._up, self._down
        linear = 1.0 - f
        roots, gain = self._root, self._gain
        thrust_n = []
        # Compiled code takes three times as long for a comprehension over zip(..., strict=True).
        for i, s in enumerate(signals):
            root = roots[i]
            to = math.sqrt(gain[i] * full_n * s * (f * s + linear))
            root += (up if to > root else down) * (to - root)
            roots[i] = root
            thrust_n.append(root * root)
        return tuple(thrust_n)

    def hover_command(self, each_n: float, full_n: float, thr_mdl_fac: float) -> float:
        """Return PX4's collective thrust setpoint, 0 to 1, at which each rotor produces `each_n` far from the ground.

        Args:
            each_n: thrust of each rotor; PX4's attitude loop compensates for differences between the rotors.
            full_n: thrust of one rotor at full signal and the present voltage.
        """
        signals = (motor_signal(each_n / (gain * full_n), self._factor) for gain in self._gain)
        return sum(thrust_share(signal, thr_mdl_fac) for signal in signals) / len(self._gain)

    def ground_effect(self, height_m: float) -> float:
        """Return the factor by which the ground effect multiplies the thrust of all rotors at a height above the floor."""
        radius_m, diagonal_m = self._radius_m, self._diagonal_m
        z = max(height_m, LOWEST_RADII * radius_m)
        r2, b2, z4 = radius_m * radius_m, diagonal_m * diagonal_m, 4.0 * z * z
        gain = 0.25 / z4
        for weight, square in self._images:
            distance2 = square * b2 + z4
            gain += weight * z / (distance2 * math.sqrt(distance2))
        return 1.0 / (1.0 - r2 * gain)

    def drag_n(self, thrust_n: float, airspeed_m_s: Vec3, q: Sequence[float]) -> Vec3:
        """Return the drag of all rotors in N, world frame; it acts along the component of the relative air velocity across the rotor
        axis.

        Args:
            airspeed_m_s: velocity of the air relative to the vehicle, world frame.
            q: position and attitude of the base, as MuJoCo's qpos.
        """
        k = self._drag_s_m * thrust_n
        vx, vy, vz = airspeed_m_s
        w, x, y, z = q[3], q[4], q[5], q[6]
        ux, uy, uz = 2.0 * (x * z + w * y), 2.0 * (y * z - w * x), 1.0 - 2.0 * (x * x + y * y)
        along = vx * ux + vy * uy + vz * uz
        return (k * (vx - along * ux), k * (vy - along * uy), k * (vz - along * uz))


def _images(layout: RotorLayout, body_lift: float) -> tuple[tuple[float, float], ...]:
    """Return the weight of the rotors' images at each distance, and the square of that distance as a fraction of the diagonal's.

    Each rotor has the images of all others, with a weight of 0.5 each; the weights are means over the rotors. The fountain below the
    body acts at the diagonal.
    """
    diagonal2 = (2.0 * layout.arm_m) ** 2
    weights = {1.0: 0.0}
    for i, (x, y, _) in enumerate(layout.positions_body_m):
        for j, (other_x, other_y, _) in enumerate(layout.positions_body_m):
            if i != j:
                square = round(((x - other_x) ** 2 + (y - other_y) ** 2) / diagonal2, 12)
                weights[square] = weights.get(square, 0.0) + 0.5
    weights = {square: weight / layout.count for square, weight in weights.items()}
    weights[1.0] += 2.0 * body_lift
    return tuple((weight, square) for square, weight in sorted(weights.items()))
