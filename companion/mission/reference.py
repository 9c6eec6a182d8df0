"""Smooth motion in one piece: polynomial profiles along straight moves, and tracks made of moves.

Plain tuples and arithmetic, no arrays: a track is asked in every control tick.
"""

from __future__ import annotations

from bisect import bisect_right
from collections.abc import Callable
from dataclasses import dataclass
from itertools import pairwise
from typing import TypeAlias

from companion.types import Reference, Vec2, Vec3

Shape: TypeAlias = tuple[float, float, float]
"""f, f', f'' of a profile at u in [0, 1]."""
Profile: TypeAlias = Callable[[float], Shape]
Sample: TypeAlias = tuple[tuple[float, ...], tuple[float, ...], float, float, float]
"""Origin, delta, f, f' / s, f'' / s^2: the value is origin + delta f."""


def rest_to_rest(u: float) -> Shape:
    """Quintic from 0 to 1, at rest with no acceleration on both ends: 10 u^3 - 15 u^4 + 6 u^5. Peak f' = 1.875, peak f'' = 5.774."""
    u2 = u * u
    return (
        u2 * u * (10.0 + u * (6.0 * u - 15.0)),
        30.0 * u2 * (1.0 + u * (u - 2.0)),
        60.0 * u * (1.0 + u * (2.0 * u - 3.0)),
    )


def speed_up(u: float) -> Shape:
    """From rest to f' = 1, which itself rises as `rest_to_rest`; covers 1/2."""
    u2 = u * u
    speed, acceleration, _ = rest_to_rest(u)
    return (u2 * u2 * (2.5 + u * (u - 3.0)), speed, acceleration)


def slow_down(u: float) -> Shape:
    """From f' = 1 to rest, the mirror of `speed_up`; covers 1/2."""
    distance, speed, acceleration = speed_up(u)
    return (u - distance, 1.0 - speed, -acceleration)


def steady(u: float) -> Shape:
    """f' = 1 throughout; covers 1."""
    return (u, 1.0, 0.0)


REST_TO_REST_PEAK_SPEED = 1.875
"""Largest f' of `rest_to_rest`, and largest f'' of `speed_up` and `slow_down`."""


@dataclass(frozen=True, slots=True)
class Move:
    """value(t) = origin + delta profile((t - start) / duration); at rest before and after, unless another move follows on."""

    start_s: float
    duration_s: float
    origin: tuple[float, ...]
    delta: tuple[float, ...]
    profile: Profile

    @property
    def end_s(self) -> float:
        """Time at the end of the move."""
        return self.start_s + self.duration_s

    @property
    def end(self) -> tuple[float, ...]:
        """Value at the end of the move."""
        share = self.profile(1.0)[0]
        return tuple(origin + delta * share for origin, delta in zip(self.origin, self.delta, strict=True))


class Track:
    """One quantity over time: moves one after another, constant between them."""

    __slots__ = ("_initial", "_moves", "_starts_s")

    def __init__(self, initial: tuple[float, ...], moves: tuple[Move, ...]) -> None:
        self._initial = initial
        self._moves = moves
        self._starts_s = [move.start_s for move in moves]
        for before, after in pairwise(moves):
            if after.start_s < before.end_s - 1e-9:
                raise ValueError(
                    f"a move starts at {after.start_s} s, before the one before it ends at {before.end_s} s"
                )

    def at(self, t_s: float) -> Sample:
        """Value and derivatives at any time."""
        index = bisect_right(self._starts_s, t_s) - 1
        if index < 0:
            return (self._initial, self._initial, 0.0, 0.0, 0.0)
        move = self._moves[index]
        duration_s = move.duration_s
        u = (t_s - move.start_s) / duration_s
        if u >= 1.0:
            return (move.origin, move.delta, move.profile(1.0)[0], 0.0, 0.0)
        f, df, ddf = move.profile(u)
        return (move.origin, move.delta, f, df / duration_s, ddf / (duration_s * duration_s))


def reference_at(position: Track, yaw: Track, arm: Track, t_s: float) -> Reference:
    """The three tracks at one instant."""
    (x, y, z), (dx, dy, dz), f, df, ddf = position.at(t_s)
    (psi,), (dpsi,), g, dg, _ = yaw.at(t_s)
    (a1, a2), (da1, da2), h, dh, ddh = arm.at(t_s)
    return Reference(
        position_world_m=(x + dx * f, y + dy * f, z + dz * f),
        velocity_world_m_s=(dx * df, dy * df, dz * df),
        acceleration_world_m_s2=(dx * ddf, dy * ddf, dz * ddf),
        yaw_rad=psi + dpsi * g,
        yaw_rate_rad_s=dpsi * dg,
        arm_rad=(a1 + da1 * h, a2 + da2 * h),
        arm_rate_rad_s=(da1 * dh, da2 * dh),
        arm_acceleration_rad_s2=(da1 * ddh, da2 * ddh),
    )


def at_rest(position_world_m: Vec3, yaw_rad: float, arm_rad: Vec2) -> Reference:
    """A reference that stays where it is."""
    zero3: Vec3 = (0.0, 0.0, 0.0)
    return Reference(position_world_m, zero3, zero3, yaw_rad, 0.0, arm_rad, (0.0, 0.0), (0.0, 0.0))
