"""The parser of NatNet frames against damaged datagrams of the simulated server."""

from __future__ import annotations

import math
import struct
from collections.abc import Sequence

import pytest

from companion.io.mocap.frames import Frame, parse_frame
from companion.io.mocap.natnet import Malformed, Message
from companion.model.types import Quat
from sitl.natnet import CLOCK_FREQUENCY_HZ, BodyPose, encode_frame
from tests.io.natnet_bytes import LATER, VERSIONS, full_frame, numbers

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
