"""The active plan, its start time, and the rate at which its time runs.

A HOLD does not leave the plan: it slows the plan's time down to a standstill. Vehicle and arm come to rest on the planned path, which
was checked against tether and room, and a resume continues from there.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, replace

import msgspec

from companion.mission.plan import Plan
from companion.mission.plan_builder import STOP_MIN_S
from companion.mission.reference import REST_TO_REST_PEAK_SPEED, slow_down, speed_up
from companion.mission.segments import Segment
from companion.model.types import Reference

HOLD_DECELERATION_M_S2 = 1.5


@dataclass(frozen=True, slots=True)
class Change:
    """A change of the rate at which the plan's time runs."""

    begin_s: float
    """Start of the change on the flight clock."""
    plan_s: float
    """Plan time when the change begins."""
    duration_s: float
    before: float
    after: float
    """Rates before and after the change; 0 or 1 after it."""


@dataclass(frozen=True, slots=True)
class ActiveTrajectory:
    """One plan on the flight clock."""

    plan: Plan
    start_s: float
    """Time on the flight clock at which the plan begins."""
    change: Change | None = None
    """The newest change of the rate; None if the plan's time has always run as fast as the flight clock."""

    @property
    def held(self) -> bool:
        """Return whether the plan's time has stopped or is slowing down to a stop."""
        return self.change is not None and self.change.after == 0.0

    def pace(self, t_s: float) -> tuple[float, float, float, float]:
        """Return the plan time at `t_s` on the flight clock, its rate (1: as the clock, 0: held) and the rate's two derivatives."""
        change = self.change
        if change is None:
            return t_s - self.start_s, 1.0, 0.0, 0.0
        duration_s, before, after = change.duration_s, change.before, change.after
        u = (t_s - change.begin_s) / duration_s
        if u >= 1.0:
            end_s = change.plan_s + 0.5 * (before + after) * duration_s
            if after == 0.0:
                return end_s, 0.0, 0.0, 0.0
            return t_s - (change.begin_s + duration_s - end_s), 1.0, 0.0, 0.0
        once, twice = 1.0 / duration_s, 1.0 / (duration_s * duration_s)
        if after == 0.0:
            way, rate, slope, jerk = slow_down(u)
            plan_s = change.plan_s + before * duration_s * way
            return plan_s, before * rate, before * slope * once, before * jerk * twice
        way, rate, slope, jerk = speed_up(u)
        rise = after - before
        now_s = change.plan_s + duration_s * (before * u + rise * way)
        return now_s, before + rise * rate, rise * slope * once, rise * jerk * twice

    def hold(self, t_s: float) -> ActiveTrajectory:
        """Return the course that brakes to rest on the planned path from `t_s`."""
        return self if self.held else self._turned_to(0.0, t_s)

    def resume(self, t_s: float) -> ActiveTrajectory:
        """Return the course that continues from the point of the hold."""
        return self._turned_to(1.0, t_s) if self.held else self

    def moved_to(self, plan_s: float, t_s: float) -> ActiveTrajectory:
        """Return the course with another plan time at `t_s`, held if this one is; otherwise the plan rests at both times."""
        if not self.held:
            return replace(self, start_s=t_s - plan_s, change=None)
        change = Change(begin_s=t_s, plan_s=plan_s, duration_s=STOP_MIN_S, before=0.0, after=0.0)
        return replace(self, change=change)

    def _turned_to(self, after: float, t_s: float) -> ActiveTrajectory:
        plan_s, rate, _, _ = self.pace(t_s)
        speed_m_s = math.hypot(*self.plan.reference(plan_s).velocity_world_m_s)
        duration_s = max(STOP_MIN_S, REST_TO_REST_PEAK_SPEED * speed_m_s / HOLD_DECELERATION_M_S2)
        return replace(self, change=Change(begin_s=t_s, plan_s=plan_s, duration_s=duration_s, before=rate, after=after))

    def reference(self, t_s: float) -> Reference:
        """Return the reference at `t_s` on the flight clock."""
        plan_s, rate, change, jerk = self.pace(t_s)
        reference = self.plan.reference(plan_s)
        return reference if rate == 1.0 and change == 0.0 else _paced(reference, rate, change, jerk)

    def segment(self, t_s: float) -> Segment:
        """Return the plan's segment at `t_s` on the flight clock."""
        return self.plan.segment(self.pace(t_s)[0])

    def left_s(self, t_s: float) -> float:
        """Return the plan time that is left; negative after the plan's end."""
        return self.plan.duration_s - self.pace(t_s)[0]


def _paced(r: Reference, rate: float, change: float, jerk: float) -> Reference:
    """Return the reference for a plan time with rate s: s v, s^2 a + s_d v, s^3 j + 3 s s_d a + s_dd v (chain rule)."""
    squared, mixed, cubed = rate * rate, 3.0 * rate * change, rate * rate * rate
    vx, vy, vz = r.velocity_world_m_s
    ax, ay, az = r.acceleration_world_m_s2
    jx, jy, jz = r.jerk_world_m_s3
    arm_rate = r.arm_rate_rad_s
    return msgspec.structs.replace(
        r,
        velocity_world_m_s=(rate * vx, rate * vy, rate * vz),
        acceleration_world_m_s2=(squared * ax + change * vx, squared * ay + change * vy, squared * az + change * vz),
        yaw_rate_rad_s=rate * r.yaw_rate_rad_s,
        arm_rate_rad_s=tuple([rate * da for da in arm_rate]),
        arm_acceleration_rad_s2=tuple(
            [squared * dda + change * da for dda, da in zip(r.arm_acceleration_rad_s2, arm_rate, strict=True)]
        ),
        jerk_world_m_s3=(
            cubed * jx + mixed * ax + jerk * vx,
            cubed * jy + mixed * ay + jerk * vy,
            cubed * jz + mixed * az + jerk * vz,
        ),
    )
