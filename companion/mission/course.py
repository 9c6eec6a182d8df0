"""The active plan, its start time, and the rate of its time.

A HOLD does not leave the plan: it slows the plan's time down to a standstill. Vehicle and arm come to rest on the planned path, which
was checked against tether and room, and a resume continues from there.
"""

from __future__ import annotations

import math

from companion.mission.plan import STOP_MIN_S, Plan
from companion.mission.reference import REST_TO_REST_PEAK_SPEED, slow_down, speed_up
from companion.mission.segments import Segment
from companion.model.types import Reference

HOLD_DECELERATION_M_S2 = 1.5


class Course:
    """One plan on the flight clock.

    Args:
        plan: the plan.
        start_s: flight time at its start.
    """

    def __init__(self, plan: Plan, start_s: float) -> None:
        self.plan = plan
        self._origin_s = start_s
        """Flight time minus plan time while the plan's time runs at rate 1."""
        self._change: tuple[float, float, float, float, float] | None = None
        """Start of a change of rate: flight time, plan time there, duration, rate before, rate after."""
        self._asked_s: float | None = None
        """Flight time of the last query, because several callers query one tick."""
        self._segment: Segment | None = None

    @property
    def held(self) -> bool:
        """Return whether the plan's time stands still or slows down to a standstill."""
        return self._change is not None and self._change[4] == 0.0

    def pace(self, t_s: float) -> tuple[float, float, float, float]:
        """Return the plan time, its rate (1 is real time, 0 is held), and the rate's first and second derivatives at a flight time."""
        if self._change is None:
            return t_s - self._origin_s, 1.0, 0.0, 0.0
        begin_s, plan_s, duration_s, before, after = self._change
        u = (t_s - begin_s) / duration_s
        if u >= 1.0:
            end_s = plan_s + 0.5 * (before + after) * duration_s
            if after == 0.0:
                return end_s, 0.0, 0.0, 0.0
            self._change = None
            self._origin_s = begin_s + duration_s - end_s
            return t_s - self._origin_s, 1.0, 0.0, 0.0
        once, twice = 1.0 / duration_s, 1.0 / (duration_s * duration_s)
        if after == 0.0:
            way, rate, change, jerk = slow_down(u)
            return plan_s + before * duration_s * way, before * rate, before * change * once, before * jerk * twice
        way, rate, change, jerk = speed_up(u)
        rise = after - before
        now_s = plan_s + duration_s * (before * u + rise * way)
        return now_s, before + rise * rate, rise * change * once, rise * jerk * twice

    def hold(self, t_s: float) -> None:
        """Come to rest on the planned path."""
        if not self.held:
            self._turn_to(0.0, t_s)

    def resume(self, t_s: float) -> None:
        """Continue from where the plan was held."""
        if self.held:
            self._turn_to(1.0, t_s)

    def _turn_to(self, after: float, t_s: float) -> None:
        plan_s, rate, _, _ = self.pace(t_s)
        speed_m_s = math.hypot(*self.plan.reference(plan_s).velocity_world_m_s)
        duration_s = max(STOP_MIN_S, REST_TO_REST_PEAK_SPEED * speed_m_s / HOLD_DECELERATION_M_S2)
        self._change = (t_s, plan_s, duration_s, rate, after)
        self._asked_s = None

    def reference(self, t_s: float) -> Reference:
        """Return the reference at a flight time."""
        plan_s, rate, change, jerk = self.pace(t_s)
        reference = self.plan.reference(plan_s)
        return reference if rate == 1.0 and change == 0.0 else _paced(reference, rate, change, jerk)

    def segment(self, t_s: float) -> Segment:
        """Return the plan's segment at a flight time."""
        if t_s != self._asked_s:
            plan_s, segment = self.pace(t_s)[0], self._segment
            if segment is None or not segment.start_s <= plan_s < segment.end_s:
                segment = self.plan.segment(plan_s)
            self._segment = segment
            self._asked_s = t_s
        assert self._segment is not None
        return self._segment

    def left_s(self, t_s: float) -> float:
        """Return the remaining plan time, s; negative after its end."""
        return self.plan.duration_s - self.pace(t_s)[0]

    def progress(self, t_s: float) -> float:
        """Return the completed share of the plan's duration, 0 to 1."""
        return self.plan.progress(self.pace(t_s)[0])


def _paced(r: Reference, rate: float, change: float, jerk: float) -> Reference:
    """Return the reference for a plan time with rate s: s v, s^2 a + s_d v, s^3 j + 3 s s_d a + s_dd v (chain rule)."""
    squared, mixed, cubed = rate * rate, 3.0 * rate * change, rate * rate * rate
    (vx, vy, vz), (ax, ay, az) = r.velocity_world_m_s, r.acceleration_world_m_s2
    (jx, jy, jz), (da1, da2), (dda1, dda2) = r.jerk_world_m_s3, r.arm_rate_rad_s, r.arm_acceleration_rad_s2
    return Reference(
        position_world_m=r.position_world_m,
        velocity_world_m_s=(rate * vx, rate * vy, rate * vz),
        acceleration_world_m_s2=(squared * ax + change * vx, squared * ay + change * vy, squared * az + change * vz),
        yaw_rad=r.yaw_rad,
        yaw_rate_rad_s=rate * r.yaw_rate_rad_s,
        arm_rad=r.arm_rad,
        arm_rate_rad_s=(rate * da1, rate * da2),
        arm_acceleration_rad_s2=(squared * dda1 + change * da1, squared * dda2 + change * da2),
        jerk_world_m_s3=(
            cubed * jx + mixed * ax + jerk * vx,
            cubed * jy + mixed * ay + jerk * vy,
            cubed * jz + mixed * az + jerk * vz,
        ),
    )
