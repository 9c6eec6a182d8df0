"""From a hand test to the setting that is wrong: the simulated machine and its hand, without wires."""

from __future__ import annotations

import math

import pytest

from companion.commissioning.mocap import align as mocap_align
from companion.commissioning.mocap.align import Alignment
from companion.io.mocap.natnet import z_up_from_y_up
from companion.model.observations import Observations
from companion.model.types import MocapPose
from companion.preflight import frames
from companion.preflight.hand_test.steps import HandResult, HandTest
from tests.preflight.hand_rig import Standing, world


def measured(*overrides: str) -> HandResult:
    test = HandTest()
    for sample in Standing(world("handling=true", *overrides)).samples(40.0):
        view = test.update(sample)
        assert not view.ended, view.ended
        if view.result is not None:
            return view.result
    raise AssertionError("the test did not end")


def found(*overrides: str, up_axis: str = "z", start_yaw_deg: float = 0.0) -> Alignment:
    return mocap_align.alignment(measured(*overrides), up_axis, math.radians(start_yaw_deg))


def test_a_sound_set_up_needs_nothing() -> None:
    result = measured()
    a = mocap_align.alignment(result, "z", 0.0)
    assert mocap_align.as_json(a)["right"]
    assert mocap_align.changes(a, "z") == {}
    world_row = mocap_align.world_row(a, 15.0)
    assert world_row is not None and world_row.ok
    turned = mocap_align.world_row(mocap_align.alignment(result, "z", math.radians(60.0)), 15.0)
    assert turned is not None and not turned.ok


def test_a_y_up_stream_becomes_the_up_axis() -> None:
    a = found('mocap_axes=["x","z","-y"]')
    assert mocap_align.changes(a, "z") == {("devices", "mocap", "up_axis"): "y"}
    assert mocap_align.world_row(a, 15.0) is None


def test_a_y_up_stream_read_as_such_is_right() -> None:
    """By the setting that is proposed, in the preflight."""
    config, poses, states = world('mocap_axes=["x","z","-y"]'), {}, []
    for sample in Standing(config).samples(3.0):
        if sample.t_s > 2.0 and sample.pose is not None and sample.vehicle is not None:
            position_m, attitude = z_up_from_y_up(sample.pose.position_world_m, sample.pose.attitude_wxyz)
            poses[sample.pose.frame_number] = MocapPose(
                stamp_s=sample.pose.stamp_s,
                frame_number=sample.pose.frame_number,
                position_world_m=position_m,
                attitude_wxyz=attitude,
                tracking_valid=True,
                marker_error_m=0.0,
            )
            states.append(sample.vehicle)
    seen = Observations(start_s=2.0, duration_s=1.0, vehicle=tuple(states), mocap=tuple(poses.values()))
    rows = frames.rows(seen, config.mission, config.vehicle)
    names = ("frames.gravity", "frames.height", "frames.place", "frames.yaw")
    assert {row.id: row.ok for row in rows if row.id in names} == dict.fromkeys(names, True)


@pytest.mark.parametrize("yaw_deg", [-90.0, 35.0, 180.0])
def test_a_turned_body_is_not_reported_as_a_turned_world(yaw_deg: float) -> None:
    a = found(f"mocap_body_yaw_deg={yaw_deg}")
    assert abs(math.remainder(a.body_yaw_deg - yaw_deg, 360.0)) < 8.0
    assert a.world_yaw_deg == pytest.approx(0.0, abs=8.0)
    assert mocap_align.changes(a, "z") == {}
    assert not mocap_align.as_json(a)["right"]


def test_a_turned_world_is_not_reported_as_a_turned_body() -> None:
    a = found('mocap_axes=["y","-x","z"]')
    assert a.world_yaw_deg == pytest.approx(-90.0, abs=8.0)
    assert a.body_yaw_deg == pytest.approx(0.0, abs=8.0)
    row = mocap_align.world_row(a, 15.0)
    assert row is not None and not row.ok and "ground plane" in row.fix


def test_a_mirrored_stream_is_reported() -> None:
    a = found('mocap_axes=["x","-y","z"]')
    assert a.mirrored
    assert a.axes.names == ("x", "-y", "z")
    assert mocap_align.changes(a, "z") == {}
