"""The target impedance M_d e'' + K_d e' + K_p e = e_tau, one row at a time (paper, eqs. Simplified_Impedance_Dynamics, s_general, tau,
del_tau and adaptive_1).

All matrices of the paper are diagonal, so each row of chi = [x y z | roll pitch yaw | joints] is a scalar impedance of its own. The
letters are the paper's; what its printed equations need to hold is corrected as in docs/internals/control-law.md.
"""

from __future__ import annotations

import math
from typing import Final

from companion.config.controller import AdaptiveConfig, fitted


class Row:
    """One row: its gains, its part of the law and its auxiliary state gamma, which starts at 0.

    Args:
        M_d: desired inertia, kg or kg m^2.
        K_d: desired damping, N s/m or N m s/rad.
        Phi: 1/s. K_p = D Phi by eq. gain_cond, which `AdaptiveConfig` checks; so K_p does not appear.
        Lambda: gain of s, N s/m or N m s/rad.
        S: weight of the row in the norms; 0 takes it out.
        robust_scale: factor of the row's robust term on a vehicle of another inertia.
    """

    def __init__(self, M_d: float, K_d: float, Phi: float, Lambda: float, S: float, robust_scale: float) -> None:
        self.M_d: Final = M_d
        self.D: Final = K_d - M_d * Phi
        """Damping of gamma; positive by eq. gain_new. It stays when `online` scales Phi and Lambda: K_d and K_p then follow."""
        self.Phi = Phi
        self.Lambda = Lambda
        self.S_squared: Final = S**2
        self._robust_weight: Final = S**2 * robust_scale
        self._dt_s, self._decay, self._growth = -1.0, 0.0, 0.0
        self.gamma = 0.0
        self.e = self.e_dot = self.s = 0.0

    def set_error(self, e: float, e_dot: float) -> None:
        """Set e = chi - chi_d and e', and with them s = e' + Phi e - gamma (eq. s_general)."""
        self.e = e
        self.e_dot = e_dot
        self.s = e_dot + self.Phi * e - self.gamma

    def tau(self, chi_d_ddot: float, robust_gain: float) -> float:
        """Return M_d (chi_d'' - Phi e') - Lambda s - D gamma + dtau: eqs. tau and del_tau, corrected, without tau_d.

        Args:
            chi_d_ddot: acceleration of the reference.
            robust_gain: rho / max(||S s||, varpi), so that dtau = -robust_gain S^2 robust_scale s.
        """
        gain_of_s = self.Lambda + robust_gain * self._robust_weight  # -Lambda s + dtau = -gain_of_s s
        return self.M_d * (chi_d_ddot - self.Phi * self.e_dot) - gain_of_s * self.s - self.D * self.gamma

    def chi_star_ddot(self, chi_d_ddot: float, e_tau: float) -> float:
        """Return chi*'' = chi_d'' - Phi e' + gamma', the acceleration that keeps s; at s = 0 it is that of the target impedance."""
        return chi_d_ddot - self.Phi * self.e_dot + (e_tau - self.D * self.gamma) / self.M_d

    def advance(self, dt_s: float, e_tau: float) -> None:
        """Integrate gamma' = M_d^-1 (e_tau - D gamma) over one step with e_tau held (eq. adaptive_1, corrected; exact)."""
        if dt_s != self._dt_s:  # most ticks have the same
            self._dt_s, self._decay = dt_s, math.exp(-self.D / self.M_d * dt_s)
            self._growth = (1.0 - self._decay) / self.D
        self.gamma = self._decay * self.gamma + self._growth * e_tau


def rows_of(config: AdaptiveConfig, joint_count: int) -> list[Row]:
    """Return x, y, z, roll, pitch, yaw and one row for each joint."""
    count = 6 + joint_count
    lists = (
        *(config.inertia_md, config.damping_kd, config.phi, config.lambda_gain),
        *(config.row_weights_s, config.robust_scale),
    )
    return [Row(*gains) for gains in zip(*(fitted(gains, count) for gains in lists), strict=True)]
