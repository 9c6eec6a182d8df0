"""Simulates the poses of an incorrectly configured motion-capture server.

The rotation of a rigid body is zero at the attitude that the vehicle had when the body was created, and it is expressed in the axes of
the stream. The nose is assumed to have pointed along the stream's x axis at that time if that axis is level, otherwise along the true x
axis.
"""

from __future__ import annotations

import math

from companion.model.frames import quat_conjugate, quat_from_euler_zyx, quat_multiply
from companion.model.types import Quat, Vec3
from companion.sitl_config.world import World

_PLACE = {"x": 0, "y": 1, "z": 2}


class MocapMisalignment:
    """Converts true to streamed poses: p_s = A p, R_s = A R Z A^T; A is `world.mocap_axes`, Z the body's zero error."""

    def __init__(self, config: World) -> None:
        names = config.mocap_axes
        self._index = tuple(_PLACE[name[-1]] for name in names)
        self._sign = tuple(-1.0 if name[0] == "-" else 1.0 for name in names)
        rows = [
            [s if column == i else 0.0 for column in range(3)] for i, s in zip(self._index, self._sign, strict=True)
        ]
        (a, b, c), (d, e, f), (g, h, i) = rows
        self._mirror = a * (e * i - f * h) - b * (d * i - f * g) + c * (d * h - e * g)
        nose_yaw_rad = math.atan2(b, a) if c == 0.0 else 0.0
        roll_deg, pitch_deg = config.mocap_body_tilt_deg
        yaw_deg = config.mocap_body_yaw_deg
        if config.mocap.on:
            roll_deg, pitch_deg = roll_deg + config.mocap.body_tilt_deg[0], pitch_deg + config.mocap.body_tilt_deg[1]
            yaw_deg += config.mocap.body_yaw_deg
        off = quat_from_euler_zyx(math.radians(roll_deg), math.radians(pitch_deg), math.radians(yaw_deg))
        self._zero = quat_multiply(off, quat_conjugate(quat_from_euler_zyx(0.0, 0.0, nose_yaw_rad)))

    @classmethod
    def of(cls, config: World) -> MocapMisalignment | None:
        """Return the misalignment of this configuration, or None if there is none."""
        upright = (config.mocap_axes, config.mocap_body_yaw_deg, config.mocap_body_tilt_deg)
        return None if upright == (("x", "y", "z"), 0.0, (0.0, 0.0)) and not config.mocap.on else cls(config)

    def pose(self, position_world_m: Vec3, attitude_wxyz: Quat) -> tuple[Vec3, Quat]:
        """Return the position (m) and attitude that the server streams for this true pose."""
        w, x, y, z = quat_multiply(attitude_wxyz, self._zero)
        x, y, z = self.position((x, y, z))
        m = self._mirror
        return self.position(position_world_m), (w, m * x, m * y, m * z)

    def position(self, v: Vec3) -> Vec3:
        """Return the position (m) that the server streams for this true position."""
        i, j, k = self._index
        a, b, c = self._sign
        return (a * v[i], b * v[j], c * v[k])
