"""Detects joints that swing: their rates turn round and round with an amplitude that no motion of a mission has."""

from __future__ import annotations

from collections import deque
from typing import Final

from companion.model.types import ArmState

SWING_RAD_S: Final = 2.0
"""Change of a joint's rate from one turning point to the next that counts."""
REVERSALS_MIN: Final = 6
"""Number of reversals of one joint within `WINDOW_S` from which it swings: three periods, 6 Hz. The blow of a payload makes fewer."""
WINDOW_S: Final = 0.5


class JointSwing:
    """Counts the reversals of each joint's rate, whatever the mean rate."""

    def __init__(self) -> None:
        self._direction: list[float] = []
        self._extreme_rad_s: list[float] = []
        self._reversals: list[deque[tuple[float, float]]] = []
        """Time of the newest reversals of each joint, and the rate from which it turned back, rad/s."""

    def update(self, arm: ArmState) -> None:
        """Update with a new joint state."""
        rates_rad_s, t_s = arm.velocity_rad_s, arm.stamp_s
        if len(self._extreme_rad_s) != len(rates_rad_s):
            self._extreme_rad_s = list(rates_rad_s)
            self._direction = [1.0 for _ in rates_rad_s]
            self._reversals = [deque(maxlen=REVERSALS_MIN) for _ in rates_rad_s]
        for joint, rate_rad_s in enumerate(rates_rad_s):
            direction = self._direction[joint]
            back_rad_s = direction * (self._extreme_rad_s[joint] - rate_rad_s)
            if back_rad_s <= 0.0:
                self._extreme_rad_s[joint] = rate_rad_s
            elif back_rad_s >= SWING_RAD_S:
                self._reversals[joint].append((t_s, self._extreme_rad_s[joint]))
                self._direction[joint], self._extreme_rad_s[joint] = -direction, rate_rad_s

    def swinging(self, t_s: float) -> tuple[int, float, float] | None:
        """Return number, frequency in Hz and rate amplitude in rad/s of the first joint that swings; None if none does."""
        for joint, reversals in enumerate(self._reversals):
            if len(reversals) == REVERSALS_MIN and t_s - reversals[0][0] <= WINDOW_S:
                lasted_s = max(reversals[-1][0] - reversals[0][0], 1e-3)
                rates_rad_s = [rate_rad_s for _, rate_rad_s in reversals]
                return joint + 1, 0.5 * (REVERSALS_MIN - 1) / lasted_s, 0.5 * (max(rates_rad_s) - min(rates_rad_s))
        return None
