"""The last look at everything that leaves: finite, in range, fresh. A bad command never leaves."""

from __future__ import annotations

import math
from dataclasses import dataclass

from companion.config.vehicle import Vehicle
from companion.frames import tilt_rad
from companion.types import AttitudeSetpoint, Vec2


@dataclass(frozen=True, slots=True)
class Verdict:
    """What may leave, and why the rest may not."""

    attitude: AttitudeSetpoint | None
    arm_torque_nm: Vec2 | None
    refused: tuple[str, ...]


class Gate:
    """Pure check of one tick's commands against the vehicle file."""

    def __init__(self, vehicle: Vehicle) -> None:
        self._tilt_max_rad = math.radians(vehicle.airframe.tilt_max_deg) + 1e-6
        self._torque_max_nm = (vehicle.arm.joints[0].torque_max_nm, vehicle.arm.joints[1].torque_max_nm)
        walls = [joint.angle_deg for joint in vehicle.arm.joints]
        self._walls_rad = [(math.radians(low), math.radians(high)) for low, high in walls]

    def check(
        self, attitude: AttitudeSetpoint | None, arm_torque_nm: Vec2 | None, arm_rad: Vec2 | None, arm_fresh: bool
    ) -> Verdict:
        """The commands that may leave.

        Args:
            attitude: wanted setpoint.
            arm_torque_nm: wanted joint torques.
            arm_rad: joint angles now; None if unknown.
            arm_fresh: the joint state is fresh enough to close a loop on.
        """
        refused = []
        if attitude is not None:
            reason = self._attitude_fault(attitude)
            if reason:
                refused.append(reason)
                attitude = None
        if arm_torque_nm is not None:
            if not all(math.isfinite(t) for t in arm_torque_nm):
                refused.append(f"joint torque {arm_torque_nm} is not finite")
                arm_torque_nm = None
            elif arm_rad is None or not arm_fresh:
                refused.append("joint torque without a fresh joint state")
                arm_torque_nm = None
            else:
                arm_torque_nm = self._within_walls(arm_torque_nm, arm_rad)
        return Verdict(attitude, arm_torque_nm, tuple(refused))

    def _attitude_fault(self, setpoint: AttitudeSetpoint) -> str | None:
        q = setpoint.attitude_wxyz
        if not all(math.isfinite(value) for value in (*q, setpoint.thrust)):
            return "attitude setpoint is not finite"
        if abs(math.sqrt(sum(value * value for value in q)) - 1.0) > 1e-3:
            return "attitude setpoint is no unit quaternion"
        if not 0.0 <= setpoint.thrust <= 1.0:
            return f"thrust {setpoint.thrust:.3f} is outside 0 to 1"
        if tilt_rad(q) > self._tilt_max_rad:
            return f"tilt setpoint {math.degrees(tilt_rad(q)):.1f} deg is above the limit"
        return None

    def _within_walls(self, torque_nm: Vec2, arm_rad: Vec2) -> Vec2:
        """Clip to the joint's limit; past a wall only torque that leads back."""
        out = []
        for torque, limit, angle, (low, high) in zip(
            torque_nm, self._torque_max_nm, arm_rad, self._walls_rad, strict=True
        ):
            clipped = max(-limit, min(limit, torque))
            if angle > high:
                clipped = min(clipped, 0.0)
            elif angle < low:
                clipped = max(clipped, 0.0)
            out.append(clipped)
        return (out[0], out[1])
