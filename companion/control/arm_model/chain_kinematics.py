"""Positions and attitudes of the links of any arm, in the body frame."""

from __future__ import annotations

import math

from companion.model.algebra import mat_mat, mat_vec
from companion.model.arm_chain import ArmChain, ChainLink
from companion.model.frames import rotation_matrix
from companion.model.types import Joints, Mat3, Vec3

Frame = tuple[Mat3, Vec3, Vec3]
"""Rotation matrix from a link's frame to the body, and position and axis of its joint in the body frame."""
_IDENTITY: Mat3 = ((1.0, 0.0, 0.0), (0.0, 1.0, 0.0), (0.0, 0.0, 1.0))


class ChainKinematics:
    """Forward kinematics of a chain."""

    def __init__(self, chain: ArmChain) -> None:
        self._joints = tuple([(link.position_m, link.axis, *_turning(link)) for link in chain.links])
        self._tip_m = chain.tip_m
        self._angle_rad: Joints | None = None
        self._frames: list[Frame] = []

    def frames(self, angle_rad: Joints) -> list[Frame]:
        """Return the frame of every link. The result for the same tuple object is computed once.

        Raises:
            ValueError: the number of angles is not that of the joints.
        """
        if angle_rad is self._angle_rad:
            return self._frames
        rotation: Mat3 = _IDENTITY
        x, y, z = 0.0, 0.0, 0.0
        frames: list[Frame] = []
        for (position, axis, fixed, by_sin, by_cos), angle in zip(self._joints, angle_rad, strict=True):
            dx, dy, dz = mat_vec(rotation, position)
            x, y, z = x + dx, y + dy, z + dz
            rotation = mat_mat(rotation, _mixed(fixed, by_sin, by_cos, math.sin(angle), math.cos(angle)))
            frames.append((rotation, (x, y, z), mat_vec(rotation, axis)))
        self._angle_rad, self._frames = angle_rad, frames
        return frames

    def tip_m(self, frames: list[Frame]) -> Vec3:
        """Return the tip in the body frame."""
        if not frames:
            return self._tip_m
        rotation, (x, y, z), _ = frames[-1]
        dx, dy, dz = mat_vec(rotation, self._tip_m)
        return (x + dx, y + dy, z + dz)


def _turning(link: ChainLink) -> tuple[Mat3, Mat3, Mat3]:
    """Return A, B and C: the rotation from the link's frame to the one before is A + B sin(angle) + C cos(angle).

    Rodrigues' formula: R_0 (a a' + [a]x sin + (I - a a') cos) with the axis a.
    """
    x, y, z = link.axis
    along: Mat3 = ((x * x, x * y, x * z), (y * x, y * y, y * z), (z * x, z * y, z * z))
    skew: Mat3 = ((0.0, -z, y), (z, 0.0, -x), (-y, x, 0.0))
    across: Mat3 = (
        (1.0 - x * x, -x * y, -x * z),
        (-y * x, 1.0 - y * y, -y * z),
        (-z * x, -z * y, 1.0 - z * z),
    )
    at_zero = rotation_matrix(link.attitude_wxyz)
    return mat_mat(at_zero, along), mat_mat(at_zero, skew), mat_mat(at_zero, across)


def _mixed(fixed: Mat3, by_sin: Mat3, by_cos: Mat3, s: float, c: float) -> Mat3:
    """Return A + B s + C c."""
    (a0, a1, a2), (a3, a4, a5), (a6, a7, a8) = fixed
    (b0, b1, b2), (b3, b4, b5), (b6, b7, b8) = by_sin
    (c0, c1, c2), (c3, c4, c5), (c6, c7, c8) = by_cos
    return (
        (a0 + b0 * s + c0 * c, a1 + b1 * s + c1 * c, a2 + b2 * s + c2 * c),
        (a3 + b3 * s + c3 * c, a4 + b4 * s + c4 * c, a5 + b5 * s + c5 * c),
        (a6 + b6 * s + c6 * c, a7 + b7 * s + c7 * c, a8 + b8 * s + c8 * c),
    )
