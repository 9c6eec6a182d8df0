"""Builds the three tracks of a plan (position, yaw and arm), one move after the other.

The durations come from the mission file, and nothing here reacts to a catch.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from itertools import pairwise

from companion.mission.arm_motion import ArmLimits, plan_arm
from companion.mission.minsnap import VehicleLimits, least_line_s, route, septic
from companion.mission.reference import (
    REST_TO_REST_PEAK_SPEED,
    Curve,
    Motion,
    Move,
    Profile,
    Track,
    minimum_snap,
    rest_to_rest,
    slow_down,
    speed_up,
    steady,
)
from companion.mission.segments import Segment
from companion.model.frames import wrap_rad
from companion.model.types import Joints, PhaseKind, Vec3

LAND_SPEED_UP_S = 1.0
LAND_SLOW_DOWN_S = 0.5
STOP_SPEED_MAX_M_S = 1.0
"""Largest initial speed of a landing from flight. A higher speed would move the point of rest farther away."""
STOP_ACCELERATION_M_S2 = 2.0
STOP_MIN_S = 0.5
ARM_LEAST_S = 0.1
"""Duration of a move of the arm to its current position."""


def stopping(velocity_world_m_s: Vec3) -> tuple[Vec3, float]:
    """Return the initial velocity of a stop, limited to `STOP_SPEED_MAX_M_S`, and its duration, s."""
    speed_m_s = math.hypot(*velocity_world_m_s)
    share = min(1.0, STOP_SPEED_MAX_M_S / speed_m_s) if speed_m_s > 0.0 else 0.0
    vx, vy, vz = velocity_world_m_s
    duration_s = max(STOP_MIN_S, REST_TO_REST_PEAK_SPEED * share * speed_m_s / STOP_ACCELERATION_M_S2)
    return (share * vx, share * vy, share * vz), duration_s


class PlanBuilder:
    """Builder that appends moves to the three tracks. `t_s` is the start of the next phase."""

    def __init__(self, position_world_m: Vec3, yaw_rad: float, arm_rad: Joints) -> None:
        self.t_s = 0.0
        self.segments: list[Segment] = []
        self._initial = (position_world_m, (yaw_rad,), arm_rad)
        self._at: list[tuple[float, ...]] = list(self._initial)
        self._moves: list[list[Motion]] = [[], [], []]

    @property
    def height_m(self) -> float:
        """Return the current height of the body's origin, m."""
        return self._at[0][2]

    @property
    def position_m(self) -> Vec3:
        """Return the current position, world frame, m."""
        x_m, y_m, z_m = self._at[0]
        return (x_m, y_m, z_m)

    @property
    def yaw_rad(self) -> float:
        """Return the current yaw, rad."""
        return self._at[1][0]

    def line_m(self, to_world_m: Vec3) -> float:
        """Return the distance of a point from the current position, m."""
        return math.dist(self._at[0], to_world_m)

    def move_vehicle(self, to_world_m: Vec3, duration_s: float) -> None:
        """Append a straight minimum-snap move."""
        self._go(0, to_world_m, self.t_s, duration_s, minimum_snap)

    def go(self, to_world_m: Vec3, duration_s: float) -> None:
        """Append a straight move from rest to rest with a lower peak speed than minimum snap."""
        self._go(0, to_world_m, self.t_s, duration_s, rest_to_rest)

    def follow(self, points_m: tuple[Vec3, ...], duration_s: float | None, limits: VehicleLimits) -> float:
        """Append a path through points without a stop; return its duration, s."""
        if len(points_m) == 1:
            duration_s = duration_s or least_line_s(self.line_m(points_m[0]), limits)
            self.move_vehicle(points_m[0], duration_s)
            return duration_s
        x_m, y_m, z_m = self._at[0]
        way = route(((x_m, y_m, z_m), *points_m), limits)
        scale_s = way.least_scale_s if duration_s is None else duration_s / way.knots[-1]
        duration_s = duration_s or scale_s * way.knots[-1]
        self._append(
            0,
            Curve(
                start_s=self.t_s,
                duration_s=duration_s,
                scale_s=scale_s,
                knots=way.knots,
                pieces=way.pieces,
                end=points_m[-1],
            ),
        )
        return duration_s

    def pieces(self, knots_s: Sequence[float], states: Sequence[tuple[Vec3, Vec3, Vec3, Vec3]]) -> None:
        """Append polynomial pieces of degree 7 through states of the vehicle; the first is its present one, at rest, and the last is at
        rest.

        Args:
            knots_s: times of the states, from 0.
            states: position, velocity, acceleration and jerk, world frame.
        """
        pieces = []
        for (begin_s, end_s), (before, after) in zip(pairwise(knots_s), pairwise(states), strict=True):
            x, y, z = (
                septic(
                    (before[0][i], before[1][i], before[2][i], before[3][i]),
                    (after[0][i], after[1][i], after[2][i], after[3][i]),
                    end_s - begin_s,
                )
                for i in range(3)
            )
            pieces.append((x, y, z))
        self._append(
            0,
            Curve(
                start_s=self.t_s,
                duration_s=knots_s[-1],
                scale_s=1.0,
                knots=tuple(knots_s),
                pieces=tuple(pieces),
                end=states[-1][0],
            ),
        )

    def turn(self, to_yaw_rad: float, duration_s: float) -> None:
        """Append a turn to the given yaw in the shorter direction."""
        self.turn_by(wrap_rad(to_yaw_rad - self.yaw_rad), duration_s)

    def turn_by(self, angle_rad: float, duration_s: float) -> None:
        """Append a turn by an angle, positive counterclockwise."""
        self._go(1, (self.yaw_rad + angle_rad,), self.t_s, duration_s, rest_to_rest)

    def least_arm_s(self, to_rad: Joints, limits: ArmLimits) -> float:
        """Return the shortest time in which the arm can move to the given pose, s."""
        delta_rad = self._arm_delta(to_rad)
        return plan_arm(delta_rad, limits).duration_s if any(delta_rad) else ARM_LEAST_S

    def move_arm(self, to_rad: Joints, delay_s: float, duration_s: float, limits: ArmLimits) -> None:
        """Append a move of the arm planned by Ruckig with the given duration."""
        delta_rad = self._arm_delta(to_rad)
        if any(delta_rad):
            profile = plan_arm(delta_rad, limits, duration_s).profile
            self._go(2, to_rad, self.t_s + delay_s, duration_s, profile)

    def fold_arm(self, to_rad: Joints, duration_s: float) -> None:
        """Append a move of the arm without Ruckig, for emergencies."""
        self._go(2, to_rad, self.t_s, duration_s, rest_to_rest)

    def stop(self, velocity_world_m_s: Vec3) -> float:
        """Append a stop from a velocity; return its end, s."""
        return self.stop_within(*stopping(velocity_world_m_s))

    def stop_within(self, velocity_world_m_s: Vec3, duration_s: float) -> float:
        """Append a stop of the given duration."""
        vx, vy, vz = velocity_world_m_s
        reach = duration_s
        self._append(
            0,
            Move(
                start_s=self.t_s,
                duration_s=duration_s,
                origin=self._at[0],
                delta=(vx * reach, vy * reach, vz * reach),
                profile=slow_down,
            ),
        )
        return self.t_s + duration_s

    def descend(self, speed_m_s: float, to_height_m: float) -> float:
        """Append a vertical descent from rest to rest; return its end, s."""
        x_m, y_m, z_m = self._at[0]
        depth_m = z_m - to_height_m
        ramps_m = 0.5 * speed_m_s * (LAND_SPEED_UP_S + LAND_SLOW_DOWN_S)
        if depth_m <= ramps_m:
            duration_s = max(STOP_MIN_S, REST_TO_REST_PEAK_SPEED * depth_m / speed_m_s)
            self._go(0, (x_m, y_m, min(z_m, to_height_m)), self.t_s, duration_s, rest_to_rest)
            return self.t_s + duration_s
        t_s = self.t_s
        steady_s = (depth_m - ramps_m) / speed_m_s
        for duration_s, profile in ((LAND_SPEED_UP_S, speed_up), (steady_s, steady), (LAND_SLOW_DOWN_S, slow_down)):
            if duration_s > 0.0:
                self._append(
                    0,
                    Move(
                        start_s=t_s,
                        duration_s=duration_s,
                        origin=self._at[0],
                        delta=(0.0, 0.0, -speed_m_s * duration_s),
                        profile=profile,
                    ),
                )
                t_s += duration_s
        return t_s

    def end_segment(self, name: str, kind: PhaseKind, index: int = -1, repetition: int = 0) -> None:
        """Append the segment from the end of the previous one, or from 0, to `t_s`; the other arguments are fields of `Segment`."""
        start_s = self.segments[-1].end_s if self.segments else 0.0
        self.segments.append(Segment(name, kind, start_s, self.t_s, index, repetition))

    def tracks(self) -> tuple[Track, Track, Track]:
        """Return the tracks of the position, the yaw and the arm."""
        position, yaw, arm = (
            Track(initial, tuple(moves)) for initial, moves in zip(self._initial, self._moves, strict=True)
        )
        return position, yaw, arm

    def _arm_delta(self, to_rad: Joints) -> Joints:
        return tuple([to - at for to, at in zip(to_rad, self._at[2], strict=True)])

    def _go(self, track: int, to: tuple[float, ...], start_s: float, duration_s: float, profile: Profile) -> None:
        delta = tuple(b - a for a, b in zip(self._at[track], to, strict=True))
        if any(delta):
            self._append(
                track,
                Move(start_s=start_s, duration_s=duration_s, origin=self._at[track], delta=delta, profile=profile),
            )
            self._at[track] = to  # exact to the last bit, so that the next phase does not depend on the previous one

    def _append(self, track: int, move: Motion) -> None:
        self._moves[track].append(move)
        self._at[track] = move.end
