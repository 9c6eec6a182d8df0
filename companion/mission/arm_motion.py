"""Plans jerk-limited motion of the arm with Ruckig, from rest to rest and with all joints synchronised.

All joints follow the same normalised profile, so the arm moves on a straight line in joint space and the most limited joint sets the
duration.
"""

from __future__ import annotations

import math
from bisect import bisect_right
from collections.abc import Sequence
from dataclasses import dataclass

import ruckig

from companion.mission.reference import Shape
from companion.model.types import Joints

_DECIMALS = 12
"""Decimal places to which the times of the profile are rounded, so that a replay on another computer, whose roots differ in the
last bit, builds the same plan.
"""


JERK_BOUND = 32.0
"""Value of jerk * duration^3 / distance for the fastest move that is limited by jerk alone."""


@dataclass(frozen=True, slots=True)
class ArmLimits:
    """Limits of the planned joint motion."""

    speed_max_rad_s: Joints
    acceleration_max_rad_s2: float
    jerk_max_rad_s3: float


@dataclass(frozen=True, slots=True)
class JerkLimited:
    """A profile from 0 at u = 0 to 1 at u = 1, at rest at both ends, made of consecutive cubics; implements `Profile`."""

    knots: tuple[float, ...]
    cubics: tuple[tuple[float, float, float, float], ...]
    """f, f', f'' / 2, f''' / 6 at the start of each cubic."""

    def __call__(self, u: float) -> Shape:
        """Return f, f', f'', f''' at u in [0, 1]."""
        if u >= 1.0:
            return (1.0, 0.0, 0.0, 0.0)
        index = max(0, bisect_right(self.knots, u) - 1)
        w = u - self.knots[index]
        c0, c1, c2, c3 = self.cubics[index]
        return (
            c0 + w * (c1 + w * (c2 + w * c3)),
            c1 + w * (2.0 * c2 + w * 3.0 * c3),
            2.0 * c2 + w * 6.0 * c3,
            6.0 * c3,
        )


SPEED_ENOUGH, ACCELERATION_ENOUGH, JERK_ENOUGH = 20.0, 400.0, 2.0e4
"""Largest limits passed to Ruckig, in units of the whole move and its shortest duration. With these limits alone a move would take
an eighth of that duration.
"""


@dataclass(frozen=True, slots=True)
class ArmMotion:
    """Profile and duration of a move of the arm."""

    profile: JerkLimited
    duration_s: float
    """Duration planned by Ruckig: the shortest possible, or the requested one if that is longer."""


def plan_arm(delta_rad: Joints, limits: ArmLimits, duration_s: float = 0.0) -> ArmMotion:
    """Plan one move; takes a few microseconds.

    Args:
        delta_rad: displacement of each joint; not all zero.
        limits: speed limit of each joint; acceleration and jerk limits common to all.

    Raises:
        ValueError: Ruckig rejects the input. Finite angles and positive limits are always accepted.
    """
    farthest_rad = max(map(abs, delta_rad), default=0.0)
    if not farthest_rad > 0.0:
        raise ValueError("a move of the arm without displacement")
    jerk_per_s3 = limits.jerk_max_rad_s3 / farthest_rad
    acceleration_per_s2 = limits.acceleration_max_rad_s2 / farthest_rad
    speed_per_s = min(
        limit / abs(delta) for limit, delta in zip(limits.speed_max_rad_s, delta_rad, strict=True) if delta
    )
    # Ruckig plans in units of about the whole duration, where its numbers are neither large nor small.
    jerk_s = (JERK_BOUND / jerk_per_s3) ** (1.0 / 3.0)
    least_s = max(jerk_s, 2.0 / math.sqrt(acceleration_per_s2), 1.0 / speed_per_s)
    # The requested duration is far too short if a limit is absurdly low; `check_mission` reports that.
    unit_s = least_s if 0.0 < 2.0 * duration_s < least_s else duration_s or jerk_s
    wanted = ruckig.InputParameter(1)
    wanted.current_position = [0.0]
    wanted.target_position = [1.0]
    # Limits far beyond what a move of one unit needs (a small move in a long time) only make Ruckig's equations
    # ill-conditioned.
    wanted.max_velocity = [min(speed_per_s * unit_s, SPEED_ENOUGH)]
    wanted.max_acceleration = [min(acceleration_per_s2 * unit_s**2, ACCELERATION_ENOUGH)]
    wanted.max_jerk = [min(jerk_per_s3 * unit_s**3, JERK_ENOUGH)]
    wanted.minimum_duration = duration_s / unit_s if duration_s else None
    trajectory = ruckig.Trajectory(1)
    try:
        result = ruckig.Ruckig(1).calculate(wanted, trajectory)
    except ruckig.RuckigError as error:
        raise ValueError(f"ruckig finds no motion of the arm over {delta_rad} rad within {limits}") from error
    if result not in (ruckig.Result.Working, ruckig.Result.Finished):
        raise ValueError(f"ruckig finds no motion of the arm over {delta_rad} rad within {limits}: {result.name}")
    profile = trajectory.profiles[0][0]
    planned_s = round(trajectory.duration * unit_s, _DECIMALS)
    # The shortest duration contains Ruckig's rounding.
    return ArmMotion(_share(profile.t, profile.j), planned_s if planned_s > duration_s * (1.0 + 1e-9) else duration_s)


def _share(times: Sequence[float], jerks: Sequence[float]) -> JerkLimited:
    """Return the profile over u from phases of constant jerk that start and end at rest."""
    total, strongest = math.fsum(times), max(map(abs, jerks))
    knots, cubics = [], []
    at = f = df = ddf = 0.0
    for time, jerk in zip(times, jerks, strict=True):
        width, dddf = round(time / total, _DECIMALS), round(jerk / strongest, _DECIMALS)
        if width > 0.0:
            knots.append(at)
            cubics.append((f, df, ddf / 2.0, dddf / 6.0))
            f += width * (df + width * (ddf / 2.0 + width * dddf / 6.0))
            df += width * (ddf + width * dddf / 2.0)
            ddf += width * dddf
            at += width
    return JerkLimited(tuple(knots), tuple((a / f, b / f, c / f, d / f) for a, b, c, d in cubics))
