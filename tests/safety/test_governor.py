"""Whatever the input, the governed reference stays in the safe set, can always stop in it, and moves smoothly."""

from __future__ import annotations

import math
import re
from functools import cache

import pytest
from hypothesis import given
from hypothesis import strategies as st
from msgspec.structs import replace

from companion.config.loader import FlightConfig, load_flight
from companion.mission.plan import Plan
from companion.mission.reference import at_rest
from companion.model.types import Reference, TetherState, Vec3
from companion.safety.governor import Governed, Governor, SafeSet
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
    return TetherState(
        range_m=2.0,
        slack_m=0.0,
        stop_slack_m=0.0,
        elevation_rad=0.5,
        clearance_m=0.1,
        turns=0.0,
        pull_n=0.0,
        taut=taut,
        snagged=snagged,
        separated=False,
        vehicle_turns=0.0,
    )


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
