"""A log as the two viewers read it: decoded messages, Foxglove's message paths, PlotJuggler's series.

Sources: mcap.dev/spec; docs.foxglove.dev (custom schema encodings, message path syntax, SceneUpdate); PlotJuggler's DataLoadMCAP,
JSON and protobuf parsers (3.x), whose naming of series is repeated here.
"""

from __future__ import annotations

import json
import re
from collections import defaultdict
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from functools import cache, cached_property
from pathlib import Path
from typing import Any

from mcap.exceptions import EndOfFile
from mcap.reader import NonSeekingReader, make_reader
from mcap.records import Schema
from mcap_protobuf.decoder import DecoderFactory


@dataclass(frozen=True)
class Seen:
    """One message."""

    topic: str
    schema: str
    message_encoding: str
    schema_encoding: str
    log_time_ns: int
    publish_time_ns: int
    data: Any


@dataclass(frozen=True)
class Viewed:
    """All messages of a log."""

    messages: tuple[Seen, ...]
    schemas: dict[str, tuple[str, str, str, bytes]]
    """By topic: message encoding, schema name, schema encoding and schema data of every channel."""

    @cached_property
    def by_topic(self) -> dict[str, list[Seen]]:
        found: dict[str, list[Seen]] = defaultdict(list, {topic: [] for topic in self.schemas})
        for message in self.messages:
            found[message.topic].append(message)
        return found

    @cached_property
    def series(self) -> set[str]:
        """Names of PlotJuggler's numeric series."""
        return {name for message in self.messages for name in _numeric(message.topic, message.data)}

    def frames(self) -> set[str]:
        """Coordinate frames known to Foxglove."""
        found: set[str] = set()
        for message in self.messages:
            if message.schema == "foxglove.FrameTransform":
                found |= {message.data["parent_frame_id"], message.data["child_frame_id"]}
            elif message.schema == "foxglove.FrameTransforms":
                for one in message.data["transforms"]:
                    found |= {one["parent_frame_id"], one["child_frame_id"]}
        return found


def view(path: Path, *, whole: bool = True) -> Viewed:
    """Read a log with the mcap library: through its summary, or (`whole` False) as far as it is readable."""
    messages: list[Seen] = []
    schemas: dict[str, tuple[str, str, str, bytes]] = {}
    with path.open("rb") as file:
        reader = make_reader(file) if whole else NonSeekingReader(file)
        if whole:
            summary = reader.get_summary()
            assert summary is not None
            for channel in summary.channels.values():
                schema = summary.schemas[channel.schema_id]  # PlotJuggler leaves out channels without one
                schemas[channel.topic] = (channel.message_encoding, schema.name, schema.encoding, schema.data)
        try:
            for schema, channel, message in reader.iter_messages(log_time_order=False):
                assert schema is not None
                schemas.setdefault(channel.topic, (channel.message_encoding, schema.name, schema.encoding, schema.data))
                if channel.message_encoding == "json":
                    data = json.loads(message.data)
                else:
                    data = protobuf_decoder(schema.name, schema.data)(message.data)
                messages.append(
                    Seen(
                        *(channel.topic, schema.name, channel.message_encoding, schema.encoding),
                        *(message.log_time, message.publish_time, data),
                    )
                )
        except EndOfFile:
            assert not whole
    return Viewed(tuple(messages), schemas)


@cache
def protobuf_decoder(name: str, descriptors: bytes) -> Callable[[bytes], Any]:
    """Return what decodes messages of a type by its descriptors in a log; what the type does not have is refused."""
    decode = DecoderFactory().decoder_for("protobuf", Schema(id=1, name=name, encoding="protobuf", data=descriptors))
    assert decode is not None

    def decoded(data: bytes) -> Any:
        message = decode(data)
        size = message.ByteSize()
        message.DiscardUnknownFields()
        assert message.ByteSize() == size, f"{name}: unknown fields"
        return _plain(message)

    return decoded


def _plain(message: Any) -> Any:
    """Return a message as nested dicts, including defaults; an absent message is None."""
    found: dict[str, Any] = {}
    for field in message.DESCRIPTOR.fields:
        value = getattr(message, field.name)
        if field.message_type is None:
            found[field.name] = list(value) if field.is_repeated else value
            if field.enum_type is not None and not field.is_repeated:
                assert value in field.enum_type.values_by_number, f"{field.full_name}: {value}"
        elif field.is_repeated:
            found[field.name] = [_plain(item) for item in value]
        else:
            found[field.name] = _plain(value) if message.HasField(field.name) else None
    return found


_STEP = re.compile(r"\.(\w+)|\[(\d+)\]")


def at_path(data: Any, steps: str) -> Any:
    """Value at a message path below its topic (`.field[0].sub`); None where a message lacks it."""
    at = 0
    for step in _STEP.finditer(steps):
        assert step.start() == at, f"{steps}: not understood at {at}"
        at = step.end()
        if data is None:
            continue
        if step[1] is not None:
            assert isinstance(data, dict), f"{steps}: {data!r:.40} has no fields"
            data = data.get(step[1])
        else:
            assert isinstance(data, list), f"{steps}: {data!r:.40} is no list"
            data = data[int(step[2])]
    assert at == len(steps), f"{steps}: not understood at {at}"
    return data


def split_path(path: str) -> tuple[str, str]:
    """(topic, steps) of a Foxglove message path."""
    topic, dot, rest = path.partition(".")
    return topic, dot + rest


def _numeric(name: str, value: Any) -> Iterator[str]:
    if isinstance(value, dict):
        for key, item in value.items():
            yield from _numeric(f"{name}/{key}", item)
    elif isinstance(value, list):
        for index, item in enumerate(value):
            yield from _numeric(f"{name}[{index}]", item)
    elif isinstance(value, (bool, int, float)):
        yield name
