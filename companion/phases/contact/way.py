"""The way to a surface, and how long the phases of a contact take if all goes well."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from itertools import pairwise

from companion.model.types import Vec2, Vec3
from companion.phases.contact.force import ACCELERATION_M_S2, SHIFT_M_S, TARE_S, TOUCH_MEAN_S, TOUCH_SETTLE_S

FROM_POINT_M, FROM_POINT_SHARE = 0.03, 0.4
"""Distance to which the tip moves back from a point, and additionally as a fraction of the way to the next point: a surface may be
tilted by 15 deg about both axes.
"""


@dataclass(frozen=True, slots=True)
class Way:
    """The way to a surface, from the keys of the phase that begins a contact."""

    direction_world: Vec3
    """Unit vector."""
    distance_max_m: float
    speed_m_s: float
    touch_n: float
    points: tuple[Vec2, ...]
    """Points that are touched to find the surface, right and up of the way straight ahead, m."""
    presses: bool
    """Whether the vehicle then turns to the surface and presses; if not, the contact is over."""


def travel_s(distance_m: float, speed_m_s: float) -> float:
    """Return the time in which the offset travels a distance from rest to rest, s."""
    return distance_m / speed_m_s + speed_m_s / ACCELERATION_M_S2


def approach_s(way: Way) -> float:
    """Return the duration of an approach or a probe, s: the largest of an approach, about that of what touches points."""
    duration_s = TARE_S + travel_s(way.distance_max_m, way.speed_m_s)
    if not way.points:
        return duration_s
    back_m = back_from_point_m(way)
    each_s = (
        travel_s(back_m, SHIFT_M_S) + travel_s(back_m, way.speed_m_s) + travel_s(_farthest_step_m(way.points), SHIFT_M_S)
        + TOUCH_SETTLE_S + TOUCH_MEAN_S
    )  # fmt: skip
    return len(way.points) * each_s + (2.0 if way.presses else 1.0) * duration_s


def back_from_point_m(way: Way) -> float:
    """Return how far the tip moves back from a point before it moves in front of the next one, m."""
    return FROM_POINT_M + FROM_POINT_SHARE * _farthest_step_m(way.points)


def _farthest_step_m(points: Sequence[Vec2]) -> float:
    """Return the largest distance between consecutive points."""
    return max((math.dist(a, b) for a, b in pairwise(points)), default=0.0)
