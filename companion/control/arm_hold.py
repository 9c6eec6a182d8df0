"""PD control of the joints: holds or folds the arm while the control law does not run (on the ground, after an abort)."""

from __future__ import annotations

from typing import Final

from companion.config.vehicle import Vehicle
from companion.control.arm_model import manipulator_of
from companion.control.scaled_gains import joint_ratios
from companion.model.types import Joints, Quat

STIFFNESS_NM_RAD: Final = 5.0
DAMPING_NMS_RAD: Final = 0.45
FOUND_FOR_KG_M2: Joints = (0.01666, 0.01778)
"""Joint inertia, as in `companion.config.controller.Machine`, of the arm with these gains; those of another arm are proportional to its
own, so that its joints do not swing.
"""


class ArmHold:
    """The controller of a vehicle's arm."""

    def __init__(self, vehicle: Vehicle) -> None:
        self._manipulator = manipulator_of(vehicle)
        self.ratios = joint_ratios(vehicle, FOUND_FOR_KG_M2)
        """Factor on the gains of each joint."""
        self._gains = [(STIFFNESS_NM_RAD * ratio, DAMPING_NMS_RAD * ratio) for ratio in self.ratios]

    def gravity_torque_nm(self, angle_rad: Joints, attitude: Quat) -> Joints:
        """Return the nominal gravity torques of the joints, N m."""
        return self._manipulator.gravity_torque_nm(angle_rad, attitude)

    def torque_nm(
        self, angle_rad: Joints, rate_rad_s: Joints, target_rad: Joints, target_rate_rad_s: Joints, attitude: Quat
    ) -> Joints:
        """Return the joint torques towards the target, N m, with nominal gravity compensation."""
        gravity = self.gravity_torque_nm(angle_rad, attitude)
        torque = [
            g + stiffness * (target - angle) + damping * (target_rate - rate)
            for g, (stiffness, damping), angle, rate, target, target_rate in zip(
                gravity, self._gains, angle_rad, rate_rad_s, target_rad, target_rate_rad_s, strict=True
            )
        ]
        return tuple(torque)


def towards(angle_rad: Joints, goal_rad: Joints, step_rad: float) -> Joints:
    """Return the next joint angles on the straight line in joint space to the goal: no joint moves farther than the step."""
    farthest_rad = max((abs(goal - angle) for angle, goal in zip(angle_rad, goal_rad, strict=True)), default=0.0)
    if farthest_rad <= step_rad:
        return goal_rad
    share = step_rad / farthest_rad
    return tuple([angle + share * (goal - angle) for angle, goal in zip(angle_rad, goal_rad, strict=True)])
