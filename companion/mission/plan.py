"""Plan of a mission: start and end of each phase, and the reference at every instant.

Pure and deterministic: a replay builds the same plan from the same mission and the same measured start.
"""

from __future__ import annotations

import math
from bisect import bisect_right
from dataclasses import dataclass, replace

from companion.config.mission import Mission
from companion.config.vehicle import Vehicle
from companion.mission.arm_motion import ArmLimits
from companion.mission.minsnap import VehicleLimits
from companion.mission.phase import Planning, phases_of
from companion.mission.plan_builder import PlanBuilder
from companion.mission.reference import REST_TO_REST_PEAK_SPEED, Track, reference_at
from companion.mission.segments import Repeats, Segment, counted, flown_phases, repeats_of
from companion.model.types import Joints, PhaseKind, Reference, Vec3

BELOW_GROUND_M = 0.4
"""A landing's reference continues below the floor, so that the vehicle is pressed down until touchdown is detected. A soft controller
flies up to 0.35 m above its reference; on the ground the vehicle stays within `tracking_error_warn_m` of it.
"""
FOLD_SPEED_RAD_S = math.radians(75.0)
FOLD_MIN_S = 0.5
BACK_SPEED_M_S = 0.2
"""Largest speed of the retreat from a surface before a landing."""
BACK_MIN_S = 1.0


@dataclass(frozen=True, slots=True)
class Plan:
    """The segments from 0 to `duration_s` and their motion. `Plan.build` and `landing_from` build it."""

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
        start_arm_rad: Joints | None = None,
    ) -> Plan:
        """Plan a mission from the measured start.

        The take-off ends over the mission's start point, at the mission's yaw and arm angles. The measured start differs from them by
        the start's tolerances at most (`check_mission`), and the difference is removed during the climb. A move with less time than the
        limits allow is still planned in that time; `check_mission` then reports which limit is exceeded, where and when.

        A path may take seconds to solve, once per process: its motion is the same from every start and is cached. Build a mission with
        paths once before the first control tick.

        Args:
            mission: phases; positions in the world frame.
            vehicle: provides the height of the body's origin on the ground and the speed of the joints.
            start_position_world_m: measured position of the body's origin; None for the mission's start, on the floor.
            start_yaw_rad: measured yaw; None for the mission's value.
            start_arm_rad: measured joint angles as in the paper; None for the mission's values.
        """
        start = mission.start
        builder = PlanBuilder(
            start_position_world_m or (*start.position_m, vehicle.airframe.ground_clearance_m),
            math.radians(start.yaw_deg) if start_yaw_rad is None else start_yaw_rad,
            start_arm_rad or tuple(map(math.radians, start.arm_deg)),
        )
        limits, arm_limits = _vehicle_limits(mission), _arm_limits(mission, vehicle)
        phases, flown = phases_of(mission), flown_phases(mission)
        for index, repetition in flown:
            phase = phases[index]
            phase.plan(Planning(builder, mission, vehicle, limits, arm_limits, phases[:index]))
            builder.end_segment(counted(phase.title, repetition, mission.repeat), phase.kind, index, repetition)
        repeats = repeats_of(mission, builder.segments, tuple([phase.title for phase in phases[1:-1]]))
        return cls.of(builder, repeats)

    @classmethod
    def of(cls, builder: PlanBuilder, repeats: Repeats | None = None) -> Plan:
        """Return the plan of a builder's segments and tracks. Its second repetition is replayed in place of all later ones."""
        segments, left_out_s = builder.segments, 0.0
        starts_s = tuple(segment.start_s for segment in segments)
        if repeats is not None:
            left_out_s = repeats.left_out_s
            *earlier, last = segments
            segments = [*earlier, replace(last, start_s=repeats.end_s, end_s=last.end_s + left_out_s)]
        position, yaw, arm = builder.tracks()
        return cls(
            segments=tuple(segments),
            duration_s=builder.t_s + left_out_s,
            _starts_s=starts_s,
            _position=position,
            _yaw=yaw,
            _arm=arm,
            _repeats=repeats,
        )

    def reference(self, t_s: float) -> Reference:
        """Return the reference at a time; at rest before 0 and after `duration_s`. Position, yaw and arm are C2 in time."""
        if self._repeats is not None:
            t_s -= self._repeats.before(t_s) * self._repeats.period_s
        return reference_at(self._position, self._yaw, self._arm, t_s)

    def jerks(self, t_s: float) -> tuple[Vec3, Joints]:
        """Return the third derivatives of position (world frame, m/s^3) and joint angles (rad/s^3), for checks."""
        if self._repeats is not None:
            t_s -= self._repeats.before(t_s) * self._repeats.period_s
        x, y, z = self._position.at(t_s)[3]
        return (x, y, z), self._arm.at(t_s)[3]

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
        before = repeats.before(t_s)
        shift_s = before * repeats.period_s
        # The shift is rounded: just after the seam the shifted time may lie just before it.
        number = max(0, bisect_right(self._starts_s, t_s - shift_s) - 1 - repeats.first)
        number = min(number, len(repeats.names) - 1)
        like = self.segments[repeats.first + number]
        name = counted(repeats.names[number], before + 2, repeats.count)
        start_s, end_s = like.start_s + shift_s, like.end_s + shift_s
        return replace(like, name=name, start_s=start_s, end_s=end_s, repetition=before + 2)

    def progress(self, t_s: float) -> float:
        """Return the completed fraction of the whole duration, 0 to 1."""
        share = t_s / self.duration_s
        return 0.0 if share <= 0.0 else share if share < 1.0 else 1.0


def landing_from(
    position_world_m: Vec3,
    velocity_world_m_s: Vec3,
    yaw_rad: float,
    arm_rad: Joints,
    arm_fold_rad: Joints,
    speed_m_s: float,
    vehicle: Vehicle,
    back_to_m: Vec3 | None = None,
) -> Plan:
    """Plan an immediate landing from any state: come to rest, then descend in place while the arm folds.

    The descent is delayed if necessary, so that the arm is folded before the net can touch the floor. The plan has two segments, both
    PhaseKind.LANDING.

    Args:
        position_world_m: start of the reference: the measured position, or the last reference.
        velocity_world_m_s: initial velocity; limited to `STOP_SPEED_MAX_M_S`.
        yaw_rad: kept constant.
        arm_rad: joint angles at the start, at rest.
        arm_fold_rad: joint angles at the end.
        vehicle: provides the height of the floor and the reach of the arm.
        back_to_m: position to go to before everything else, from a surface that the tool may touch.
    """
    builder = PlanBuilder(position_world_m, yaw_rad, arm_rad)
    if back_to_m is not None:
        velocity_world_m_s = go_back(builder, back_to_m, PhaseKind.LANDING)
    back_s = builder.t_s
    fold_s = fold_time_s(arm_rad, arm_fold_rad)
    builder.fold_arm(arm_fold_rad, fold_s)
    stop_s = builder.stop(velocity_world_m_s)
    arm = vehicle.arm
    reach_m = vehicle.reach_m - arm.first_joint_body_m[2] + vehicle.tip_radius_m
    free_s = max(0.0, builder.height_m - reach_m) / speed_m_s
    builder.t_s = max(stop_s, back_s + fold_s - free_s)
    builder.end_segment("stop", PhaseKind.LANDING)
    end_s = builder.descend(speed_m_s, vehicle.airframe.ground_clearance_m - BELOW_GROUND_M)
    builder.t_s = max(end_s, back_s + fold_s)
    builder.end_segment("land", PhaseKind.LANDING)
    return Plan.of(builder)


def go_back(builder: PlanBuilder, to_m: Vec3, kind: PhaseKind) -> Vec3:
    """Begin a plan with the way back from a surface; return the velocity at its end."""
    duration_s = max(BACK_MIN_S, REST_TO_REST_PEAK_SPEED * builder.line_m(to_m) / BACK_SPEED_M_S)
    builder.go(to_m, duration_s)
    builder.t_s = duration_s
    builder.end_segment("back", kind)
    return (0.0, 0.0, 0.0)


def fold_time_s(arm_rad: Joints, arm_fold_rad: Joints) -> float:
    """Return the duration of an emergency fold of the arm, s; 0 if there is no arm."""
    if not arm_rad:
        return 0.0
    farthest_rad = max(abs(to - at) for to, at in zip(arm_fold_rad, arm_rad, strict=True))
    return max(FOLD_MIN_S, REST_TO_REST_PEAK_SPEED * farthest_rad / FOLD_SPEED_RAD_S)


def _vehicle_limits(mission: Mission) -> VehicleLimits:
    limits = mission.limits
    return VehicleLimits(limits.speed_max_m_s, limits.acceleration_max_m_s2, limits.jerk_max_m_s3)


def _arm_limits(mission: Mission, vehicle: Vehicle) -> ArmLimits:
    limits = mission.limits
    return ArmLimits(
        speed_max_rad_s=tuple(
            math.radians(min(limits.arm_speed_max_deg_s, joint.velocity_max_deg_s)) for joint in vehicle.arm.joints
        ),
        acceleration_max_rad_s2=math.radians(limits.arm_acceleration_max_deg_s2),
        jerk_max_rad_s3=math.radians(limits.arm_jerk_max_deg_s3),
    )
