"""Single markers and the bar of NatNet frames: parsed, dropped if malformed, and through real sockets to the driver."""

from __future__ import annotations

import asyncio
import math
import struct
import time
from collections.abc import Sequence
from dataclasses import replace
from typing import Any

import pytest
from hypothesis import given
from hypothesis import strategies as st

from companion.io.mocap.driver import MocapDriver, settings_of
from companion.io.mocap.frames import Frame, parse_frame
from companion.model.markers import MARKERS_MAX, MarkerFrame
from companion.model.team import BarPose
from companion.model.types import Vec3
from companion.runtime.clock import flight_clock
from sitl.natnet import BodyPose, NatNetServer, encode_frame
from tests.io.natnet_bytes import VERSIONS, full_frame, numbers
from tests.io.test_mocap import POSE, STRANGER, device_for, streaming
from tests.support import DEADLINE_S

TICKS_HZ = 10_000_000
BALL: Vec3 = (0.5, -0.25, 1.5)
OTHER: Vec3 = (2.0, -2.0, 0.03125)
MARKER = {"kind": "marker"}
BAR = BodyPose(3, (0.5, -0.25, 1.5), (0.5, 0.5, -0.5, 0.5))
versions = pytest.mark.parametrize("version", VERSIONS)
positions = st.tuples(*[st.floats(width=32)] * 3)


def datagram(version: str, single: Sequence[Vec3]) -> bytes:
    return encode_frame(version, 7, 1.0, [POSE], 0.996, {1: "quad"}, single)


def parsed(data: bytes, version: str, *, markers: bool = True) -> Frame:
    frame = parse_frame(data, numbers(version), POSE.id, TICKS_HZ, markers=markers)
    assert isinstance(frame, Frame), frame
    return frame


@versions
def test_markers_without_a_body_come_out_once_though_motive_lists_them_twice(version: str) -> None:
    frame = parsed(datagram(version, (BALL, OTHER)), version)
    assert (frame.markers, frame.bad_markers) == ((BALL, OTHER), 0)


@versions
def test_markers_are_not_read_for_a_mission_that_follows_no_ball(version: str) -> None:
    assert parsed(datagram(version, (BALL, OTHER)), version, markers=False).markers == ()


def labelled(params: int) -> bytes:
    """Return a frame whose only single marker is in the section of labelled markers, with these flags."""
    whole, others = datagram("4.1", (BALL,)), struct.pack("<II3f", 1, 12, *BALL)
    assert others in whole
    old, new = (struct.pack("<fHf", 0.014, flags, 0.0004) for flags in (0x12, params))
    short = whole.replace(others, struct.pack("<II", 0, 0), 1).replace(old, new)
    return short[:2] + struct.pack("<H", len(short) - 4) + short[4:]


@pytest.mark.parametrize(
    ("params", "found"),
    [(0x12, (BALL,)), (0x02, (BALL,)), (0x0A, ()), (0x13, ())],
    ids=["unlabelled", "a label without a body", "of a body", "occluded"],
)
def test_a_labelled_marker_counts_if_no_body_has_it_and_cameras_see_it(params: int, found: tuple[Vec3, ...]) -> None:
    assert parsed(labelled(params), "4.1").markers == found


def test_markers_are_found_in_a_frame_with_two_elements_in_every_section() -> None:
    for version in VERSIONS:
        frame = parsed(full_frame(version), version)
        assert frame.markers == ((1.0, 1.0, 1.0), (1.0, 2.0, 3.0))


@given(single=st.lists(positions, max_size=12), version=st.sampled_from(VERSIONS))
def test_whatever_a_marker_holds_only_finite_ones_come_out_and_the_body_does_not_suffer(
    single: list[Vec3], version: str
) -> None:
    frame = parsed(datagram(version, single), version)
    good = [point for point in single if all(math.isfinite(value) and abs(value) <= 1000.0 for value in point)]
    assert frame.markers == tuple(dict.fromkeys(good))
    assert frame.bad_markers == 2 * (len(single) - len(good))
    assert frame.body is not None and frame.body.position_m == POSE.position_m


async def received(single: Sequence[Vec3], *poses: BodyPose, **device: Any) -> tuple[MarkerFrame | None, MocapDriver]:
    """Return what a driver of this device has after some frames over real sockets."""
    arrived = asyncio.Event()
    async with NatNetServer() as server, streaming(server, POSE, *poses, single=single):
        driver = MocapDriver(
            device_for(server, **device), flight_clock(), lambda _: arrived.set(), connect_timeout_s=DEADLINE_S
        )
        async with driver:
            await asyncio.wait_for(arrived.wait(), DEADLINE_S)
            pose, frame = driver.latest(), driver.markers()
            assert pose is not None
            if frame is not None:
                assert (frame.stamp_s, frame.frame_number) == (pose.stamp_s, pose.frame_number)
                assert pose.latency_s is not None and frame.exposed_s == pose.stamp_s - pose.latency_s
            return frame, driver


def places(frame: MarkerFrame | None) -> list[Vec3]:
    assert frame is not None
    return [marker.position_world_m for marker in frame.markers]


async def test_the_ball_arrives_with_the_pose_of_its_frame() -> None:
    frame, driver = await received((OTHER, BALL), ball=MARKER)
    assert places(frame) == [OTHER, BALL]
    assert driver.counts().malformed == 0


async def test_without_a_ball_no_markers_arrive() -> None:
    assert (await received((BALL,)))[0] is None


async def test_y_up_markers_are_turned_as_poses_are() -> None:
    frame, driver = await received((POSE.position_m,), ball=MARKER, up_axis="y")
    pose = driver.latest()
    assert pose is not None and places(frame) == [pose.position_world_m] != [POSE.position_m]


@pytest.mark.parametrize("up_axis", ["y", "z"])
async def test_of_many_markers_the_nearest_to_the_vehicle_are_kept(up_axis: str) -> None:
    x, y, z = POSE.position_m
    near = [(x, y, z + k / MARKERS_MAX) for k in range(MARKERS_MAX)]
    far = [(x + 2.0, y + 2.0, z), (x - 2.0, y, z - 1.0)]
    for single in ([*far, *near], [*near, *far]):
        frame, _ = await received(single, ball=MARKER, up_axis=up_axis)
        assert len(set(places(frame))) == MARKERS_MAX
        assert max(math.dist(one, two) for one in places(frame) for two in places(frame)) < 1.0


async def test_a_marker_that_is_not_a_number_is_dropped_and_counted() -> None:
    frame, driver = await received((BALL, (math.nan, 0.0, 1.0)), ball=MARKER)
    counts = driver.counts()
    assert places(frame) == [BALL]
    assert counts.malformed >= 1 and counts.problem is not None and "without a finite position" in counts.problem


async def test_a_ball_with_a_body_of_its_own_is_the_only_marker_while_it_is_tracked() -> None:
    ball = {"kind": "body", "id": 9}
    frame, _ = await received((OTHER,), BodyPose(9, BALL, (1.0, 0.0, 0.0, 0.0)), ball=ball)
    assert places(frame) == [BALL]
    lost = BodyPose(9, BALL, (1.0, 0.0, 0.0, 0.0), valid=False)
    for poses in ((lost,), ()):
        frame, _ = await received((OTHER,), *poses, ball=ball)
        assert places(frame) == []


async def test_the_guardian_reads_no_markers() -> None:
    from companion.guardian.mocap import GuardianMocap

    async with NatNetServer() as server, streaming(server, POSE, single=(BALL,)):
        guardian = GuardianMocap(settings_of(device_for(server, ball=MARKER)))
        try:
            deadline_s = time.monotonic() + DEADLINE_S
            while not guardian.poses() and time.monotonic() < deadline_s:
                guardian.keep_connected()
                await asyncio.sleep(0.01)
            assert guardian.tracked_s > 0.0 and guardian._client.markers() is None
        finally:
            guardian.close()


async def seen(*poses: BodyPose, **device: object) -> BarPose | None:
    """Return what a driver of this device has of the bar after some frames over real sockets."""
    _, driver = await received((), STRANGER, *poses, **device)
    bar, pose = driver.bar(), driver.latest()
    assert pose is not None and (bar is None or bar.stamp_s == pose.stamp_s)
    return bar


async def test_the_bar_arrives_with_the_pose_of_its_frame() -> None:
    bar = await seen(BAR, bar_id=3)
    assert bar is not None and bar.tracking_valid
    assert (bar.position_world_m, bar.attitude_wxyz) == (BAR.position_m, BAR.quat_wxyz)


async def test_a_y_up_bar_is_turned_as_the_vehicle_is() -> None:
    bar = await seen(BAR, bar_id=3, up_axis="y")
    (x, y, z), (qw, qx, qy, qz) = BAR.position_m, BAR.quat_wxyz
    assert bar is not None
    assert (bar.position_world_m, bar.attitude_wxyz) == ((x, -z, y), (qw, qx, -qz, qy))


async def test_a_bar_out_of_sight_is_not_tracked() -> None:
    bar = await seen(replace(BAR, valid=False), bar_id=3)
    assert bar is not None and not bar.tracking_valid


@pytest.mark.parametrize("bar_id", [None, 7])
async def test_without_a_bar_in_settings_or_stream_there_is_none(bar_id: int | None) -> None:
    assert await seen(BAR, bar_id=bar_id) is None


async def test_a_bar_whose_pose_is_not_a_number_is_not_seen() -> None:
    assert await seen(replace(BAR, position_m=(math.nan, 0.0, 0.0)), bar_id=3) is None
