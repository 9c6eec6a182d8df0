"""The target impedance: error coordinates, external torque, and the auxiliary state gamma (paper, eqs. s_general to I_cl).

Corrected as in docs/control-law.md: gamma' = M_d^-1 (e_tau - D gamma) with D = K_d - M_d Phi, gamma(0) = 0. Written out row by row
because it runs in the control tick.
"""

from __future__ import annotations

import math
from collections.abc import Sequence

from companion.config.controller import AdaptiveConfig
from companion.control.zero_order_hold import HoldTable
from companion.model.types import Chi


class Impedance:
    """States gamma and s of the target impedance M_d e'' + K_d e' + K_p e = e_tau."""

    def __init__(self, config: AdaptiveConfig) -> None:
        self.inertia = config.inertia_md
        self.phi = config.phi
        self.d = tuple(
            kd - md * phi for kd, md, phi in zip(config.damping_kd, config.inertia_md, config.phi, strict=True)
        )
        rates = [d / md for d, md in zip(self.d, self.inertia, strict=True)]

        def held(dt_s: float) -> tuple[float, ...]:
            decays = [math.exp(-rate * dt_s) for rate in rates]
            return (*decays, *((1.0 - decay) / d for decay, d in zip(decays, self.d, strict=True)))

        self._held = HoldTable(held)
        """e^{-M_d^-1 D T} of every row, then (1 - e^{-M_d^-1 D T}) / D."""
        self.gamma = [0.0] * 8

    def sliding(self, error: Sequence[float], error_rate: Sequence[float]) -> Chi:
        """Return s = e' + Phi e - gamma (eq. s_general)."""
        e0, e1, e2, e3, e4, e5, e6, e7 = error
        v0, v1, v2, v3, v4, v5, v6, v7 = error_rate
        p0, p1, p2, p3, p4, p5, p6, p7 = self.phi
        g0, g1, g2, g3, g4, g5, g6, g7 = self.gamma
        return (
            v0 + p0 * e0 - g0,
            v1 + p1 * e1 - g1,
            v2 + p2 * e2 - g2,
            v3 + p3 * e3 - g3,
            v4 + p4 * e4 - g4,
            v5 + p5 * e5 - g5,
            v6 + p6 * e6 - g6,
            v7 + p7 * e7 - g7,
        )

    def advance(self, dt_s: float, e_tau: Sequence[float]) -> Chi:
        """Integrate gamma over one step with e_tau held (eq. adaptive_1, corrected; exact)."""
        k0, k1, k2, k3, k4, k5, k6, k7, b0, b1, b2, b3, b4, b5, b6, b7 = self._held[dt_s]
        t0, t1, t2, t3, t4, t5, t6, t7 = e_tau
        g0, g1, g2, g3, g4, g5, g6, g7 = self.gamma
        gamma: Chi = (
            k0 * g0 + b0 * t0,
            k1 * g1 + b1 * t1,
            k2 * g2 + b2 * t2,
            k3 * g3 + b3 * t3,
            k4 * g4 + b4 * t4,
            k5 * g5 + b5 * t5,
            k6 * g6 + b6 * t6,
            k7 * g7 + b7 * t7,
        )
        self.gamma = list(gamma)
        return gamma
