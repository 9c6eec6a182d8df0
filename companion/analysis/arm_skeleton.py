"""Positions of the arm's joints for any joint angles."""

from __future__ import annotations

import numpy as np
import numpy.typing as npt

from companion.model.arm_skeleton import ArmSkeleton
from companion.model.types import Vec3

Array = npt.NDArray[np.float64]


def pose(arm: ArmSkeleton, arm_rad: Array) -> tuple[Array, Array]:
    """Return the arm at the given angles.

    Args:
        arm_rad: joint angles, shape (N, joints).

    Returns:
        Positions of the joints and of the tip, shape (N, joints + 1, 3), m, and the joints' axes, shape (N, joints, 3), both in
        the body frame.
    """
    count = len(arm_rad)
    turned = np.broadcast_to(np.eye(3), (count, 3, 3))
    points = [np.broadcast_to(np.array(arm.shoulder_body_m), (count, 3))]
    axes = []
    for link, axis, angle in zip(arm.links_body_m, arm.joint_axes, arm_rad.T, strict=True):
        axes.append(turned @ np.array(axis))
        turned = turned @ _rotations(axis, angle)
        points.append(points[-1] + turned @ np.array(link))
    return np.stack(points, axis=1), np.stack(axes, axis=1) if axes else np.zeros((count, 0, 3))


def _rotations(axis: Vec3, angle_rad: Array) -> Array:
    """Return the rotation matrices about an axis, shape (N, 3, 3), by Rodrigues' formula."""
    x, y, z = axis
    across = np.array([[0.0, -z, y], [z, 0.0, -x], [-y, x, 0.0]])
    sin, versine = np.sin(angle_rad)[:, None, None], (1.0 - np.cos(angle_rad))[:, None, None]
    out: Array = np.eye(3) + sin * across + versine * (across @ across)
    return out
