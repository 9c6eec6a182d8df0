"""MAVLink frames of the link to PX4, against pymavlink."""

from __future__ import annotations

from random import Random

import pytest
from pymavlink.dialects.v20 import common as mavlink

from companion.io.px4.frames import FrameReader, FrameWriter, Received
from tests.fuzz.mavlink import corpus

OWN = (1, 195)
WHOLE = corpus()[:-1]


def whole(found: list[Received]) -> list[bytes]:
    return [one.frame for one in found]


def pieces(rng: Random, data: bytes) -> list[bytes]:
    found = []
    while data:
        cut = rng.randint(1, 40)
        found.append(data[:cut])
        data = data[cut:]
    return found


def test_messages_are_read_as_pymavlink_reads_them() -> None:
    found = FrameReader(stream=False).read(b"".join(WHOLE))
    assert whole(found) == WHOLE
    for one, data in zip(found, WHOLE, strict=True):
        message = mavlink.MAVLink(None).decode(bytearray(data))
        assert one[:3] == (message.get_msgId(), message.get_srcSystem(), message.get_srcComponent())
        assert data[10 : 10 + len(one.payload)] == one.payload


@pytest.mark.parametrize("seed", range(20))
def test_a_stream_may_be_cut_anywhere_and_noise_between_the_frames_costs_none_of_them(seed: int) -> None:
    rng, reader = Random(seed), FrameReader(stream=True)
    noise = [bytes(rng.choice(b"\x00\x01U\xff") for _ in range(rng.randint(0, 30))) for _ in WHOLE]
    data = b"".join(between + frame for between, frame in zip(noise, WHOLE, strict=True))
    assert whole([one for piece in pieces(rng, data) for one in reader.read(piece)]) == WHOLE


def test_a_damaged_frame_costs_no_other_one() -> None:
    damaged = bytearray(WHOLE[2])
    damaged[15] ^= 1
    for bad in (bytes(damaged), WHOLE[2][:-4], b"\xfd", b"\xfd\xff\x00"):
        for stream in (False, True):
            found = FrameReader(stream=stream).read(bad + b"".join(WHOLE * 2))
            assert whole(found)[-len(WHOLE) :] == WHOLE


def test_a_frame_cut_at_the_end_of_a_datagram_does_not_continue_in_the_next() -> None:
    reader = FrameReader(stream=False)
    assert reader.read(WHOLE[3][:-1]) == []
    assert whole(reader.read(WHOLE[0])) == [WHOLE[0]]


def test_frames_of_mavlink_1_are_read() -> None:
    from pymavlink.dialects.v10 import common as first

    data = bytes(first.MAVLink_heartbeat_message(2, 12, 209, 6 << 16, 4, 3).pack(first.MAVLink(None, 1, 1)))
    assert FrameReader(stream=False).read(data) == [Received(0, 1, 1, data[6:-2], data)]


def test_frames_of_both_encoders_are_numbered_together() -> None:
    writer, theirs = FrameWriter(*OWN), mavlink.MAVLink(None, srcSystem=OWN[0], srcComponent=OWN[1])
    theirs.seq = 77
    beat = bytes(mavlink.MAVLink_heartbeat_message(18, 8, 0, 0, 0, 3).pack(theirs))
    timesync = mavlink.MAVLink_timesync_message(0, 5)
    payload = bytes(timesync.pack(mavlink.MAVLink(None)))[10:-2]
    sent = b"".join((writer.frame(111, payload), writer.numbered(beat + beat), writer.frame(111, b"")))
    messages = mavlink.MAVLink(None).parse_buffer(sent)
    assert [(m.get_type(), m.get_seq(), (m.get_srcSystem(), m.get_srcComponent())) for m in messages] == [
        (name, number, OWN) for number, name in enumerate(("TIMESYNC", "HEARTBEAT", "HEARTBEAT", "TIMESYNC"))
    ]
    assert (messages[0].ts1, messages[3].ts1) == (5, 0)
