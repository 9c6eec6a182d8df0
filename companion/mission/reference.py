"""Smooth reference motion: polynomial profiles along straight moves, polynomial curves, and tracks made of both.

It uses plain tuples and no arrays, because a track is evaluated in every control tick.
"""

from __future__ import annotations

from bisect import bisect_right
from collections.abc import Callable
from dataclasses import dataclass
from itertools import pairwise
from typing import TypeAlias

from companion.model.types import Reference

Shape: TypeAlias = tuple[float, float, float, float]
"""f, f', f'', f''' of a profile at u in [0, 1]."""
Profile: TypeAlias = Callable[[float], Shape]
Values: TypeAlias = tuple[float, ...]
Sample: TypeAlias = tuple[Values, Values, Values, Values]
"""Value and its first, second and third time derivatives."""
Septic: TypeAlias = tuple[float, float, float, float, float, float, float, float]
"""Coefficients of one axis, the constant first, in the piece's own time from 0."""


def minimum_snap(u: float) -> Shape:
    """Return the profile of least integral of f'''' squared, with f' to f''' zero at both ends: 35 u^4 - 84 u^5 + 70 u^6 - 20 u^7."""
    u2 = u * u
    u3 = u2 * u
    return (
        u2 * u2 * (35.0 + u * (u * (70.0 - 20.0 * u) - 84.0)),
        140.0 * u3 * (1.0 + u * (u * (3.0 - u) - 3.0)),
        420.0 * u2 * (1.0 + u * (u * (5.0 - 2.0 * u) - 4.0)),
        840.0 * u * (1.0 + u * (u * (10.0 - 5.0 * u) - 6.0)),
    )


def rest_to_rest(u: float) -> Shape:
    """Return the quintic from 0 to 1, at rest at both ends: 10 u^3 - 15 u^4 + 6 u^5. Peak f' = 1.875, peak f'' = 5.774."""
    u2 = u * u
    return (
        u2 * u * (10.0 + u * (6.0 * u - 15.0)),
        30.0 * u2 * (1.0 + u * (u - 2.0)),
        60.0 * u * (1.0 + u * (2.0 * u - 3.0)),
        60.0 * (1.0 + u * (6.0 * u - 6.0)),
    )


def speed_up(u: float) -> Shape:
    """Return the profile that accelerates from rest to f' = 1, with f' following `rest_to_rest`; f(1) = 1/2."""
    u2 = u * u
    speed, acceleration, jerk, _ = rest_to_rest(u)
    return (u2 * u2 * (2.5 + u * (u - 3.0)), speed, acceleration, jerk)


def slow_down(u: float) -> Shape:
    """Return the profile from f' = 1 to rest, the mirror image of `speed_up`; f(1) = 1/2."""
    distance, speed, acceleration, jerk = speed_up(u)
    return (u - distance, 1.0 - speed, -acceleration, -jerk)


def steady(u: float) -> Shape:
    """Return the profile with f' = 1 throughout; f(1) = 1."""
    return (u, 1.0, 0.0, 0.0)


REST_TO_REST_PEAK_SPEED = 1.875
"""Largest f' of `rest_to_rest`, and largest f'' of `speed_up` and `slow_down`."""


@dataclass(frozen=True, slots=True)
class Move:
    """value(t) = origin + delta profile((t - start) / duration); at rest before it, and after it until the next move."""

    start_s: float
    duration_s: float
    origin: Values
    delta: Values
    profile: Profile

    @property
    def end_s(self) -> float:
        """Time at the end of the move."""
        return self.start_s + self.duration_s

    @property
    def end(self) -> Values:
        """Value at the end of the move."""
        share = self.profile(1.0)[0]
        return tuple(origin + delta * share for origin, delta in zip(self.origin, self.delta, strict=True))

    def at(self, t_s: float) -> Sample:
        """Return the value and its derivatives between start and end."""
        duration_s = self.duration_s
        f, df, ddf, dddf = self.profile((t_s - self.start_s) / duration_s)
        df /= duration_s
        ddf /= duration_s * duration_s
        dddf /= duration_s * duration_s * duration_s
        delta = self.delta
        if len(delta) == 3:  # the case of most of a flight; written out it takes a third of the time
            x, y, z = self.origin
            a, b, c = delta
            return (
                (x + a * f, y + b * f, z + c * f),
                (a * df, b * df, c * df),
                (a * ddf, b * ddf, c * ddf),
                (a * dddf, b * dddf, c * dddf),
            )
        if len(delta) == 2:
            x, y = self.origin
            a, b = delta
            return (x + a * f, y + b * f), (a * df, b * df), (a * ddf, b * ddf), (a * dddf, b * dddf)
        return (
            tuple([a + d * f for a, d in zip(self.origin, delta, strict=True)]),
            tuple([d * df for d in delta]),
            tuple([d * ddf for d in delta]),
            tuple([d * dddf for d in delta]),
        )


@dataclass(frozen=True, slots=True)
class Curve:
    """Consecutive polynomial pieces of degree 7 in every axis; at rest before and after."""

    start_s: float
    duration_s: float
    scale_s: float
    """Seconds per unit of the time in which knots and pieces are given."""
    knots: tuple[float, ...]
    """Start of each piece, from 0, and the end of the last one."""
    pieces: tuple[tuple[Septic, ...], ...]
    end: Values

    @property
    def end_s(self) -> float:
        """Time at the end of the curve."""
        return self.start_s + self.duration_s

    def at(self, t_s: float) -> Sample:
        """Return the value and its derivatives between start and end."""
        scale_s = self.scale_s
        t = (t_s - self.start_s) / scale_s
        index = min(len(self.pieces), max(1, bisect_right(self.knots, t))) - 1
        t -= self.knots[index]
        once, twice = 1.0 / scale_s, 1.0 / (scale_s * scale_s)
        thrice = twice * once
        values, rates, accelerations, jerks = [], [], [], []
        for c0, c1, c2, c3, c4, c5, c6, c7 in self.pieces[index]:
            values.append(c0 + t * (c1 + t * (c2 + t * (c3 + t * (c4 + t * (c5 + t * (c6 + t * c7)))))))
            rates.append(
                once
                * (
                    c1
                    + t * (2.0 * c2 + t * (3.0 * c3 + t * (4.0 * c4 + t * (5.0 * c5 + t * (6.0 * c6 + t * 7.0 * c7)))))
                )
            )
            accelerations.append(
                twice
                * (2.0 * c2 + t * (6.0 * c3 + t * (12.0 * c4 + t * (20.0 * c5 + t * (30.0 * c6 + t * 42.0 * c7)))))
            )
            jerks.append(thrice * (6.0 * c3 + t * (24.0 * c4 + t * (60.0 * c5 + t * (120.0 * c6 + t * 210.0 * c7)))))
        return (tuple(values), tuple(rates), tuple(accelerations), tuple(jerks))


Motion: TypeAlias = Move | Curve


class Track:
    """One quantity over time: consecutive motions with constant values between them."""

    __slots__ = ("_ends_s", "_moves", "_rests", "_starts_s")

    def __init__(self, initial: Values, moves: tuple[Motion, ...]) -> None:
        self._moves = moves
        self._starts_s = [move.start_s for move in moves]
        self._ends_s = [move.end_s for move in moves]
        zero = (0.0,) * len(initial)
        # Values before the first motion and after each.
        self._rests: list[Sample] = [(at, zero, zero, zero) for at in (initial, *(move.end for move in moves))]
        for before, after in pairwise(moves):
            if after.start_s < before.end_s - 1e-9:
                raise ValueError(
                    f"a move starts at {after.start_s} s, before the previous one ends at {before.end_s} s"
                )

    def at(self, t_s: float) -> Sample:
        """Return the value and its derivatives at any time."""
        index = bisect_right(self._starts_s, t_s)
        if index == 0 or t_s >= self._ends_s[index - 1]:
            return self._rests[index]
        return self._moves[index - 1].at(t_s)


def reference_at(position: Track, yaw: Track, arm: Track, t_s: float) -> Reference:
    """Return the reference of the three tracks at one instant."""
    (x, y, z), (vx, vy, vz), (ax, ay, az), (jx, jy, jz) = position.at(t_s)
    (psi,), (dpsi,), _, _ = yaw.at(t_s)
    arm_rad, arm_rate_rad_s, arm_acceleration_rad_s2, _ = arm.at(t_s)
    return Reference(
        position_world_m=(x, y, z),
        velocity_world_m_s=(vx, vy, vz),
        acceleration_world_m_s2=(ax, ay, az),
        yaw_rad=psi,
        yaw_rate_rad_s=dpsi,
        arm_rad=arm_rad,
        arm_rate_rad_s=arm_rate_rad_s,
        arm_acceleration_rad_s2=arm_acceleration_rad_s2,
        jerk_world_m_s3=(jx, jy, jz),
    )
