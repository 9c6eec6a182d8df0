"""Is a mission flyable as written? Everything that geometry and mechanics can tell before anything is armed.

Pure: the plan is sampled finely and every sample is held against room, tether, joint walls, floor, limits and thrust.
"""

from __future__ import annotations

import math
from collections.abc import Iterator, Sequence
from dataclasses import dataclass

from companion.config.mission import Mission
from companion.config.vehicle import Vehicle
from companion.control.manipulator import GRAVITY_M_S2, Manipulator
from companion.frames import quat_from_euler_zyx, wrap_rad
from companion.mission.minsnap import Progress
from companion.mission.plan import Plan, Segment
from companion.safety.tether import allowed_m, distance_m
from companion.types import PhaseKind, Reference, Vec2, Vec3

SAMPLE_S = 0.02
SAMPLES_PER_SEGMENT_MAX = 3000
BODY_TOP_M = 0.15
"""Rotors and markers above the body's origin."""
ARM_RADIUS_M = 0.03
"""Half the thickness of servos and links."""
FLOOR_GAP_M = 0.01
TAKEOFF_RISE_MIN_M = 0.2
CATCH_NEAR_M = 0.05
TOLERANCE = 1e-6
"""Relative; so that a mission may use its limits to the full."""


@dataclass(frozen=True, slots=True)
class _Violation:
    """One limit exceeded in one sample. `excess` orders violations of the same limit."""

    limit: str
    excess: float
    what: str
    detail: str
    advice: str


def check_mission(
    mission: Mission,
    vehicle: Vehicle,
    *,
    start_position_world_m: Vec3 | None = None,
    start_yaw_rad: float | None = None,
    start_arm_rad: Vec2 | None = None,
    phase_origins: Sequence[str] = (),
    progress: Progress | None = None,
) -> list[str]:
    """Every reason not to fly this mission, one clear line each: what, where, when, how to fix; empty if there is none.

    Of each limit, the worst violation in the first phase that exceeds it is told, and which other phases do.

    Args:
        mission: what is to be flown.
        vehicle: with what, and where.
        start_position_world_m: measured, body origin; None: as the mission says, standing on the floor.
        start_yaw_rad: measured; None: as the mission says.
        start_arm_rad: measured, the paper's angles; None: as the mission says.
        phase_origins: file:line:col of each phase (`FlightConfig.sources.phases`).
        progress: told the share of the planning that is done, 0 to 1, while paths are solved.
    """
    start = mission.start
    position = start_position_world_m or (*start.position_m, vehicle.airframe.ground_clearance_m)
    yaw_rad = math.radians(start.yaw_deg) if start_yaw_rad is None else start_yaw_rad
    plan = Plan.build(mission, vehicle, position, yaw_rad, start_arm_rad, progress)
    problems = check_start(mission, vehicle, position, yaw_rad, start_arm_rad)
    problems += _whole(mission, vehicle, plan, phase_origins)
    judge = _Judge(mission, vehicle)
    told: dict[str, str] = {}
    also: dict[str, list[str]] = {}
    for segment in plan.segments:
        worst: dict[str, tuple[_Violation, float, Reference]] = {}
        for t_s in _samples(segment):
            reference = plan.reference(t_s)
            for violation in judge.violations(reference, plan.jerks(t_s), segment.kind):
                known = worst.get(violation.limit)
                if known is None or violation.excess > known[0].excess:
                    worst[violation.limit] = (violation, t_s, reference)
        for limit, (violation, t_s, reference) in worst.items():
            if limit in told:
                also[limit].append(f"'{segment.name}'")
                continue
            x, y, z = reference.position_world_m
            also[limit] = []
            told[limit] = (
                f"{_place(mission, segment, phase_origins)} {violation.what} at t = {t_s:.1f} s, "
                f"({x:z.2f}, {y:z.2f}, {z:z.2f}) m: {violation.detail}; {violation.advice}"
            )
    for limit, text in told.items():
        problems.append(text + (f" (also in {', '.join(also[limit])})" if also[limit] else ""))
    return problems


def _place(mission: Mission, segment: Segment, phase_origins: Sequence[str]) -> str:
    origin = f"{phase_origins[segment.index]}: " if segment.index < len(phase_origins) else ""
    return f"{origin}mission '{mission.name}', phase '{segment.name}'"


def _samples(segment: Segment) -> Iterator[float]:
    duration_s = segment.end_s - segment.start_s
    count = min(SAMPLES_PER_SEGMENT_MAX, max(20, math.ceil(duration_s / SAMPLE_S)))
    for index in range(count):
        yield segment.start_s + duration_s * index / count
    yield segment.end_s - 1e-9  # the end itself is the next one's beginning


def check_start(
    mission: Mission, vehicle: Vehicle, position_world_m: Vec3, yaw_rad: float, arm_rad: Vec2 | None
) -> list[str]:
    """Only what depends on where the machine really stands; cheap enough for a control tick. Arguments as `check_mission`."""
    found = _start(mission, vehicle, position_world_m, yaw_rad, arm_rad)
    return [f"mission '{mission.name}': {text}" for text in found]


def _start(mission: Mission, vehicle: Vehicle, position: Vec3, yaw_rad: float, arm_rad: Vec2 | None) -> Iterator[str]:
    """Does the machine stand where and as the mission says?"""
    start = mission.start
    x_m, y_m = start.position_m
    away_m = math.dist(position[:2], start.position_m)
    if away_m > start.tolerance_m:
        yield (
            f"starts at ({x_m:g}, {y_m:g}) m, but the vehicle stands at ({position[0]:.2f}, {position[1]:.2f}) m, "
            f"{away_m:.2f} m away, {start.tolerance_m:g} m allowed; carry it there or change start.position_m"
        )
    clearance_m = vehicle.airframe.ground_clearance_m
    if abs(position[2] - clearance_m) > start.tolerance_m:
        yield (
            f"starts on the floor, with the body's origin at z = {clearance_m:.2f} m (airframe.ground_clearance_m), "
            f"but z = {position[2]:.2f} m was measured; check the floor of the motion-capture volume and the pivot of the rigid body"
        )
    turned_deg = abs(math.degrees(wrap_rad(yaw_rad - math.radians(start.yaw_deg))))
    if turned_deg > start.yaw_tolerance_deg:
        yield (
            f"starts at a yaw of {start.yaw_deg:g} deg, but the vehicle stands at {math.degrees(wrap_rad(yaw_rad)):.0f} deg, "
            f"{start.yaw_tolerance_deg:g} deg of difference allowed; turn it or change start.yaw_deg"
        )
    if arm_rad is not None:
        measured_deg = [math.degrees(angle) for angle in arm_rad]
        off_deg = max(abs(a - b) for a, b in zip(measured_deg, start.arm_deg, strict=True))
        if off_deg > start.arm_tolerance_deg:
            yield (
                f"starts with the arm at ({start.arm_deg[0]:g}, {start.arm_deg[1]:g}) deg, but it is at ({measured_deg[0]:.0f}, "
                f"{measured_deg[1]:.0f}) deg, {start.arm_tolerance_deg:g} deg of difference allowed; move it there by hand"
            )


def _whole(mission: Mission, vehicle: Vehicle, plan: Plan, phase_origins: Sequence[str]) -> list[str]:
    """What no single sample shows."""
    problems: list[str] = []
    takeoff = plan.segments[0]
    top_m = plan.reference(takeoff.end_s).position_world_m[2]
    clearance_m = vehicle.airframe.ground_clearance_m
    if top_m < clearance_m + TAKEOFF_RISE_MIN_M:
        problems.append(
            f"{_place(mission, takeoff, phase_origins)} ends at {top_m:g} m, but the body's origin is "
            f"{clearance_m:g} m above the floor when the vehicle stands; set height_m to {clearance_m + TAKEOFF_RISE_MIN_M:g} or more"
        )
    if mission.catch is not None:
        flown = [segment for segment in plan.segments if segment.kind is PhaseKind.FLIGHT]
        near_m = min(
            (
                math.dist(plan.reference(t_s).position_world_m[:2], mission.catch.expected_at_m)
                for segment in flown
                for t_s in _samples(segment)
            ),
            default=math.inf,
        )
        if near_m > CATCH_NEAR_M:
            x_m, y_m = mission.catch.expected_at_m
            problems.append(
                f"mission '{mission.name}': expects the payload at ({x_m:g}, {y_m:g}) m, but never comes nearer than {near_m:.2f} m; "
                "change catch.expected_at_m or the lines"
            )
    return problems


class _Judge:
    """Holds one instant of the plan against every limit."""

    def __init__(self, mission: Mission, vehicle: Vehicle) -> None:
        self._limits = mission.limits
        self._vehicle = vehicle
        self._manipulator = Manipulator(vehicle.arm, vehicle.tool)
        payload_kg = mission.catch.payload_max_kg if mission.catch is not None else 0.0
        self._mass_kg = vehicle.airframe.mass_kg + payload_kg

    def violations(self, reference: Reference, jerks: tuple[Vec3, Vec2], kind: PhaseKind) -> Iterator[_Violation]:
        clearance_m = self._vehicle.airframe.ground_clearance_m
        x_m, y_m, z_m = reference.position_world_m
        if kind is PhaseKind.LANDING and z_m < clearance_m:
            return  # the reference goes on below the floor until touchdown is detected
        if kind is PhaseKind.FLIGHT and z_m < clearance_m - TOLERANCE:
            yield _Violation(
                "floor",
                clearance_m - z_m,
                "flies into the floor",
                f"the body's origin at {z_m:.2f} m, {clearance_m:.2f} m is the lowest",
                "raise the waypoint",
            )
        position = (x_m, y_m, max(z_m, clearance_m)) if kind is PhaseKind.TAKEOFF else reference.position_world_m
        yield from self._space(position, reference)
        yield from self._arm(position, reference)
        yield from self._motion(reference, jerks)

    def _space(self, position: Vec3, reference: Reference) -> Iterator[_Violation]:
        vehicle = self._vehicle
        net_m = _world(position, reference.yaw_rad, self._manipulator.net_body_m(reference.arm_rad))
        net_radius_m = vehicle.tool.net_radius_m
        radius_m = vehicle.airframe.radius_m
        room = vehicle.room
        for axis, name, span in ((0, "x", room.x_m), (1, "y", room.y_m), (2, "z", room.z_m)):
            if axis == 2 and position[2] < vehicle.airframe.ground_clearance_m:
                continue  # told as flying into the floor
            low = min(position[axis] - radius_m, net_m[axis] - net_radius_m) if axis < 2 else position[2]
            high = max(position[axis] + (radius_m if axis < 2 else BODY_TOP_M), net_m[axis] + net_radius_m)
            for edge, excess, reach in (("low", span[0] - low, low), ("high", high - span[1], high)):
                if excess > TOLERANCE:
                    yield _Violation(
                        f"room {name} {edge}",
                        excess,
                        "leaves the room",
                        f"rotors, arm and net reach {name} = {reach:.2f} m, the room is {span[0]:g} to {span[1]:g} m",
                        "move the waypoint inwards",
                    )
        attitude = quat_from_euler_zyx(0.0, 0.0, reference.yaw_rad)
        away_m = distance_m(vehicle.tether, position, attitude)
        limit_m = allowed_m(vehicle.tether)
        if away_m > limit_m + TOLERANCE:
            yield _Violation(
                "tether",
                away_m - limit_m,
                "leaves the tether sphere",
                f"{away_m:.2f} m from the anchor, {limit_m:.2f} m allowed",
                "shorten the line or move the anchor",
            )

    def _arm(self, position: Vec3, reference: Reference) -> Iterator[_Violation]:
        arm = self._vehicle.arm
        for number, (angle_rad, joint) in enumerate(zip(reference.arm_rad, arm.joints, strict=True), start=1):
            angle_deg = math.degrees(angle_rad)
            low_deg, high_deg = joint.angle_deg
            excess = max(low_deg - angle_deg, angle_deg - high_deg)
            if excess > TOLERANCE:
                what = f"drives joint {number} through its wall"
                detail = f"{angle_deg:.1f} deg, {low_deg:g} to {high_deg:g} deg allowed"
                yield _Violation(f"joint {number}", excess, what, detail, "change arm_deg")
        net_z_m = position[2] + self._manipulator.net_body_m(reference.arm_rad)[2] - self._vehicle.tool.net_radius_m
        elbow_z_m = position[2] + self._manipulator.elbow_body_m(reference.arm_rad)[2] - ARM_RADIUS_M
        for part, lowest_m in (("net", net_z_m), ("elbow", elbow_z_m)):
            if lowest_m < FLOOR_GAP_M:
                what = f"drags the {part} over the floor"
                detail = f"its lowest point is {lowest_m:.2f} m high, {FLOOR_GAP_M:g} m is the least"
                yield _Violation(
                    f"floor {part}", FLOOR_GAP_M - lowest_m, what, detail, "fly higher or fold the arm first"
                )

    def _motion(self, reference: Reference, jerks: tuple[Vec3, Vec2]) -> Iterator[_Violation]:
        limits = self._limits
        speed = math.hypot(*reference.velocity_world_m_s)
        acceleration = math.hypot(*reference.acceleration_world_m_s2)
        arm_speed = math.degrees(max(map(abs, reference.arm_rate_rad_s)))
        arm_acceleration = math.degrees(max(map(abs, reference.arm_acceleration_rad_s2)))
        jerk = math.hypot(*jerks[0])
        arm_jerk = math.degrees(max(map(abs, jerks[1])))
        checked = (
            ("speed_max_m_s", speed, limits.speed_max_m_s, "m/s", "flies too fast"),
            ("acceleration_max_m_s2", acceleration, limits.acceleration_max_m_s2, "m/s^2", "accelerates too hard"),
            ("jerk_max_m_s3", jerk, limits.jerk_max_m_s3, "m/s^3", "starts or stops too abruptly"),
            ("arm_speed_max_deg_s", arm_speed, limits.arm_speed_max_deg_s, "deg/s", "turns a joint too fast"),
            (
                "arm_acceleration_max_deg_s2",
                arm_acceleration,
                limits.arm_acceleration_max_deg_s2,
                "deg/s^2",
                "accelerates a joint too hard",
            ),
            ("arm_jerk_max_deg_s3", arm_jerk, limits.arm_jerk_max_deg_s3, "deg/s^3", "jerks a joint"),
        )
        for key, value, limit, unit, what in checked:
            if value > limit * (1.0 + TOLERANCE):
                detail = f"{value:.3g} {unit}, limits.{key} is {limit:g}"
                yield _Violation(key, value / limit, what, detail, "take longer or go less far")
        for number, joint in enumerate(self._vehicle.arm.joints, start=1):
            rate = abs(math.degrees(reference.arm_rate_rad_s[number - 1]))
            if rate > joint.velocity_max_deg_s * (1.0 + TOLERANCE):
                what = f"turns joint {number} faster than it can"
                detail = f"{rate:.3g} deg/s, the joint's velocity_max_deg_s is {joint.velocity_max_deg_s:g}"
                yield _Violation(f"velocity {number}", rate, what, detail, "take longer or go less far")
        ax, ay, az = reference.acceleration_world_m_s2
        airframe = self._vehicle.airframe
        thrust_n = self._mass_kg * math.hypot(ax, ay, az + GRAVITY_M_S2)
        allowed_n = limits.thrust_share_max * airframe.thrust_max_n
        if thrust_n > allowed_n * (1.0 + TOLERANCE):
            detail = (
                f"{thrust_n:.1f} N with the largest payload, {allowed_n:.1f} N allowed "
                f"({limits.thrust_share_max:g} of {airframe.thrust_max_n:g} N)"
            )
            yield _Violation("thrust", thrust_n, "needs too much thrust", detail, "take longer or carry less")
        tilt_deg = math.degrees(math.atan2(math.hypot(ax, ay), az + GRAVITY_M_S2))
        if tilt_deg > airframe.tilt_max_deg * (1.0 + TOLERANCE):
            detail = f"{tilt_deg:.1f} deg, airframe.tilt_max_deg is {airframe.tilt_max_deg:g}"
            yield _Violation("tilt", tilt_deg, "leans too far", detail, "take longer or go less far")


def _world(position: Vec3, yaw_rad: float, body_m: Vec3) -> Vec3:
    """A point of the level vehicle, world frame."""
    c, s = math.cos(yaw_rad), math.sin(yaw_rad)
    x_m, y_m, z_m = body_m
    return (position[0] + c * x_m - s * y_m, position[1] + s * x_m + c * y_m, position[2] + z_m)
