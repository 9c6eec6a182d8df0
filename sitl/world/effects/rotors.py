"""Thrust of the true rotors: static curve, differences between rotors, lag, ground effect and drag.

Sources: static curve of PX4's THR_MDL_FAC (`FunctionMotors::updateValues`); drag linear in thrust and airspeed (Faessler, Franchi,
Scaramuzza, RA-L 2018); ground effect of four rotors (Sanchez-Cuevas, Heredia, Ollero, Int. J. Aerospace Eng. 2017; the equation for
the quadrotor, which adds the images of the other rotors and the fountain below the body to Cheeseman and Bennett 1955).
"""

from __future__ import annotations

import math
from collections.abc import Sequence

from companion.model.types import Vec3, Vec4
from companion.sitl_config.effects.rotors import Rotors as RotorsConfig
from sitl.autopilot.cascade import motor_signal

LOWEST_RADII = 0.5
"""Height in rotor radii below which the ground effect is held constant; the formula is valid only above it."""


def curve(signal: float, factor: float) -> float:
    """Return the fraction of full thrust at a motor signal of 0 to 1; `factor` is defined like THR_MDL_FAC."""
    return signal * (factor * signal + 1.0 - factor)


class LinearRotors:
    """Rotors with thrust linear in the motor signal and a single lag, used in a world in which the effect is off.

    Args:
        lag_s: time constant of the thrust.
        dt_s: physics step.
    """

    def __init__(self, lag_s: float, dt_s: float) -> None:
        self._gain = 1.0 - math.exp(-dt_s / lag_s)
        self._thrust: Vec4 = (0.0, 0.0, 0.0, 0.0)

    def step(self, signals: Vec4, full_n: float) -> Vec4:
        """Advance by one physics step, like `Rotors.step`."""
        k, (a, b, c, d), (to_a, to_b, to_c, to_d) = self._gain, self._thrust, signals
        self._thrust = thrust = (
            a + k * (to_a * full_n - a),
            b + k * (to_b * full_n - b),
            c + k * (to_c * full_n - c),
            d + k * (to_d * full_n - d),
        )
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
    """The four rotors, in PX4's quad-x order; call `step` once per physics step.

    Args:
        config: section `rotors`.
        rotor_arm_m: distance from the centre to each rotor.
        dt_s: physics step.
    """

    def __init__(self, config: RotorsConfig, rotor_arm_m: float, dt_s: float) -> None:
        self._factor = config.thrust_curve
        self._up = 1.0 - math.exp(-dt_s / config.lag_up_s)
        self._down = 1.0 - math.exp(-dt_s / config.lag_down_s)
        self._gain = tuple(1.0 + error for error in config.thrust_error)
        self._drag_s_m = config.drag_s_m
        self._radius_m, self._body_lift, self._diagonal_m = config.radius_m, config.ground_body_lift, 2.0 * rotor_arm_m
        self._root: Vec4 = (0.0, 0.0, 0.0, 0.0)
        """Square root of each rotor's thrust in N^0.5, which is proportional to the rotor's speed."""

    @classmethod
    def of(cls, config: RotorsConfig, rotor_arm_m: float, dt_s: float) -> Rotors | None:
        """Return the rotors, or None if the effect is off."""
        return cls(config, rotor_arm_m, dt_s) if config.on else None

    def step(self, signals: Vec4, full_n: float) -> Vec4:
        """Advance by one physics step and return the thrust of each rotor in N, without the ground effect.

        Args:
            signals: motor signals, 0 to 1.
            full_n: thrust of one rotor at full signal and the present voltage.
        """
        f, up, down = self._factor, self._up, self._down
        linear = 1.0 - f
        (a, b, c, d), (ga, gb, gc, gd), (sa, sb, sc, sd) = self._root, self._gain, signals
        a_to = math.sqrt(ga * full_n * sa * (f * sa + linear))
        b_to = math.sqrt(gb * full_n * sb * (f * sb + linear))
        c_to = math.sqrt(gc * full_n * sc * (f * sc + linear))
        d_to = math.sqrt(gd * full_n * sd * (f * sd + linear))
        a += (up if a_to > a else down) * (a_to - a)
        b += (up if b_to > b else down) * (b_to - b)
        c += (up if c_to > c else down) * (c_to - c)
        d += (up if d_to > d else down) * (d_to - d)
        self._root = (a, b, c, d)
        return (a * a, b * b, c * c, d * d)

    def hover_command(self, each_n: float, full_n: float, thr_mdl_fac: float) -> float:
        """Return PX4's collective thrust setpoint, 0 to 1, at which each rotor produces `each_n` far from the ground.

        Args:
            each_n: thrust of each rotor; PX4's attitude loop compensates for differences between the rotors.
            full_n: thrust of one rotor at full signal and the present voltage.
            thr_mdl_fac: PX4's THR_MDL_FAC.
        """
        signals = (motor_signal(each_n / (gain * full_n), self._factor) for gain in self._gain)
        return sum(curve(signal, thr_mdl_fac) for signal in signals) / 4.0

    def ground_effect(self, height_m: float) -> float:
        """Return the factor by which the ground effect multiplies the thrust of all rotors at a height above the floor."""
        radius_m, diagonal_m = self._radius_m, self._diagonal_m
        z = max(height_m, LOWEST_RADII * radius_m)
        r2, b2, z4 = radius_m * radius_m, diagonal_m * diagonal_m, 4.0 * z * z
        beside2 = 0.5 * b2 + z4
        across2 = b2 + z4
        beside, across = beside2 * math.sqrt(beside2), across2 * math.sqrt(across2)
        return 1.0 / (1.0 - r2 * (0.25 / z4 + z / beside + (0.5 + 2.0 * self._body_lift) * z / across))

    def drag_n(self, thrust_n: float, airspeed_m_s: Vec3, q: Sequence[float]) -> Vec3:
        """Return the drag of all rotors in N, world frame; it acts along the component of the relative air velocity across the rotor
        axis.

        Args:
            thrust_n: thrust of all rotors.
            airspeed_m_s: velocity of the air relative to the vehicle, world frame.
            q: position and attitude of the base, as MuJoCo's qpos.
        """
        k = self._drag_s_m * thrust_n
        vx, vy, vz = airspeed_m_s
        w, x, y, z = q[3], q[4], q[5], q[6]
        ux, uy, uz = 2.0 * (x * z + w * y), 2.0 * (y * z - w * x), 1.0 - 2.0 * (x * x + y * y)
        along = vx * ux + vy * uy + vz * uz
        return (k * (vx - along * ux), k * (vy - along * uy), k * (vz - along * uz))
