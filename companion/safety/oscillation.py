"""Detects that the closed loop oscillates: the position error swings to and fro while the tilt follows it. Pure.

A loop with too much delay, or with a gain that is too high, swings about its reference, however small the mean error is. A blow, a gust
or a new reference displaces the vehicle once, and the error dies out within a swing or two.
"""

from __future__ import annotations

import math
from collections import deque
from typing import Final

TURNS: Final = 4
"""Number of turning points within `WINDOW_S`: two whole periods."""
WINDOW_S: Final = 6.0
"""Three periods of the slowest limit cycle in docs/internals/safety.md, 2 s."""
RATE_RAD_S: Final = 0.3
"""Tilt rate (RMS) of an oscillation that the rotors drive. Vibration of a gyroscope alone reaches 0.2."""
RATE_TIME_S: Final = 1.0
"""Time constant of the mean square of the tilt rate."""


class Swings:
    """Turning points of one component of the position error.

    Args:
        swing_m: distance between two successive turning points; smaller motions are ignored.
    """

    __slots__ = ("_extreme_m", "_rises", "_swing_m", "turned_s")

    def __init__(self, swing_m: float) -> None:
        self._swing_m = swing_m
        self._extreme_m, self._rises = 0.0, True
        self.turned_s: deque[float] = deque((-math.inf,) * TURNS, maxlen=TURNS)
        """Times of the newest turning points, oldest first."""

    def update(self, t_s: float, error_m: float) -> None:
        """Update with the error of one tick."""
        beyond_m = error_m - self._extreme_m if self._rises else self._extreme_m - error_m
        if beyond_m > 0.0:
            self._extreme_m = error_m
        elif beyond_m < -self._swing_m:
            self._extreme_m, self._rises = error_m, not self._rises
            self.turned_s.append(t_s)


class Oscillation:
    """Watches the horizontal position error and the tilt rate.

    Args:
        swing_m: distance between two turning points that counts as a swing, `safety.oscillation_m`.
    """

    def __init__(self, swing_m: float) -> None:
        self._x, self._y = Swings(swing_m), Swings(swing_m)
        self._rate_2 = 0.0
        self.rate_rad_s: float | None = None
        """Tilt rate (RMS) while the vehicle oscillates; else None."""

    def update(self, t_s: float, dt_s: float, error_m: tuple[float, float], rate_rad_s: tuple[float, float]) -> None:
        """Update with one tick in which the control law flies.

        Args:
            t_s: flight clock.
            dt_s: time since the previous tick.
            error_m: position error, x and y of the world frame.
            rate_rad_s: angular rate about x and y of the body frame.
        """
        p, q = rate_rad_s
        self._rate_2 += dt_s / (RATE_TIME_S + dt_s) * (p * p + q * q - self._rate_2)
        self._x.update(t_s, error_m[0])
        self._y.update(t_s, error_m[1])
        begun_s = max(self._x.turned_s[0], self._y.turned_s[0])
        found = t_s - begun_s <= WINDOW_S and self._rate_2 > RATE_RAD_S * RATE_RAD_S
        self.rate_rad_s = math.sqrt(self._rate_2) if found else None
