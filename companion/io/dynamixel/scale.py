"""Conversion between the servos' units and joint angles, rates and torques; it computes in every tick, so it can be compiled."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Final

from companion.config.arm import Joint
from companion.io.dynamixel.registers import CURRENT_LIMIT
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


def joint_scale(joint: Joint, torque_per_amp_nm_a: float, current_limit_counts: int) -> JointScale:
    """Return the scale of a joint.

    Args:
        current_limit_counts: current limit of its servo (register 38).

    Raises:
        ValueError: the current limit is below what `torque_max_nm` needs.
    """
    torque_nm_per_count = torque_per_amp_nm_a * joint.kind.current_unit_a
    wanted = math.floor(joint.torque_max_nm / torque_nm_per_count + 1e-9)
    if wanted > current_limit_counts:
        raise ValueError(
            f"{CURRENT_LIMIT} is {current_limit_counts}, which is {current_limit_counts * torque_nm_per_count:.2f} N m; "
            f"torque_max_nm {joint.torque_max_nm:g} needs {wanted}: raise the register or lower torque_max_nm"
        )
    return JointScale(joint.sign, joint.zero_count, torque_nm_per_count, wanted)


def turn_offset_counts(joint: Joint, position_count: int) -> int:
    """Return the whole turns, in counts, to add to `zero_count` so that the joint angle lies within its limits, or 0 if none fits.

    The encoder measures the angle within one turn; the servo loses the number of turns when it is switched off. The angle is still
    unambiguous, because the vehicle file has less than one turn between the limits.
    """
    low_deg, high_deg = joint.angle_deg
    angle_deg = joint.sign * (position_count - joint.zero_count) * 360.0 / COUNTS_PER_TURN
    turns = math.ceil((low_deg - angle_deg) / 360.0)
    if angle_deg + 360.0 * turns > high_deg:
        return 0
    return -joint.sign * turns * COUNTS_PER_TURN
