"""Adaptive gains of the robust term (paper, eqs. up_bound_E and adaptive_law_full). They bound everything that the law does not know:
coupling, payload, disturbance.
"""

from __future__ import annotations

import math

from companion.config.controller import AdaptiveConfig
from companion.model.types import Vec4


class Adaptation:
    """H_0 to H_3 and zeta, integrated with an exact zero-order hold, so that they stay >= 0 for any input."""

    def __init__(self, config: AdaptiveConfig) -> None:
        self._nu = config.nu
        self._epsilon = config.epsilon
        self.varpi = config.boundary_layer
        """Boundary layer of ||S s||."""
        self._rho_max = config.rho_max
        self._h_max = config.h_max
        self.h: Vec4 = config.h_initial
        self.zeta = config.zeta_initial

    def rho(self, b: Vec4) -> float:
        """Return the gain of the robust term, H . b + zeta, at most `rho_max`.

        Args:
            b: regressor [1, ||S xi||, ||S xi||^2, ||S chi''||], the last capped.
        """
        return min(self._bound(b) + self.zeta, self._rho_max)

    def advance(self, dt_s: float, norm_s: float, b: Vec4, held: bool) -> None:
        """Integrate H_i' = ||S s|| b_i - nu_i H_i, and zeta' = -(1 + H . b ||S s||) zeta + epsilon inside the boundary layer (outside
        zeta' = 0), over one step with ||S s|| and b held.

        Args:
            dt_s: step.
            norm_s: ||S s||.
            b: as for `rho`.
            held: H only leaks, because the actuators were saturated in the last tick, whose effect this tick's s is.
        """
        if norm_s < self.varpi:
            c = 1.0 + self._bound(b) * norm_s
            decay = math.exp(-c * dt_s)
            self.zeta = decay * self.zeta + (1.0 - decay) * self._epsilon / c
        drive = 0.0 if held else norm_s
        h = []
        for i, nu in enumerate(self._nu):
            decay = math.exp(-nu * dt_s)
            h.append(decay * self.h[i] + (1.0 - decay) / nu * drive * b[i])
        if self._h_max is not None:
            h = [min(grown, most) for grown, most in zip(h, self._h_max, strict=True)]
        self.h = (h[0], h[1], h[2], h[3])

    def _bound(self, b: Vec4) -> float:
        """Return H . b, the estimated bound of ||E|| (eq. up_bound_E)."""
        h, (b0, b1, b2, b3) = self.h, b
        return h[0] * b0 + h[1] * b1 + h[2] * b2 + h[3] * b3
