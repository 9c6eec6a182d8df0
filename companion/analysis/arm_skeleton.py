"""Positions of the arm's joints for any joint angles, from the geometry in a logged configuration."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
import numpy.typing as npt

from companion.model.types import Vec3

Array = npt.NDArray[np.float64]


@dataclass(frozen=True, slots=True)
class ArmSkeleton:
    """Joints and links of an arm in the body frame, with all joint angles at 0."""

    shoulder_body_m: Vec3
    links_body_m: tuple[Vec3, ...]
    """Vector from each joint to the next one; of the last link, to the tip."""
    joint_axes: tuple[Vec3, ...]
    """Unit vectors about which positive angles turn by the right-hand rule."""

    def pose(self, arm_rad: Array) -> tuple[Array, Array]:
        """Return the arm at the given angles.

        Args:
            arm_rad: joint angles, shape (N, joints).

        Returns:
            Positions of the joints and of the tip, shape (N, joints + 1, 3), m, and the joints' axes, shape (N, joints, 3), both in
            the body frame.
        """
        count = len(arm_rad)
        turned = np.broadcast_to(np.eye(3), (count, 3, 3))
        points = [np.broadcast_to(np.array(self.shoulder_body_m), (count, 3))]
        axes = []
        for link, axis, angle in zip(self.links_body_m, self.joint_axes, arm_rad.T, strict=True):
            axes.append(turned @ np.array(axis))
            turned = turned @ _rotations(axis, angle)
            points.append(points[-1] + turned @ np.array(link))
        return np.stack(points, axis=1), np.stack(axes, axis=1) if axes else np.zeros((count, 0, 3))


NO_ARM = ArmSkeleton((0.0, 0.0, 0.0), (), ())


def skeleton_of(arm: Any) -> ArmSkeleton | None:
    """Return the skeleton of the section `vehicle.arm` of a configuration; None if it is not a valid arm.

    Links are in line at angle 0; the first joint turns about the body's +y axis, and the others about -y.
    """
    if not isinstance(arm, dict):
        return None
    shoulder, lengths = _numbers(arm.get("shoulder_body_m", (0.0, 0.0, 0.0))), _numbers(arm.get("link_lengths_m"))
    if shoulder is None or len(shoulder) != 3 or lengths is None:
        return None
    return ArmSkeleton(
        shoulder_body_m=(shoulder[0], shoulder[1], shoulder[2]),
        links_body_m=tuple((length, 0.0, 0.0) for length in lengths),
        joint_axes=tuple((0.0, -1.0 if index else 1.0, 0.0) for index in range(len(lengths))),
    )


def _numbers(values: Any) -> Sequence[float] | None:
    if not isinstance(values, list | tuple) or not all(type(value) in (int, float) for value in values):
        return None
    return values


def _rotations(axis: Vec3, angle_rad: Array) -> Array:
    """Return the rotation matrices about an axis, shape (N, 3, 3), by Rodrigues' formula."""
    x, y, z = axis
    across = np.array([[0.0, -z, y], [z, 0.0, -x], [-y, x, 0.0]])
    sin, versine = np.sin(angle_rad)[:, None, None], (1.0 - np.cos(angle_rad))[:, None, None]
    out: Array = np.eye(3) + sin * across + versine * (across @ across)
    return out
