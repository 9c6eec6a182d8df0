"""The net's way to a meeting point, and the choice of that point. Pure.

Towards a ball, the reference accelerates so that the net is at the meeting with the least integral of the acceleration's square, within
its limit: a multiple of the net's response to an impulse of acceleration, clipped. The farther the ball, the more of it is clipped, up
to full tilt in one direction and then in the other, which is as far as the net can come.
"""

from __future__ import annotations

import functools
import itertools
import math
import operator
from collections.abc import Iterator
from typing import Final

from companion.model.codec import Record
from companion.model.types import Vec3
from companion.phases.intercept.ball import Point
from companion.phases.intercept.lag import BODY_S2, TILT_S2_M, Lag, faded, fading, impulse_1_s
from companion.phases.intercept.motion import Bounds, State

SWINGS: Final = 0.85
"""Share of the net's distance below the body's origin by which it swings against the tilt: the arm gives way."""
RISES_S: Final = 0.02
"""Time by which the body follows the reference vertically."""
FROZEN_S: Final = 0.08
"""Time before a meeting from which its plan is not changed any more."""
LEAST_S: Final = 0.15
"""Shortest time to a meeting that is planned for the first time; in less time, the net hardly moves."""
MISS_M: Final = 0.08
"""Distance from the net's centre at which a ball is still caught."""
FACING: Final = 0.5
"""Smallest cosine between the net's opening and the direction that the ball comes from."""
ASKEW: Final = 0.3
"""Effort of a ball that comes from the side, beyond that of one that comes straight."""
KEPT: Final = 0.05
"""Effort by which another meeting must be better than the planned one."""
STEP_S: Final = 0.02
"""Step of the sums over the time to a meeting."""
TRIED_MAX: Final = 3
APART_S: Final = 0.05
"""Number of meetings that are tried, those of the least effort first, until the ball clears the rotors, and the time between two."""


class Plan(Record, frozen=True):
    """How the net gets to a meeting: the acceleration of the reference over the time that is left."""

    point: Point
    """The ball."""
    aside_m_s2: tuple[float, float]
    """Largest horizontal acceleration, world frame."""
    up_m_s2: float
    """Largest vertical acceleration."""
    aside_gain: float
    """Gain on the net's horizontal response."""
    up_end_m_s2: float
    """Vertical acceleration at the meeting."""
    up_slope_m_s3: float
    """How much more it is, per second before the meeting."""

    def push_m_s2(self, t_s: float, drop_m: float) -> Vec3:
        """Return the acceleration of the reference at a time."""
        left_s = self.point.t_s - t_s
        if left_s <= 0.0:
            return (0.0, 0.0, 0.0)
        aside = max(-1.0, min(1.0, self.aside_gain * aside_s(left_s, drop_m)))
        up_m_s2 = max(-self.up_m_s2, min(self.up_m_s2, self.up_end_m_s2 + self.up_slope_m_s3 * left_s))
        return (self.aside_m_s2[0] * aside, self.aside_m_s2[1] * aside, up_m_s2)


def aside_s(left_s: float, drop_m: float) -> float:
    """Return the net's horizontal displacement per change of the reference's velocity, a time after it.

    Args:
        left_s: time since the change.
        drop_m: distance of the net below the body's origin, by which it swings against the tilt.
    """
    return left_s + impulse_1_s(BODY_S2, left_s) - drop_m * impulse_1_s(TILT_S2_M, left_s)


class Reach:
    """How far an acceleration of 1 m/s^2 brings the net in a time.

    Args:
        drop_m: distance of the net below the body's origin.
        horizon_s: longest time.
    """

    def __init__(self, drop_m: float, horizon_s: float) -> None:
        self.drop_m = drop_m = SWINGS * drop_m
        """Distance by which it swings."""
        times = [(k + 0.5) * STEP_S for k in range(math.ceil(horizon_s / STEP_S))]
        self._aside, self._up = [aside_s(t, drop_m) for t in times], [t - RISES_S for t in times]
        self._tilt = [impulse_1_s(TILT_S2_M, t) for t in times]
        self._asides_s2, self._ups_s2 = (
            list(itertools.accumulate(STEP_S * abs(response) for response in responses))
            for responses in (self._aside, self._up)
        )

    def of(self, left_s: float) -> tuple[int, float, float]:
        """Return the number of steps, the horizontal and the vertical reach."""
        number = min(len(self._aside), max(1, round(left_s / STEP_S)))
        return number, self._asides_s2[number - 1], self._ups_s2[number - 1]

    def plan(
        self,
        point: Point,
        left_s: float,
        away_m: Vec3,
        rises_m_s: float,
        most_m_s2: float,
        ahead_m: tuple[float, float],
    ) -> Plan:
        """Return the plan with which the net moves by `away_m`, beyond what it moves by itself. It does not sink at the meeting if the
        limit allows: a heavy ball pushes a vehicle that sinks much farther down.

        Args:
            point: the ball at the meeting.
            left_s: time to the meeting.
            away_m: displacement of the net.
            rises_m_s: vertical velocity of the reference.
            most_m_s2: largest acceleration.
            ahead_m: horizontal position of the net relative to the body, world frame: if that is tilted, the net rises or falls.
        """
        number, aside_s2, up_s2 = self.of(left_s)
        (x, y, z), aside, up, tilt = away_m, self._aside[:number], self._up[:number], self._tilt[:number]
        aside_m = math.hypot(x, y)
        effort = math.hypot(aside_m / aside_s2, z / up_s2) or 1.0
        most = most_m_s2 * aside_m / aside_s2 / effort
        gain = _gain(aside, aside_m / most) if most > 0.0 else 0.0
        push = (most * x / aside_m, most * y / aside_m) if most > 0.0 else (0.0, 0.0)
        swung_s2 = STEP_S * sum([max(-1.0, min(1.0, gain * w)) * slope for w, slope in zip(aside, tilt, strict=True)])
        z += swung_s2 * (ahead_m[0] * push[0] + ahead_m[1] * push[1])
        rise = math.copysign(max(1e-9, min(abs(z) / up_s2, math.sqrt(max(0.0, most_m_s2**2 - most**2)))), z)
        up_gain = _gain(up, z / rise)
        if rises_m_s + rise * STEP_S * sum([max(-1.0, min(1.0, up_gain * w)) for w in up]) < 0.0:
            slope = 12.0 * (z + (0.5 * left_s - RISES_S) * rises_m_s) / left_s**3
            end = -rises_m_s / left_s - 0.5 * left_s * slope
            peak = max(abs(end), abs(end + left_s * slope))
            if math.hypot(peak, most * min(1.0, gain * max(map(abs, aside)))) <= most_m_s2:
                return Plan(point, push, peak, gain, end, slope)
        slope = rise * up_gain
        return Plan(point, push, abs(rise), gain, -RISES_S * slope, slope)


reach_of = functools.lru_cache(maxsize=4)(Reach)


def _gain(responses: list[float], wanted_s2: float) -> float:
    """Return the gain for which the clipped multiple of the responses gives the wanted displacement, or the largest one below it."""
    gain, wanted = 0.0, wanted_s2 / STEP_S
    for _ in range(8):
        clipped = sum([abs(r) for r in responses if gain * abs(r) >= 1.0])
        free = sum([r * r for r in responses if gain * abs(r) < 1.0])
        if free <= 0.0:
            break
        before, gain = gain, (wanted - clipped) / free
        if gain <= before * 1.001:
            break
    return gain


def meetings(
    t_s: float,
    now: State,
    lag: Lag,
    path: list[Point],
    net_m: Vec3,
    opening: Vec3,
    bounds: Bounds,
    reach: Reach,
    kept_s: float | None,
) -> Iterator[Plan]:
    """Yield the plans of the meetings with the least effort, which is the fraction of the reach that they need, the least first. If the
    net cannot come to the ball, it comes as near as it can, at least to `MISS_M`.

    Args:
        t_s: flight clock.
        now: motion of the reference now.
        lag: its lagging acceleration.
        path: the ball's predicted path.
        net_m: the net's centre relative to the body's origin of the level vehicle, world frame.
        opening: unit vector out of the net's opening, world frame.
        bounds: the limits.
        reach: how far the net comes.
        kept_s: time of the meeting that was planned before, which is kept unless another one is clearly better; None for a first plan.
    """
    found: list[tuple[float, Point, Vec3]] = []
    most, least_s = bounds.acceleration_m_s2, LEAST_S if kept_s is None else FROZEN_S
    (x, y, z), (vx, vy, vz), (nx, ny, nz), (ox, oy, oz) = now.position_m, now.velocity_m_s, net_m, opening
    swings = [body - reach.drop_m * tilt for body, tilt in zip(BODY_S2, TILT_S2_M, strict=True)]
    left_x, left_y = fading(lag.x_m_s2, swings), fading(lag.y_m_s2, swings)
    left_z = [
        nx * a + ny * b for a, b in zip(fading(lag.x_m_s2, TILT_S2_M), fading(lag.y_m_s2, TILT_S2_M), strict=True)
    ]
    for point in path:
        h, (bx, by, bz), (ux, uy, uz) = point.t_s - t_s, point.position_m, point.velocity_m_s
        if h < least_s or not bounds.in_box((bx - nx, by - ny, bz - nz)):
            continue
        facing = -(ox * ux + oy * uy + oz * uz) / math.hypot(ux, uy, uz)
        if facing < FACING:
            continue
        dx = bx - nx - x - h * vx - faded(left_x, h)
        dy = by - ny - y - h * vy - faded(left_y, h)
        dz = bz - nz - z - (h - RISES_S) * vz + faded(left_z, h)
        _, aside_s2, up_s2 = reach.of(h)
        needed = math.hypot(dx / aside_s2, dy / aside_s2, dz / up_s2) / most
        needed = max(needed, math.hypot(dx, dy, dz) / (bounds.speed_m_s * h))
        if needed > 1.0 and kept_s is None and (1.0 - 1.0 / needed) * math.hypot(dx, dy, dz) > MISS_M:
            continue
        kept = KEPT if kept_s is not None and abs(point.t_s - kept_s) < 1e-6 else 0.0
        found.append((needed + ASKEW * (1.0 - facing) - kept, point, (dx, dy, dz)))
    found.sort(key=operator.itemgetter(0))
    tried_s: list[float] = []
    for _, point, away_m in found:
        if all(abs(point.t_s - other_s) >= APART_S for other_s in tried_s):
            tried_s.append(point.t_s)
            yield reach.plan(point, point.t_s - t_s, away_m, vz, most, (nx, ny))
            if len(tried_s) == TRIED_MAX:
                return
