"""Every channel of a log conforms to its own schema and to the documentation of the viewers."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import jsonschema
import pytest

from companion.analysis.log import FlightLog
from tests.recorder.flights import EPOCH_NS, config_json, offer, record, started, tethered
from tests.recorder.viewers import Viewed, protobuf_decoder, view
from tests.support import DEADLINE_S, wait_until

pytestmark = pytest.mark.xdist_group("recorded flight")

JSON = {
    "/inputs": "companion.Inputs",
    "/outputs": "companion.Outputs",
    "/sent": "companion.Sent",
    "/events": "companion.EventLine",
}
PROTOBUF = {
    "/tf": "foxglove.FrameTransform",
    "/tf_arm": "foxglove.FrameTransforms",
    "/pose": "foxglove.PoseInFrame",
    "/reference": "foxglove.PoseInFrame",
    "/scene": "foxglove.SceneUpdate",
    "/scene_path": "foxglove.SceneUpdate",
    "/scene_static": "foxglove.SceneUpdate",
    "/log": "foxglove.Log",
}


@pytest.fixture(scope="module")
def synthetic(tmp_path_factory: pytest.TempPathFactory) -> Viewed:
    """A short flight with messages on every channel."""
    path = tmp_path_factory.mktemp("short") / "flight.mcap"
    return view(record(path, tethered(end_s=6.6), config_json=config_json(), plan_json="[[0, 0, 1], [0.5, 0, 1]]"))


def check(viewed: Viewed, *, every: int = 1) -> None:
    """Check JSON messages against their own schema, one in `every`; protobuf messages were decoded with theirs."""
    for topic, (encoding, _, _, data) in viewed.schemas.items():
        messages = viewed.by_topic[topic]
        if encoding == "json":
            schema = json.loads(data)
            jsonschema.Draft202012Validator.check_schema(schema)
            validator = jsonschema.Draft202012Validator(schema)
            for message in messages[::every]:
                validator.validate(message.data)


def test_every_channel_says_what_it_holds_in_the_terms_of_the_viewers(synthetic: Viewed) -> None:
    found = {topic: (message, name, schema) for topic, (message, name, schema, _) in synthetic.schemas.items()}
    assert found == {
        **{topic: ("json", name, "jsonschema") for topic, name in JSON.items()},
        **{topic: ("protobuf", name, "protobuf") for topic, name in PROTOBUF.items()},
    }


def test_no_channel_is_silent_and_messages_keep_to_their_schemas(synthetic: Viewed) -> None:
    counts = {topic: len(messages) for topic, messages in synthetic.by_topic.items()}
    assert min(counts.values()) > 0, counts
    check(synthetic, every=5)


def test_a_whole_flight_keeps_to_its_schemas(viewed: Viewed) -> None:
    assert len(viewed.by_topic["/outputs"]) > 1800
    assert {message.data["id"] for message in viewed.by_topic["/events"]} >= {"takeoff", "catch", "touchdown"}
    check(viewed, every=50)
    for topic in ("/events", "/sent"):
        check(Viewed(tuple(viewed.by_topic[topic]), {topic: viewed.schemas[topic]}))


def test_a_message_that_breaks_its_schema_is_found(synthetic: Viewed) -> None:
    first = synthetic.by_topic["/outputs"][0]
    for key, value in (("tick", "seven"), ("phase", None), ("surprise", 1)):
        broken = {**first.data, key: value}
        with pytest.raises(jsonschema.ValidationError):
            jsonschema.validate(broken, json.loads(synthetic.schemas["/outputs"][3]))
    decode = protobuf_decoder("foxglove.FrameTransform", synthetic.schemas["/tf"][3])
    for unknown in (b"\xfa\x7f\x00", b"\x0a\x02\x78\x01"):
        with pytest.raises(AssertionError, match="unknown fields"):
            decode(unknown)
    log = protobuf_decoder("foxglove.Log", synthetic.schemas["/log"][3])
    with pytest.raises(AssertionError, match="level: 99"):
        log(b"\x10\x63")


def test_json_schemas_use_only_what_viewers_read(synthetic: Viewed) -> None:
    """Objects, arrays of one type, scalars: no unions, no references, no tuples; the root is an object."""

    def walk(schema: dict[str, Any], where: str) -> None:
        assert schema.keys() <= {
            *("$schema", "title", "type", "properties", "required", "additionalProperties"),
            *("items", "minItems", "maxItems", "enum"),
        }, where
        match schema["type"]:
            case "object":
                for name, inner in schema["properties"].items():
                    walk(inner, f"{where}.{name}")
            case "array":
                assert isinstance(schema["items"], dict), where
                assert schema["items"]["type"] != "array", f"{where}: no viewer reads lists of lists"
                walk(schema["items"], where)
            case other:
                assert other in ("boolean", "integer", "number", "string"), where

    for topic in JSON:
        root = json.loads(synthetic.schemas[topic][3])
        assert root["type"] == "object"
        walk(root, topic)


def test_log_time_publish_time_and_header_are_the_wall_clock_of_the_tick(synthetic: Viewed) -> None:
    walls = {EPOCH_NS + round(m.data["t_s"] * 1e9) for m in synthetic.by_topic["/inputs"]}
    for message in synthetic.messages:
        assert message.publish_time_ns == message.log_time_ns
        assert message.log_time_ns in walls, message.topic
        for header in headers(message.data):
            assert header["seconds"] * 1_000_000_000 + header["nanos"] == message.log_time_ns, message.topic
    times = [message.log_time_ns for message in synthetic.messages]
    assert times == sorted(times)


def headers(data: Any) -> list[dict[str, int]]:
    """Return every `timestamp` of a protobuf message, including nested ones."""
    if isinstance(data, list):
        return [header for item in data for header in headers(item)]
    if not isinstance(data, dict):
        return []
    found = [data["timestamp"]] if isinstance(data.get("timestamp"), dict) else []
    return found + [header for key, item in data.items() if key != "timestamp" for header in headers(item)]


def test_the_log_of_a_killed_recorder_opens_and_keeps_to_its_schemas(tmp_path: Path) -> None:
    path = tmp_path / "flight.mcap"
    recorder = started(path, config_json())
    offer(recorder, tethered(end_s=4.0))
    topics = {"/inputs", "/outputs", "/sent", "/tf", "/tf_arm", "/scene", "/scene_static"}
    wait_until(lambda: view(path, whole=False).by_topic.keys() >= topics, lambda: "the recorder writes no chunk")
    recorder.process.kill()
    recorder.process.wait(DEADLINE_S)
    recorder.finish(DEADLINE_S)
    found = view(path, whole=False)
    assert found.by_topic.keys() >= topics
    check(found, every=50)
    counts = {len(found.by_topic[topic]) for topic in ("/inputs", "/outputs", "/sent")}
    assert len(counts) == 1, "a chunk holds whole ticks"
    log = FlightLog.read(path)
    assert not log.closed
    assert len(log.inputs) in counts
