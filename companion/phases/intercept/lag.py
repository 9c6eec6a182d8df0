"""How body and tilt follow the reference's acceleration: through lags. Pure."""

from __future__ import annotations

import math
import operator
from collections.abc import Sequence
from typing import Final

from companion.model.codec import Record
from companion.model.types import Vec3

LAG_S: Final = 0.12
"""Time constant of each of the lags through which body and tilt follow the reference's acceleration."""
BODY_S2 = (0.0, -0.051, 0.182, -0.421, 0.274)
"""Displacement of the body from its reference per acceleration after one to five lags, horizontally."""
TILT_S2_M = (0.0, 0.050, 0.174, 0.186, -0.337)
"""Slope of the body's tilt, the same. These were identified in the fast loop, in other laboratories than those of the figures."""


class Lag(Record, frozen=True):
    """The reference's horizontal acceleration after one to five lags of `LAG_S`: how body and tilt follow it."""

    x_m_s2: tuple[float, ...] = (0.0,) * len(BODY_S2)
    y_m_s2: tuple[float, ...] = (0.0,) * len(BODY_S2)

    def after(self, dt_s: float, acceleration_m_s2: Vec3) -> Lag:
        """Return the lags after a tick with this acceleration."""
        x, y, _ = acceleration_m_s2
        return Lag(_lagging(self.x_m_s2, x, dt_s), _lagging(self.y_m_s2, y, dt_s))

    def net_m(self, drop_m: float, ahead_m: tuple[float, float]) -> Vec3:
        """Return the displacement of the net from where it hangs at the reference.

        Args:
            drop_m: distance of the net below the body's origin by which it swings.
            ahead_m: horizontal position of the net relative to the body, world frame.
        """
        (x, y), (u, v) = self.slopes(), self.body_m()
        return (u - drop_m * x, v - drop_m * y, -ahead_m[0] * x - ahead_m[1] * y)

    def body_m(self) -> tuple[float, float]:
        """Return the horizontal displacement of the body from its reference, world frame."""
        return sum(map(operator.mul, BODY_S2, self.x_m_s2)), sum(map(operator.mul, BODY_S2, self.y_m_s2))

    def body_m_s(self, acceleration_m_s2: Vec3) -> tuple[float, float]:
        """Return the horizontal velocity of the body relative to its reference, which accelerates like this, world frame."""
        x, y, _ = acceleration_m_s2
        return _weighed_rate(self.x_m_s2, x), _weighed_rate(self.y_m_s2, y)

    def slopes(self) -> tuple[float, float]:
        """Return the slopes of the body's tilt, world frame."""
        return sum(map(operator.mul, TILT_S2_M, self.x_m_s2)), sum(map(operator.mul, TILT_S2_M, self.y_m_s2))


def _lagging(values: tuple[float, ...], followed: float, dt_s: float) -> tuple[float, ...]:
    share = dt_s / LAG_S
    a, b, c, d, e = values
    a += share * (followed - a)
    b += share * (a - b)
    c += share * (b - c)
    d += share * (c - d)
    return a, b, c, d, e + share * (d - e)


def _weighed_rate(values: tuple[float, ...], followed: float) -> float:
    total = 0.0
    for weight, value in zip(BODY_S2, values, strict=True):
        total += weight * (followed - value)
        followed = value
    return total / LAG_S


def fading(values: Sequence[float], weights: Sequence[float]) -> list[float]:
    """Return the coefficients with which `faded` gives the weighted sum of the lags a time later, if the acceleration ends."""
    count = len(values)
    return [sum([weights[n] * values[n - k] for n in range(k, count)]) / math.factorial(k) for k in range(count)]


def faded(coefficients: Sequence[float], h: float) -> float:
    """Return the weighted sum of the lags a time after the end of the acceleration."""
    total, u = 0.0, h / LAG_S
    for coefficient in reversed(coefficients):
        total = total * u + coefficient
    return total * math.exp(-u)


def impulse_1_s(weights: tuple[float, ...], left_s: float) -> float:
    """Return the weighted sum of the lags' responses to an impulse of acceleration, a time after it."""
    return faded([weight / math.factorial(n) for n, weight in enumerate(weights)], left_s) / LAG_S
