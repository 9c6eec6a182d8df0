"""Before arming, checks from geometry and mechanics whether a mission can be flown as written. No I/O.

The plan is sampled finely, and every sample is checked against the room, the tether, the joint limits, the floor, the motion limits and
the thrust.
"""

from __future__ import annotations

import math
from collections.abc import Iterator, Sequence

from companion.config.mission import Mission
from companion.config.vehicle import Vehicle
from companion.mission.phase import Checking, phases_of
from companion.mission.plan import Plan
from companion.mission.sample_check import CATCH_NEAR_M, STOP, SampleCheck
from companion.mission.segments import Segment
from companion.mission.violation import Violation
from companion.model.frames import wrap_rad
from companion.model.listing import listed
from companion.model.types import Joints, PhaseKind, Reference, Vec3
from companion.safety.governor import SafeSet

SAMPLE_S = 0.02
SAMPLES_PER_SEGMENT_MAX = 3000
SPEED_SHARE_MAX = 0.8
"""Largest planned speed as a fraction of the speed at which the flight is stopped. The rest is a margin for a caught payload, gusts
and tracking errors.
"""


def check_mission(
    mission: Mission,
    vehicle: Vehicle,
    *,
    start_position_world_m: Vec3 | None = None,
    start_yaw_rad: float | None = None,
    start_arm_rad: Joints | None = None,
    phase_origins: Sequence[str] = (),
) -> list[str]:
    """Return every reason not to fly this mission, one line each: what, where, when, and how to fix it. The list is empty if there
    is none.

    For each limit the worst violation in the first phase that exceeds it is reported, with the names of the other phases that
    exceed it. Two repetitions of a repeated mission are checked: later ones differ from the second only in the winding of the
    tether, which adds up.

    Args:
        start_position_world_m: measured position of the body's origin; None for the mission's start, on the floor.
        start_yaw_rad: measured yaw; None for the mission's value.
        start_arm_rad: measured joint angles as in the paper; None for the mission's values.
        phase_origins: file:line:col of each phase (`FlightConfig.sources.phases`).
    """
    start = mission.start
    position = start_position_world_m or (*start.position_m, vehicle.airframe.ground_clearance_m)
    yaw_rad = math.radians(start.yaw_deg) if start_yaw_rad is None else start_yaw_rad
    problems = check_vehicle(vehicle)
    if problems:
        return problems
    plan = Plan.build(mission, vehicle, position, yaw_rad, start_arm_rad)
    problems = check_start(mission, vehicle, position, yaw_rad, start_arm_rad)
    problems += [
        *_speed(mission, vehicle),
        *_of_phases(mission, vehicle, plan, phase_origins),
        *_catch(mission, vehicle, plan, phase_origins),
    ]
    samples = SampleCheck(mission, vehicle)
    told: dict[str, str] = {}
    where: dict[str, set[int]] = {}
    also: dict[str, list[str]] = {}
    repetition = 0
    for segment in plan.segments:
        if segment.repetition != repetition:
            repetition = segment.repetition
            samples.begin_repetition(repetition)
        worst: dict[str, tuple[Violation, float, Reference]] = {}
        for t_s in _samples(segment):
            reference = plan.reference(t_s)
            for violation in samples.violations(t_s, reference, plan.jerks(t_s), segment.kind):
                known = worst.get(violation.limit)
                if known is None or violation.excess > known[0].excess:
                    worst[violation.limit] = (violation, t_s, reference)
        for limit, (violation, t_s, reference) in worst.items():
            if limit.startswith(STOP) and any(other.startswith(limit.removeprefix(STOP)) for other in worst):
                continue  # the path itself leads out
            if limit in told:
                if segment.index not in where[limit]:
                    where[limit].add(segment.index)
                    also[limit].append(f"'{segment.name}'")
                continue
            x, y, z = reference.position_world_m
            where[limit] = {segment.index}
            also[limit] = []
            told[limit] = (
                f"{_place(mission, segment, phase_origins)} {violation.what} at t = {t_s:.1f} s, "
                f"({x:z.2f}, {y:z.2f}, {z:z.2f}) m: {violation.detail}; {violation.advice}"
            )
    for limit, text in told.items():
        problems.append(text + (f" (also in {', '.join(also[limit])})" if also[limit] else ""))
    turns = samples.turns_in_the_end(mission.repeat)
    if vehicle.tether is not None and "turns" not in told and turns > vehicle.tether.turns_max:
        problems.append(
            f"mission '{mission.name}': its {mission.repeat} repetitions wind up the tether: {turns:.2f} turns about anchor or vehicle "
            f"at the end (tether.turns_max is {vehicle.tether.turns_max:g}); fly back the way it came, or lower repeat"
        )
    return problems


def check_vehicle(vehicle: Vehicle) -> list[str]:
    """Return the reasons why nothing can be flown with this vehicle, tether and room, whatever the mission; one line each."""
    problems = []
    tether, thrust_n = vehicle.tether, vehicle.airframe.thrust_max_n
    if tether is not None and tether.load_rating_n < thrust_n:
        problems.append(
            f"vehicle '{vehicle.name}': tether.load_rating_n is {tether.load_rating_n:g} N, but the rotors pull with {thrust_n:g} N "
            "(airframe.thrust_max_n); the tether must hold them: use a stronger one"
        )
    try:
        SafeSet(vehicle)
    except ValueError as error:
        problems.append(str(error))
    return problems


def _place(mission: Mission, segment: Segment, phase_origins: Sequence[str]) -> str:
    origin = f"{phase_origins[segment.index]}: " if segment.index < len(phase_origins) else ""
    return f"{origin}mission '{mission.name}', phase '{segment.name}'"


def _samples(segment: Segment) -> Iterator[float]:
    duration_s = segment.end_s - segment.start_s
    count = min(SAMPLES_PER_SEGMENT_MAX, max(20, math.ceil(duration_s / SAMPLE_S)))
    for index in range(count):
        yield segment.start_s + duration_s * index / count
    yield segment.end_s - 1e-9  # the end belongs to the next segment


def check_start(
    mission: Mission, vehicle: Vehicle, position_world_m: Vec3, yaw_rad: float, arm_rad: Joints | None
) -> list[str]:
    """Return only the reasons that depend on the measured start, fast enough for a tick; arguments of `check_mission`."""
    found = _start(mission, vehicle, position_world_m, yaw_rad, arm_rad)
    return [f"mission '{mission.name}': {text}" for text in found]


def _start(mission: Mission, vehicle: Vehicle, position: Vec3, yaw_rad: float, arm_rad: Joints | None) -> Iterator[str]:
    start = mission.start
    x_m, y_m = start.position_m
    away_m = math.dist(position[:2], start.position_m)
    if away_m > start.tolerance_m:
        yield (
            f"starts at ({x_m:g}, {y_m:g}) m, but the vehicle is at ({position[0]:.2f}, {position[1]:.2f}) m, "
            f"{away_m:.2f} m away (tolerance {start.tolerance_m:g} m); carry it there or change start.position_m"
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
            f"starts at a yaw of {start.yaw_deg:g} deg, but the vehicle's yaw is {math.degrees(wrap_rad(yaw_rad)):.0f} deg "
            f"(tolerance {start.yaw_tolerance_deg:g} deg); turn the vehicle or change start.yaw_deg"
        )
    if arm_rad:
        measured_deg = [math.degrees(angle) for angle in arm_rad]
        off_deg = max(abs(a - b) for a, b in zip(measured_deg, start.arm_deg, strict=True))
        if off_deg > start.arm_tolerance_deg:
            yield (
                f"starts with the arm at ({listed(start.arm_deg, 'g')}) deg, but it is at ({listed(measured_deg, '.0f')}) deg "
                f"(tolerance {start.arm_tolerance_deg:g} deg); move it there by hand"
            )


def _speed(mission: Mission, vehicle: Vehicle) -> Iterator[str]:
    """Check that the plan stays below the speed at which the monitors stop the flight."""
    planned, stopped = mission.limits.speed_max_m_s, vehicle.safety.speed_max_m_s
    if planned > SPEED_SHARE_MAX * stopped:
        yield (
            f"mission '{mission.name}': limits.speed_max_m_s is {planned:g} m/s, but must be at least one fifth below "
            f"safety.speed_max_m_s ({stopped:g} m/s), above which the vehicle holds; lower limits.speed_max_m_s to "
            f"{SPEED_SHARE_MAX * stopped:.2f} m/s or less"
        )


def _of_phases(mission: Mission, vehicle: Vehicle, plan: Plan, phase_origins: Sequence[str]) -> Iterator[str]:
    phases = phases_of(mission)
    for segment in plan.segments:
        if segment.repetition < 2:
            begin, end = plan.reference(segment.start_s), plan.reference(segment.end_s)
            c = Checking(mission, vehicle, begin, end, phases[: segment.index])
            for text in phases[segment.index].problems(c):
                yield f"{_place(mission, segment, phase_origins)} {text}"


def _catch(mission: Mission, vehicle: Vehicle, plan: Plan, phase_origins: Sequence[str]) -> list[str]:
    """Check that the plan passes where the payload is expected, with a net."""
    problems: list[str] = []
    if mission.catch is not None:
        flown = [segment for segment in plan.segments if segment.kind is PhaseKind.FLIGHT]
        near_m, catching = min(
            (
                (math.dist(plan.reference(t_s).position_world_m[:2], mission.catch.expected_at_m), segment)
                for segment in flown
                for t_s in _samples(segment)
            ),
            key=lambda found: found[0],
            default=(math.inf, plan.segments[0]),
        )
        if not vehicle.has_net:
            instead = f", but a {vehicle.tool.kind}" if vehicle.tool is not None else ""
            fix = "choose a vehicle with a net" if instead else "add tool to the vehicle file"
            problems.append(
                f"{_place(mission, catching, phase_origins)} expects a payload in the net, but vehicle '{vehicle.name}' has no net "
                f"(tool){instead}; {fix}, or remove catch from the mission"
            )
        elif near_m > CATCH_NEAR_M:
            x_m, y_m = mission.catch.expected_at_m
            problems.append(
                f"mission '{mission.name}': expects the payload at ({x_m:g}, {y_m:g}) m, but never comes closer than {near_m:.2f} m; "
                "change catch.expected_at_m or the lines"
            )
    return problems
