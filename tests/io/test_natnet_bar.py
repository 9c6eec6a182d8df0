"""The bar's rigid body of NatNet frames, through real sockets to the driver."""

from __future__ import annotations

import math
from dataclasses import replace

import pytest

from companion.model.team import BarPose
from sitl.natnet import BodyPose
from tests.io.test_mocap import STRANGER
from tests.io.test_natnet_markers import received

BAR = BodyPose(3, (0.5, -0.25, 1.5), (0.5, 0.5, -0.5, 0.5))


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
