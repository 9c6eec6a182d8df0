"""PID that is algebraically equal to the position rows of `adaptive/recommended` without the paper's H and zeta.

A position row of that law has e_tau = 0, so gamma = 0 and s = e' + Phi e. With rho = 0 and the adaptive load theta, theta' = -Gamma s,

    tau   = -Lambda s + M_d (x''_d - Phi e') + theta
    theta = -Gamma int (e' + Phi e) dt = -Gamma e - Gamma Phi int e dt                  for e = 0 where the integral begins
    tau   = M_d x''_d - (Lambda + M_d Phi) e' - (Lambda Phi + Gamma) e - Gamma Phi int e dt.

With M_d = m this is the textbook PID (Åström and Hägglund, "PID Controllers: Theory, Design, and Tuning", ISA, 1995) with

    K_d = (Lambda + m Phi) / m,    K_p = (Lambda Phi + Gamma) / m,    K_i = Gamma Phi / m.

In the gains of `recommended`: 6.267, 12.083 and 7 on x and y (12.5, 2.1, 10), 10.267, 26.6 and 17.333 on z (23, 2.6, 20). The two
differ by Gamma times the change of e while the integral is held, and in their bounds.
"""

from typing import ClassVar, Literal

import numpy as np

from companion.api.laws import NonNegative3, Positive, Positive3, TunedGain, Vehicle

from .tick import Array, Baseline, BaselineConfig, Tick


class PidConfig(BaselineConfig):
    """PID with the gains of the position rows of adaptive/recommended (Astrom and Hagglund, 1995)."""

    presets = ("recommended_equal",)
    tuned_gains = (
        *(TunedGain("position_kp_xyz", 2.0, 80.0, rows) for rows in ((0, 2), (2, 3))),
        *(TunedGain("position_kd_xyz", 1.0, 30.0, rows) for rows in ((0, 2), (2, 3))),
        *(TunedGain("position_ki_xyz", 0.1, 60.0, rows) for rows in ((0, 2), (2, 3))),
    )
    law: Literal["pid"]
    position_kp_xyz: Positive3
    """1/s^2."""
    position_kd_xyz: Positive3
    """1/s."""
    position_ki_xyz: NonNegative3
    """1/s^3."""
    integral_max_m_s2: Positive


class PidLaw(Baseline):
    """The law; each flight makes one."""

    settings: ClassVar = PidConfig

    def __init__(self, config: PidConfig, vehicle: Vehicle, hover_thrust: float) -> None:
        super().__init__(config, vehicle, hover_thrust)
        gains = (config.position_kp_xyz, config.position_kd_xyz, config.position_ki_xyz)
        self._kp, self._kd, self._ki = (np.array(gain) for gain in gains)
        self._most = config.integral_max_m_s2
        self._integral = np.zeros(3)

    def acceleration(self, tick: Tick) -> Array:
        """Return x''_d - K_p e - K_d e' - K_i int e."""
        wanted: Array = tick.wanted_m_s2 - self._kp * tick.e - self._kd * tick.e_dot - self._integral
        self._integral = (self._integral + tick.dt_s * self._ki * tick.unwinding_e).clip(-self._most, self._most)
        return wanted
