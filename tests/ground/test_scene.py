from __future__ import annotations

import itertools
import json
import math

import jsonschema
import pytest

from companion.config.loader import load_flight
from companion.ground.protocol.messages import MESSAGE_MAX_BYTES, Scene, Topic, decode
from companion.ground.telemetry.scene import PATH_POINTS_MAX, scene_of
from companion.mission.plan import Plan
from companion.model.codec import to_json
from companion.model.types import Vec3
from companion.sitl_config.team import load_team
from tests.machines import overrides_with_joints
from tests.support import CATCH, HOVER, tether_of
from tools.docs.telemetry import FOLDER, schema_file, schema_of, schema_text


def test_the_scene_is_the_vehicle_file_and_the_mission() -> None:
    config = load_flight(CATCH)
    scene = scene_of(config, "s1", [(0.0, 1.0, 2.0)], mission_s=31.5)
    vehicle = config.vehicle
    assert scene.room_min_world_m == (vehicle.room.x_m[0], vehicle.room.y_m[0], vehicle.room.z_m[0])
    assert scene.room_max_world_m == (vehicle.room.x_m[1], vehicle.room.y_m[1], vehicle.room.z_m[1])
    assert scene.anchor_world_m == tether_of(vehicle).anchor_world_m
    assert scene.tether_length_m == tether_of(vehicle).length_m
    for joint, low_rad, high_rad in zip(vehicle.arm.joints, scene.joint_min_rad, scene.joint_max_rad, strict=True):
        assert (math.degrees(low_rad), math.degrees(high_rad)) == pytest.approx(joint.angle_deg)
    assert math.degrees(scene.tilt_abort_rad) == pytest.approx(vehicle.safety.tilt_abort_deg)
    assert scene.tracking_warn_m < scene.tracking_abort_m == vehicle.safety.tracking_error_abort_m
    assert (scene.path_world_m, scene.mission_s) == (((0.0, 1.0, 2.0),), 31.5)
    assert decode(Scene, to_json(scene)) == scene


def test_the_scene_of_a_vehicle_without_tether_and_net_has_no_anchor_and_no_net() -> None:
    absent = ["vehicle.tether=null", "vehicle.tool=null", "vehicle.devices.force=null"]
    scene = scene_of(load_flight(CATCH, overrides=absent), "s1")
    assert (scene.anchor_world_m, scene.tether_length_m, scene.net_radius_m) == (None, None, None)
    assert decode(Scene, to_json(scene)) == scene
    jsonschema.Draft202012Validator(schema_of(Topic.SCENE)).validate(json.loads(to_json(scene)))


@pytest.mark.parametrize("count", [0, 1, 4])
def test_the_scene_has_as_many_links_and_limits_as_the_arm(count: int) -> None:
    config = load_flight(HOVER, overrides=overrides_with_joints(count))
    scene = scene_of(config, "s1")
    assert [len(values) for values in (scene.links_body_m, scene.joint_min_rad, scene.joint_max_rad)] == [count] * 3
    assert decode(Scene, to_json(scene)) == scene
    jsonschema.Draft202012Validator(schema_of(Topic.SCENE)).validate(json.loads(to_json(scene)))


@pytest.mark.parametrize(
    ("overrides", "partners"),
    [
        ((), ("carry-right", "carry-left")),
        (("left.vehicle.ground.topic=alpha", "right.vehicle.ground.topic=right"), (None, None)),
    ],
)
def test_the_scene_of_a_member_of_a_team_names_the_other_one_and_the_length_of_the_bar(
    overrides: tuple[str, ...], partners: tuple[str | None, str | None]
) -> None:
    scenes = [scene_of(config.flight, "s") for _, config in load_team("carry", overrides).members]
    assert tuple(scene.partner for scene in scenes) == partners
    assert [scene.bar_length_m for scene in scenes] == [1.2, 1.2]
    for scene in scenes:
        jsonschema.Draft202012Validator(schema_of(Topic.SCENE)).validate(json.loads(to_json(scene)))
    alone = scene_of(load_flight(CATCH, overrides=["vehicle.ground.topic=carry-left"]), "s")
    assert (alone.partner, alone.bar_length_m) == (None, None)


def test_phases_are_named_as_the_flight_names_them() -> None:
    config = load_flight(CATCH)
    plan = Plan.build(config.mission, config.vehicle)
    assert scene_of(config, "s").phases == tuple(segment.name for segment in plan.segments)


@pytest.mark.parametrize("count", [0, 1, 299, 300, 301, 5000])
def test_a_long_path_is_thinned_out_evenly(count: int) -> None:
    path: list[Vec3] = [(float(k), 0.1 * k, -0.123456789 * k) for k in range(count)]
    scene = scene_of(load_flight(CATCH), "s", path)
    found = scene.path_world_m
    assert len(found) == min(count, PATH_POINTS_MAX)
    assert len(to_json(scene)) < MESSAGE_MAX_BYTES
    if count:
        assert (found[0], found[-1]) == (path[0], path[-1])
        steps = {b[0] - a[0] for a, b in itertools.pairwise(found)}
        assert not steps or max(steps) - min(steps) <= 1.0


@pytest.mark.parametrize("topic", list(Topic))
def test_schemas_in_the_docs_are_up_to_date(topic: Topic) -> None:
    """Written by `python -m tools.docs.telemetry`."""
    assert schema_file(topic).read_text(encoding="utf-8") == schema_text(topic)
    jsonschema.Draft202012Validator.check_schema(schema_of(topic))


def test_the_docs_hold_no_schema_of_another_topic() -> None:
    assert {path.name for path in FOLDER.iterdir()} == {schema_file(topic).name for topic in Topic}
