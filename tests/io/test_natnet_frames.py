"""The parser of NatNet frames and definitions: every version, unknown sections of later ones, and damaged datagrams."""

from __future__ import annotations

import math
import struct
from collections.abc import Sequence

import pytest

from companion.io.mocap.definitions import BodyDefinition, parse_model_definitions
from companion.io.mocap.frames import Frame, parse_frame
from companion.io.mocap.natnet import Malformed, Message, encode_message
from companion.model.types import Quat
from sitl.natnet import CLOCK_FREQUENCY_HZ, BodyPose, encode_frame
from tests.io.natnet_bytes import DESCRIBED, LATER, VERSIONS, all_definitions, full_frame, numbers

NAMES = {1: "quad", 5: "ball"}
TURNED: Quat = (0.5, -0.5, 0.5, 0.5)
POSES = (
    BodyPose(5, (4.0, 5.0, 6.0), (1.0, 0.0, 0.0, 0.0), valid=False, error_m=0.003),
    BodyPose(1, (-1.25, 0.5, 1.0), TURNED, error_m=0.00025),
)
versions = pytest.mark.parametrize("version", VERSIONS)


def frame_of(version: str, poses: Sequence[BodyPose] = POSES, exposure_t_s: float | None = 2.0) -> bytes:
    return encode_frame(version, 77, 2.005, poses, exposure_t_s, NAMES)


def parse(datagram: bytes, version: str, body_id: int = 1) -> Frame | Malformed:
    return parse_frame(datagram, numbers(version), body_id, CLOCK_FREQUENCY_HZ)


def good(result: Frame | Malformed) -> Frame:
    assert isinstance(result, Frame), result
    return result


@versions
def test_other_body_untracked_and_missing_body(version: str) -> None:
    other = good(parse(frame_of(version), version, 5)).body
    assert other is not None
    assert other.position_m == (4.0, 5.0, 6.0)
    assert not other.tracking_valid
    missing = good(parse(frame_of(version), version, 9))
    assert missing.body is None
    assert missing.body_ids == (5, 1)
    assert good(parse(frame_of(version, ()), version)).body_ids == ()


@versions
def test_no_exposure_stamp_or_clock_means_no_latency(version: str) -> None:
    assert good(parse(frame_of(version, exposure_t_s=None), version)).latency_s is None
    assert good(parse_frame(frame_of(version), numbers(version), 1, None)).latency_s is None


@versions
@pytest.mark.parametrize("bad", [(0.0, 0.0, 0.0, 0.0), (2.0, 0.0, 0.0, 0.0), (math.nan, 0.0, 0.0, 0.0)])
def test_bad_quaternion(version: str, bad: Quat) -> None:
    assert isinstance(parse(frame_of(version, [BodyPose(1, (0.0, 0.0, 0.0), bad)]), version), Malformed)
    lost = good(parse(frame_of(version, [BodyPose(1, (0.0, 0.0, 0.0), bad, valid=False)]), version)).body
    assert lost is not None
    assert not lost.tracking_valid
    assert lost.quat_wxyz == (1.0, 0.0, 0.0, 0.0)


@versions
def test_every_truncation_is_refused(version: str) -> None:
    for whole in (frame_of(version), full_frame(version)):
        for size in range(len(whole)):
            assert isinstance(parse(whole[:size], version), Malformed)
        tail = 2 + 4 + (8 if numbers(version) >= (4, 1) else 0)  # behind the last field that is read
        if version == LATER:  # what follows its rigid bodies is unknown
            continue
        for size in range(4, len(whole) - tail):
            honest = struct.pack("<HH", Message.FRAME, size - 4) + whole[4:size]
            assert isinstance(parse(honest, version), Malformed)


def parsed(datagram: bytes, version: str) -> Frame:
    """Parse a `full_frame` and check its rigid body."""
    frame = parse_frame(datagram, numbers(version), 1, 10_000)
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
    frame = parse_frame(full_frame(LATER).replace(size, longer, 1), numbers(LATER), 1, 10_000)
    assert isinstance(frame, Malformed) and "38 bytes each" in frame.reason


@versions
def test_the_body_has_a_name_between_all_other_definitions(version: str) -> None:
    assert parse_model_definitions(all_definitions(version), numbers(version)) == (BodyDefinition(1, "quad"),)


@pytest.mark.parametrize("version", [version for version in DESCRIBED if numbers(version) < (4, 1)])
def test_an_unknown_definition_without_a_size_is_refused(version: str) -> None:
    unknown = encode_message(Message.MODELDEF, struct.pack("<II", 1, 66) + b"whatever")
    assert isinstance(parse_model_definitions(unknown, numbers(version)), Malformed)
