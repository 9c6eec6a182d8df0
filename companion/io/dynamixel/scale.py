"""Conversion between the servos' units and joint angles, rates and torques; it computes in every tick, so it can be compiled."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Final

from companion.model.servos import COUNTS_PER_TURN, RPM_PER_COUNT

RAD_PER_COUNT: Final = 2.0 * math.pi / COUNTS_PER_TURN
RAD_S_PER_COUNT: Final = RPM_PER_COUNT * 2.0 * math.pi / 60.0


@dataclass(frozen=True, slots=True)
class JointScale:
    """Conversion between one servo's register units and the paper's joint angle."""

    sign: int
    zero_count: int
    """Present position at joint angle 0, including whole turns of the encoder."""
    torque_nm_per_count: float
    current_max_counts: int

    def angle_rad(self, position_count: int) -> float:
        """Return the joint angle, rad."""
        return self.sign * (position_count - self.zero_count) * RAD_PER_COUNT

    def velocity_rad_s(self, velocity_count: int) -> float:
        """Return the joint velocity, rad/s."""
        return self.sign * velocity_count * RAD_S_PER_COUNT

    def torque_nm(self, current_count: int) -> float:
        """Return the joint torque that a current produces, N m."""
        return self.sign * current_count * self.torque_nm_per_count

    def current_counts(self, torque_nm: float) -> int:
        """Return the goal current for a joint torque, rounded and clipped.

        Raises:
            ValueError: the torque is not finite.
        """
        if not math.isfinite(torque_nm):
            raise ValueError(f"joint torque {torque_nm} is not finite")
        limit = self.current_max_counts
        return max(-limit, min(limit, round(self.sign * torque_nm / self.torque_nm_per_count)))
