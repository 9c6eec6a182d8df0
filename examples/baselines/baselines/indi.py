"""Incremental nonlinear dynamic inversion of the position: the outer loop of

    E. J. J. Smeur, G. C. H. E. de Croon, Q. Chu, "Cascaded incremental nonlinear dynamic inversion for MAV disturbance rejection",
    Control Engineering Practice 73, 2018 (their attitude loop, which is PX4's here: "Adaptive incremental nonlinear dynamic inversion
    for attitude control of micro air vehicles", Journal of Guidance, Control, and Dynamics 39(3), 2016).

The acceleration that the rotors produce is the present one plus an increment. The reference of the acceleration is that of a PD,

    nu = x''_d - K_p e - K_d e',

and with T b_z the thrust vector and the index f for the same second-order filter on both, the increment of the thrust vector is

    m (nu - x''_f),    T b_z = (T b_z)_f + m (nu - x''_f).

This is their G^-1 (nu - x''_f) for roll, pitch and thrust, but not linearised (Tal and Karaman, "Accurate tracking of aggressive
quadrotor trajectories using incremental nonlinear dynamic inversion and differential flatness", IEEE T-CST 29(3), 2021). The filter is
linear, so that it filters one signal: d = m x'' - T b_z - m g, the force that is not known, and T b_z = m (nu - g) - d_f. On the ground
and in saturation d_f is held.
"""

from typing import ClassVar, Literal

import numpy as np

from companion.api.laws import Positive, Positive3, TunedGain, Vehicle

from .tick import Array, Baseline, BaselineConfig, Tick


class IndiConfig(BaselineConfig):
    """Incremental nonlinear dynamic inversion of the position (Smeur, de Croon and Chu, 2018)."""

    presets = ("tuned",)
    tuned_gains = (
        *(TunedGain("position_kp_xyz", 1.0, 40.0, rows) for rows in ((0, 2), (2, 3))),
        *(TunedGain("position_kd_xyz", 1.0, 20.0, rows) for rows in ((0, 2), (2, 3))),
        *(TunedGain("filter_rad_s", 0.5, 60.0, rows) for rows in ((0, 2), (2, 3))),
        TunedGain("feedforward_lead_s", 0.01, 0.4),
    )
    law: Literal["indi"]
    position_kp_xyz: Positive3
    """1/s^2."""
    position_kd_xyz: Positive3
    """1/s."""
    filter_rad_s: Positive3
    """Bandwidth of the filter of acceleration and thrust, per axis."""
    filter_damping: Positive


class IndiLaw(Baseline):
    """The law; each flight makes one."""

    settings: ClassVar = IndiConfig

    def __init__(self, config: IndiConfig, vehicle: Vehicle, hover_thrust: float) -> None:
        super().__init__(config, vehicle, hover_thrust)
        self._kp, self._kd = np.array(config.position_kp_xyz), np.array(config.position_kd_xyz)
        self._w, self._damping = np.array(config.filter_rad_s), config.filter_damping
        self._d_f, self._d_f_rate = np.zeros(3), np.zeros(3)

    def acceleration(self, tick: Tick) -> Array:
        """Return nu - d_f / m."""
        if tick.learn:
            self._filter(tick.dt_s, self.mass_kg * tick.acceleration_m_s2 - tick.known_n)
        nu = tick.wanted_m_s2 - self._kp * tick.e - self._kd * tick.e_dot
        wanted: Array = nu - self._d_f / self.mass_kg
        return wanted

    def _filter(self, dt_s: float, d: Array) -> None:
        """Advance w^2 / (s^2 + 2 damping w s + w^2), implicit Euler."""
        pull = self._w**2 * dt_s
        denominator = 1.0 + 2.0 * self._damping * self._w * dt_s + pull * dt_s
        self._d_f_rate = (self._d_f_rate + pull * (d - self._d_f)) / denominator
        self._d_f = self._d_f + dt_s * self._d_f_rate
