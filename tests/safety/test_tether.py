"""The tether watch: geometry against closed forms and brute force, and pull and snag. In flights: test_tether_flights.py."""

from __future__ import annotations

import math
from collections.abc import Callable
from functools import cache

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from companion.config.vehicle import Vehicle
from companion.model.algebra import plus
from companion.model.frames import quat_from_euler_zyx, quat_rotate
from companion.model.outputs import TetherState
from companion.model.types import Joints, Quat, Vec2, Vec3
from companion.safety.stop import StopModel
from companion.safety.tether import TetherWatch
from companion.safety.tether_pull import PullEstimate
from companion.safety.tether_shape import Clearance, steepest_slope
from companion.sitl_config.loader import SitlConfig, load_sitl
from tests.support import tether_of

LEVEL: Quat = (1.0, 0.0, 0.0, 0.0)
STILL: Vec3 = (0.0, 0.0, 0.0)
FOLDED: Joints = (math.radians(165.0), math.radians(140.0))
DOWN: Joints = (math.radians(90.0), 0.0)
DT_S = 0.005
ANCHOR: Vec3 = (0.0, -1.2, 0.0)
LENGTH_M = 3.0
STEPS_M = [0.001 * step for step in range(2000)]


@cache
def config(*overrides: str) -> SitlConfig:
    return load_sitl("configs/missions/catch.yaml", overrides=overrides)


def vehicle(*overrides: str) -> Vehicle:
    return config(*overrides).vehicle


def watch_of(machine: Vehicle) -> TetherWatch:
    return TetherWatch(machine, tether_of(machine))


def clearance(machine: Vehicle) -> Clearance:
    return Clearance(machine, tether_of(machine))


def once(p: Vec3, v: Vec3 = STILL, attitude: Quat = LEVEL, *overrides: str) -> TetherState:
    return watch_of(vehicle(*overrides)).update(0.0, p, v, attitude, FOLDED, None, None)


# -- geometry ----------------------------------------------------------------------------------------------------------


def test_range_slack_and_elevation() -> None:
    state = once((0.0, 0.0, 1.6))
    assert state.range_m == pytest.approx(2.0)
    assert state.slack_m == pytest.approx(1.0)
    assert state.stop_slack_m == state.slack_m
    assert state.elevation_rad == pytest.approx(math.asin(0.8))
    assert (state.taut, state.snagged, state.separated, state.pull_n) == (False, False, False, 0.0)


def test_slack_at_the_stop_counts_outward_speed_only() -> None:
    outward: Vec3 = (0.0, 0.6, 0.8)  # along the line: anchor at (0, -0.6, -0.8) * 2 from here
    state = once((0.0, 0.0, 1.6), outward)
    assert state.stop_slack_m == pytest.approx(1.0 - StopModel(vehicle().safety).distance_m(1.0))
    assert once((0.0, 0.0, 1.6), (0.0, -0.6, -0.8)).stop_slack_m == pytest.approx(1.0)
    assert once((0.0, 0.0, 1.6), (1.0, 0.0, 0.0)).stop_slack_m == pytest.approx(1.0)


def test_the_attachment_is_what_is_tied() -> None:
    tied = "vehicle.tether.attachment_body_m=[0.1, 0, 0.2]"
    yawed: Quat = quat_from_euler_zyx(0.0, 0.0, math.pi / 2)
    assert once((0.0, 0.0, 0.8), STILL, yawed, tied).range_m == pytest.approx(math.dist((0.0, 0.1, 1.0), ANCHOR))


def test_used_up_is_taut_and_far_beyond_is_separated() -> None:
    assert not once((0.0, -1.2, LENGTH_M - 0.06)).taut
    assert once((0.0, -1.2, LENGTH_M - 0.04)).taut
    assert not once((0.0, -1.2, LENGTH_M + 0.2)).separated
    gone = once((0.0, -1.2, LENGTH_M + 0.4))
    assert gone.separated
    assert not gone.snagged


degree = st.floats(-25.0, 25.0)


@given(
    st.tuples(st.floats(-1.5, 1.5), st.floats(-1.5, 1.5), st.floats(0.4, 2.0)),
    st.tuples(st.floats(-1.0, 1.0), st.floats(-1.0, 1.0), st.floats(-1.0, 1.0)),
    st.tuples(degree, degree, st.floats(-180.0, 180.0)),
    st.sampled_from([(0.02, -0.13, 0.05), (0.3, -0.1, -0.05)]),
)
def test_any_pose_gives_the_state_of_a_line_from_the_anchor_to_where_it_is_tied(
    p: Vec3, v: Vec3, deg: Vec3, tied: Vec3
) -> None:
    anchor = (0.4, -0.7, 0.2)
    machine = vehicle(f"vehicle.tether.attachment_body_m={list(tied)}", f"vehicle.tether.anchor_world_m={list(anchor)}")
    q = quat_from_euler_zyx(*map(math.radians, deg))
    back = (q[0], -q[1], -q[2], -q[3])
    state = watch_of(machine).update(0.0, p, v, q, FOLDED, None, None)
    lx, ly, lz = (a - b - c for a, b, c in zip(anchor, p, quat_rotate(q, tied), strict=True))
    range_m, level_m = math.hypot(lx, ly, lz), math.hypot(lx, ly)
    assert state.range_m == pytest.approx(range_m)
    assert state.slack_m == pytest.approx(LENGTH_M - range_m)
    assert state.elevation_rad == pytest.approx(math.atan2(-lz, level_m))
    outward_m_s = -(v[0] * lx + v[1] * ly + v[2] * lz) / range_m
    stop_m = StopModel(machine.safety).distance_m(max(0.0, outward_m_s))
    assert state.stop_slack_m == pytest.approx(LENGTH_M - range_m - stop_m, abs=1e-9)
    straight = quat_rotate(back, (lx / range_m, ly / range_m, lz / range_m))
    hanging = None
    if state.slack_m > 0.0:
        out, up = steepest_slope(level_m, lz, range_m, state.slack_m)
        hanging = quat_rotate(back, (lx / level_m * out, ly / level_m * out, up))
    assert state.clearance_m == pytest.approx(clearance(machine).least_m(straight, hanging, FOLDED), abs=1e-6)


def turned(way: Callable[[float], tuple[Vec3, Quat]], overrides: tuple[str, ...] = ()) -> float:
    watch = watch_of(vehicle(*overrides))
    for step in range(1001):
        p, q = way(step / 1000)
        state = watch.update(step * DT_S, p, STILL, q, FOLDED, None, None)
    return state.turns


def circle(turns: float, *, yaw_turns: float = 0.0, centre: Vec3 = ANCHOR) -> Callable[[float], tuple[Vec3, Quat]]:
    def way(share: float) -> tuple[Vec3, Quat]:
        a = 2 * math.pi * turns * share
        p = (centre[0] + math.cos(a), centre[1] + math.sin(a), 1.0)
        return p, quat_from_euler_zyx(0.0, 0.0, 2 * math.pi * yaw_turns * share)

    return way


@pytest.mark.parametrize(
    ("way", "turns"),
    [
        (circle(2.25), 2.25),
        (circle(-1.5), -1.5),
        (circle(2.0, yaw_turns=2.0), 2.0),  # about the anchor's post, not about the vehicle
        (circle(0.0, yaw_turns=-3.0), 3.0),  # about the vehicle: seen from it, the line turns the other way
        (circle(1.0, centre=(0.0, 1.2, 0.0)), 0.0),  # a round that leaves the anchor outside
        (lambda share: ((0.0, -1.2, 0.5 + share), LEVEL), 0.0),  # straight above it
    ],
)
def test_turns_of_the_tether_around_its_anchor_are_counted(
    way: Callable[[float], tuple[Vec3, Quat]], turns: float
) -> None:
    found = turned(way)
    assert found == pytest.approx(turns, abs=1e-6)


# -- sag, rotors and arm -----------------------------------------------------------------------------------------------


def ring_distance_m(clearance_of: Vehicle, ray: Vec3) -> float:
    """Brute force: least distance of a ray from the attachment to the ring of the rotors; negative if it comes up through it."""
    p, inner = tether_of(clearance_of).attachment_body_m, tether_of(clearance_of).rotor_inner_radius_m
    outer = clearance_of.airframe.radius_m
    least, above = math.inf, -math.inf
    for step in range(4000):
        s = step * 0.0005
        x, y, z = (a + s * b for a, b in zip(p, ray, strict=True))
        r = math.hypot(x, y)
        beside = max(0.0, inner - r, r - outer)
        least = min(least, math.hypot(beside, z))
        if beside == 0.0:
            above = max(above, z)
    return least if above < 0.0 else -max(above, 0.0)


@given(
    st.floats(-math.pi, math.pi),
    st.floats(math.radians(-30), math.radians(89)),
    st.sampled_from([(0.0, 0.0, 0.0), (0.0, 0.0, -0.1), (0.05, -0.05, -0.02), (0.3, 0.1, -0.1), (0.7, 0.2, -0.05)]),
)
def test_clearance_of_the_rotors_against_brute_force(azimuth: float, elevation: float, tied: Vec3) -> None:
    machine = vehicle(f"vehicle.tether.attachment_body_m={list(tied)}")
    ray = (math.cos(elevation) * math.cos(azimuth), math.cos(elevation) * math.sin(azimuth), -math.sin(elevation))
    found, true = clearance(machine).least_m(ray, None, FOLDED), ring_distance_m(machine, ray)
    through_the_middle = math.hypot(tied[0], tied[1]) < tether_of(machine).rotor_inner_radius_m
    if true <= 0.0:
        assert found <= 1e-6
    elif (
        through_the_middle or true < 0.1
    ):  # beyond the middle the distance is measured vertically: near the rotors it agrees
        # Tied beside the axis the ring's inner edge is taken where the line crosses it: 5.9 mm at most, of 20,000 rays.
        assert found <= true + 6.5e-3, "it must not promise more room than there is"
    if through_the_middle:
        assert found >= true - 0.11


def sampled_clearance_m(machine: Vehicle, tied: Vec3, rays: list[Vec3]) -> float:
    """The smallest distance of points along the lines from the rotors' plane, over or under the disk, and from the arm's plane."""
    outer, inner, net_m = machine.airframe.radius_m, tether_of(machine).rotor_inner_radius_m, machine.tip_radius_m
    (px, py, pz), found = tied, []
    side = -1.0 if pz <= 0.0 else 1.0
    for number, (dx, dy, dz) in enumerate(rays):
        flat = math.hypot(dx, dy)
        s = np.arange(0.0, 1.3, 5e-4) / flat if flat > 0.0 else np.arange(0.0, 1.0001, 5e-4)
        beside, r = side * (pz + s * dz), np.hypot(px + s * dx, py + s * dy)
        if number != (len(rays) - 1 if side > 0.0 else 0):
            pass  # tied below, the straight line comes nearest to the rotors, tied above, the one that hangs deepest
        elif r[0] >= inner:
            found.append(min(beside[r <= outer]) if min(r) <= outer else min(r) - outer)
        elif flat > 0.0:
            found += [math.hypot(inner - r[0], pz), flat * min(beside[(inner <= r) & (r <= outer)])]
        else:
            found.append(r[0] - outer if side * dz < 0.0 else inner - r[0])
        if clearance(machine).judges_arm:  # a slab about the shoulder, which is 0.05 m below the origin
            reach_m, s = sum(machine.arm.link_lengths_m) + net_m, np.arange(0.0, 8.0, 5e-4)
            away, y = np.hypot(px + s * dx, pz + 0.05 + s * dz) - reach_m, py + s * dy
            within = np.abs(y) <= net_m
            found.append(min(away[within]) if any(within) else max(abs(py) - net_m, away[0]))
    return float(min(found))


AROUND = [math.radians(deg) for deg in range(5, 365, 30)]
RAYS: list[Vec3] = [
    (math.cos(e) * math.cos(a), math.cos(e) * math.sin(a), math.sin(e))
    for e in (-1.2, -0.5, 0.0, 0.4, 1.1)
    for a in AROUND
]


@pytest.mark.parametrize("height_m", [-0.07, 0.07, 0.0])
@pytest.mark.parametrize("place", [(0.05, 0.0), (0.08, -0.11), (0.0, 0.3), (0.3, -0.2), (0.6, 0.12), (-0.3, -0.6)])
def test_the_clearance_is_that_of_points_along_the_line(place: Vec2, height_m: float) -> None:
    tied = (*place, height_m)
    machine = vehicle(f"vehicle.tether.attachment_body_m={list(tied)}")
    judge = clearance(machine)
    for k, ray in enumerate([*RAYS, (0.0, 0.0, 1.0), (0.0, 0.0, -1.0), (0.0, 1.0, 0.0), (0.0, -1.0, 0.0)]):
        hanging = None if k % 3 == 0 else RAYS[(7 * k) % len(RAYS)]
        true_m = sampled_clearance_m(machine, tied, [ray] if hanging is None else [ray, hanging])
        assert judge.least_m(ray, hanging, None) == pytest.approx(true_m, abs=2e-3), (ray, hanging)
        assert judge.needs_hanging or true_m == sampled_clearance_m(machine, tied, [ray])


@pytest.mark.parametrize("elbow_deg", [0.0, 60.0, 140.0, 180.0])
def test_the_arm_is_as_far_away_as_its_farther_joint_or_the_net(elbow_deg: float) -> None:
    """Tied 0.9 m ahead of the shoulder and beside the arm's plane, the line leads away sideways."""
    machine = vehicle("vehicle.tether.attachment_body_m=[0.9, -0.13, -0.05]")
    upper_m, fore_m = machine.arm.link_lengths_m
    elbow = math.radians(elbow_deg)
    net_m = math.hypot(upper_m + fore_m * math.cos(elbow), fore_m * math.sin(elbow)) + machine.tip_radius_m
    found_m = clearance(machine).least_m((0.0, -1.0, 0.0), None, (2.0, elbow))
    rotors_m = math.hypot(0.9, 0.13) - machine.airframe.radius_m
    assert found_m == pytest.approx(min(rotors_m, max(0.04, 0.9 - max(upper_m, net_m))))


def test_a_level_line_touches_the_rotors_of_a_tilted_machine() -> None:
    towards_anchor = quat_from_euler_zyx(math.radians(-20.0), 0.0, 0.0)  # the right side, where the anchor is, goes up
    away = quat_from_euler_zyx(math.radians(20.0), 0.0, 0.0)
    assert once((0.0, 1.2, 0.5), STILL, away).clearance_m < -0.02
    assert once((0.0, 1.2, 0.5), STILL, LEVEL).clearance_m > 0.02
    assert once((0.0, 1.2, 0.5), STILL, towards_anchor).clearance_m > 0.06


def test_a_slack_line_from_above_sags_into_the_rotors_and_a_straight_one_does_not() -> None:
    above = ("vehicle.tether.attachment_body_m=[0, 0, 0.1]", "vehicle.tether.anchor_world_m=[0, -1.2, 2.6]")
    slack = once((0.0, 0.0, 1.0), STILL, LEVEL, *above)
    straight = once((0.0, 0.0, 1.0), STILL, LEVEL, *above, "vehicle.tether.length_m=1.93")
    assert slack.clearance_m < 0.0 < straight.clearance_m


def test_the_arm_counts_when_the_line_is_tied_beside_it() -> None:
    beside = "vehicle.tether.attachment_body_m=[0, -0.13, -0.05]"
    machine = vehicle(beside)
    assert not clearance(vehicle()).judges_arm
    assert clearance(machine).judges_arm
    watch = watch_of(machine)

    def clear(p: Vec3, yaw_deg: float, arm: Joints | None) -> float:
        q = quat_from_euler_zyx(0.0, 0.0, math.radians(yaw_deg))
        return watch.update(0.0, p, STILL, q, arm, None, None).clearance_m

    # The anchor is on the attachment's side: the line leads away from the arm.
    assert clear((0.0, 0.0, 1.0), 0.0, DOWN) == pytest.approx(0.04, abs=0.01)
    # It is on the other side: the line crosses the arm's plane within its reach.
    assert clear((0.0, 0.0, 1.0), 180.0, DOWN) < 0.0
    assert clear((0.0, 0.0, 1.0), 180.0, None) <= clear((0.0, 0.0, 1.0), 180.0, FOLDED)


@given(st.floats(0.05, 3.0), st.floats(-2.0, 2.0), st.floats(0.0, 2.0))
def test_the_steepest_slope_lies_below_the_chord(level_m: float, drop_m: float, slack_m: float) -> None:
    chord_m = math.hypot(level_m, drop_m)
    along, up = steepest_slope(level_m, drop_m, chord_m, slack_m)
    assert math.hypot(along, up) == pytest.approx(1.0)
    assert along >= 0.0
    assert up * level_m <= drop_m * along + 1e-9


def test_the_sag_of_a_flat_line_is_that_of_the_catenary() -> None:
    level_m, parameter_m = 2.0, 4.0  # z = a cosh(x / a): length 2 a sinh(h / 2a), slope sinh(h / 2a)
    length_m = 2 * parameter_m * math.sinh(level_m / (2 * parameter_m))
    along, up = steepest_slope(level_m, 0.0, level_m, length_m - level_m)
    assert up / along == pytest.approx(-math.sinh(level_m / (2 * parameter_m)), rel=0.02)


# -- pull, analytic ----------------------------------------------------------------------------------------------------


def towards(p: Vec3, to: Vec3 = ANCHOR) -> Vec3:
    away = math.dist(p, to)
    return ((to[0] - p[0]) / away, (to[1] - p[1]) / away, (to[2] - p[2]) / away)


def pulled(
    seconds: float,
    force: Callable[[float, Vec3], Vec3 | None],
    tool: Callable[[float], Vec3 | None] = lambda t_s: STILL,
    v: Vec3 = STILL,
    p: Vec3 = (0.5, 0.0, 1.0),
    calm: Vec3 = STILL,
) -> list[TetherState]:
    """States from t = 0 on, after 6 s with a steady force."""
    watch, states = watch_of(vehicle()), []
    for tick in range(round(-6.0 / DT_S), 0):
        watch.update(tick * DT_S, p, STILL, LEVEL, FOLDED, calm, STILL)
    for tick in range(round(seconds / DT_S)):
        t_s = tick * DT_S
        at = (p[0] + v[0] * t_s, p[1] + v[1] * t_s, p[2] + v[2] * t_s)
        states.append(watch.update(t_s, at, v, LEVEL, FOLDED, force(t_s, at), tool(t_s)))
    return states


def along(size_n: float, to: Vec3 = ANCHOR) -> Callable[[float, Vec3], Vec3]:
    def force(t_s: float, p: Vec3) -> Vec3:
        x, y, z = towards(p, to)
        return (size_n * x, size_n * y, size_n * z)

    return force


def test_a_pull_towards_the_anchor_is_measured_and_is_a_snag_while_there_is_slack() -> None:
    states = pulled(1.5, along(5.0))
    assert states[-1].pull_n == pytest.approx(5.0, rel=0.03)
    assert states[-1].snagged
    assert not states[-1].taut, "there is slack"
    first = next(k for k, state in enumerate(states) if state.snagged) * DT_S
    assert 0.8 <= first <= 1.1, "longer than a blow, and no longer than it must be"


@pytest.mark.parametrize("wind_n", [(-5.0, 0.0, 0.0), (0.0, -7.0, 0.0), (4.0, -5.0, 1.0)])
def test_a_force_that_was_there_at_the_take_off_is_wind(wind_n: Vec3) -> None:
    gusty = pulled(4.0, lambda t_s, p: (wind_n[0], wind_n[1] - math.sin(3.0 * t_s), wind_n[2]), calm=wind_n)
    assert not any(state.taut or state.snagged for state in gusty)
    assert max(state.pull_n for state in gusty) < 2.0
    held = pulled(2.0, lambda t_s, p: plus(wind_n, along(5.0)(t_s, p)), calm=wind_n)
    assert held[-1].snagged, "and what comes on top of it is not"


@pytest.mark.parametrize(("speed_m_s", "held"), [(-0.25, False), (-0.1, True), (0.1, True), (0.25, False)])
@pytest.mark.parametrize("size_n", [5.0, 9.0])
def test_a_vehicle_that_moves_along_a_force_is_not_held_by_a_line(speed_m_s: float, held: bool, size_n: float) -> None:
    """0.15 m in the time after which a pull counts."""
    towards_x = towards((0.5, 0.0, 1.0))
    v = (speed_m_s * towards_x[0], speed_m_s * towards_x[1], speed_m_s * towards_x[2])
    states = pulled(1.5, lambda t_s, p: (size_n * towards_x[0], size_n * towards_x[1], size_n * towards_x[2]), v=v)
    assert any(state.snagged for state in states) is held


@pytest.mark.parametrize("size_n", [-9.0, -5.0, 5.0, 9.0])
def test_an_error_that_ends_with_the_motion_that_refuted_it_leaves_no_pull(size_n: float) -> None:
    """A vehicle that swings after a chase: errors of the thrust of 5 to 9 N along its motion, first one way, then the other."""
    moves_s, force = 1.0, along(size_n)

    def error(t_s: float, p: Vec3) -> Vec3:
        return force(t_s, (0.5, 0.0, 1.0)) if t_s < moves_s else STILL

    ways = towards((0.5, 0.0, 1.0))
    watch, p = watch_of(vehicle()), (0.5, 0.0, 1.0)
    for tick in range(-1200, 1000):
        t_s = tick * DT_S
        moves = 0.0 <= t_s < moves_s
        v = (0.3 * ways[0], 0.3 * ways[1], 0.3 * ways[2]) if moves else STILL
        state = watch.update(t_s, p, v, LEVEL, FOLDED, error(t_s, p) if t_s >= 0.0 else STILL, STILL)
        assert not state.snagged, t_s
    for tick in range(1000, 1400):
        state = watch.update(tick * DT_S, p, STILL, LEVEL, FOLDED, along(12.0)(0.0, p), STILL)
    assert state.snagged, "and a line that pulls afterwards is noticed"


@pytest.mark.parametrize("anchor", [(0.0, -1.2, 0.0), (-1.1, 0.4, 0.3), (0.5, 0.1, 2.4)])
def test_a_pull_comes_through_its_filter_and_counts_after_its_time_and_from_its_threshold_on(anchor: Vec3) -> None:
    """The threshold is 3 standard deviations of 0.7 N horizontally and 2 N vertically, and `pull_min_n` at least."""
    tether = tether_of(vehicle(f"vehicle.tether.anchor_world_m={list(anchor)}"))
    estimate = PullEstimate(tether)
    to_anchor = towards((0.5, 0.0, 1.0), anchor)
    spread_n = 1.0 / math.sqrt((to_anchor[0] ** 2 + to_anchor[1] ** 2) / 0.7**2 + to_anchor[2] ** 2 / 2.0**2)
    least_n = max(tether.pull_min_n, 3.0 * spread_n)

    def run(size_n: float, ticks: int) -> list[bool]:
        force = (size_n * to_anchor[0], size_n * to_anchor[1], size_n * to_anchor[2])
        found = []
        for _ in range(ticks):
            estimate.update(DT_S, to_anchor, STILL, force, None)
            found.append(estimate.pulling)
        return found

    def calm() -> None:
        estimate.forget()
        assert not any(run(0.0, 1200))

    gain = DT_S / (tether.pull_filter_s + DT_S)
    calm()
    run(2.0 * least_n, 40)
    assert estimate.pull_n == pytest.approx(2.0 * least_n * (1.0 - (1.0 - gain) ** 40), rel=0.03)
    calm()
    assert not any(run(0.99 * least_n, 1000))
    calm()
    assert run(1.1 * least_n, 2000)[-1]
    assert run(0.7 * least_n, 2000)[-1], "it goes on until it falls below 0.6 of that"
    assert not run(0.59 * least_n, 2000)[-1]
    calm()
    beyond = math.ceil(math.log(1.0 - least_n / (1e3 * least_n)) / math.log(1.0 - gain))
    first = run(1e3 * least_n, 400).index(True)
    assert first == pytest.approx(beyond - 2 + tether.pull_time_s / DT_S, abs=2.0)


def test_at_the_anchor_a_pull_has_no_direction() -> None:
    watch, force = watch_of(vehicle()), (0.0, 50.0, 0.0)
    states = [watch.update(k * DT_S, (0.0, -1.2 - 5e-7, 0.0), STILL, LEVEL, FOLDED, force, None) for k in range(3)]
    assert [state.pull_n for state in states] == [0.0, 0.0, 0.0]


@pytest.mark.parametrize(("gap_s", "counts_s"), [(0.03, 0.03), (1.0, 0.05), (-0.1, 0.0)])
def test_a_gap_between_two_ticks_counts_as_50_ms_at_most(gap_s: float, counts_s: float) -> None:
    watch, p = watch_of(vehicle()), (0.5, 0.0, 1.0)
    force = along(5.0)(0.0, p)
    for t_s in (1.0, 1.0 + gap_s):
        state = watch.update(t_s, p, STILL, LEVEL, FOLDED, force, None)
    assert state.pull_n == pytest.approx(5.0 * counts_s / (tether_of(vehicle()).pull_filter_s + counts_s))


@pytest.mark.parametrize(
    ("size_n", "later_n", "held"), [(5.9, 5.9, False), (7.0, 7.0, True), (7.0, 4.0, True), (7.0, 3.3, False)]
)
def test_six_newtons_from_the_side_hold_the_vehicle_until_they_fall_below_3_6_newtons(
    size_n: float, later_n: float, held: bool
) -> None:
    def force(t_s: float, p: Vec3) -> Vec3:
        now_n = size_n if t_s < 2.0 else later_n
        return (0.6 * now_n, 0.8 * now_n, 0.0)

    states = pulled(6.0, force)
    assert states[-1].snagged is held
    assert states[-1].pull_n == pytest.approx(later_n if held else 0.0, rel=0.15), (
        "away from the anchor: 0 unless it holds"
    )
    first = next(k for k, state in enumerate(pulled(2.0, lambda t_s, p: (60.0, 80.0, 0.0))) if state.snagged)
    assert first * DT_S == pytest.approx(tether_of(vehicle()).pull_time_s, abs=0.1), "no blow"


def test_the_pull_ends_when_the_line_falls_slack_again() -> None:
    states = pulled(3.0, lambda t_s, p: along(8.0 if t_s < 1.0 else 0.0)(t_s, p))
    assert states[190].snagged
    assert not states[-1].snagged
    assert not states[-1].taut


@pytest.mark.parametrize("sensor", [True, False])
@pytest.mark.parametrize("payload_kg", [0.1, 0.2, 0.4])
def test_a_caught_payload_is_no_pull(payload_kg: float, sensor: bool) -> None:
    """A blow forward and down, then the weight; with the force sensor, which sees the same, and without it."""

    def load(t_s: float) -> Vec3:
        if t_s < 0.5:
            return STILL
        blow = 12.0 * payload_kg * math.exp(-(t_s - 0.5) / 0.05)
        return (-4.0 * blow, 0.3 * blow, -4.0 * blow - 9.81 * payload_kg)

    states = pulled(3.0, lambda t_s, p: load(t_s), load if sensor else lambda t_s: None)
    assert not any(state.taut or state.snagged for state in states)


def test_wind_is_no_snag() -> None:
    for wind in ((1.0, 0.0, 0.0), (-0.7, -0.7, 0.0), (0.0, -1.0, 0.0)):
        states = pulled(3.0, lambda t_s, p, wind=wind: wind)  # type: ignore[misc]
        assert not any(state.taut or state.snagged for state in states)


def test_wrong_hover_thrust_above_the_anchor_is_no_pull() -> None:
    states = pulled(3.0, lambda t_s, p: (0.0, 0.0, -4.5), p=(0.0, -1.2, 1.5))
    assert not any(state.taut or state.snagged for state in states)
    assert pulled(3.0, lambda t_s, p: (0.0, 0.0, -9.0), p=(0.0, -1.2, 1.5))[-1].snagged


def test_held_by_something_else_than_the_anchor_is_a_snag() -> None:
    states = pulled(1.5, along(12.0, to=(0.5, 1.8, 0.2)))
    assert states[-1].snagged
    assert states[-1].pull_n > 10.0, "the event once said that the tether pulls with 0 N"


def test_without_knowledge_of_forces_there_is_no_pull() -> None:
    states = pulled(2.0, lambda t_s, p: None if t_s >= 1.5 else along(8.0)(t_s, p))
    assert states[290].snagged
    assert (states[-1].pull_n, states[-1].snagged) == (0.0, False)


def test_an_arm_that_leaves_its_plane_is_a_ball_about_its_first_joint() -> None:
    aside = "vehicle.tether.attachment_body_m=[0, 0.8, 0]"
    yaws = vehicle(aside, "vehicle.arm.joints[0].axis=[0, 0, 1]")
    judge = clearance(yaws)
    assert judge.judges_arm
    reach_m = 0.4 + yaws.tip_radius_m
    away = judge.least_m((0.0, 1.0, 0.0), None, (2.0, 1.0))
    assert away == pytest.approx(min(math.hypot(0.8, 0.05) - reach_m, 0.8 - yaws.airframe.radius_m))
    # The shoulder is 0.05 m below the origin.
    for ray in ((0.0, -1.0, 0.0), (0.36, -0.8, -0.48)):
        nearest_m = min(math.dist((0.0, 0.0, -0.05), (s * ray[0], 0.8 + s * ray[1], s * ray[2])) for s in STEPS_M)
        assert judge.least_m(ray, None, (2.0, 1.0)) == pytest.approx(nearest_m - reach_m, abs=1e-5)
    assert not clearance(
        vehicle("vehicle.tether.attachment_body_m=[0, 0.3, 0]", "vehicle.arm.joints[0].axis=[0, 0, 1]")
    ).judges_arm
