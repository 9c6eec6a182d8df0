"""PD control of the joints: holds or folds the arm while the control law does not run (on the ground, after an abort)."""

from __future__ import annotations

from companion.control.manipulator import Manipulator
from companion.model.types import Joints, Quat

STIFFNESS_NM_RAD = 5.0
DAMPING_NMS_RAD = 0.45


def hold_torque_nm(
    manipulator: Manipulator,
    angle_rad: Joints,
    rate_rad_s: Joints,
    target_rad: Joints,
    target_rate_rad_s: Joints,
    attitude: Quat,
) -> Joints:
    """Return the joint torques towards the target, N m, with nominal gravity compensation."""
    gravity = manipulator.gravity_torque_nm(angle_rad, attitude)
    torque = [
        g + STIFFNESS_NM_RAD * (target - angle) + DAMPING_NMS_RAD * (target_rate - rate)
        for g, angle, rate, target, target_rate in zip(
            gravity, angle_rad, rate_rad_s, target_rad, target_rate_rad_s, strict=True
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
