"""Which poses of motion capture are believed, passed on to PX4, and reported."""

from __future__ import annotations

import pytest

from companion.model.frames import quat_from_euler_zyx, quat_rotate
from companion.model.types import Inputs, MocapPose, SafetyAction
from companion.safety.flight_context import FlightContext
from companion.safety.mocap import limits_of, unfused
from companion.safety.monitors import Monitors
from companion.safety.pose_filter import PoseFilter
from companion.safety.rules import RULES
from tests.safety.faults import (
    NAN,
    VEHICLE,
    both,
    drifting,
    every_35_ms,
    frozen_values,
    moved,
    replace,
    stream,
    turned,
    turning,
)
from tests.safety.healthy import (
    START_S,
    TICK_S,
    Change,
    after_a_moment,
    flying,
    healthy,
    put,
    standing,
    stopped,
    watched,
)


def test_a_rejected_pose_is_not_passed_on() -> None:
    monitors = Monitors(VEHICLE)
    watched(VEHICLE, [healthy(k) for k in range(3)], flying(), monitors)
    monitors.check(moved("mocap", (0.0, 0.3, 0.0))(healthy(3)), flying())
    assert not monitors.mocap_trusted
    assert monitors.trusted is not None and monitors.trusted.mocap == healthy(2).mocap, "as if it had not arrived"
    monitors.check(healthy(4), flying())
    assert monitors.mocap_trusted
    assert monitors.trusted.mocap is not None


def between_ticks(tick: int, change: Change = lambda i: i) -> MocapPose:
    """A pose that arrives 2 ms after the tick."""
    pose = change(healthy(tick)).mocap
    assert pose is not None
    return replace(pose, stamp_s=pose.stamp_s + 0.002, position_world_m=(*pose.position_world_m[:2], 0.99995))


def delayed(latency_s: float) -> Change:
    """Poses that were exposed this long before they arrive."""
    return lambda i: put("mocap", latency_s=latency_s, exposure_server_s=i.t_s - latency_s)(i)


BAD: dict[str, Change] = {
    "shifted": moved("mocap", (0.0, 0.3, 0.0)),
    "turned": turned("mocap", 180.0),
    "too late": delayed(0.13),
    "not tracked": put("mocap", tracking_valid=False),
}


@pytest.mark.parametrize("kind", BAD)
def test_each_pose_is_judged_before_it_is_passed_on_and_not_by_the_one_before_it(kind: str) -> None:
    """Frames that start no tick arrive between two of them: the verdict of the tick is that of another pose."""
    bad, monitors = BAD[kind], Monitors(VEHICLE)
    watched(VEHICLE, [healthy(k) for k in range(3)], flying(), monitors)
    vehicle = healthy(2).vehicle
    assert monitors.forwards(between_ticks(2), vehicle)
    assert not monitors.forwards(between_ticks(2, bad), vehicle)
    monitors.check(bad(healthy(3)), flying())
    assert monitors.forwards(between_ticks(3), vehicle), "a good pose after a bad one"
    assert not monitors.forwards(between_ticks(3, bad), vehicle)
    evaluated = bad(healthy(3)).mocap
    assert evaluated is not None and not monitors.forwards(evaluated, vehicle)


@pytest.mark.parametrize("id_", ["mocap_frozen", "mocap_two_streams", "mocap_dragged"])
def test_of_a_stream_that_is_rejected_no_pose_is_passed_on_or_used(id_: str) -> None:
    monitors, inputs = Monitors(VEHICLE), stream(id_)
    until = next(k for k, i in enumerate(inputs) if any(e.id == id_ for e in monitors.check(i, flying())))
    last = inputs[until].mocap
    assert last is not None and monitors.pose_filter() is None
    x, y, z = last.position_world_m
    another = replace(last, stamp_s=last.stamp_s + 0.002, position_world_m=(x, y, z + 1e-4))
    assert not monitors.forwards(another, inputs[until].vehicle)
    assert monitors.trusted is not None and monitors.trusted.mocap is None


def test_a_pose_that_is_too_late_counts_as_not_received() -> None:
    """PX4 lands on its own estimate then, and what it does shows more than a pose that PX4 does not get."""
    monitors = Monitors(VEHICLE)
    watched(VEHICLE, [healthy(k) for k in range(3)], flying(), monitors)
    late = delayed(0.13)
    monitors.check(late(healthy(3)), flying())
    assert not monitors.mocap_trusted
    assert monitors.trusted is not None and monitors.trusted.mocap == healthy(2).mocap
    watched(VEHICLE, [late(healthy(k)) for k in range(4, 50)], flying(), monitors)
    assert monitors.trusted.mocap is None
    monitors.check(healthy(50), flying())
    assert monitors.mocap_trusted and monitors.trusted.mocap is not None


def test_judging_a_pose_between_ticks_changes_nothing() -> None:
    """A replay has the inputs of the ticks only."""
    asked, unasked = Monitors(VEHICLE), Monitors(VEHICLE)
    for tick in range(40):
        i = turned("mocap", 180.0)(healthy(tick)) if tick % 3 == 2 else healthy(tick)
        assert asked.check(i, flying()) == unasked.check(i, flying())
        assert asked.mocap_trusted is unasked.mocap_trusted
        asked.forwards(between_ticks(tick, BAD[("shifted", "turned")[tick % 2]]), i.vehicle)


@pytest.mark.parametrize("id_", ["estimate_disagrees", "yaw_disagrees"])
def test_poses_that_are_rejected_in_between_do_not_restart_the_hold_time_of_a_disagreement(id_: str) -> None:
    apart = {"estimate_disagrees": moved("vehicle", (0.0, 0.4, 0.0)), "yaw_disagrees": turned("vehicle", 20.0)}[id_]

    def flickering(i: Inputs) -> Inputs:
        return apart(turned("mocap", 180.0)(i) if i.tick % 2 else i)

    events = watched(VEHICLE, after_a_moment(flickering), flying())
    reported = [event.t_s - START_S for event in events if event.id == id_]
    hold_s = next(rule.hold_time for rule in RULES if rule.id == id_)
    assert isinstance(hold_s, float)
    assert reported == [pytest.approx(3 * TICK_S + hold_s, abs=3 * TICK_S)]


@pytest.mark.parametrize(("late_s", "id_"), [(0.06, "mocap_late"), (0.15, "mocap_too_late")])
def test_a_delay_that_the_servers_stamps_do_not_contain_is_measured_against_the_least(late_s: float, id_: str) -> None:
    """A system that answers no echo requests: frames wait on the network from the 100th tick on."""

    def held(i: Inputs) -> Inputs:
        assert i.mocap is not None and i.mocap.exposure_server_s is not None
        wait_s = late_s if i.tick >= 100 else 0.0
        return put("mocap", exposure_server_s=i.mocap.exposure_server_s - wait_s)(i)

    events = watched(VEHICLE, (held(healthy(k)) for k in range(300)), flying())
    assert [event.id for event in events] == [id_]


@pytest.mark.parametrize(("late_s", "passes"), [(0.06, True), (0.15, False)])
def test_a_pose_whose_measured_delay_is_too_large_is_not_passed_on(late_s: float, passes: bool) -> None:
    """Its own latency ends at the transmission: the delay on the network shows only against the server's clock."""

    def held(i: Inputs) -> Inputs:
        assert i.mocap is not None and i.mocap.exposure_server_s is not None
        return put("mocap", exposure_server_s=i.mocap.exposure_server_s - late_s)(i)

    monitors = Monitors(VEHICLE)
    watched(VEHICLE, [healthy(k) for k in range(100)], flying(), monitors)
    vehicle, between = healthy(99).vehicle, between_ticks(99)
    assert between.exposure_server_s is not None and monitors.forwards(between, vehicle)
    late = replace(between, exposure_server_s=between.exposure_server_s + 0.002 - late_s)
    assert monitors.forwards(late, vehicle) is passes
    monitors.check(held(healthy(100)), flying())
    assert monitors.mocap_trusted is passes
    evaluated = held(healthy(100)).mocap
    assert evaluated is not None and monitors.forwards(evaluated, vehicle) is passes


def test_a_landing_without_the_core_judges_the_delay_on_the_network_as_the_flight_does() -> None:
    """The delay is there from the first pose of the landing on: only the flight has seen the server's clock without it."""
    monitors = Monitors(VEHICLE)
    watched(VEHICLE, [healthy(k) for k in range(100)], flying(), monitors)
    landing = monitors.pose_filter()
    first, second = healthy(100).mocap, healthy(101).mocap
    assert landing is not None and first is not None and second is not None and first.exposure_server_s is not None
    assert not landing.check(replace(first, exposure_server_s=first.exposure_server_s - 0.15), healthy(100).vehicle)
    assert landing.check(second, healthy(101).vehicle)


def test_bad_poses_of_every_kind_in_turn_are_no_motion_capture() -> None:
    """None of the kinds lasts; but nothing to believe has come."""

    def mixed(i: Inputs) -> Inputs:
        kinds = (
            moved("mocap", (0.0, 0.3, 0.0)),
            put("mocap", tracking_valid=False),
            put("mocap", position_world_m=(NAN,) * 3),
        )
        return kinds[i.tick % 3](i)

    events = watched(VEHICLE, after_a_moment(mixed), flying())
    first = next(event for event in events if event.action is SafetyAction.AUTOPILOT_LAND)
    assert first.t_s - START_S <= VEHICLE.safety.mocap_timeout_s + 5 * TICK_S


@pytest.mark.parametrize("gone_s", [0.3, 2.5])
def test_motion_capture_that_comes_back_at_its_full_rate_is_not_reported_as_slow(gone_s: float) -> None:
    def lost_for_a_while(i: Inputs) -> Inputs:
        return stopped("mocap")(i) if 1.0 <= i.t_s - START_S < 1.0 + gone_s else i

    events = watched(VEHICLE, after_a_moment(lost_for_a_while, ticks=1200), flying())
    assert [event.id for event in events] == ["mocap_lost"]


@pytest.mark.parametrize(
    ("gap_s", "off_m", "trusted"),
    [
        (0.5, 0.22, True), (0.5, 0.28, False), (0.95, 0.32, False), (0.15, 0.12, True), (0.15, 0.17, False),
        (1.5, 0.45, True), (1.5, 0.49, False), (3.0, 1.12, True), (3.0, 1.16, False),
    ],
)  # fmt: skip
def test_after_a_gap_a_pose_far_from_px4s_position_is_not_passed_on(gap_s: float, off_m: float, trusted: bool) -> None:
    """0.1 m, and 0.3 m/s for the drift of PX4's position, up to 0.3 m; from 1 s on 0.2 m x t^1.5 / s^1.5 in its place."""
    monitors, ticks = after_a_gap(gap_s, flying())
    far = moved("mocap", (0.0, off_m, 0.0))(healthy(ticks))
    monitors.check(far, flying())
    assert monitors.trusted is not None and (monitors.trusted.mocap is far.mocap) is trusted


@pytest.mark.parametrize(("turn_deg", "trusted"), [(18.0, True), (-18.0, True), (22.0, False), (-90.0, False)])
def test_after_a_long_gap_a_pose_that_has_turned_is_not_passed_on(turn_deg: float, trusted: bool) -> None:
    monitors, ticks = after_a_gap(2.0, flying())
    monitors.check(turned("mocap", turn_deg)(healthy(ticks)), flying())
    assert monitors.mocap_trusted is trusted


def test_after_a_long_gap_another_bodys_poses_are_not_trusted_however_long_they_last() -> None:
    monitors, ticks = after_a_gap(1.5, flying())
    others = [moved("mocap", (1.0, 0.0, 0.0))(healthy(k)) for k in range(ticks, ticks + 2000)]
    events = watched(VEHICLE, others, flying(), monitors)
    assert not monitors.mocap_trusted
    assert [event.id for event in events if event.id == "mocap_swapped"]


@pytest.mark.parametrize("gone", [stopped("mocap"), put("mocap", tracking_valid=False)], ids=["lost", "not tracked"])
def test_the_first_pose_after_a_loss_is_evaluated_before_it_may_be_passed_on(gone: Change) -> None:
    """PX4 would reset its position to it."""
    monitors = Monitors(VEHICLE)
    watched(VEHICLE, after_a_moment(gone, ticks=201), flying(), monitors)
    sound = healthy(201)
    far = moved("mocap", (1.0, 0.0, 0.0))(sound)
    assert sound.mocap is not None and monitors.forwards(sound.mocap, sound.vehicle)
    assert far.mocap is not None and not monitors.forwards(far.mocap, far.vehicle)


@pytest.mark.parametrize(("gap_s", "trusted"), [(0.9, False), (1.1, True)])
def test_on_the_ground_the_vehicle_may_be_carried_while_it_is_not_seen_for_a_second(
    gap_s: float, trusted: bool
) -> None:
    monitors, ticks = after_a_gap(gap_s, standing())
    carried = moved("mocap", (1.5, 0.0, 0.0))(healthy(ticks))
    assert carried.mocap is not None and monitors.forwards(carried.mocap, carried.vehicle) is trusted
    monitors.check(carried, standing())
    assert monitors.mocap_trusted is trusted


def after_a_gap(gap_s: float, context: FlightContext) -> tuple[Monitors, int]:
    """Monitors that have seen no frame for a while, and the tick of the next one."""
    monitors = Monitors(VEHICLE)
    ticks = 20 + round(gap_s / TICK_S)
    gone = [replace(healthy(k), mocap=healthy(min(k, 19)).mocap) for k in range(ticks)]
    watched(VEHICLE, gone, context, monitors)
    return monitors, ticks


def test_motion_capture_that_comes_back_slowly_is_reported_with_its_own_rate() -> None:
    def lost_then_slow(i: Inputs) -> Inputs:
        since_s = i.t_s - START_S
        return stopped("mocap")(i) if 1.0 <= since_s < 3.0 else every_35_ms(i) if since_s >= 3.0 else i

    events = watched(VEHICLE, after_a_moment(lost_then_slow, ticks=1200), flying())
    assert [event.id for event in events] == ["mocap_lost", "mocap_slow"]
    assert events[1].text == "motion capture arrives at 29 Hz (limit 50 Hz)"


def test_a_pose_that_is_lost_disagrees_with_nothing() -> None:
    """PX4's estimate drifts on without it: one cause, one event."""
    events = watched(VEHICLE, after_a_moment(both(drifting, turning, stopped("mocap"))), flying())
    assert [event.id for event in events] == ["mocap_lost"]


@pytest.mark.parametrize("direction", [(0.0, 1.0, 0.0), (0.0, 0.0, -1.0), (-0.6, 0.8, 0.0)])
@pytest.mark.parametrize("flies", [True, False])
def test_poses_that_move_are_dragged_unless_the_imu_measures_the_motion(
    direction: tuple[float, float, float], flies: bool
) -> None:
    """From 3.2 s on the vehicle, or only its poses, accelerate by 4 m/s2 to 0.8 m/s; the IMU measures in the body's axes."""
    into_body = quat_from_euler_zyx(0.0, 0.0, -0.4)

    def change(i: Inputs) -> Inputs:
        since_s = max(0.0, i.t_s - START_S - 3.2)
        speed_m_s = min(0.8, 4.0 * since_s)
        way_m = 0.5 * speed_m_s * min(since_s, 0.2) + 0.8 * max(0.0, since_s - 0.2)
        x, y, z = direction
        i = both(
            moved("mocap", (way_m * x, way_m * y, way_m * z)), moved("vehicle", (way_m * x, way_m * y, way_m * z))
        )(i)
        if not flies:
            return i
        assert i.vehicle is not None and i.vehicle.delta_velocity_body_m_s is not None
        gained = quat_rotate(into_body, (speed_m_s * x, speed_m_s * y, speed_m_s * z))
        sensed = tuple(a + b for a, b in zip(i.vehicle.delta_velocity_body_m_s, gained, strict=True))
        return put("vehicle", delta_velocity_body_m_s=sensed)(i)

    events = watched(VEHICLE, after_a_moment(change, ticks=730, sound=0), flying())
    assert ("mocap_dragged" in [event.id for event in events]) is not flies


@pytest.mark.parametrize("direction", [(1, 0, 0), (0, 1, 0), (0, 0, 1), (-1, 0, 0), (0, -1, 0), (0, 0, -1)])
@pytest.mark.parametrize(("size_m", "trusted"), [(0.09, True), (0.11, False)])
def test_a_jump_is_one_from_ten_centimetres_on_in_every_direction(
    direction: tuple[int, int, int], size_m: float, trusted: bool
) -> None:
    monitors = Monitors(VEHICLE)
    watched(VEHICLE, [healthy(k) for k in range(3)], flying(), monitors)
    x, y, z = direction
    monitors.check(moved("mocap", (size_m * x, size_m * y, size_m * z))(healthy(3)), flying())
    assert monitors.mocap_trusted is trusted


@pytest.mark.parametrize("component", [0, 1, 2])
def test_a_pose_is_compared_with_where_px4s_velocity_has_carried_the_last_one(component: int) -> None:
    """80 ms without a frame at 1.5 m/s are 0.12 m, more than the jump limit."""
    velocity, there = [0.0, 0.0, 0.0], [0.0, 0.0, 0.0]
    velocity[component], there[component] = 1.5, 0.12
    monitors = Monitors(VEHICLE)
    fast = put("vehicle", velocity_world_m_s=tuple(velocity))
    gone = [fast(replace(healthy(k), mocap=healthy(min(k, 4)).mocap)) for k in range(20)]
    watched(VEHICLE, gone, flying(), monitors)
    monitors.check(fast(moved("mocap", (there[0], there[1], there[2]))(healthy(20))), flying())
    assert monitors.mocap_trusted


@pytest.mark.parametrize(
    ("position", "yaw", "fused"),
    [
        ((0.0, 0.0, 1.0), 0.4, True),
        ((0.05, 0.0, 1.0), 0.45, True),
        ((0.2, 0.0, 1.0), 0.4, False),
        ((0.0, 0.0, 1.0), 0.9, False),
    ],
)
def test_fusion_is_proved_by_agreement(position: tuple[float, float, float], yaw: float, fused: bool) -> None:
    pose = put("mocap", position_world_m=position, attitude_wxyz=quat_from_euler_zyx(0, 0, yaw))
    assert (unfused(pose(healthy())) is None) == fused


def test_in_the_air_a_repeated_pose_is_not_passed_on_at_once() -> None:
    """Long before it is a finding: PX4 would take it for standing still."""
    monitors, first = Monitors(VEHICLE), healthy()
    assert first.mocap is not None
    for k in range(5):
        monitors.check(healthy(k), flying())
        assert monitors.mocap_trusted
    pose = healthy(4).mocap
    assert pose is not None
    same = put("mocap", position_world_m=pose.position_world_m, attitude_wxyz=pose.attitude_wxyz)
    monitors.check(same(healthy(5)), flying())
    assert not monitors.mocap_trusted
    assert monitors.trusted is not None and monitors.trusted.mocap is not None, "it is no finding yet"
    monitors.check(healthy(6), flying())
    assert monitors.mocap_trusted
    monitors.check(same(healthy(7)), standing())
    monitors.check(same(healthy(8)), standing())
    assert monitors.mocap_trusted, "on the ground a pose may well repeat"


def test_a_frame_without_the_body_does_not_end_a_freeze() -> None:
    """Otherwise the frozen pose is trusted again for `mocap_frozen_s`, and a landing by PX4 takes it for a new one."""
    monitors, same = Monitors(VEHICLE), frozen_values("mocap", "position_world_m", "attitude_wxyz")
    told = watched(VEHICLE, (same(healthy(k)) for k in range(60)), flying(), monitors)
    assert [event.id for event in told] == ["mocap_frozen"]
    monitors.check(put("mocap", tracking_valid=False)(same(healthy(60))), flying())
    for k in range(61, 80):
        monitors.check(same(healthy(k)), flying())
        assert monitors.trusted is not None and monitors.trusted.mocap is None
    monitors.check(healthy(80), flying())
    assert monitors.trusted is not None and monitors.trusted.mocap is not None, "the pose moves again"


def test_a_repeated_an_untracked_or_a_late_pose_is_not_passed_on() -> None:
    checked, poses = PoseFilter(limits_of(VEHICLE.safety)), [healthy(k).mocap for k in range(4)]
    first, second, third, fourth = (pose for pose in poses if pose is not None)
    assert checked.check(first, None) and not checked.check(replace(first, stamp_s=second.stamp_s), None)
    assert not checked.check(replace(third, tracking_valid=False), None)
    assert third.exposure_server_s is not None and third.latency_s is not None
    late_s = VEHICLE.safety.mocap_latency_max_s + 0.01
    exposed_s = third.exposure_server_s + third.latency_s - late_s
    assert not checked.check(replace(third, latency_s=late_s, exposure_server_s=exposed_s), None)
    assert not checked.check(replace(third, exposure_server_s=third.exposure_server_s - 0.15), None)
    assert checked.check(fourth, None)
