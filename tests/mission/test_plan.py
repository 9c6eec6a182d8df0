"""The plan's timeline and its smoothness, for the committed missions and for any other."""

from __future__ import annotations

import math
from collections.abc import Callable
from pathlib import Path

import pytest
from hypothesis import given
from hypothesis import strategies as st
from pydantic import ValidationError

from companion.config.loader import load_flight
from companion.config.mission import Mission
from companion.mission import minsnap
from companion.mission.plan import BELOW_GROUND_M, Plan, landing_from
from companion.mission.plan_builder import STOP_SPEED_MAX_M_S
from companion.mission.reference import Move, Profile, Track, minimum_snap, rest_to_rest, slow_down, speed_up, steady
from companion.model.types import Joints, PhaseKind, Reference, Vec3
from tests.control.states import at_rest
from tests.support import tool_of

ROOT = Path(__file__).parents[2]
CONFIG = load_flight(ROOT / "configs/missions/catch.yaml")
CIRCUIT = load_flight(ROOT / "configs/missions/circuit.yaml").mission
VEHICLE = CONFIG.vehicle
CLEARANCE_M = VEHICLE.airframe.ground_clearance_m
START: Vec3 = (-1.0, 0.0, CLEARANCE_M)
FOLD: Joints = (math.radians(165.0), math.radians(140.0))

length = st.floats(-5.0, 5.0)
duration = st.floats(0.2, 20.0)
angle = st.floats(-3.0, 3.0)
point = st.tuples(length, length, length)


def values(reference: Reference) -> tuple[float, ...]:
    return (*reference.position_world_m, reference.yaw_rad, *reference.arm_rad)


def rates(reference: Reference) -> tuple[float, ...]:
    return (*reference.velocity_world_m_s, reference.yaw_rate_rad_s, *reference.arm_rate_rad_s)


def accelerations(reference: Reference) -> tuple[float, ...]:
    return (*reference.acceleration_world_m_s2, *reference.arm_acceleration_rad_s2)


def assert_smooth(plan: Plan) -> None:
    """Nothing jumps where one piece of motion meets the next, and each derivative is the derivative of what it should be."""
    edges = {0.0, plan.duration_s}
    jerk = 0.0
    for track in (plan._position, plan._yaw, plan._arm):
        for move in track._moves:
            edges |= {move.start_s, move.end_s}
            inside = [move.start_s + move.duration_s * share / 50 for share in range(50)] + [move.end_s - 1e-9]
            jerk = max(jerk, *(abs(value) for t_s in inside for value in move.at(t_s)[3]))
    step_s = 1e-9
    for edge_s in edges:
        before, after = plan.reference(edge_s - step_s), plan.reference(edge_s + step_s)
        for part in (values, rates, accelerations):
            steepest = 1.0 + max(map(abs, rates(before) + accelerations(before))) + jerk
            assert part(before) == pytest.approx(part(after), abs=1e-9 + 4.0 * step_s * steepest)
    for index in range(1, 60):
        t_s = plan.duration_s * index / 60
        h_s = 1e-5
        before, here, after = (plan.reference(t_s + offset) for offset in (-h_s, 0.0, h_s))
        slope = [(b - a) / (2 * h_s) for a, b in zip(values(before), values(after), strict=True)]
        assert slope == pytest.approx(rates(here), abs=1e-3 * (1.0 + max(map(abs, rates(here) + accelerations(here)))))
    assert rates(plan.reference(-1.0)) == pytest.approx([0.0] * 6)
    assert rates(plan.reference(plan.duration_s + 1.0)) == pytest.approx([0.0] * 6)


@st.composite
def missions(draw: st.DrawFn) -> Mission:
    phases: list[dict[str, object]] = [
        {"type": "takeoff", "height_m": draw(st.floats(0.1, 5.0)), "duration_s": draw(duration)}
    ]
    for _ in range(draw(st.integers(0, 5))):
        kind = draw(st.sampled_from(["hold", "line", "arm", "path"]))
        seconds = draw(duration)
        phase: dict[str, object] = {"type": kind, "duration_s": seconds}
        if kind == "line":
            phase["to_m"] = draw(point)
            if draw(st.booleans()):
                delay = seconds * draw(st.floats(0.0, 0.5))
                phase |= {"arm_deg": draw(st.tuples(length, length)), "arm_delay_s": delay}
                if draw(st.booleans()):
                    phase["arm_duration_s"] = (seconds - delay) * draw(st.floats(0.1, 0.99))
        elif kind == "path":
            # each point a step away from the one before it, wherever that is: no two alike
            phase["waypoints_m"] = [
                (6.0 + 6.0 * len(phases) + k, *draw(st.tuples(length, length))) for k in range(draw(st.integers(1, 4)))
            ]
        elif kind == "arm":
            phase["arm_deg"] = draw(st.tuples(length, length))
        phases.append(phase)
    phases.append({"type": "land", "speed_m_s": draw(st.floats(0.05, 1.0))})
    document = CONFIG.mission.model_dump(mode="json") | {"phases": phases, "name": "any"}
    document["start"]["yaw_deg"] = draw(st.floats(-180.0, 180.0))
    return Mission.model_validate(document)


@given(missions(), point, angle, st.one_of(st.none(), st.tuples(angle, angle)))
def test_any_plan_is_smooth_and_without_gaps(
    mission: Mission, start: Vec3, yaw_rad: float, arm_rad: Joints | None
) -> None:
    plan = Plan.build(mission, VEHICLE, start, yaw_rad, arm_rad)
    assert_smooth(plan)
    assert plan.segments[0].start_s == 0.0
    assert plan.segments[-1].end_s == plan.duration_s
    for before, after in zip(plan.segments, plan.segments[1:], strict=False):
        assert before.end_s == after.start_s > before.start_s
    assert plan.reference(0.0).position_world_m == pytest.approx(start)


@given(point, st.tuples(length, length, length), angle, st.tuples(angle, angle), st.floats(0.05, 1.0))
def test_any_landing_is_smooth_and_ends_folded_below_the_floor(
    position: Vec3, velocity: Vec3, yaw_rad: float, arm_rad: Joints, speed_m_s: float
) -> None:
    plan = landing_from(position, velocity, yaw_rad, arm_rad, FOLD, speed_m_s, VEHICLE)
    start, end = plan.reference(0.0), plan.reference(plan.duration_s)
    assert start.position_world_m == pytest.approx(position)
    speed = math.hypot(*velocity)
    share = min(1.0, STOP_SPEED_MAX_M_S / speed) if speed > 0 else 0.0
    assert start.velocity_world_m_s == pytest.approx([share * v for v in velocity])
    assert end.arm_rad == pytest.approx(FOLD)
    assert rates(plan.reference(plan.duration_s + 0.1)) == pytest.approx([0.0] * 6)
    stopped = plan.reference(plan.segments[0].end_s)
    assert stopped.velocity_world_m_s == pytest.approx((0.0, 0.0, 0.0), abs=1e-9)
    lowest_m = min(CLEARANCE_M - BELOW_GROUND_M, stopped.position_world_m[2])
    assert end.position_world_m == pytest.approx((*stopped.position_world_m[:2], lowest_m), abs=1e-9)
    for index in range(200):
        reference = plan.reference(
            plan.segments[1].start_s + (plan.duration_s - plan.segments[1].start_s) * index / 199
        )
        assert -speed_m_s - 1e-9 <= reference.velocity_world_m_s[2] <= 1e-9
        assert reference.position_world_m[:2] == pytest.approx(stopped.position_world_m[:2])
        assert reference.yaw_rad == yaw_rad
    assert {segment.kind for segment in plan.segments} == {PhaseKind.LANDING}


@pytest.mark.parametrize("height_m", [0.5, 0.7, 1.0, 1.8])
def test_a_landing_folds_the_arm_before_the_net_can_touch_the_floor(height_m: float) -> None:
    unfolded = (math.radians(90.0), math.radians(0.0))  # straight down: the longest reach
    plan = landing_from((0.0, 0.0, height_m), (0.0, 0.0, 0.0), 0.0, unfolded, FOLD, 0.35, VEHICLE)
    arm = VEHICLE.arm
    reach_m = sum(arm.link_lengths_m) - arm.shoulder_body_m[2] + tool_of(VEHICLE).radius_m
    at_rest_height_m = plan.reference(plan.segments[0].end_s).position_world_m[2]
    for index in range(500):
        reference = plan.reference(plan.duration_s * index / 499)
        if reference.position_world_m[2] < min(reach_m, at_rest_height_m - 1e-9):
            assert reference.arm_rad == pytest.approx(FOLD)


def test_the_catch_mission_passes_the_catch_at_its_time_with_the_arm_out() -> None:
    plan = Plan.build(CONFIG.mission, VEHICLE, START, 0.0)
    assert plan.reference(3.0).position_world_m == pytest.approx((-1.0, 0.0, 1.0))
    assert plan.reference(6.5).position_world_m == pytest.approx((0.0, 0.0, 1.0))
    assert plan.reference(6.0).arm_rad == pytest.approx((math.radians(100.0), math.radians(60.0)))
    assert plan.segment(6.5).kind is PhaseKind.FLIGHT
    assert plan.reference(9.5).position_world_m == pytest.approx((1.0, 0.0, 1.0))
    assert plan.reference(17.0).position_world_m == pytest.approx((-1.0, 0.0, 1.0))
    assert plan.reference(17.0).arm_rad == pytest.approx(FOLD)
    assert plan.reference(plan.duration_s).position_world_m == pytest.approx((-1.0, 0.0, CLEARANCE_M - BELOW_GROUND_M))
    assert [segment.kind for segment in plan.segments] == [
        PhaseKind.TAKEOFF,
        *[PhaseKind.FLIGHT] * 5,
        PhaseKind.LANDING,
    ]


def test_before_and_after_the_plan() -> None:
    plan = Plan.build(CONFIG.mission, VEHICLE, START, 0.0)
    assert plan.segment(-1.0) == plan.segments[0]
    assert plan.segment(0.0) == plan.segments[0]
    assert plan.segment(plan.segments[1].start_s) == plan.segments[1]
    assert plan.segment(1e6) == plan.segments[-1]
    assert (plan.progress(-1.0), plan.progress(plan.duration_s / 2), plan.progress(1e6)) == (0.0, 0.5, 1.0)
    assert plan.reference(-5.0) == at_rest(START, 0.0, FOLD)


def test_a_small_difference_at_the_start_is_taken_out_during_take_off() -> None:
    measured = (-1.08, 0.05, CLEARANCE_M + 0.01)
    plan = Plan.build(CONFIG.mission, VEHICLE, measured, 2 * math.pi + 0.1, (2.8, 2.4))
    assert values(plan.reference(0.0)) == pytest.approx((*measured, 2 * math.pi + 0.1, 2.8, 2.4))
    reference = plan.reference(3.0)
    assert values(reference) == pytest.approx((-1.0, 0.0, 1.0, 2 * math.pi, *FOLD))


@pytest.mark.parametrize(
    ("waypoints_m", "number"),
    [([(-1.0, 0.0, 1.0), (0.0, 0.0, 1.0)], 0), ([(0.0, 0.0, 1.0), (0.0, 0.0, 1.005)], 1)],
    ids=["where it stands", "twice the same"],
)
def test_a_path_that_stays_where_it_is_is_refused(waypoints_m: list[Vec3], number: int) -> None:
    document = CONFIG.mission.model_dump(mode="json")
    document["phases"][1] = {"type": "path", "waypoints_m": waypoints_m}
    with pytest.raises(ValidationError, match="repeats the previous point of the path") as caught:
        Mission.model_validate(document)
    assert caught.value.errors()[0]["loc"] == ("phases", 1, "waypoints_m", number)


def test_a_path_with_a_duration_takes_it_and_passes_its_points() -> None:
    document = CIRCUIT.model_dump(mode="json")
    document["phases"][2]["duration_s"] = 20.0
    plan = Plan.build(Mission.model_validate(document), VEHICLE)
    segment = plan.segments[2]
    assert segment.end_s - segment.start_s == 20.0
    flown = [plan.reference(segment.start_s + 0.002 * k).position_world_m for k in range(10001)]
    for point in document["phases"][2]["waypoints_m"]:
        assert min(math.dist(point, position) for position in flown) < 0.002
    inside = [plan.reference(segment.start_s + 0.1 * k).velocity_world_m_s for k in range(20, 181)]
    assert min(math.hypot(*velocity) for velocity in inside) > 0.05, "it stops on the way"


def test_paths_are_the_same_wherever_the_machine_stood_and_solved_once() -> None:
    minsnap._known.clear()
    first = Plan.build(CIRCUIT, VEHICLE)
    other = Plan.build(CIRCUIT, VEHICLE, (-1.07, 0.031, CLEARANCE_M + 0.013), 0.1)
    assert len(minsnap._known) == 1
    later = [first.segments[2].start_s + 0.05 * k for k in range(200)]
    assert all(first.reference(t_s).position_world_m == other.reference(t_s).position_world_m for t_s in later)


def test_yaw_turns_by_the_shorter_way() -> None:
    document = CONFIG.mission.model_dump(mode="json")
    document["start"]["yaw_deg"] = 179.0
    plan = Plan.build(Mission.model_validate(document), VEHICLE, START, math.radians(-179.0))
    assert plan.reference(3.0).yaw_rad == pytest.approx(math.radians(-181.0))


@pytest.mark.parametrize("profile", [minimum_snap, rest_to_rest, speed_up, slow_down, steady])
def test_profiles_are_what_their_derivatives_say(profile: Profile) -> None:
    h = 1e-6
    for index in range(1, 100):
        u = index / 100
        (f0, d0, dd0, _), (_, d1, dd1, ddd1), (f2, d2, dd2, _) = profile(u - h), profile(u), profile(u + h)
        assert (f2 - f0) / (2 * h) == pytest.approx(d1, abs=1e-6)
        assert (d2 - d0) / (2 * h) == pytest.approx(dd1, abs=1e-6)
        assert (dd2 - dd0) / (2 * h) == pytest.approx(ddd1, abs=1e-6)


@pytest.mark.parametrize(
    ("profile", "covered", "speeds"),
    [
        (minimum_snap, 1.0, (0.0, 0.0)),
        (rest_to_rest, 1.0, (0.0, 0.0)),
        (speed_up, 0.5, (0.0, 1.0)),
        (slow_down, 0.5, (1.0, 0.0)),
        (steady, 1.0, (1.0, 1.0)),
    ],
)
def test_profiles_cover_what_they_promise(profile: Profile, covered: float, speeds: tuple[float, float]) -> None:
    assert profile(0.0)[:3] == (0.0, speeds[0], 0.0)
    assert profile(1.0)[:3] == pytest.approx((covered, speeds[1], 0.0))


def test_moves_that_overlap_are_refused() -> None:
    plan = Plan.build(CONFIG.mission, VEHICLE, START, 0.0)
    first = plan._position._moves[0]
    assert isinstance(first, Move)
    with pytest.raises(ValueError, match="a move starts at"):
        Track((0.0, 0.0, 0.0), (first, first))


@pytest.mark.parametrize("mission", [CONFIG.mission, CIRCUIT], ids=["catch", "circuit"])
def test_the_same_start_gives_the_same_plan_bit_for_bit(mission: Mission) -> None:
    build: Callable[[], Plan] = lambda: Plan.build(mission, VEHICLE, (-1.03, 0.02, 0.31), 0.03)  # noqa: E731
    one = build()
    minsnap._known.clear()
    other = build()
    assert all(one.reference(0.005 * k) == other.reference(0.005 * k) for k in range(4400))
