"""Whatever the input, the governed reference stays in the safe set, can always stop in it, and moves smoothly."""

from __future__ import annotations

import itertools
import math
import re
from functools import cache

import pytest
from hypothesis import given
from hypothesis import strategies as st
from msgspec.structs import replace

from companion.config.loader import FlightConfig, load_flight
from companion.mission.plan import Plan
from companion.model.algebra import plus
from companion.model.outputs import TetherState
from companion.model.types import Reference, Vec3
from companion.safety.governor import Governed, Governor, SafeSet, _share_within
from tests.control.states import at_rest
from tests.safety.healthy import SLOW
from tests.support import tether_of

DT_S = 0.005
ARM = (2.0, 1.0)
CLOSE = 1e-6


@cache
def config(*overrides: str) -> FlightConfig:
    return load_flight("configs/missions/catch.yaml", overrides=overrides)


def governor(*overrides: str) -> Governor:
    flight = config(*overrides)
    return Governor(flight.vehicle, flight.mission.limits)


def asked(p: Vec3, v: Vec3 = (0.0, 0.0, 0.0), a: Vec3 = (0.0, 0.0, 0.0)) -> Reference:
    return replace(at_rest(p, 0.3, ARM), velocity_world_m_s=v, acceleration_world_m_s2=a)


def tether(*, taut: bool = False, snagged: bool = False) -> TetherState:
    return replace(SLOW, taut=taut, snagged=snagged)


def stop_of(g: Governor, reference: Reference) -> Vec3:
    p, v = reference.position_world_m, reference.velocity_world_m_s
    reach = math.hypot(*v) / (2.0 * g.stop_deceleration_m_s2)
    return (p[0] + v[0] * reach, p[1] + v[1] * reach, p[2] + v[2] * reach)


def assert_safe(g: Governor, within: SafeSet, reference: Reference) -> None:
    for point in (reference.position_world_m, stop_of(g, reference)):
        assert within.breach_tether_m(point) <= CLOSE
        assert within.breach_walls_m(point) <= CLOSE
    assert math.hypot(*reference.velocity_world_m_s) <= g.speed_max_m_s * (1 + 1e-5)


def assert_smooth(g: Governor, before: Reference, after: Reference, dt_s: float) -> None:
    assert (
        math.dist(before.velocity_world_m_s, after.velocity_world_m_s)
        <= g.acceleration_max_m_s2 * dt_s * (1 + 1e-5) + 1e-9
    )
    moved = math.dist(before.position_world_m, after.position_world_m)
    assert moved <= g.speed_max_m_s * dt_s * (1 + 1e-5) + 0.0021


@pytest.mark.parametrize("mission", ["catch", "hover", "circuit"])
def test_committed_missions_pass_untouched(mission: str) -> None:
    flight = load_flight(f"configs/missions/{mission}.yaml")
    plan = Plan.build(flight.mission, flight.vehicle)
    g = Governor(flight.vehicle, flight.mission.limits)
    for tick in range(int(plan.duration_s / DT_S)):
        reference = plan.reference(tick * DT_S)
        governed = g.constrain(DT_S, reference, tether())
        assert governed.limited_by == (), (tick * DT_S, reference)
        assert governed.reference is reference


@pytest.mark.parametrize("axis", [0, 1, 2])
@pytest.mark.parametrize(
    ("jump_m", "faster", "why"),
    [(0.0019, 0.0, ()), (0.0021, 0.0, ("acceleration",)), (0.0, 1.0, ()), (0.0, 1.01, ("acceleration",))],
)
def test_a_reference_that_jumps_by_2_mm_or_accelerates_beyond_the_limit_is_constrained(
    axis: int, jump_m: float, faster: float, why: tuple[str, ...]
) -> None:
    g = governor()
    g.constrain(DT_S, asked((0.0, 0.0, 1.0)), None)
    v, p = [0.0, 0.0, 0.0], [0.0, 0.0, 1.0]
    v[axis] = faster * g.acceleration_max_m_s2 * DT_S
    p[axis] += jump_m + 0.5 * v[axis] * DT_S
    governed = g.constrain(DT_S, asked((p[0], p[1], p[2]), (v[0], v[1], v[2])), None)
    assert governed.limited_by == why
    assert not why or governed.reference.jerk_world_m_s3 == (0.0, 0.0, 0.0)


@pytest.mark.parametrize("direction", [(1.0, 0.0, 0.0), (0.0, -1.0, 0.0), (0.6, 0.0, -0.8)])
def test_a_reference_faster_than_the_mission_may_fly_is_constrained(direction: Vec3) -> None:
    for share, why in ((1.0, ()), (1.001, ("speed",))):
        g = governor()
        speed_m_s = share * g.speed_max_m_s
        v = (speed_m_s * direction[0], speed_m_s * direction[1], speed_m_s * direction[2])
        assert g.constrain(DT_S, asked((0.0, 0.0, 1.0), v), None).limited_by == why


def test_what_returns_to_its_reference_does_so_within_seconds_and_does_not_overshoot() -> None:
    g = governor()
    follow(g, at_rest((-1.0, 0.0, 1.0), 0.0, ARM), 0.1)
    goal = at_rest((-0.5, 0.2, 1.1), 0.0, ARM)
    way = [g.constrain(DT_S, goal, None).reference for _ in range(round(4.0 / DT_S))]
    left_m = [math.dist(reference.position_world_m, (-0.5, 0.2, 1.1)) for reference in way]
    assert all(b <= a + CLOSE for a, b in itertools.pairwise(left_m))
    assert left_m[round(1.0 / DT_S)] < 0.5 * left_m[0]
    assert left_m[round(2.5 / DT_S)] < 0.02
    assert way[-1] is goal
    for a, b in itertools.pairwise(way[: way.index(goal)]):
        mean = [0.5 * (v + w) for v, w in zip(a.velocity_world_m_s, b.velocity_world_m_s, strict=True)]
        gone = [(q - p) / DT_S for p, q in zip(a.position_world_m, b.position_world_m, strict=True)]
        assert math.dist(mean, gone) < 1e-3
        grown = [(w - v) / DT_S for v, w in zip(a.velocity_world_m_s, b.velocity_world_m_s, strict=True)]
        assert math.dist(grown, b.acceleration_world_m_s2) < 1e-6


@given(st.tuples(st.floats(-2.5, 2.5), st.floats(-2.2, 2.2), st.floats(-1.0, 2.6)))
def test_the_safe_set_is_the_room_and_the_reach_of_the_tether(p: Vec3) -> None:
    """The room of the vehicle file less 0.49 m for the rotors and 0.15 m above; a tether of 3 m less its margin of 0.25 m."""
    within = SafeSet(config().vehicle)
    walls_m = max(abs(p[0]) - 1.71, abs(p[1]) - 1.31, p[2] - 2.05, 0.3 - 0.75 - p[2])
    reach_m = math.dist(p, (0.0, -1.2, 0.0)) - 2.75
    assert within.breach_walls_m(p) == pytest.approx(walls_m)
    assert within.breach_tether_m(p) == pytest.approx(reach_m)
    if abs(max(walls_m, reach_m)) > 1e-6:
        assert within.holds(p) is (max(walls_m, reach_m) <= 0.0)


coordinate = st.floats(-20, 20, allow_nan=False)
far = st.tuples(coordinate, coordinate, coordinate)
near = st.tuples(st.floats(-2.2, 2.2), st.floats(-1.8, 1.8), st.floats(-0.2, 2.2))
speed = st.tuples(st.floats(-3, 3), st.floats(-3, 3), st.floats(-3, 3))
still = st.just((0.0, 0.0, 0.0))
strategies = st.tuples(
    st.one_of(near, far),
    st.one_of(still, speed),
    speed,
    st.integers(1, 150),
    st.sampled_from([0.001, 0.005, 0.005, 0.02, 0.05]),
    st.sampled_from(["slack", "slack", "slack", "taut", "snagged", "unknown"]),
    st.booleans(),
)
anchors = st.sampled_from(
    [
        (),
        ("vehicle.tether.length_m=2.0",),
        ("vehicle.tether.length_m=2.0", "vehicle.tether.anchor_world_m=[0.3, 0.2, 2.5]"),
        ("vehicle.tether.length_m=1.5", "vehicle.tether.anchor_world_m=[-1.8, -1.2, 0]", "mission.limits.acceleration_max_m_s2=3"),
    ]
)  # fmt: skip


@given(anchors, st.lists(strategies, min_size=1, max_size=8))
def test_any_stream_keeps_inside_and_smooth(
    overrides: tuple[str, ...], stream: list[tuple[Vec3, Vec3, Vec3, int, float, str, bool]]
) -> None:
    g, within = governor(*overrides), SafeSet(config(*overrides).vehicle)
    last: Reference | None = None
    limit: tuple[float, float] | None = None
    for p, v, a, ticks, dt_s, state, moving in stream:
        now = None if state == "unknown" else tether(taut=state == "taut", snagged=state == "snagged")
        if state not in ("taut", "snagged"):
            limit = None
        elif limit is None and last is not None:
            ends = (last.position_world_m, stop_of(g, last))
            limit = (max(math.dist(end, within.anchor_m) for end in ends), max(end[2] for end in ends))
        for tick in range(ticks):
            t_s = tick * dt_s if moving else 0.0
            wanted = asked((p[0] + v[0] * t_s, p[1] + v[1] * t_s, p[2] + v[2] * t_s), v, a)
            governed = g.constrain(dt_s, wanted, now)
            assert (governed.reference is wanted) == (governed.limited_by == ())
            assert set(governed.limited_by) <= {"tether", "geofence", "speed", "acceleration"}
            reference = governed.reference
            assert (reference.yaw_rad, reference.arm_rad) == (0.3, ARM)
            assert_safe(g, within, reference)
            if last is not None:
                assert_smooth(g, last, reference, dt_s)
            if limit is not None:
                away, height = math.dist(reference.position_world_m, within.anchor_m), reference.position_world_m[2]
                assert away <= limit[0] + CLOSE
                assert height <= limit[1] + CLOSE
                stop = stop_of(g, reference)
                limit = (
                    min(limit[0], max(away, math.dist(stop, within.anchor_m))),
                    min(limit[1], max(height, stop[2])),
                )
            last = reference


def follow(g: Governor, wanted: Reference, seconds: float, state: TetherState | None = None) -> Governed:
    governed = Governed(wanted, ())
    for _ in range(round(seconds / DT_S)):
        governed = g.constrain(DT_S, wanted, state)
    return governed


def test_a_step_within_is_followed_to_the_end_and_then_passes() -> None:
    g = governor()
    follow(g, at_rest((-1.0, 0.0, 1.0), 0.0, ARM), 0.1)
    goal = at_rest((1.0, 0.3, 1.2), 0.0, ARM)
    assert g.constrain(DT_S, goal, None).limited_by == ("acceleration",)
    assert follow(g, goal, 8.0).reference is goal


@pytest.mark.parametrize(
    ("to", "why", "expected"),
    [
        ((9.0, 0.0, 1.0), "geofence", (1.71, 0.0, 1.0)),
        ((1.0, 0.0, 9.0), "geofence", None),
        ((0.0, 1.3, 2.0), "tether", None),
    ],
)
def test_what_lies_outside_is_followed_to_the_edge(to: Vec3, why: str, expected: Vec3 | None) -> None:
    g, within = governor("vehicle.tether.length_m=3.0"), SafeSet(config().vehicle)
    follow(g, at_rest((-1.0, 0.0, 1.0), 0.0, ARM), 0.1)
    governed = follow(g, at_rest(to, 0.0, ARM), 10.0)
    assert why in governed.limited_by
    edge = governed.reference
    assert math.hypot(*edge.velocity_world_m_s) < 1e-3
    nearest = max(within.breach_tether_m(edge.position_world_m), within.breach_walls_m(edge.position_world_m))
    assert -0.01 < nearest <= CLOSE
    if expected is not None:
        assert edge.position_world_m == pytest.approx(expected, abs=0.01)


def test_a_motion_that_begins_outside_begins_at_the_nearest_corner_of_reach_and_room() -> None:
    """In the thin corners alternating projections do not arrive; the last step starts from a point inside."""
    corners = ("vehicle.tether.length_m=1.5", "vehicle.tether.anchor_world_m=[-1.8, -1.2, 0]")
    for overrides in (corners, ("vehicle.tether.length_m=1.6", "vehicle.tether.anchor_world_m=[0, -1.8, 3.3]")):
        g, within = governor(*overrides), SafeSet(config(*overrides).vehicle)
        for x, y, z in itertools.product(
            (-20.0, -1.8, -1.0, 0.2, 3.0), (-9.0, -1.2, 0.4, 7.0), (-3.0, 0.5, 1.5, 2.1, 8.0)
        ):
            g.reset()
            begun = g.constrain(DT_S, at_rest((x, y, z), 0.0, ARM), None).reference.position_world_m
            assert within.breach_tether_m(begun) <= CLOSE and within.breach_walls_m(begun) <= CLOSE
            if within.holds((x, y, z)):
                assert begun == (x, y, z)


@pytest.mark.parametrize(
    ("inside", "p", "share"),
    [
        ((0.0, 0.0, 0.0), (4.0, 0.0, 0.0), 0.5),
        ((1.0, 0.0, 0.0), (-5.0, 0.0, 0.0), 0.5),
        ((0.0, 0.0, 0.0), (1.0, 1.0, 0.0), 1.0),
        ((2.1, 0.0, 0.0), (3.0, 0.0, 0.0), 0.0),
        ((2.0, 0.0, 0.0), (3.0, 0.0, 0.0), 0.0),
        ((1.0, 0.0, 0.0), (1.0, 0.0, 0.0), 0.0),
    ],
)
def test_a_segment_is_followed_as_far_as_it_stays_in_the_ball(inside: Vec3, p: Vec3, share: float) -> None:
    centre = (0.3, -0.7, 0.2)
    assert _share_within(plus(inside, centre), plus(p, centre), centre, 2.0) == pytest.approx(share, abs=1e-9)


def test_along_the_edge_it_slides() -> None:
    g = governor()
    follow(g, at_rest((-1.0, 0.5, 1.0), 0.0, ARM), 0.1)
    follow(g, at_rest((-1.0, 5.0, 1.0), 0.0, ARM), 6.0)
    slid = follow(g, at_rest((0.2, 5.0, 0.9), 0.0, ARM), 10.0).reference
    assert slid.position_world_m == pytest.approx((0.2, 1.31, 0.9), abs=0.02)


def test_taut_it_stops_at_once_and_may_only_come_home() -> None:
    g, anchor = governor(), tether_of(config().vehicle).anchor_world_m
    plan = Plan.build(config().mission, config().vehicle)
    t_s = 0.0
    while t_s < 7.5:
        last = g.constrain(DT_S, plan.reference(t_s), tether()).reference
        t_s += DT_S
    speed_m_s = math.hypot(*last.velocity_world_m_s)
    assert speed_m_s > 0.4
    reached = [math.dist(last.position_world_m, anchor)]
    for _ in range(600):
        governed = g.constrain(DT_S, plan.reference(t_s), tether(taut=True))
        t_s += DT_S
        reached.append(math.dist(governed.reference.position_world_m, anchor))
        assert governed.limited_by
        assert governed.reference.position_world_m[2] <= 1.0 + CLOSE
    assert 0.0 < max(reached) - reached[0] <= speed_m_s**2 / (2 * g.stop_deceleration_m_s2)
    top = reached.index(max(reached))
    assert all(b <= a + CLOSE for a, b in zip(reached[top:], reached[top + 1 :], strict=False))
    home = at_rest((0.0, -0.5, 0.7), 0.0, ARM)
    assert follow(g, home, 8.0, tether(taut=True)).reference is home
    up = follow(g, at_rest((0.0, -0.5, 1.2), 0.0, ARM), 3.0, tether(snagged=True)).reference
    assert up.position_world_m[2] <= 0.7 + CLOSE
    free = at_rest((0.0, -0.5, 1.2), 0.0, ARM)
    assert follow(g, free, 5.0, tether()).reference is free


def test_without_a_tether_only_the_walls_constrain() -> None:
    g, room = governor("vehicle.tether=null"), config().vehicle.room
    beyond_the_tether = (0.0, 1.2, 1.9)
    assert math.dist(beyond_the_tether, tether_of(config().vehicle).anchor_world_m) > 2.75
    free = at_rest(beyond_the_tether, 0.0, ARM)
    assert follow(g, free, 12.0).reference is free
    outside = follow(g, at_rest((9.0, 1.2, 1.9), 0.0, ARM), 12.0)
    assert "geofence" in outside.limited_by
    assert "tether" not in outside.limited_by
    assert outside.reference.position_world_m[0] == pytest.approx(room.x_m[1] - 0.49, abs=0.01)


def test_a_late_tick_is_caught_up_without_a_step() -> None:
    g = governor()
    plan = Plan.build(config().mission, config().vehicle)
    last = plan.reference(0.0)
    late_s, constrained = 0.0, 0
    for tick in range(int(plan.duration_s / DT_S) - 100):
        if tick == 1300:
            late_s = 0.4
        governed = g.constrain(DT_S, plan.reference(tick * DT_S + late_s), None)
        assert_smooth(g, last, governed.reference, DT_S)
        last = governed.reference
        constrained += bool(governed.limited_by)
    assert 0 < constrained < 3.5 / DT_S


def test_after_a_reset_a_new_motion_begins_where_it_says() -> None:
    g = governor()
    follow(g, at_rest((-1.0, 0.0, 1.0), 0.0, ARM), 0.1)
    g.reset()
    there = asked((0.5, 0.0, 1.0), (0.3, 0.0, 0.0))
    assert g.constrain(DT_S, there, None).reference is there


@pytest.mark.parametrize(
    ("overrides", "text"),
    [
        (("vehicle.room.x_m=[-0.4, 0.4]",), "room.x_m is -0.4 to 0.4 m, too small for the vehicle"),
        (("vehicle.tether.anchor_world_m=[0, -9, 0]",), "the room begins 7.69 m from the anchor"),
        (("vehicle.tether.length_m=0.2",), "the tether reaches 0.00 m"),
    ],
)
def test_nothing_left_to_fly_in_is_one_line(overrides: tuple[str, ...], text: str) -> None:
    with pytest.raises(ValueError, match=re.escape(text)) as caught:
        SafeSet(config(*overrides).vehicle)
    assert "\n" not in str(caught.value)
