"""What a machine at rest tells of wrong axes: every wrong frame that shows at rest is refused and named, the sound one passes."""

from __future__ import annotations

import math

import pytest
from msgspec.structs import replace

from companion.model.check_row import Row
from companion.model.frames import quat_conjugate, quat_from_euler_zyx, quat_multiply, quat_rotate
from companion.model.observations import Observations
from companion.model.types import Vec3
from companion.preflight import frames
from companion.preflight.axes import IDENTITY, ROTATIONS, AxisMap
from companion.preflight.frames import Pose, Wanted, explanation, standing
from tests.preflight.hand_rig import Standing, world

G: Vec3 = (0.0, 0.0, 9.81)
WATCH_S = 3.0


def watched(*overrides: str, until_s: float = WATCH_S, yaw_deg: float = 0.0, y_m: float = 0.8) -> list[Row]:
    """The rows of a machine that is watched for a while in a world set so; PX4 has had two seconds to begin with."""
    config = world(*overrides)
    start = config.mission.start.model_copy(update={"yaw_deg": yaw_deg, "position_m": (-1.0, y_m)})
    config = config.model_copy(update={"mission": config.mission.model_copy(update={"start": start})})
    return list(frames.rows(observed(Standing(config), until_s), config.mission, config.vehicle))


def observed(rig: Standing, until_s: float) -> Observations:
    seen = [sample for sample in rig.samples(until_s) if sample.t_s > 2.0]
    poses = {sample.pose.frame_number: sample.pose for sample in seen if sample.pose is not None}
    states = tuple(sample.vehicle for sample in seen if sample.vehicle is not None)
    return Observations(start_s=2.0, duration_s=until_s - 2.0, vehicle=states, mocap=tuple(poses.values()))


def failed(rows: list[Row]) -> dict[str, str]:
    return {row.id: row.fix for row in rows if not row.ok}


@pytest.mark.parametrize("seed", range(2))
def test_a_sound_set_up_passes_whatever_the_noise(seed: int) -> None:
    rows = watched(f"seed={seed}")
    assert not failed(rows), [row.line() for row in rows if not row.ok]
    assert [row.id for row in rows] == [check.id for check in frames.CHECKS if check is not frames.HAND_TEST]


@pytest.mark.parametrize(
    ("wrong", "row", "words"),
    [
        # The whole world in other axes, the body made in them: z up turned about x, y and z, exchanged, mirrored.
        ('mocap_axes=["x","z","-y"]', "frames.height", "the stream looks y-up: set devices.mocap.up_axis: y"),
        ('mocap_axes=["-z","y","x"]', "frames.height", "the stream's axes look exchanged"),
        ('mocap_axes=["-y","x","z"]', "frames.yaw", "the world looks turned by +90 deg about z: set the ground plane"),
        ('mocap_axes=["x","z","y"]', "frames.height", "the stream looks left-handed"),
        ('mocap_axes=["-x","y","z"]', "frames.place", "the stream looks left-handed"),
        ('mocap_axes=["y","x","z"]', "frames.place", "the stream looks left-handed"),
        # The body alone.
        ("mocap_body_yaw_deg=90", "frames.yaw", "the rigid body's zero was set while it was turned by -90 deg about z"),
        ("mocap_body_yaw_deg=20", "frames.yaw", "the rigid body's zero is turned by +20 deg"),
        ("mocap_body_tilt_deg=[90,0]", "frames.gravity", "while it was turned by -90 deg about x: place the vehicle level"),
        ("mocap_body_tilt_deg=[0,90]", "frames.gravity", "the rigid body's zero was set while it was turned by -90 deg about y"),
        ("mocap_body_tilt_deg=[0,8]", "frames.gravity", "the rigid body's zero was set while it was tilted"),
    ],
)  # fmt: skip
def test_a_wrong_frame_is_refused_and_named(wrong: str, row: str, words: str) -> None:
    rows = watched(wrong, "seed=1")
    assert row in {bad.id for bad in rows if bad.refuses}
    assert words in failed(rows)[row]
    # On an axis of the world some of them look alike, and none of them looks right.
    assert row in {bad.id for bad in watched(wrong, "seed=1", y_m=0.0) if bad.refuses}


def test_a_y_up_stream_of_a_machine_that_looks_to_the_left_shows_in_its_tilt_too() -> None:
    rows = watched('mocap_axes=["x","z","-y"]', yaw_deg=90.0)
    assert "y-up" in failed(rows)["frames.gravity"]
    assert "y-up" in failed(rows)["frames.height"]


@pytest.mark.parametrize("axes", [axes for axes in ROTATIONS if axes != IDENTITY], ids=lambda a: ",".join(a.names))
def test_a_world_that_was_turned_after_the_body_was_made_is_named(axes: AxisMap) -> None:
    wanted = Wanted((-1.0, 0.3, 0.3), 0.0, 0.15, 15.0)
    at = Pose(axes.vector(wanted.position_m), axes.quat)
    rows = list(standing(at, G, wanted, "z"))
    assert any(row.refuses for row in rows)
    fix = explanation(at, G, wanted, "z")
    assert fix.startswith("the world looks turned")
    assert all(row.fix == fix for row in rows if not row.ok)


@pytest.mark.parametrize("axes", [axes for axes in ROTATIONS if axes != IDENTITY], ids=lambda a: ",".join(a.names))
def test_a_rigid_body_whose_zero_was_set_while_it_was_turned_is_explained(axes: AxisMap) -> None:
    wanted = Wanted((0.4, -0.7, 0.3), math.radians(35.0), 0.15, 15.0)
    truth = quat_from_euler_zyx(0.01, -0.01, wanted.yaw_rad)
    force = quat_rotate(quat_conjugate(truth), G)
    at = Pose(wanted.position_m, quat_multiply(truth, quat_conjugate(axes.quat)))
    assert explanation(at, force, wanted, "z").startswith("the rigid body's zero was set while it was turned")


def test_a_wrong_start_position_is_not_taken_for_wrong_axes() -> None:
    wanted = Wanted((-1.0, 0.3, 0.3), 0.0, 0.15, 15.0)
    rows = list(standing(Pose((-0.6, 0.5, 0.31), (1.0, 0.0, 0.0, 0.0)), G, wanted, "z"))
    assert failed(rows) == {"frames.place": "carry the vehicle there or change the mission's start.position_m"}


def test_a_little_too_high_is_reported_but_does_not_refuse() -> None:
    wanted = Wanted((-1.0, 0.3, 0.3), 0.0, 0.15, 15.0)
    rows = list(standing(Pose((-1.0, 0.3, 0.36), (1.0, 0.0, 0.0, 0.0)), G, wanted, "z"))
    assert list(failed(rows)) == ["frames.height"]
    assert not any(row.refuses for row in rows)


def test_a_machine_that_is_carried_is_not_judged() -> None:
    rows = watched("handling=true", "handling_t_s=1.5", until_s=5.0)
    assert [row.id for row in rows] == ["frames.rest"]
    assert rows[0].refuses
    assert rows[0].fix == "do not touch the vehicle, and check again"


def test_too_few_samples_are_not_judged() -> None:
    config = world()
    (row,) = frames.rows(Observations(start_s=0.0, duration_s=5.0), config.mission, config.vehicle)
    assert row.refuses
    assert "0 tracked poses" in row.read


def test_noise_and_jumps_are_reported_by_how_bad_they_are() -> None:
    noisy = {row.id: row for row in watched("mocap_noise_m=0.003", "mocap_noise_deg=0.4")}
    for name in ("frames.noise_position", "frames.noise_attitude"):
        assert not noisy[name].ok
        assert not noisy[name].refuses
    assert {row.id for row in watched("mocap_noise_m=0.02") if row.refuses} >= {"frames.noise_position"}
    config = world()
    seen = observed(Standing(config), WATCH_S)
    flipped = replace(seen.mocap[50], attitude_wxyz=(0.0, 0.0, 0.0, 1.0))
    seen = replace(seen, mocap=(*seen.mocap[:50], flipped, *seen.mocap[51:]))
    refused = [row.id for row in frames.rows(seen, config.mission, config.vehicle) if row.refuses]
    assert refused == ["frames.noise_attitude"]


def test_px4_that_does_not_take_the_yaw_is_reported() -> None:
    config = world()
    seen = observed(Standing(config), WATCH_S)
    turned = quat_from_euler_zyx(0.0, 0.0, math.radians(60.0))
    states = tuple(replace(s, attitude_wxyz=quat_multiply(turned, s.attitude_wxyz)) for s in seen.vehicle)
    rows = list(frames.rows(replace(seen, vehicle=states), config.mission, config.vehicle))
    assert [row.id for row in rows if row.refuses] == ["frames.px4_yaw"]
    tilted = quat_from_euler_zyx(math.radians(6.0), 0.0, 0.0)
    states = tuple(replace(s, attitude_wxyz=quat_multiply(s.attitude_wxyz, tilted)) for s in seen.vehicle)
    rows = list(frames.rows(replace(seen, vehicle=states), config.mission, config.vehicle))
    assert [row.id for row in rows if row.refuses] == ["frames.px4_tilt"]


def test_an_accelerometer_that_reads_wrong_is_reported() -> None:
    config = world()
    seen = observed(Standing(config), WATCH_S)
    states = tuple(replace(s, specific_force_body_m_s2=(0.0, 0.0, 8.9)) for s in seen.vehicle)
    rows = list(frames.rows(replace(seen, vehicle=states), config.mission, config.vehicle))
    assert list(failed(rows)) == ["frames.accelerometer"]
    assert not any(row.refuses for row in rows)


def test_the_hand_test_on_record_is_reported_on_hardware_only() -> None:
    config = world()
    seen = observed(Standing(config), WATCH_S)

    def row(**known: str) -> Row | None:
        rows = frames.rows(replace(seen, **known), config.mission, config.vehicle)
        return next((row for row in rows if row.id == "frames.hand_test"), None)

    assert row() is None
    passed, never = row(hand_test="passed on 2026-11-21"), row(hand_test="")
    changed = row(hand_test="", hand_test_changed="passed on 2026-11-21, but since then up_axis changed from y to z")
    assert passed is not None and never is not None and changed is not None
    assert passed.ok
    for missing in (never, changed):
        assert not missing.ok
        assert not missing.refuses
        assert "companion check --hand" in missing.fix
    assert never.read == "never passed"
    assert "up_axis changed from y to z" in changed.read
