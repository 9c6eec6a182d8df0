"""Detects that the closed loop oscillates: the position error swings to and fro while the tilt follows it. Pure.

Slow swings are large. Fast ones move the vehicle little and tilt it much: 17 deg of tilt within 6 cm, at 1.3 Hz.

A loop with too much delay, or with a gain that is too high, swings about its reference, however small the mean error is. A blow, a gust
or a new reference displaces the vehicle once, and the error dies out within a swing or two.
"""

from __future__ import annotations

import math
from collections import deque
from typing import Final, NamedTuple

TURNS: Final = 4
"""Number of turning points within the window: two whole periods."""


class Kind(NamedTuple):
    """What counts as one kind of oscillation."""

    share: float
    """Smallest distance between two turning points, as a share of `safety.oscillation_m`."""
    window_s: float
    """Time within which the turning points must lie."""
    rate_rad_s: float
    """Smallest tilt rate (RMS) of an oscillation that the rotors drive. Vibration of a gyroscope alone reaches 0.2."""


KINDS: Final = (Kind(share=1.0, window_s=6.0, rate_rad_s=0.3), Kind(share=0.4, window_s=3.0, rate_rad_s=0.6))
"""Slow and fast. 6 s are three periods of the slowest limit cycle in docs/internals/safety.md, 2 s."""
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
        self._extreme_m: float | None = None
        self._rises = True
        self.turned_s: deque[float] = deque((-math.inf,) * TURNS, maxlen=TURNS)
        """Times of the newest turning points, oldest first."""

    def update(self, t_s: float, error_m: float) -> None:
        """Update with the error of one tick."""
        if self._extreme_m is None:  # after a chase the error does not begin at 0
            self._extreme_m = error_m
        beyond_m = error_m - self._extreme_m if self._rises else self._extreme_m - error_m
        if beyond_m > 0.0:
            self._extreme_m = error_m
        elif beyond_m < -self._swing_m:
            self._extreme_m, self._rises = error_m, not self._rises
            self.turned_s.append(t_s)


class Oscillation:
    """Watches the horizontal position error and the tilt rate.

    Args:
        swing_m: distance between two turning points of a slow swing, `safety.oscillation_m`.
    """

    def __init__(self, swing_m: float) -> None:
        self._kinds = [(kind, kind.share * swing_m) for kind in KINDS]
        self._swings = [(Swings(least_m), Swings(least_m)) for _, least_m in self._kinds]
        self._rate_2 = 0.0
        self.swing_m = swing_m
        """Distance between two turning points that the swings exceed while the vehicle oscillates."""
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
        self.rate_rad_s = None
        for (kind, least_m), (x, y) in zip(self._kinds, self._swings, strict=True):
            x.update(t_s, error_m[0])
            y.update(t_s, error_m[1])
            lasts = t_s - max(x.turned_s[0], y.turned_s[0]) <= kind.window_s
            if lasts and self.rate_rad_s is None and self._rate_2 > kind.rate_rad_s * kind.rate_rad_s:
                self.swing_m, self.rate_rad_s = least_m, math.sqrt(self._rate_2)
