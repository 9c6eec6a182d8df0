"""The target impedance: error coordinates, external torque, and the auxiliary state gamma (paper, eqs. s_general to I_cl).

Corrected as printed in docs/control-law.md: gamma' = M_d^-1 (e_tau - D gamma) with D = K_d - M_d Phi, gamma(0) = 0.
"""

from __future__ import annotations

import math
from collections.abc import Sequence

from companion.config.controller import AdaptiveConfig


class LowPass:
    """First-order low-pass of a vector, exact for a held input; starts at its first sample."""

    def __init__(self, cutoff_hz: float) -> None:
        self._w = 2.0 * math.pi * cutoff_hz
        self._value: list[float] | None = None

    def step(self, dt_s: float, sample: Sequence[float]) -> list[float]:
        """Filtered vector."""
        if self._value is None:
            self._value = list(sample)
        else:
            k = 1.0 - math.exp(-self._w * dt_s)
            self._value = [v + k * (s - v) for v, s in zip(self._value, sample, strict=True)]
        return self._value

    def reset(self, value: Sequence[float]) -> None:
        """Set the filter's state."""
        self._value = list(value)


class Impedance:
    """gamma and s of the target impedance M_d e'' + K_d e' + K_p e = e_tau."""

    def __init__(self, config: AdaptiveConfig) -> None:
        self.inertia = config.inertia_md
        self.phi = config.phi
        self.d = tuple(
            kd - md * phi for kd, md, phi in zip(config.damping_kd, config.inertia_md, config.phi, strict=True)
        )
        self._rate = [d / md for d, md in zip(self.d, self.inertia, strict=True)]
        self.gamma = [0.0] * 8

    def sliding(self, error: Sequence[float], error_rate: Sequence[float]) -> list[float]:
        """s = e' + Phi e - gamma (eq. s_general)."""
        return [
            rate + phi * e - gamma for rate, phi, e, gamma in zip(error_rate, self.phi, error, self.gamma, strict=True)
        ]

    def advance(self, dt_s: float, e_tau: Sequence[float]) -> None:
        """gamma over one step with e_tau held (eq. adaptive_1, corrected; exact)."""
        for i, (rate, d) in enumerate(zip(self._rate, self.d, strict=True)):
            decay = math.exp(-rate * dt_s)
            self.gamma[i] = decay * self.gamma[i] + (1.0 - decay) / d * e_tau[i]
