"""Joints and links of an arm as lines, for drawing and for clearances."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

from companion.model.arm_chain import ArmChain
from companion.model.frames import quat_from_euler_zyx, quat_multiply, quat_rotate
from companion.model.types import IDENTITY_QUAT, Quat, Vec3


@dataclass(frozen=True, slots=True)
class ArmSkeleton:
    """Joints and links of an arm in the body frame, with all joint angles at 0. Joint i turns everything after it about its axis."""

    shoulder_body_m: Vec3
    links_body_m: tuple[Vec3, ...]
    """Vector from each joint to the next one; of the last link, to the tip."""
    joint_axes: tuple[Vec3, ...]
    """Unit vectors about which positive angles turn by the right-hand rule."""

    @property
    def is_in_xz_plane(self) -> bool:
        """Whether the arm moves in a plane parallel to the body's x-z plane."""
        return all(abs(y) < 1e-9 for _, y, _ in self.links_body_m) and all(
            math.hypot(x, z) < 1e-9 for x, _, z in self.joint_axes
        )

    @property
    def reach_m(self) -> float:
        """Largest possible distance of the tip from the first joint."""
        return sum(math.hypot(*link) for link in self.links_body_m)


NO_ARM = ArmSkeleton((0.0, 0.0, 0.0), (), ())


def skeleton_of(chain: ArmChain) -> ArmSkeleton:
    """Return the skeleton of a chain."""
    return _skeleton([(link.position_m, link.attitude_wxyz, link.axis) for link in chain.links], chain.tip_m)


def logged_skeleton(vehicle: Any) -> ArmSkeleton | None:
    """Return the skeleton of arm and tool in the section `vehicle` of a logged configuration; None if it has no valid arm."""
    arm = vehicle.get("arm") if isinstance(vehicle, dict) else None
    if not isinstance(arm, dict):
        return None
    tool = vehicle.get("tool")
    rod_m: Any = tool.get("length_m") if isinstance(tool, dict) else None
    rod: Vec3 = (float(rod_m) if _are_numbers([rod_m]) else 0.0, 0.0, 0.0)
    links = arm.get("links")
    if links:
        joints = [_logged_link(link) for link in links] if isinstance(links, list | tuple) else [None]
        tip = _vector(arm.get("tip_m", (0.0, 0.0, 0.0)))
        rpy_deg = _vector(arm.get("tip_rpy_deg", (0.0, 0.0, 0.0)))
        if tip is None or rpy_deg is None or None in joints:
            return None
        roll, pitch, yaw = map(math.radians, rpy_deg)
        x, y, z = quat_rotate(quat_from_euler_zyx(roll, pitch, yaw), rod)
        tip = (tip[0] + x, tip[1] + y, tip[2] + z)
        return _skeleton([joint for joint in joints if joint is not None], tip)
    shoulder = _vector(arm.get("shoulder_body_m", (0.0, 0.0, 0.0)))
    lengths: Any = arm.get("link_lengths_m")
    if shoulder is None or not _are_numbers(lengths):
        return None
    axes: list[Vec3] = [(0.0, -1.0 if index else 1.0, 0.0) for index in range(len(lengths))]
    for index, joint in enumerate((arm.get("joints") or ())[: len(axes)]):
        axis = _unit(joint.get("axis")) if isinstance(joint, dict) else None
        axes[index] = axis or axes[index]
    vectors: list[Vec3] = [(float(length), 0.0, 0.0) for length in lengths]
    if vectors:
        vectors[-1] = (vectors[-1][0] + rod[0], 0.0, 0.0)
    return ArmSkeleton(shoulder, tuple(vectors), tuple(axes))


def _skeleton(joints: Sequence[tuple[Vec3, Quat, Vec3]], tip: Vec3) -> ArmSkeleton:
    """Return the skeleton of joints with these positions, attitudes and axes in the frames of the links before."""
    if not joints:
        return NO_ARM
    attitude, vectors, axes = IDENTITY_QUAT, [], []
    for position, at_zero, axis in joints:
        vectors.append(quat_rotate(attitude, position))
        attitude = quat_multiply(attitude, at_zero)
        axes.append(quat_rotate(attitude, axis))
    return ArmSkeleton(vectors[0], (*vectors[1:], quat_rotate(attitude, tip)), tuple(axes))


def _logged_link(link: Any) -> tuple[Vec3, Quat, Vec3] | None:
    if not isinstance(link, dict):
        return None
    origin, axis = _vector(link.get("origin_m")), _unit(link.get("axis"))
    rpy_deg = _vector(link.get("origin_rpy_deg", (0.0, 0.0, 0.0)))
    if origin is None or axis is None or rpy_deg is None:
        return None
    roll, pitch, yaw = map(math.radians, rpy_deg)
    return origin, quat_from_euler_zyx(roll, pitch, yaw), axis


def _are_numbers(values: Any) -> bool:
    return isinstance(values, list | tuple) and all(
        type(value) in (int, float) and math.isfinite(value) for value in values
    )


def _vector(values: Any) -> Vec3 | None:
    if not _are_numbers(values) or len(values) != 3:
        return None
    x, y, z = values
    return (x, y, z)


def _unit(values: Any) -> Vec3 | None:
    vector = _vector(values)
    if vector is None or not (norm := math.hypot(*vector)) > 0.0:
        return None
    return (vector[0] / norm, vector[1] / norm, vector[2] / norm)
