"""Pull of the tether, estimated from the residual force on the vehicle.

The residual is the disturbance of the whole vehicle minus the force at the net: a caught payload is in both and cancels. The rest
is wind, errors of the thrust model, and the tether. Errors of the thrust lie along the rotors' axis, nearly vertical, so the
vertical part of the residual has less weight than the horizontal part: the pull is the weighted least-squares fit of a force along
the line. For the same reason a payload is not mistaken for the tether when the force sensor is lost: it only pulls down, whereas a
pull along the line also has a horizontal part.

Two facts distinguish the tether from wind. At the take-off the tether is slack, so that the mean residual, followed slowly, is wind and
model error, and only what exceeds it can be a pull. And a line that pulls holds the vehicle: one that moves along the force, in either
direction, is not held. A force that motion has refuted is wind that goes on, or an error of the model that ends with the motion: the
rest is a pull only if neither explains it.
"""

from __future__ import annotations

import math
from typing import Final

from companion.config.tether import Tether
from companion.model.types import Vec3

HORIZONTAL_N = 0.7
"""Standard deviation of the horizontal residual without a tether: air flow in the room, drag, tilt errors."""
VERTICAL_N = 2.0
"""Standard deviation of the vertical residual: 7 % of the hover thrust."""
CERTAIN: Final = 3.0
"""Number of standard deviations of the fit from which a pull is accepted as one."""
RELEASE: Final = 0.6
"""A pull ends when it falls below this fraction of its threshold."""
SIDEWAYS_N: Final = 6.0
"""A horizontal residual of this size in any direction means that something other than the anchor holds the vehicle."""
_FLAT: Final = 1.0 / HORIZONTAL_N**2
_STEEP: Final = 1.0 / VERTICAL_N**2
AMBIENT_S: Final = 5.0
"""Time constant of the mean residual that is not a pull."""
FREE_M: Final = 0.15
"""Distance moved along a force, or against it, that shows that no line exerts it: a stiff one yields by a few centimetres."""


class PullEstimate:
    """Estimates the pull from the low-passed residual and decides, with hysteresis, whether the tether pulls.

    Args:
        tether: thresholds and time constants.
    """

    def __init__(self, tether: Tether) -> None:
        self._min_n = tether.pull_min_n
        self._filter_s = tether.pull_filter_s
        self._after_s = tether.pull_time_s
        self.forget()

    def forget(self) -> None:
        """Discard the estimate."""
        self._f: Vec3 = (0.0, 0.0, 0.0)
        self._ambient: Vec3 = (0.0, 0.0, 0.0)
        """Mean residual while nothing pulls."""
        self._refuted: Vec3 = (0.0, 0.0, 0.0)
        """What motion has refuted of late; it is part of `_ambient`, and fades."""
        self._learned_s = 0.0
        self._pull_s = self._side_s = 0.0
        self._moved_m = 0.0
        """Distance that the vehicle has moved along the present pull."""
        self.pull_n = 0.0
        """Pull towards the anchor, or the whole horizontal pull while there is one in any direction."""
        self.pulling = False
        """Whether there is a pull towards the anchor."""
        self.sideways = False
        """Whether there is a horizontal pull in any direction."""

    def update(
        self,
        dt_s: float,
        towards_anchor: Vec3,
        velocity_world_m_s: Vec3,
        disturbance_world_n: Vec3 | None,
        tool_force_world_n: Vec3 | None,
    ) -> None:
        """Update the pull; `towards_anchor` is the unit vector from the attachment to the anchor; forces are in the world frame, N."""
        if disturbance_world_n is None:
            if self._learned_s > 0.0:
                self.forget()
            return
        rx, ry, rz = disturbance_world_n
        if tool_force_world_n is not None:
            rx -= tool_force_world_n[0]
            ry -= tool_force_world_n[1]
            rz -= tool_force_world_n[2]
        ax, ay, az = self._ambient
        rx, ry, rz = rx - ax, ry - ay, rz - az
        if self._pull_s == 0.0 and self._side_s == 0.0:
            self._moved_m = 0.0
            self._learned_s = min(AMBIENT_S, self._learned_s + dt_s)
            gain = dt_s / self._learned_s if self._learned_s > 0.0 else 0.0
            self._ambient = (ax + gain * rx, ay + gain * ry, az + gain * rz)
        gain = dt_s / (self._filter_s + dt_s)
        fx, fy, fz = self._f
        ux, uy, uz = fx + gain * (rx - fx), fy + gain * (ry - fy), fz + gain * (rz - fz)
        self._f = (ux, uy, uz)
        faded = max(0.0, 1.0 - dt_s / AMBIENT_S)
        qx, qy, qz = self._refuted
        self._refuted = qx, qy, qz = faded * qx, faded * qy, faded * qz
        ends = (ux + qx) ** 2 + (uy + qy) ** 2 + (uz + qz) ** 2 < ux * ux + uy * uy + uz * uz
        fx, fy, fz = (ux + qx, uy + qy, uz + qz) if ends else (ux, uy, uz)
        ux, uy, uz = towards_anchor
        weight = (ux * ux + uy * uy) * _FLAT + uz * uz * _STEEP
        if weight <= 0.0:
            return  # at the anchor: no direction
        pull = ((ux * fx + uy * fy) * _FLAT + uz * fz * _STEEP) / weight
        least = max(self._min_n, CERTAIN / math.sqrt(weight))
        self._pull_s = self._pull_s + dt_s if pull > (RELEASE * least if self.pulling else least) else 0.0
        self.pulling = self._pull_s > 0.0 and (self.pulling or self._pull_s >= self._after_s)
        side_2 = fx * fx + fy * fy
        limit = RELEASE * SIDEWAYS_N if self.sideways else SIDEWAYS_N
        self._side_s = self._side_s + dt_s if side_2 > limit * limit else 0.0
        self.sideways = self._side_s > 0.0 and (self.sideways or self._side_s >= self._after_s)
        self.pull_n = max(pull, math.sqrt(side_2)) if self.sideways else pull
        if self._pull_s > 0.0 or self._side_s > 0.0:
            vx, vy, vz = velocity_world_m_s
            self._moved_m += dt_s * (vx * fx + vy * fy + vz * fz) / math.sqrt(side_2 + fz * fz)
            if not (self.pulling or self.sideways or -FREE_M < self._moved_m < FREE_M):
                (ax, ay, az), (fx, fy, fz), (qx, qy, qz) = self._ambient, self._f, self._refuted
                self._ambient, self._refuted = (ax + fx, ay + fy, az + fz), (qx + fx, qy + fy, qz + fz)
                self._f, self.pull_n = (0.0, 0.0, 0.0), 0.0
                self._pull_s = self._side_s = 0.0
