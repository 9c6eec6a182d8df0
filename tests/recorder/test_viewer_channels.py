"""The viewer channels: frames, poses, scene and rates; and that they never cost a tick."""

from __future__ import annotations

import json
import math
import random
from collections.abc import Iterable
from pathlib import Path
from typing import Any

import pytest
from msgspec.structs import fields, replace

from companion.analysis.log import FlightLog
from companion.cli.main import main
from companion.config.loader import load_flight, load_vehicle
from companion.control.arm_model import manipulator_of
from companion.model.codec import Record, differences
from companion.model.exit_codes import EXIT_BAD_INPUT, EXIT_OK
from companion.model.frames import quat_from_euler_zyx, quat_multiply, quat_rotate
from companion.model.hanging_line import hanging_line_m
from companion.model.markers import BallState
from companion.model.team import BarPose, Grip, PartnerState, TeamState
from companion.model.types import Joints, Quat, Vec3
from companion.recorder.log_file import LogFile
from companion.recorder.log_writer import LogWriter
from tests.machines import overrides_with_joints
from tests.recorder.flights import EPOCH_NS, Row, config_json, tethered
from tests.recorder.test_layouts import TEAM
from tests.recorder.viewers import Seen, Viewed, at_path, split_path, view
from tests.safety.healthy import SLOW
from tests.support import HOVER, level_pose, tether_of

NAN = math.nan


def written(path: Path, rows: Iterable[Row], *, config: str | None = None, plan: str | None = None) -> Viewed:
    """Write rows with the log writer alone."""
    log_file = LogFile(path)
    writer = LogWriter(log_file, EPOCH_NS)
    writer.metadata("companion", {"log_format": "1", "epoch_offset_ns": str(EPOCH_NS)})
    writer.metadata("config", {"json": config_json() if config is None else config})
    if plan is not None:
        writer.metadata("plan", {"json": plan, "mission_s": "1.0"})
    for row in rows:
        writer.tick(*row)
    writer.close()
    log_file.close()
    return view(path)


def still(ticks: int = 1) -> list[Row]:
    """Return the first ticks of a flight."""
    rows = tethered(end_s=1.0)
    return [next(rows) for _ in range(ticks)]


def moved(row: Row, position: Vec3, attitude: Quat, arm: Joints) -> Row:
    """Return the same tick at another pose, in motion capture and PX4."""
    inputs, outputs, sent = row
    assert inputs.mocap is not None and inputs.arm is not None and inputs.vehicle is not None
    inputs = replace(
        inputs,
        mocap=replace(inputs.mocap, position_world_m=position, attitude_wxyz=attitude),
        vehicle=replace(inputs.vehicle, position_world_m=position, attitude_wxyz=attitude),
        arm=replace(inputs.arm, angle_rad=arm),
    )
    return inputs, outputs, sent


def vec(message: dict[str, float]) -> Vec3:
    return (message["x"], message["y"], message["z"])


def quat(message: dict[str, float]) -> Quat:
    return (message["w"], message["x"], message["y"], message["z"])


def in_world(transforms: list[dict[str, Any]], frame: str) -> tuple[Vec3, Quat]:
    """Return the position of a frame by following its parents."""
    position: Vec3 = (0.0, 0.0, 0.0)
    turn: Quat = (1.0, 0.0, 0.0, 0.0)
    by_child = {one["child_frame_id"]: one for one in transforms}
    while frame != "world":
        one = by_child[frame]
        x, y, z = quat_rotate(quat(one["rotation"]), position)
        tx, ty, tz = vec(one["translation"])
        position, turn = (x + tx, y + ty, z + tz), quat_multiply(quat(one["rotation"]), turn)
        frame = one["parent_frame_id"]
    return position, turn


def test_the_frames_are_where_the_arm_s_kinematics_have_them(tmp_path: Path) -> None:
    vehicle = load_flight("configs/missions/catch.yaml").vehicle
    arm = manipulator_of(vehicle)
    chance = random.Random(5)
    for case in range(6):
        at = (chance.uniform(-1, 1), chance.uniform(-1, 1), chance.uniform(0.5, 1.5))
        attitude = quat_from_euler_zyx(chance.uniform(-0.3, 0.3), chance.uniform(-0.3, 0.3), chance.uniform(-3, 3))
        angles = (chance.uniform(1.0, 3.0), chance.uniform(-0.2, 2.6))
        viewed = written(tmp_path / f"{case}.mcap", [moved(still()[0], at, attitude, angles)])
        (body,), (joints,) = viewed.by_topic["/tf"], viewed.by_topic["/tf_arm"]
        frames = [body.data, *joints.data["transforms"]]
        for frame, body_m in (("link2", arm.joints_body_m(angles)[1]), ("net", arm.net_body_m(angles))):
            x, y, z = quat_rotate(attitude, body_m)
            position, turn = in_world(frames, frame)
            assert position == pytest.approx((at[0] + x, at[1] + y, at[2] + z), abs=1e-12)
        # Link 2 points from the elbow to the net.
        along = quat_rotate(turn, (vehicle.arm.link_lengths_m[1], 0.0, 0.0))
        elbow, _ = in_world(frames, "link2")
        assert tuple(e + a for e, a in zip(elbow, along, strict=True)) == pytest.approx(position, abs=1e-12)


@pytest.mark.parametrize(("count", "change"), [(0, []), (1, []), (4, ["vehicle.arm.joints[0].axis=[0, 0, 1]"])])
def test_every_link_has_a_frame_and_a_shape_and_an_absent_arm_none(
    tmp_path: Path, count: int, change: list[str]
) -> None:
    vehicle = load_vehicle("tarot650_2r", [*overrides_with_joints(count), *change])
    config = json.dumps({"vehicle": json.loads(vehicle.model_dump_json())})
    angles = (1.2, 0.4, -0.3, 0.9)[:count]
    row = moved(still()[0], (0.0, 0.0, 1.0), (1.0, 0.0, 0.0, 0.0), angles)
    viewed = written(tmp_path / "flight.mcap", [row], config=config)
    links = [f"link{number}" for number in range(1, count + 1)]
    (static,) = viewed.by_topic["/scene_static"]
    assert [one["id"] for one in static.data["entities"] if one["id"].startswith("link")] == links
    if not count:
        assert not viewed.by_topic.get("/tf_arm")
        return
    frames = [viewed.by_topic["/tf"][0].data, *viewed.by_topic["/tf_arm"][0].data["transforms"]]
    arm = manipulator_of(vehicle)
    for frame, (x, y, z) in zip([*links, "net"], [*arm.joints_body_m(angles), arm.net_body_m(angles)], strict=True):
        assert in_world(frames, frame)[0] == pytest.approx((x, y, z + 1.0), abs=1e-12)


def test_each_channel_keeps_its_rate(tmp_path: Path) -> None:
    rows = [row for row in tethered(end_s=5.0) if row[0].t_s >= 1.0]
    viewed = written(tmp_path / "flight.mcap", rows, plan="[[0, 0, 1], [1, 0, 1]]")
    seconds = rows[-1][0].t_s - rows[0][0].t_s
    for topic, rate_hz in (
        *(
            ("/tf", 50.0),
            ("/tf_arm", 50.0),
            ("/pose", 50.0),
            ("/reference", 50.0),
            ("/scene", 20.0),
            ("/inputs", 200.0),
        ),
    ):
        assert len(viewed.by_topic[topic]) / seconds == pytest.approx(rate_hz, rel=0.02), topic
    assert len(viewed.by_topic["/scene_static"]) == 1
    assert 2 <= len(viewed.by_topic["/scene_path"]) <= 3


def only(seen: list[Seen], entity: str) -> dict[str, Any]:
    found: list[dict[str, Any]] = [one for m in seen for one in m.data["entities"] if one["id"] == entity]
    assert len(found) == 1
    return found[0]


def test_what_stands_is_drawn_once_for_good_in_its_own_frame(tmp_path: Path) -> None:
    viewed = written(tmp_path / "flight.mcap", still(20), plan="[[0, 0, 1], [1, 0, 1], [1, 1, 1]]")
    standing = viewed.by_topic["/scene_static"]
    frames = {"room": "world", "anchor": "world", "planned path": "world", "vehicle": "body"}
    frames |= {"link1": "link1", "link2": "link2", "net": "net"}
    assert {one["id"]: one["frame_id"] for one in standing[0].data["entities"]} == frames
    for one in standing[0].data["entities"]:
        assert one["frame_locked"]
        assert one["lifetime"] is None or one["lifetime"] == {"seconds": 0, "nanos": 0}
    vehicle = load_flight("configs/missions/catch.yaml").vehicle
    disks = only(standing, "vehicle")["cylinders"]
    reach = [math.hypot(d["pose"]["position"]["x"], d["pose"]["position"]["y"]) + d["size"]["x"] / 2 for d in disks]
    assert reach == pytest.approx([vehicle.airframe.radius_m] * 4)
    corners = [vec(p) for p in only(standing, "room")["lines"][0]["points"]]
    assert len(corners) == 24
    assert [min(c) for c in zip(*corners, strict=True)] == [
        vehicle.room.x_m[0],
        vehicle.room.y_m[0],
        vehicle.room.z_m[0],
    ]
    assert [max(c) for c in zip(*corners, strict=True)] == [
        vehicle.room.x_m[1],
        vehicle.room.y_m[1],
        vehicle.room.z_m[1],
    ]


def test_a_plan_that_comes_later_is_drawn_with_everything_else_again(tmp_path: Path) -> None:
    log_file = LogFile(tmp_path / "flight.mcap")
    writer = LogWriter(log_file, EPOCH_NS)
    writer.metadata("config", {"json": config_json()})
    rows = still(40)
    for row in rows[:20]:
        writer.tick(*row)
    writer.metadata("plan", {"json": "[[0, 0, 1], [1, 0, 1]]", "mission_s": "1.0"})
    for row in rows[20:]:
        writer.tick(*row)
    writer.close()
    log_file.close()
    first, second = view(tmp_path / "flight.mcap").by_topic["/scene_static"]
    names = [{one["id"] for one in message.data["entities"]} for message in (first, second)]
    assert names[1] - names[0] == {"planned path"}
    assert names[0] < names[1]


GREEN, AMBER, RED = "green", "amber", "red"


def colour_of(rgba: dict[str, float]) -> str:
    if rgba["r"] < 0.5:
        return GREEN
    return AMBER if rgba["g"] > 0.4 else RED


@pytest.mark.parametrize(
    ("away_m", "held", "colour"),
    [
        (1.5, False, GREEN),
        (2.70, False, GREEN),
        (2.80, False, AMBER),
        (2.97, False, RED),
        (3.2, False, RED),
        (1.5, True, RED),
    ],
)
def test_the_tether_is_coloured_by_its_slack(tmp_path: Path, away_m: float, held: bool, colour: str) -> None:
    tether = tether_of(load_flight("configs/missions/catch.yaml").vehicle)
    x, y, z = tether.anchor_world_m
    inputs, outputs, sent = moved(still()[0], (x, y, z + away_m), (1.0, 0.0, 0.0, 0.0), (2.0, 2.0))
    watched = replace(SLOW, range_m=away_m, slack_m=3.0 - away_m, stop_slack_m=0.0, snagged=held)
    viewed = written(tmp_path / "flight.mcap", [(inputs, replace(outputs, tether=watched), sent)])
    line = only(viewed.by_topic["/scene"], "tether")["lines"][0]
    assert colour_of(line["color"]) == colour
    assert vec(line["points"][0]) == pytest.approx(tether.anchor_world_m)
    assert vec(line["points"][-1]) == pytest.approx((x, y, z + away_m))


def test_a_ball_is_drawn_with_the_net_where_they_meet(tmp_path: Path) -> None:
    inputs, outputs, sent = still()[0]
    ball = BallState(position_world_m=(1.0, 2.0, 3.0), meeting_world_m=(0.5, 0.25, 1.0), meeting_s=1.0)
    viewed = written(tmp_path / "flight.mcap", [(inputs, replace(outputs, ball=ball), sent)])
    spheres = only(viewed.by_topic["/scene"], "ball")["spheres"]
    assert [vec(sphere["pose"]["position"]) for sphere in spheres] == [(1.0, 2.0, 3.0), (0.5, 0.25, 1.0)]
    tool = load_flight("configs/missions/catch.yaml").vehicle.tool
    assert tool is not None and tool.net_radius_m is not None
    assert spheres[1]["size"]["x"] == pytest.approx(2.0 * tool.net_radius_m)


@pytest.mark.parametrize("end", [(2.0, 0.0, 0.0), (1.5, 1.0, 1.0), (0.5, 0.0, 2.5), (0.3, 0.0, -2.0), (0.05, 0.0, 1.0)])
@pytest.mark.parametrize("slack_m", [0.02, 0.3, 1.5])
def test_the_hanging_line_is_as_long_as_the_tether_and_below_its_chord(end: Vec3, slack_m: float) -> None:
    length_m = math.hypot(*end) + slack_m
    points = hanging_line_m((0.0, 0.0, 0.0), end, length_m)
    drawn_m = sum(map(math.dist, points, points[1:]))
    assert drawn_m <= length_m * 1.001
    assert drawn_m >= length_m * 0.97, "thirteen points cut corners, but not more"
    for k, point in enumerate(points):
        assert point[2] <= end[2] * k / (len(points) - 1) + 1e-12
    on_floor = hanging_line_m((0.0, 0.0, 0.0), end, length_m, floor_m=-0.1)
    assert min(p[2] for p in on_floor[1:-1]) >= -0.1


def test_the_flown_path_stays_short_however_long_the_flight(tmp_path: Path) -> None:
    inputs, outputs, sent = still()[0]
    seen = level_pose(0.0)

    def circling() -> Iterable[Row]:
        for k in range(600):
            t_s = k * 0.1
            pose = replace(seen, stamp_s=t_s, position_world_m=(math.cos(t_s), math.sin(t_s), 1.0))
            yield replace(inputs, tick=k, t_s=t_s, mocap=pose), replace(outputs, tick=k, t_s=t_s), replace(sent, tick=k)

    viewed = written(tmp_path / "flight.mcap", circling())
    sizes = [len(only([m], "flown")["lines"][0]["points"]) for m in viewed.by_topic["/scene_path"]]
    assert max(sizes) <= 256
    assert sizes[-1] >= 128
    last = viewed.by_topic["/scene_path"][-1]
    start = vec(only([last], "flown")["lines"][0]["points"][0])
    assert start == pytest.approx((1.0, 0.0, 1.0), abs=0.1), "the beginning of the flight is in it"


@pytest.mark.parametrize(
    "changes",
    [
        {"tracking_valid": False},
        {"stamp_s": -1.0},
        {"stamp_s": NAN},
        {"position_world_m": (NAN, 0.2, 1.0)},
        {"attitude_wxyz": (0.0, 0.0, 0.0, 0.0)},
        {"attitude_wxyz": (1e200, 0.0, 0.0, 0.0)},
    ],
)
def test_without_a_pose_of_motion_capture_px4_s_is_shown(tmp_path: Path, changes: dict[str, Any]) -> None:
    inputs, outputs, sent = moved(still()[0], (0.7, 0.8, 0.9), (1.0, 0.0, 0.0, 0.0), (2.0, 2.0))
    viewed = written(
        tmp_path / "flight.mcap", [(replace(inputs, mocap=level_pose(inputs.t_s, **changes)), outputs, sent)]
    )
    assert vec(viewed.by_topic["/tf"][0].data["translation"]) == (0.7, 0.8, 0.9)
    assert len(viewed.by_topic["/pose"]) == (1 if "stamp_s" in changes else 0), "what is no pose is not shown as one"


def sick(rows: list[Row], chance: random.Random) -> Row:
    """Yield ticks in which any field is absent or not finite, at every depth."""

    def corrupt(record: Any) -> Any:
        if isinstance(record, float):
            return chance.choice([record, record, NAN, math.inf, -math.inf, 1e308, -0.0])
        if isinstance(record, tuple):
            return tuple(corrupt(item) for item in record)
        if isinstance(record, Record):
            changed = {}
            for field in fields(record):
                absent = field.default is None and chance.random() < 0.2
                changed[field.name] = None if absent else corrupt(getattr(record, field.name))
            return replace(record, **changed)
        if isinstance(record, str):
            return chance.choice([record, "", "\x00", "ä" * 300])
        return record

    inputs, outputs, sent = chance.choice(rows)
    return corrupt(inputs), corrupt(outputs), corrupt(sent)


def test_no_sick_tick_is_lost_or_stops_the_viewers(tmp_path: Path) -> None:
    chance = random.Random(11)
    healthy = [row for row in tethered(end_s=7.5) if row[0].t_s > 6.0]
    rows: list[Row] = []
    for k in range(150):
        inputs, outputs, sent = sick(healthy, chance)
        # What the flight counts itself is always whole.
        t_s = 6.0 + 0.005 * k
        rows.append((replace(inputs, tick=k, t_s=t_s), replace(outputs, tick=k, t_s=t_s), replace(sent, tick=k)))
    path = tmp_path / "flight.mcap"
    last = healthy[-1]
    viewed = written(path, [*rows, last])
    log = FlightLog.read(path)
    assert len(log.inputs) == len(rows) + 1
    for (inputs, outputs, sent), row in zip(rows, log.rows(), strict=False):
        assert differences((inputs, outputs, sent), row) is None
    shown = {message.topic for message in viewed.messages if message.log_time_ns == EPOCH_NS + round(last[0].t_s * 1e9)}
    assert {"/tf", "/tf_arm", "/pose", "/reference", "/scene"} <= shown
    for message in viewed.messages:
        if message.topic in ("/tf", "/tf_arm", "/pose", "/reference", "/scene", "/scene_path"):
            assert all(map(math.isfinite, floats(message.data))), message


def test_a_tick_that_cannot_be_drawn_is_recorded_and_reported_once(tmp_path: Path) -> None:
    log_file = LogFile(tmp_path / "flight.mcap")
    writer = LogWriter(log_file, EPOCH_NS)
    rows = still(12)
    for inputs, outputs, sent in rows:
        torn: Any = (0.0, 1.0)
        writer.tick(replace(inputs, mocap=level_pose(inputs.t_s, position_world_m=torn)), outputs, sent)
    writer.close()
    log_file.close()
    viewed = view(tmp_path / "flight.mcap")
    assert len(viewed.by_topic["/inputs"]) == len(viewed.by_topic["/sent"]) == len(rows)
    assert [message.data["name"] for message in viewed.by_topic["/log"]] == ["recorder"]
    assert viewed.by_topic["/log"][0].data["message"].startswith("viewer messages left out: tick 0: ValueError")


def test_a_bar_is_drawn_between_its_handles_while_it_is_seen(tmp_path: Path) -> None:
    inputs, outputs, sent = still()[0]
    half_turn = quat_from_euler_zyx(0.0, 0.0, math.pi / 2.0)
    bar = BarPose(stamp_s=inputs.t_s, position_world_m=(1.0, 2.0, 0.6), attitude_wxyz=half_turn, tracking_valid=True)
    config = json.dumps({"mission": {"phases": [{"type": "land"}, {"type": "grip", "bar": {"length_m": 1.2}}]}})
    for number, (seen, count) in enumerate(
        ((bar, 1), (replace(bar, stamp_s=inputs.t_s - 0.2), 0), (replace(bar, tracking_valid=False), 0))
    ):
        row = replace(inputs, bar=seen), outputs, sent
        viewed = written(tmp_path / f"{number}.mcap", [row], config=config)
        assert len(viewed.by_topic["/scene"]) == count
        if count:
            ends = [vec(end) for end in only(viewed.by_topic["/scene"], "bar")["lines"][0]["points"]]
            assert [value for end in ends for value in end] == pytest.approx([1.0, 2.6, 0.6, 1.0, 1.4, 0.6])


def test_the_other_vehicle_of_a_team_is_drawn_where_it_says_it_is_while_it_is_heard(tmp_path: Path) -> None:
    inputs, outputs, sent = still()[0]
    said = TeamState(grip=Grip.FREE, holds=False, lands=False, px4_lands=False, position_world_m=(1.0, 2.0, 0.6))
    for age_s, shown in ((0.02, True), (0.2, False)):
        row = replace(inputs, partner=PartnerState(stamp_s=inputs.t_s - age_s, said=said)), outputs, sent
        viewed = written(tmp_path / f"{age_s}.mcap", [row])
        entities = [entity for message in viewed.by_topic["/scene"] for entity in message.data["entities"]]
        disks = [entity["cylinders"][0] for entity in entities if entity["id"] == "other vehicle"]
        assert len(disks) == shown
        if shown:
            assert vec(disks[0]["pose"]["position"]) == (1.0, 2.0, 0.6)
            assert disks[0]["size"]["x"] == pytest.approx(2.0 * load_flight(HOVER).vehicle.airframe.radius_m)


def test_a_file_shows_the_vehicles_of_several_logs_each_with_frames_and_topics_of_its_own(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    """The layout for a team finds everything in it."""
    places: dict[str, Vec3] = {"left": (0.0, 1.0, 1.0), "right": (0.0, -1.0, 1.0)}
    logs = [tmp_path / name / "flight.mcap" for name in places]
    for log, place in zip(logs, places.values(), strict=True):
        log.parent.mkdir()
        written(log, [moved(row, place, (1.0, 0.0, 0.0, 0.0), (0.1, 0.2)) for row in tethered(end_s=1.0)])
    out = tmp_path / "new" / "both.mcap"
    export = ["export", *map(str, logs), "--format", "foxglove"]
    assert main([*export, "--out", str(out)]) == EXIT_OK
    viewed, single = view(out), view(logs[0])
    own = {"body", "link1", "link2", "net"}
    assert viewed.frames() == {"world"} | {f"{name}/{frame}" for name in places for frame in own}
    for name, place in places.items():
        assert vec(viewed.by_topic[f"/{name}/pose"][0].data["pose"]["position"]) == place
        frames = {one["frame_id"] for one in viewed.by_topic[f"/{name}/scene_static"][0].data["entities"]}
        assert frames == {"world"} | {f"{name}/{frame}" for frame in own}
        for topic in ("/tf", "/tf_arm", "/scene", "/reference"):
            stamps_ns = [message.log_time_ns for message in single.by_topic[topic]]
            assert [message.log_time_ns for message in viewed.by_topic[f"/{name}{topic}"]] == stamps_ns != [], topic
    events = [message.data["name"] for message in single.by_topic["/log"]]
    assert [m.data["name"] for m in viewed.by_topic["/log"]] == [f"{name} {e}" for e in events for name in places]
    layout = json.loads(TEAM.read_text())["configById"]
    assert layout["3D!room"]["topics"].keys() <= viewed.schemas.keys()
    for series in (series for name in layout if name.startswith("Plot") for series in layout[name]["paths"]):
        topic, steps = split_path(series["value"])
        assert isinstance(at_path(viewed.by_topic[topic][0].data, steps), float)
    assert main([*export, "--out", str(out)]) == EXIT_BAD_INPUT
    assert f"{out}: cannot be written: File exists" in capsys.readouterr().err
    assert main(export) == EXIT_BAD_INPUT


def floats(data: Any) -> Iterable[float]:
    if isinstance(data, dict):
        for item in data.values():
            yield from floats(item)
    elif isinstance(data, list):
        for item in data:
            yield from floats(item)
    elif isinstance(data, float):
        yield data


@pytest.mark.parametrize(
    "config",
    ["", "null", "[]", "nonsense", '{"vehicle": 7}', '{"vehicle": {"arm": {"link_lengths_m": ["a", 1]}, "room": []}}'],
)
def test_any_configuration_gives_a_log_and_at_least_the_frame(tmp_path: Path, config: str) -> None:
    viewed = written(tmp_path / "flight.mcap", still(20), config=config, plan='{"no": "path"}')
    assert len(viewed.by_topic["/inputs"]) == 20
    assert viewed.by_topic["/tf"]
    assert not viewed.by_topic["/tf_arm"]
    assert not viewed.by_topic["/scene"]
