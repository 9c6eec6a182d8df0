"""Geometric position control with L1 adaptation of the disturbance force.

    T. Lee, M. Leok, N. H. McClamroch, "Geometric tracking control of a quadrotor UAV on SE(3)", IEEE CDC 2010:

        f_d = -k_x e - k_v e' + m g e_3 + m x''_d,    thrust f_d . R e_3,    body z along f_d;

    their attitude controller is PX4's here.

    Z. Wu, S. Cheng, K. A. Ackerman, A. Gahlawat, A. Lakshmanan, P. Zhao, N. Hovakimyan, "L1 adaptive augmentation for geometric
    tracking control of quadrotors", ICRA 2022; Z. Wu et al., "L1Quad: L1 adaptive augmentation of geometric control for agile
    quadrotors with performance guarantees", IEEE T-CST, 2025.

With f the known force, sigma^ the estimated force, z^ the predicted velocity, z~ = z^ - x', and A_s = -a I:

        z^' = (f + sigma^) / m + A_s z~                                       state predictor
        sigma^ = -m Phi^-1 exp(A_s T) z~,    Phi = A_s^-1 (exp(A_s T) - I)    adaptation, piecewise constant
        u_L1 = -C(s) sigma^,    C(s) = w / (s + w)                            low-pass filter

They cancel the matched part of sigma^, which is along body z, because the attitude belongs to the trajectory. Here the attitude follows
the force, so that all three components are cancelled. On the ground and in saturation u_L1 is held and z^ = x'.
"""

from math import exp
from typing import ClassVar, Literal

import numpy as np

from companion.api.laws import Positive, Positive3, TunedGain, Vehicle

from .tick import Array, Baseline, BaselineConfig, Tick


class L1Config(BaselineConfig):
    """Geometric position control (Lee et al., 2010) with L1 adaptation of the force (Wu et al., 2022)."""

    presets = ("tuned",)
    tuned_gains = (
        *(TunedGain("position_kx_xyz", 1.0, 40.0, rows) for rows in ((0, 2), (2, 3))),
        *(TunedGain("position_kv_xyz", 1.0, 20.0, rows) for rows in ((0, 2), (2, 3))),
        *(TunedGain("cutoff_rad_s", 0.3, 40.0, rows) for rows in ((0, 2), (2, 3))),
        TunedGain("feedforward_lead_s", 0.01, 0.4),
    )
    law: Literal["l1"]
    position_kx_xyz: Positive3
    """k_x / m, 1/s^2."""
    position_kv_xyz: Positive3
    """k_v / m, 1/s."""
    predictor_a_1_s: Positive
    """a of the state predictor, at most 20."""
    cutoff_rad_s: Positive3
    """w of the low-pass filter, per axis."""


class L1Law(Baseline):
    """The law; each flight makes one."""

    settings: ClassVar = L1Config

    def __init__(self, config: L1Config, vehicle: Vehicle, hover_thrust: float) -> None:
        super().__init__(config, vehicle, hover_thrust)
        self._kx, self._kv = np.array(config.position_kx_xyz), np.array(config.position_kv_xyz)
        self._a, self._w = config.predictor_a_1_s, np.array(config.cutoff_rad_s)
        self._error, self._predicted = np.zeros(3), np.zeros(3)
        self._sigma, self._u_l1 = np.zeros(3), np.zeros(3)

    def acceleration(self, tick: Tick) -> Array:
        """Return x''_d - (k_x e + k_v e' - u_L1) / m."""
        if tick.learn:
            self._adapt(tick)
        else:
            self._predicted, self._error, self._sigma = tick.velocity_m_s, np.zeros(3), np.zeros(3)
        wanted: Array = tick.wanted_m_s2 - self._kx * tick.e - self._kv * tick.e_dot + self._u_l1 / self.mass_kg
        return wanted

    def _adapt(self, tick: Tick) -> None:
        dt_s, m, a = tick.dt_s, self.mass_kg, self._a
        self._predicted = self._predicted + dt_s * ((tick.known_n + self._sigma) / m - a * self._error)
        self._error = self._predicted - tick.velocity_m_s
        phi = (1.0 - exp(-a * dt_s)) / a
        self._sigma = -m / phi * exp(-a * dt_s) * self._error
        self._u_l1 = self._u_l1 + (1.0 - np.exp(-self._w * dt_s)) * (-self._sigma - self._u_l1)
