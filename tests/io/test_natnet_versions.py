"""The vehicle's rigid body, its name and its time stamps come out of the frames of every NatNet version."""

from __future__ import annotations

import struct

import pytest

from companion.io.mocap.definitions import BodyDefinition, parse_model_definitions
from companion.io.mocap.frames import Frame, parse_frame
from companion.io.mocap.natnet import Malformed, Message, encode_message
from tests.io.natnet_bytes import DESCRIBED, LATER, VERSIONS, all_definitions, full_frame, numbers

TICKS_HZ = 10_000
versions = pytest.mark.parametrize("version", VERSIONS)


def parsed(datagram: bytes, version: str) -> Frame:
    """Parse a `full_frame` and check its rigid body."""
    frame = parse_frame(datagram, numbers(version), 1, TICKS_HZ)
    assert isinstance(frame, Frame), frame
    assert (frame.number, frame.body_ids) == (4242, (3, 1))
    assert frame.body is not None and frame.body.position_m == (10.0, 2.0, 3.0)
    return frame


@versions
def test_the_body_comes_out_between_all_other_sections(version: str) -> None:
    frame = parsed(full_frame(version), version)
    assert (frame.timestamp_s, frame.latency_s, frame.exposure_s) == (12.5, 0.2, 0.1)


@pytest.mark.parametrize("unknown", [(b"",), (b"\0",), (bytes(70),), (b"one", b"another" * 20)])
def test_unknown_sections_of_a_later_version_are_skipped(unknown: tuple[bytes, ...]) -> None:
    frame = parsed(full_frame(LATER, unknown), LATER)
    assert (frame.timestamp_s, frame.latency_s, frame.exposure_s) == (12.5, 0.2, 0.1)


@pytest.mark.parametrize("added", [4, 12, 20])
def test_a_longer_suffix_of_a_later_version_keeps_its_stamps(added: int) -> None:
    frame = parsed(full_frame(LATER, more_suffix=b"\1" * added), LATER)
    assert (frame.timestamp_s, frame.latency_s, frame.exposure_s) == (12.5, 0.2, 0.1)


def test_a_suffix_that_looks_like_a_section_gives_no_false_latency() -> None:
    """Without a time code a suffix that has grown by eight bytes starts like an empty section."""
    frame = parsed(full_frame(LATER, more_suffix=b"\1" * 8), LATER)
    assert frame.latency_s is None and frame.exposure_s is None


def test_rigid_bodies_of_another_size_are_refused() -> None:
    size, longer = struct.pack("<II", 2, 2 * 38), struct.pack("<II", 2, 2 * 40)
    frame = parse_frame(full_frame(LATER).replace(size, longer, 1), numbers(LATER), 1, TICKS_HZ)
    assert isinstance(frame, Malformed) and "38 bytes each" in frame.reason


@versions
def test_the_body_has_a_name_between_all_other_definitions(version: str) -> None:
    assert parse_model_definitions(all_definitions(version), numbers(version)) == (BodyDefinition(1, "quad"),)


@pytest.mark.parametrize("version", [version for version in DESCRIBED if numbers(version) < (4, 1)])
def test_an_unknown_definition_without_a_size_is_refused(version: str) -> None:
    unknown = encode_message(Message.MODELDEF, struct.pack("<II", 1, 66) + b"whatever")
    assert isinstance(parse_model_definitions(unknown, numbers(version)), Malformed)
