"""The guided hand test on the simulated machine that a hand carries: sound set-ups pass, every wrong one is refused and named."""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Callable, Iterable
from functools import cache

import pytest
from msgspec.structs import replace

from companion.model.check_row import Row, refusals
from companion.model.frames import quat_rotate
from companion.model.types import MocapPose, Quat, Vec3
from companion.preflight.axes import ALL, IDENTITY, MIRRORINGS, ROTATIONS, AxisMap
from companion.preflight.hand_test import evaluation as hand_test_evaluation
from companion.preflight.hand_test.steps import (
    SILENCE_MAX_S,
    STEP_TIMEOUT_S,
    HandResult,
    HandSample,
    HandTest,
    HandView,
    Step,
)
from sitl.world.handling import ROUND_S
from tests.preflight.hand_rig import Standing, world
from tests.support import ROOT
from tools.docs.preflight import checks_table
from tools.docs.tables import written

END_S = 4.0 + ROUND_S


@cache
def samples(*overrides: str) -> tuple[HandSample, ...]:
    """A whole round of the hand in a world set so."""
    if not overrides:
        return tuple(sample for sample in two_rounds() if sample.t_s <= END_S)
    return tuple(Standing(world("handling=true", *overrides)).samples(END_S))


@cache
def two_rounds() -> tuple[HandSample, ...]:
    return tuple(Standing(world("handling=true")).samples(4.0 + 2 * ROUND_S + 6.0))


@cache
def standing() -> tuple[HandSample, ...]:
    """A machine that nobody touches, for longer than a step may take: the same five seconds again and again."""
    stood = [sample for sample in Standing(world()).samples(5.0) if sample.pose is not None]
    return tuple(
        later(sample, number) for number in range(1 + math.ceil((STEP_TIMEOUT_S + 10.0) / 5.0)) for sample in stood
    )


def later(sample: HandSample, number: int) -> HandSample:
    """The sample so many times five seconds later."""
    late_s, pose, vehicle = 5.0 * number, sample.pose, sample.vehicle
    assert pose is not None and vehicle is not None
    return dataclasses.replace(
        sample,
        t_s=sample.t_s + late_s,
        pose=replace(pose, stamp_s=pose.stamp_s + late_s, frame_number=pose.frame_number + 10_000 * number),
        vehicle=replace(vehicle, imu_stamp_s=vehicle.imu_stamp_s + late_s),
    )


def ran(course: Iterable[HandSample]) -> HandView:
    test = HandTest()
    view = None
    for sample in course:
        view = test.update(sample)
        if view.result is not None or view.ended:
            break
    assert view is not None
    return view


def result(course: Iterable[HandSample]) -> HandResult:
    view = ran(course)
    assert view.result is not None, view
    return view.result


def failed(rows: Iterable[Row]) -> dict[str, str]:
    """What to do, of each row that refuses."""
    return {row.id: row.fix for row in refusals(rows)}


def felt_otherwise(course: Iterable[HandSample], turn: Callable[[Vec3], Vec3]) -> list[HandSample]:
    """The same course with PX4's IMU mounted otherwise."""
    turned = []
    for sample in course:
        vehicle = sample.vehicle
        if vehicle is not None:
            vehicle = replace(
                vehicle,
                specific_force_body_m_s2=turn(vehicle.specific_force_body_m_s2),
                angular_rate_body_rad_s=turn(vehicle.angular_rate_body_rad_s),
            )
        turned.append(dataclasses.replace(sample, vehicle=vehicle))
    return turned


def test_a_sound_set_up_passes() -> None:
    measured = result(samples())
    assert not failed(hand_test_evaluation.rows(measured, "z"))
    # Far from the limits: what refuses is a wrong axis, not a shaking hand.
    assert abs(hand_test_evaluation.yaw_offset_deg(measured.forward)) < 0.5 * hand_test_evaluation.YAW_MAX_DEG
    assert hand_test_evaluation.best_axes(measured) == IDENTITY


def test_a_biased_imu_and_slow_motion_capture_pass() -> None:
    knobs = ("mocap_rate_hz=60", "mocap_noise_m=0.001", "mocap_noise_deg=0.3", "mocap_latency_s=0.03")
    course = []
    for sample in samples(*knobs):
        vehicle = sample.vehicle
        if vehicle is not None:
            (fx, fy, fz), (wx, wy, wz) = vehicle.specific_force_body_m_s2, vehicle.angular_rate_body_rad_s
            force, rate = (fx + 0.3, fy - 0.2, fz + 0.2), (wx + 0.02, wy - 0.02, wz + 0.03)
            vehicle = replace(vehicle, specific_force_body_m_s2=force, angular_rate_body_rad_s=rate)
        course.append(dataclasses.replace(sample, vehicle=vehicle))
    assert not failed(hand_test_evaluation.rows(result(course), "z"))


@pytest.mark.parametrize(
    ("wrong", "row", "words"),
    [
        ("mocap_body_yaw_deg=90", "hand.forward", "deg to the left of the nose"),
        ("mocap_body_yaw_deg=-20", "hand.forward", "the rigid body's zero is turned"),
        ("mocap_body_tilt_deg=[90,0]", "hand.level", "the rigid body's axes are exchanged"),
        ("mocap_body_tilt_deg=[0,12]", "hand.level", "the rigid body's zero was set while the vehicle was tilted"),
    ],
)
def test_a_wrong_body_is_refused_and_named(wrong: str, row: str, words: str) -> None:
    measured = result(samples(wrong))
    refused = failed(hand_test_evaluation.rows(measured, "z"))
    assert row in refused
    assert words in refused[row]
    if wrong.startswith("mocap_body_yaw_deg="):
        off_deg = float(wrong.partition("=")[2])
        assert hand_test_evaluation.yaw_offset_deg(measured.forward) == pytest.approx(off_deg, abs=5.0)


@pytest.mark.parametrize(
    ("names", "row", "words"),
    [
        (("x", "z", "-y"), "hand.lift", "the stream looks y-up: set devices.mocap.up_axis: y"),
        (
            ("x", "-z", "y"),
            "hand.lift",
            "the stream's axes are exchanged (its x, y, z look like the vehicle's x, -z, y)",
        ),
        (("x", "z", "y"), "hand.lift", "the stream is left-handed (its x, y, z look like the true x, z, y)"),
        (("x", "-y", "z"), "hand.turn", "the stream is left-handed"),
    ],
)
def test_a_wrong_frame_is_refused_and_named(names: tuple[str, str, str], row: str, words: str) -> None:
    assert words in failed(hand_test_evaluation.rows(in_axes(AxisMap.of(names)), "z"))[row]


def test_a_z_up_stream_that_is_taken_for_y_up_is_named() -> None:
    refused = failed(hand_test_evaluation.rows(in_axes(AxisMap.of(("x", "-z", "y"))), "y"))
    assert refused["hand.lift"] == "the stream looks z-up: set devices.mocap.up_axis: z"


@pytest.mark.parametrize("axes", ALL, ids=lambda axes: ",".join(axes.names))
def test_each_of_the_48_body_frames_is_distinguished_from_the_others(axes: AxisMap) -> None:
    """Without the rule of how people make a rigid body: every exchange of its axes."""
    measured = in_axes(axes)
    assert hand_test_evaluation.best_axes(measured) == axes
    assert bool(failed(hand_test_evaluation.rows(measured, "z"))) is (axes != IDENTITY)


def in_axes(axes: AxisMap) -> HandResult:
    """The round's result with world and body in other axes."""
    return result(
        dataclasses.replace(sample, pose=exchanged(sample.pose, axes)) if sample.pose is not None else sample
        for sample in samples()[::3]
    )


def exchanged(pose: MocapPose, axes: AxisMap) -> MocapPose:
    """World and body in other axes: A p, A R A'."""
    position, attitude = axes.vector(pose.position_world_m), axes.rotation(pose.attitude_wxyz)
    return replace(pose, position_world_m=position, attitude_wxyz=attitude)


def test_axis_maps_are_what_they_say() -> None:
    assert len(ROTATIONS) == len(MIRRORINGS) == 24
    v: Vec3 = (1.0, 2.0, 3.0)
    for axes in ROTATIONS:
        assert quat_rotate(axes.quat, v) == pytest.approx(axes.vector(v))
    for axes in ALL:
        assert axes.inverse.vector(axes.vector(v)) == v
        assert AxisMap.of(axes.names) == axes
    q: Quat = (math.cos(0.3), 0.0, 0.0, math.sin(0.3))
    assert AxisMap.of(("x", "-y", "z")).rotation(q) == (q[0], 0.0, 0.0, -q[3])


def test_px4_mounted_the_wrong_way_round_is_distinguished_from_wrong_motion_capture() -> None:
    course = felt_otherwise(samples(), lambda v: (v[1], -v[0], v[2]))
    refused = failed(hand_test_evaluation.rows(result(course), "z"))
    assert "hand.instructed" in refused
    assert "SENS_BOARD_ROT" in refused["hand.forward"]


def doubled(pose: MocapPose) -> MocapPose:
    x, y, z = pose.position_world_m
    return replace(pose, position_world_m=(2.0 * x, 2.0 * y, 2.0 * z))


def test_wrong_distances_are_reported() -> None:
    course = [dataclasses.replace(s, pose=doubled(s.pose)) if s.pose is not None else s for s in samples()]
    assert set(failed(hand_test_evaluation.rows(result(course), "z"))) == {"hand.scale"}


# -- how it ends without a result ----------------------------------------------------------------------------------------


def test_it_ends_at_once_when_px4_is_armed() -> None:
    view = ran(dataclasses.replace(sample, armed=sample.t_s > 6.0) for sample in samples())
    assert view.ended.startswith("PX4 reports that it is armed")
    assert view.step is Step.LIFT
    assert view.result is None
    view = HandTest().update(dataclasses.replace(samples()[0], armed=True))
    assert view.ended.startswith("PX4 reports that it is armed")


def test_it_ends_when_px4_does_not_say_whether_it_is_armed() -> None:
    view = ran(dataclasses.replace(sample, armed=None if sample.t_s > 3.0 else False) for sample in samples())
    assert view.ended.startswith(f"PX4 has not reported for {SILENCE_MAX_S:g} s whether it is armed")


def test_a_test_without_a_result_names_the_command_to_do_again() -> None:
    for again, row in (
        ("companion check --hand", hand_test_evaluation.ended("nobody lifted it")),
        ("companion mocap align", hand_test_evaluation.ended("nobody lifted it", "companion mocap align")),
    ):
        assert (row.refuses, row.read, row.fix) == (True, "nobody lifted it", f"repeat the test: {again}")


def test_a_machine_that_nobody_lifts_is_reported_after_the_time_limit() -> None:
    view = ran(standing())
    assert view.ended.startswith(f"not done within {STEP_TIMEOUT_S:g} s: hold it by its legs")
    assert "moved by 0 cm" in view.ended


@pytest.mark.parametrize(
    ("change", "words"),
    [
        (lambda sample: dataclasses.replace(sample, pose=None), "motion capture does not track the rigid body"),
        (lambda sample: dataclasses.replace(sample, vehicle=None), "no state from PX4"),
        (
            lambda sample: dataclasses.replace(sample, pose=sample.pose and replace(sample.pose, tracking_valid=False)),
            "motion capture does not track the rigid body",
        ),
    ],
)
def test_a_silent_device_is_named(change: Callable[[HandSample], HandSample], words: str) -> None:
    view = ran(change(sample) for sample in standing())
    assert view.step is Step.STAND
    assert words in view.ended


def test_markers_that_are_covered_during_a_move_make_it_count_not() -> None:
    test = HandTest()
    notices = set()
    for sample in samples():
        covered = 5.0 < sample.t_s < 5.7
        pose = replace(sample.pose, tracking_valid=False) if sample.pose and covered else sample.pose
        view = test.update(dataclasses.replace(sample, pose=pose))
        notices.add(view.notice)
        assert view.result is None or view.step is Step.DONE
    assert any("motion capture lost the rigid body" in notice for notice in notices)


def test_a_pause_in_the_middle_of_the_round_is_not_taken_for_the_floor() -> None:
    """Whoever joins while the machine is carried waits for the next time that it stands."""
    view = ran(sample for sample in two_rounds() if sample.t_s > 6.5)
    assert view.result is not None
    assert not failed(hand_test_evaluation.rows(view.result, "z"))


def test_the_docs_list_every_row() -> None:
    page = (ROOT / "docs/internals/hand-test.md").read_text(encoding="utf-8")
    assert written(page, {"hand": checks_table(hand_test_evaluation.CHECKS)}) == page
