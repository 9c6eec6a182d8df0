"""Plan of a mission: start and end of each phase, and the reference at every instant.

Pure and deterministic: a replay builds the same plan from the same mission and the same measured start.
"""

from __future__ import annotations

import math
from bisect import bisect_right
from dataclasses import dataclass, replace

from companion.config.mission import ArmMove, Land, Line, Mission, Path, Phase, Takeoff
from companion.config.vehicle import Vehicle
from companion.mission.arm_motion import ArmLimits, plan_arm
from companion.mission.minsnap import Progress, VehicleLimits, least_line_s, route
from companion.mission.reference import (
    REST_TO_REST_PEAK_SPEED,
    Curve,
    Motion,
    Move,
    Profile,
    Track,
    minimum_snap,
    reference_at,
    rest_to_rest,
    slow_down,
    speed_up,
    steady,
)
from companion.mission.segments import Repeats, Segment, counted, flown_phases, repeats_of
from companion.model.frames import wrap_rad
from companion.model.types import PhaseKind, Reference, Vec2, Vec3

BELOW_GROUND_M = 0.4
"""A landing's reference continues below the floor, so that the vehicle is pressed down until touchdown is detected. A soft law flies up
to 0.35 m above its reference in a sound laboratory; a standing vehicle stays within `tracking_error_warn_m` of it."""
LAND_SPEED_UP_S = 1.0
LAND_SLOW_DOWN_S = 0.5
STOP_SPEED_MAX_M_S = 1.0
"""Largest initial speed of a landing from flight. A higher speed would move the point of rest farther away."""
STOP_ACCELERATION_M_S2 = 2.0
STOP_MIN_S = 0.5
FOLD_SPEED_RAD_S = math.radians(75.0)
FOLD_MIN_S = 0.5
ARM_LEAST_S = 0.1
"""Duration of a move of the arm to its current position."""


@dataclass(frozen=True, slots=True)
class Plan:
    """Segments from 0 to `duration_s` and their motion. Built by `Plan.build` or `landing_from`."""

    name: str
    segments: tuple[Segment, ...]
    """Segments without gaps. A repeated mission has two repetitions here; `segment` computes the others."""
    duration_s: float
    _starts_s: tuple[float, ...]
    """Start of each segment, with at most two repetitions; the tracks use the same clock."""
    _position: Track
    _yaw: Track
    _arm: Track
    _repeats: Repeats | None = None

    @classmethod
    def build(
        cls,
        mission: Mission,
        vehicle: Vehicle,
        start_position_world_m: Vec3 | None = None,
        start_yaw_rad: float | None = None,
        start_arm_rad: Vec2 | None = None,
        progress: Progress | None = None,
    ) -> Plan:
        """Plan a mission from the measured start.

        The take-off ends over the mission's start point, at the mission's yaw and arm angles. The measured start differs from them by
        the start's tolerances at most (`check_mission`), and the difference is removed during the climb. A move with less time than the
        limits allow is still planned in that time; `check_mission` then reports which limit is exceeded, where and when.

        A path takes up to seconds to solve, once per process: its motion is the same from every start and is cached. Build a mission
        with paths once before the first control tick.

        Args:
            mission: phases; positions in the world frame.
            vehicle: height of the body's origin on the ground, and speed of the joints.
            start_position_world_m: measured, body origin; None for the mission's start, on the floor.
            start_yaw_rad: measured; None for the mission's value.
            start_arm_rad: measured joint angles as in the paper; None for the mission's values.
            progress: called with the completed share of the planning, 0 to 1, while paths are solved.
        """
        start = mission.start
        arm_start = _radians(start.arm_deg)
        yaw_start = math.radians(start.yaw_deg)
        builder = PlanBuilder(
            start_position_world_m or (*start.position_m, vehicle.airframe.ground_clearance_m),
            yaw_start if start_yaw_rad is None else start_yaw_rad,
            start_arm_rad or arm_start,
        )
        limits, arm_limits = _vehicle_limits(mission), _arm_limits(mission, vehicle)
        flown = flown_phases(mission)
        paths, solved = sum(isinstance(mission.phases[index], Path) for index, _ in flown), 0
        for index, repetition in flown:
            phase = mission.phases[index]
            start_s = builder.t_s
            kind = PhaseKind.FLIGHT
            if isinstance(phase, Takeoff):
                kind = PhaseKind.TAKEOFF
                x_m, y_m = start.position_m
                builder.move_vehicle((x_m, y_m, phase.height_m), phase.duration_s)
                builder.turn(yaw_start, phase.duration_s)
                builder.move_arm(arm_start, 0.0, phase.duration_s, arm_limits)
                builder.t_s += phase.duration_s
            elif isinstance(phase, Line):
                builder.t_s += _line(builder, phase, limits, arm_limits)
            elif isinstance(phase, Path):
                builder.t_s += builder.follow(phase.through_m, phase.duration_s, limits, _part(progress, solved, paths))
                solved += 1
            elif isinstance(phase, ArmMove):
                to_rad = _radians(phase.arm_deg)
                duration_s = phase.duration_s or builder.least_arm_s(to_rad, arm_limits)
                builder.move_arm(to_rad, 0.0, duration_s, arm_limits)
                builder.t_s += duration_s
            elif isinstance(phase, Land):
                kind = PhaseKind.LANDING
                builder.t_s = builder.descend(phase.speed_m_s, vehicle.airframe.ground_clearance_m - BELOW_GROUND_M)
            else:
                builder.t_s += phase.duration_s
            name = counted(_name(phase), repetition, mission.repeat)
            builder.segments.append(
                Segment(name=name, kind=kind, start_s=start_s, end_s=builder.t_s, index=index, repetition=repetition)
            )
        return builder.plan(
            mission.name, repeats_of(mission, builder.segments, tuple(map(_name, mission.phases[1:-1])))
        )

    def reference(self, t_s: float) -> Reference:
        """Return the reference at a time; at rest before 0 and after `duration_s`. Position, yaw and arm are C2 in time."""
        if self._repeats is not None:
            t_s -= self._repeats.before(t_s) * self._repeats.period_s
        return reference_at(self._position, self._yaw, self._arm, t_s)

    def jerks(self, t_s: float) -> tuple[Vec3, Vec2]:
        """Return the third derivatives of position (world frame, m/s^3) and joint angles (rad/s^3), for checks."""
        if self._repeats is not None:
            t_s -= self._repeats.before(t_s) * self._repeats.period_s
        (x, y, z), (first, second) = self._position.at(t_s)[3], self._arm.at(t_s)[3]
        return (x, y, z), (first, second)

    def segment(self, t_s: float) -> Segment:
        """Return the segment at a time: the first before 0, the last after the end."""
        repeats = self._repeats
        if repeats is not None and t_s >= repeats.begin_s + repeats.period_s:
            if t_s >= repeats.end_s:
                return self.segments[-1]
            return self._repeated(t_s, repeats)
        index = bisect_right(self._starts_s, t_s)
        return self.segments[index - 1 if index else 0]

    def _repeated(self, t_s: float, repeats: Repeats) -> Segment:
        """Return the segment of a repetition that the second one represents."""
        before = repeats.before(t_s)
        shift_s = before * repeats.period_s
        # The shift is rounded: just after the seam the shifted time may lie just before it.
        number = max(0, bisect_right(self._starts_s, t_s - shift_s) - 1 - repeats.first)
        number = min(number, len(repeats.names) - 1)
        like = self.segments[repeats.first + number]
        name = counted(repeats.names[number], before + 2, repeats.count)
        return Segment(
            name=name,
            kind=like.kind,
            start_s=like.start_s + shift_s,
            end_s=like.end_s + shift_s,
            index=like.index,
            repetition=before + 2,
        )

    def progress(self, t_s: float) -> float:
        """Return the completed share of the whole duration, 0 to 1."""
        share = t_s / self.duration_s
        return 0.0 if share <= 0.0 else share if share < 1.0 else 1.0


def landing_from(
    position_world_m: Vec3,
    velocity_world_m_s: Vec3,
    yaw_rad: float,
    arm_rad: Vec2,
    arm_fold_rad: Vec2,
    speed_m_s: float,
    vehicle: Vehicle,
) -> Plan:
    """Plan an immediate landing from any state: come to rest, then descend in place while the arm folds.

    The descent is delayed until the arm is folded before the net could touch the floor. Two segments, both PhaseKind.LANDING.

    Args:
        position_world_m: start of the reference: the measured position, or the last reference.
        velocity_world_m_s: initial velocity; limited to `STOP_SPEED_MAX_M_S`.
        yaw_rad: kept constant.
        arm_rad: start of the arm, from rest.
        arm_fold_rad: end of the arm.
        speed_m_s: speed of the descent.
        vehicle: height of the floor and reach of the arm.
    """
    builder = PlanBuilder(position_world_m, yaw_rad, arm_rad)
    fold_rad = max(abs(arm_fold_rad[0] - arm_rad[0]), abs(arm_fold_rad[1] - arm_rad[1]))
    fold_s = max(FOLD_MIN_S, REST_TO_REST_PEAK_SPEED * fold_rad / FOLD_SPEED_RAD_S)
    builder.fold_arm(arm_fold_rad, fold_s)
    stop_s = builder.stop(velocity_world_m_s)
    arm = vehicle.arm
    reach_m = sum(arm.link_lengths_m) - arm.shoulder_body_m[2] + vehicle.tool.net_radius_m
    free_s = max(0.0, builder.height_m - reach_m) / speed_m_s
    builder.t_s = max(stop_s, fold_s - free_s)
    builder.segments.append(Segment(name="stop", kind=PhaseKind.LANDING, start_s=0.0, end_s=builder.t_s, index=-1))
    start_s = builder.t_s
    end_s = builder.descend(speed_m_s, vehicle.airframe.ground_clearance_m - BELOW_GROUND_M)
    builder.t_s = max(end_s, fold_s)
    builder.segments.append(Segment(name="land", kind=PhaseKind.LANDING, start_s=start_s, end_s=builder.t_s, index=-1))
    return builder.plan("landing")


def stopping(velocity_world_m_s: Vec3) -> tuple[Vec3, float]:
    """Return the initial velocity of a stop, limited to `STOP_SPEED_MAX_M_S`, and its duration, s."""
    speed_m_s = math.hypot(*velocity_world_m_s)
    share = min(1.0, STOP_SPEED_MAX_M_S / speed_m_s) if speed_m_s > 0.0 else 0.0
    vx, vy, vz = velocity_world_m_s
    duration_s = max(STOP_MIN_S, REST_TO_REST_PEAK_SPEED * share * speed_m_s / STOP_ACCELERATION_M_S2)
    return (share * vx, share * vy, share * vz), duration_s


class PlanBuilder:
    """Builder that appends moves to the three tracks. `t_s` is the start of the next phase."""

    def __init__(self, position_world_m: Vec3, yaw_rad: float, arm_rad: Vec2) -> None:
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

    def line_m(self, to_world_m: Vec3) -> float:
        """Return the distance of a point from the current position, m."""
        return math.dist(self._at[0], to_world_m)

    def move_vehicle(self, to_world_m: Vec3, duration_s: float) -> None:
        """Append a straight minimum-snap move."""
        self._go(0, to_world_m, self.t_s, duration_s, minimum_snap)

    def go(self, to_world_m: Vec3, duration_s: float) -> None:
        """Append a straight move from rest to rest with a lower peak speed than minimum snap."""
        self._go(0, to_world_m, self.t_s, duration_s, rest_to_rest)

    def follow(
        self, points_m: tuple[Vec3, ...], duration_s: float | None, limits: VehicleLimits, progress: Progress | None
    ) -> float:
        """Append a path through points without a stop; returns its duration, s."""
        if len(points_m) == 1:
            duration_s = duration_s or least_line_s(self.line_m(points_m[0]), limits)
            self.move_vehicle(points_m[0], duration_s)
            return duration_s
        x_m, y_m, z_m = self._at[0]
        way = route(((x_m, y_m, z_m), *points_m), limits, progress)
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

    def turn(self, to_yaw_rad: float, duration_s: float) -> None:
        """Append a turn to a yaw, in the shorter direction."""
        yaw_rad = self._at[1][0]
        self._go(1, (yaw_rad + wrap_rad(to_yaw_rad - yaw_rad),), self.t_s, duration_s, rest_to_rest)

    def least_arm_s(self, to_rad: Vec2, limits: ArmLimits) -> float:
        """Return the least duration of a move of the arm, s."""
        delta_rad = self._arm_delta(to_rad)
        return plan_arm(delta_rad, limits).duration_s if any(delta_rad) else ARM_LEAST_S

    def move_arm(self, to_rad: Vec2, delay_s: float, duration_s: float, limits: ArmLimits) -> None:
        """Append a move of the arm by ruckig with the given duration."""
        delta_rad = self._arm_delta(to_rad)
        if any(delta_rad):
            profile = plan_arm(delta_rad, limits, duration_s).profile
            self._go(2, to_rad, self.t_s + delay_s, duration_s, profile)

    def fold_arm(self, to_rad: Vec2, duration_s: float) -> None:
        """Append a move of the arm without ruckig, for emergencies."""
        self._go(2, to_rad, self.t_s, duration_s, rest_to_rest)

    def stop(self, velocity_world_m_s: Vec3) -> float:
        """Append a stop from a velocity; returns its end, s."""
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
        """Append a vertical descent from rest to rest; returns its end, s."""
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

    def plan(self, name: str, repeats: Repeats | None = None) -> Plan:
        """Return the plan. Its second repetition represents all further ones."""
        position, yaw, arm = (
            Track(initial, tuple(moves)) for initial, moves in zip(self._initial, self._moves, strict=True)
        )
        segments, left_out_s = self.segments, 0.0
        starts_s = tuple(segment.start_s for segment in segments)
        if repeats is not None:
            left_out_s = repeats.left_out_s
            *earlier, last = segments
            segments = [*earlier, replace(last, start_s=repeats.end_s, end_s=last.end_s + left_out_s)]
        return Plan(
            name=name,
            segments=tuple(segments),
            duration_s=self.t_s + left_out_s,
            _starts_s=starts_s,
            _position=position,
            _yaw=yaw,
            _arm=arm,
            _repeats=repeats,
        )

    def _arm_delta(self, to_rad: Vec2) -> Vec2:
        first_rad, second_rad = self._at[2]
        return (to_rad[0] - first_rad, to_rad[1] - second_rad)

    def _go(self, track: int, to: tuple[float, ...], start_s: float, duration_s: float, profile: Profile) -> None:
        delta = tuple(b - a for a, b in zip(self._at[track], to, strict=True))
        if any(delta):
            self._append(
                track,
                Move(start_s=start_s, duration_s=duration_s, origin=self._at[track], delta=delta, profile=profile),
            )
            self._at[track] = to  # no difference in the last bit: the next phase does not depend on the previous one

    def _append(self, track: int, move: Motion) -> None:
        self._moves[track].append(move)
        self._at[track] = move.end


def _line(builder: PlanBuilder, phase: Line, limits: VehicleLimits, arm_limits: ArmLimits) -> float:
    """Append a line and the arm's simultaneous move; returns the duration, s."""
    arm_rad = None if phase.arm_deg is None else _radians(phase.arm_deg)
    delay_s = phase.arm_delay_s or 0.0
    duration_s = phase.duration_s
    if duration_s is None:
        duration_s = least_line_s(builder.line_m(phase.to_m), limits)
        if arm_rad is not None:
            arm_s = phase.arm_duration_s or builder.least_arm_s(arm_rad, arm_limits)
            duration_s = max(duration_s, delay_s + arm_s)
    builder.move_vehicle(phase.to_m, duration_s)
    if arm_rad is not None:
        builder.move_arm(arm_rad, delay_s, phase.arm_duration_s or duration_s - delay_s, arm_limits)
    return duration_s


def _vehicle_limits(mission: Mission) -> VehicleLimits:
    limits = mission.limits
    return VehicleLimits(limits.speed_max_m_s, limits.acceleration_max_m_s2, limits.jerk_max_m_s3)


def _arm_limits(mission: Mission, vehicle: Vehicle) -> ArmLimits:
    limits = mission.limits
    first, second = vehicle.arm.joints
    return ArmLimits(
        speed_max_rad_s=(
            math.radians(min(limits.arm_speed_max_deg_s, first.velocity_max_deg_s)),
            math.radians(min(limits.arm_speed_max_deg_s, second.velocity_max_deg_s)),
        ),
        acceleration_max_rad_s2=math.radians(limits.arm_acceleration_max_deg_s2),
        jerk_max_rad_s3=math.radians(limits.arm_jerk_max_deg_s3),
    )


def _part(progress: Progress | None, done: int, count: int) -> Progress | None:
    """Return a progress callback that converts the progress of one path into that of all."""
    return None if progress is None else lambda share: progress((done + share) / count)


def _radians(angle_deg: Vec2) -> Vec2:
    return (math.radians(angle_deg[0]), math.radians(angle_deg[1]))


_PLAIN_NAMES = {"takeoff": "take-off", "hold": "hold", "land": "land"}


def _name(phase: Phase) -> str:
    return phase.name or _default_name(phase)


def _default_name(phase: Phase) -> str:
    if isinstance(phase, Line):
        return f"line to ({', '.join(f'{value:g}' for value in phase.to_m)}) m"
    if isinstance(phase, Path):
        return f"path to ({', '.join(f'{value:g}' for value in phase.through_m[-1])}) m"
    if isinstance(phase, ArmMove):
        return f"arm to ({', '.join(f'{value:g}' for value in phase.arm_deg)}) deg"
    return _PLAIN_NAMES[phase.type]
