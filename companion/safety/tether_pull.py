"""Pull of the tether, estimated from the residual force on the vehicle.

The residual is the disturbance of the whole vehicle minus the force at the net: a caught payload is in both and cancels. The rest
is wind, errors of the thrust model, and the tether. Errors of the thrust lie along the rotors' axis, nearly vertical, so the
vertical part of the residual has less weight than the horizontal part: the pull is the weighted least-squares fit of a force along
the line. For the same reason a payload is not mistaken for the tether when the force sensor is lost: it only pulls down, whereas a
pull along the line also has a horizontal part.
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
GROWTH_S: Final = 0.3
GROWTH_N_PER_M: Final = 10.0
"""Slope of the pull over the range (the distance to the anchor) from which the line counts as tightening."""
GROWTH_SPREAD_M2: Final = 1e-6
"""Below this variance of the range no slope can be estimated."""


class PullEstimate:
    """Estimates the pull from the low-passed residual and decides, with hysteresis, whether the tether pulls, tightens or is snagged.

    Args:
        tether: thresholds and time constants.
    """

    __slots__ = (
        "_after_s",
        "_cov",
        "_f",
        "_filter_s",
        "_min_n",
        "_pull_mean",
        "_pull_s",
        "_range_mean",
        "_side_s",
        "_var",
        "growing",
        "pull_n",
        "pulling",
        "sideways",
    )

    def __init__(self, tether: Tether) -> None:
        self._min_n = tether.pull_min_n
        self._filter_s = tether.pull_filter_s
        self._after_s = tether.pull_time_s
        self.forget()

    def forget(self) -> None:
        """Discard the estimate."""
        self._f: Vec3 | None = None
        self._pull_s = self._side_s = 0.0
        self._range_mean = self._pull_mean = self._cov = self._var = 0.0
        self.pull_n = 0.0
        self.pulling = False
        """Whether there is a pull towards the anchor."""
        self.sideways = False
        """Whether there is a horizontal pull in any direction."""
        self.growing = False
        """Whether the present pull has grown with the range."""

    def update(
        self,
        dt_s: float,
        towards_anchor: Vec3,
        range_m: float,
        disturbance_world_n: Vec3 | None,
        tool_force_world_n: Vec3 | None,
    ) -> None:
        """Update the pull; `towards_anchor` is the unit vector from the attachment to the anchor; forces are in the world frame, N."""
        if disturbance_world_n is None:
            if self._f is not None:
                self.forget()
            return
        rx, ry, rz = disturbance_world_n
        if tool_force_world_n is not None:
            rx -= tool_force_world_n[0]
            ry -= tool_force_world_n[1]
            rz -= tool_force_world_n[2]
        before = self._f
        if before is None:
            # Not the newest sample, which is mostly noise.
            before = (0.0, 0.0, 0.0)
            self._range_mean = range_m
        gain = dt_s / (self._filter_s + dt_s)
        fx = before[0] + gain * (rx - before[0])
        fy = before[1] + gain * (ry - before[1])
        fz = before[2] + gain * (rz - before[2])
        self._f = (fx, fy, fz)
        ux, uy, uz = towards_anchor
        weight = (ux * ux + uy * uy) * _FLAT + uz * uz * _STEEP
        if weight <= 0.0:
            return  # at the anchor: no direction
        pull = ((ux * fx + uy * fy) * _FLAT + uz * fz * _STEEP) / weight
        self.pull_n = pull

        gain = dt_s / (GROWTH_S + dt_s)
        d_range, d_pull = range_m - self._range_mean, pull - self._pull_mean
        self._range_mean += gain * d_range
        self._pull_mean += gain * d_pull
        keep = 1.0 - gain
        self._cov = keep * (self._cov + gain * d_range * d_pull)
        self._var = keep * (self._var + gain * d_range * d_range)

        least = max(self._min_n, CERTAIN / math.sqrt(weight))
        self._pull_s = self._pull_s + dt_s if pull > (RELEASE * least if self.pulling else least) else 0.0
        self.pulling = self._pull_s > 0.0 and (self.pulling or self._pull_s >= self._after_s)
        side_2 = fx * fx + fy * fy
        limit = RELEASE * SIDEWAYS_N if self.sideways else SIDEWAYS_N
        self._side_s = self._side_s + dt_s if side_2 > limit * limit else 0.0
        self.sideways = self._side_s > 0.0 and (self.sideways or self._side_s >= self._after_s)
        grows = self._var > GROWTH_SPREAD_M2 and self._cov > GROWTH_N_PER_M * self._var
        self.growing = self.pulling and (self.growing or grows)
