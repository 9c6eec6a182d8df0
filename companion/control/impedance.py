"""The target impedance: error coordinates, external torque, and the auxiliary state gamma (paper, eqs. s_general to I_cl).

Corrected as in docs/control-law.md: gamma' = M_d^-1 (e_tau - D gamma) with D = K_d - M_d Phi, gamma(0) = 0. The rows of the base are
written out because this runs in the control tick.
"""

from __future__ import annotations

import math
from collections.abc import Sequence

from companion.config.controller import AdaptiveConfig, fitted
from companion.control.zero_order_hold import HoldTable
from companion.model.types import Chi


class Impedance:
    """States gamma and s of the target impedance M_d e'' + K_d e' + K_p e = e_tau.

    Args:
        config: M_d, K_d and Phi of each row.
        joint_count: number of joints.
    """

    def __init__(self, config: AdaptiveConfig, joint_count: int) -> None:
        self._rows = rows = 6 + joint_count
        self._joint_rows = tuple(range(6, rows))
        self.inertia, self.phi = fitted(config.inertia_md, rows), fitted(config.phi, rows)
        damping_kd = fitted(config.damping_kd, rows)
        self.d = tuple([kd - md * phi for kd, md, phi in zip(damping_kd, self.inertia, self.phi, strict=True)])
        rates = [d / md for d, md in zip(self.d, self.inertia, strict=True)]

        def held(dt_s: float) -> tuple[float, ...]:
            decays = [math.exp(-rate * dt_s) for rate in rates]
            return (*decays, *((1.0 - decay) / d for decay, d in zip(decays, self.d, strict=True)))

        self._held = HoldTable(held)
        """e^{-M_d^-1 D T} of every row, then (1 - e^{-M_d^-1 D T}) / D."""
        self.gamma: Sequence[float] = (0.0,) * rows

    def sliding(self, error: Sequence[float], error_rate: Sequence[float]) -> Chi:
        """Return s = e' + Phi e - gamma (eq. s_general)."""
        e, v, p, g = error, error_rate, self.phi, self.gamma
        s = [
            v[0] + p[0] * e[0] - g[0],
            v[1] + p[1] * e[1] - g[1],
            v[2] + p[2] * e[2] - g[2],
            v[3] + p[3] * e[3] - g[3],
            v[4] + p[4] * e[4] - g[4],
            v[5] + p[5] * e[5] - g[5],
        ]
        for i in self._joint_rows:
            s.append(v[i] + p[i] * e[i] - g[i])
        return tuple(s)

    def advance(self, dt_s: float, e_tau: Sequence[float]) -> Chi:
        """Integrate gamma over one step with e_tau held (eq. adaptive_1, corrected; exact)."""
        held, g, rows = self._held[dt_s], self.gamma, self._rows
        grown = []
        for i, t in enumerate(e_tau):
            grown.append(held[i] * g[i] + held[rows + i] * t)
        self.gamma = gamma = tuple(grown)
        return gamma
