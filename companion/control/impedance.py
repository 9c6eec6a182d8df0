"""The target impedance: its gains and the auxiliary state gamma (paper, eqs. s_general to I_cl).

Corrected as in docs/control-law.md: gamma' = M_d^-1 (e_tau - D gamma) with D = K_d - M_d Phi, gamma(0) = 0.
"""

from __future__ import annotations

import math
from collections.abc import Sequence

from companion.config.controller import AdaptiveConfig, fitted
from companion.control.zero_order_hold import HoldTable
from companion.model.types import Chi


class Impedance:
    """State gamma of the target impedance M_d e'' + K_d e' + K_p e = e_tau.

    Args:
        config: M_d, K_d and Phi of each row.
        joint_count: number of joints.
    """

    def __init__(self, config: AdaptiveConfig, joint_count: int) -> None:
        rows = 6 + joint_count
        self.inertia, self.phi = fitted(config.inertia_md, rows), fitted(config.phi, rows)
        damping_kd = fitted(config.damping_kd, rows)
        self.d = tuple([kd - md * phi for kd, md, phi in zip(damping_kd, self.inertia, self.phi, strict=True)])
        rows_of = [(row, self.d[row] / self.inertia[row], self.d[row]) for row in (0, 1, 2, *range(6, rows))]

        def held(dt_s: float) -> tuple[tuple[tuple[int, float, float], ...], tuple[tuple[int, float, float], ...]]:
            held = []
            for row, rate, d in rows_of:
                decay = math.exp(-rate * dt_s)
                held.append((row, decay, (1.0 - decay) / d))
            return tuple(held[:3]), tuple(held[3:])

        self._held = HoldTable(held)
        """Number of each row, e^{-M_d^-1 D T} and (1 - e^{-M_d^-1 D T}) / D; first of x, y and z, then of the joints."""
        self.gamma: Sequence[float] = (0.0,) * rows

    def advance(self, dt_s: float, e_tau: Sequence[float]) -> Chi:
        """Integrate gamma over one step with e_tau held (eq. adaptive_1, corrected; exact). The attitude rows stay 0."""
        g = self.gamma
        ((_, k0, r0), (_, k1, r1), (_, k2, r2)), joints = self._held[dt_s]
        grown = [k0 * g[0] + r0 * e_tau[0], k1 * g[1] + r1 * e_tau[1], k2 * g[2] + r2 * e_tau[2], 0.0, 0.0, 0.0]
        for row, decay, growth in joints:
            grown.append(decay * g[row] + growth * e_tau[row])
        self.gamma = gamma = tuple(grown)
        return gamma
