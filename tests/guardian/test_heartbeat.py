"""The datagrams between flight and guardian, and the stall watch."""

from __future__ import annotations

import math
from typing import Any

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from msgspec.structs import replace

from companion.guardian import heartbeat
from companion.guardian.heartbeat import Heartbeat
from companion.guardian.monitors import StallWatch

finite = st.floats(allow_nan=False, allow_infinity=False)
byte = st.integers(0, 255)
beats = st.builds(
    Heartbeat,
    tick=st.integers(0, 2**32 - 1),
    t_s=finite,
    origin_s=finite,
    mission_t_s=finite,
    lifting=st.booleans(),
    pilot=st.booleans(),
    goodbye=st.booleans(),
    mocap_refused=st.booleans(),
    autopilot_system=byte,
    own_system=byte,
    own_component=byte,
    local_port=st.integers(0, 65535),
    pose_stamp_s=finite | st.just(-math.inf),
    position_world_m=st.tuples(finite, finite, finite),
    attitude_wxyz=st.tuples(finite, finite, finite, finite),
    peer=st.none() | st.tuples(st.ip_addresses(v=4).map(str), st.integers(1, 65535)),
)


@given(beats)
@settings(max_examples=50)
def test_a_beat_comes_through_bit_for_bit_and_fits(beat: Heartbeat) -> None:
    datagram = heartbeat.pack(beat)
    assert heartbeat.unpack(datagram) == beat
    assert len(datagram) <= heartbeat.MAX_BYTES


@given(st.binary(max_size=200))
def test_nothing_that_comes_in_raises(datagram: bytes) -> None:
    heartbeat.unpack(datagram)
    heartbeat.unpack(heartbeat.HEARTBEAT + datagram)


@given(beats)
@settings(max_examples=10)
@pytest.mark.parametrize(
    "change",
    [
        *({name: bad} for name in ("t_s", "origin_s", "mission_t_s") for bad in (math.nan, math.inf)),
        {"pose_stamp_s": math.nan},
        {"position_world_m": (0.0, -math.inf, 0.0)},
        {"back_world_m": (0.0, 0.0, math.nan)},
        {"own_system": 256},
        {"local_port": -1},
        {"peer": ("example.com", 14580)},
        {"peer": ("10.0.0.7", 65536)},
        {"tick": 1.5},
    ],
)
def test_a_beat_that_is_not_finite_or_out_of_range_is_none(change: dict[str, Any], beat: Heartbeat) -> None:
    assert heartbeat.unpack(heartbeat.pack(replace(beat, **change))) is None


@given(beats)
@settings(max_examples=2)
def test_the_ends_of_the_ranges_are_still_in_them(beat: Heartbeat) -> None:
    for number, port in ((0, 0), (255, 65535)):
        ids = {"autopilot_system": number, "own_system": number, "own_component": number}
        edge = replace(beat, local_port=port, peer=("10.0.0.7", port), back_world_m=(-0.3, 0.0, 0.0), **ids)
        assert heartbeat.unpack(heartbeat.pack(edge)) == edge


def silent_after(watch: StallWatch, period_s: float, rounds: int) -> list[bool]:
    return [watch.update(k * period_s, heard=False) for k in range(rounds)]


def test_silence_is_a_stall_after_the_timeout() -> None:
    verdicts = silent_after(StallWatch(0.1), 0.01, 20)
    assert verdicts.index(True) == 11  # the first round that is more than 0.1 s after the last beat
    assert all(verdicts[11:])


def test_a_beat_in_time_is_no_stall() -> None:
    watch = StallWatch(0.1)
    assert not any(watch.update(k * 0.01, heard=k % 10 == 0) for k in range(1000))


def test_what_the_guardian_slept_through_proves_nothing() -> None:
    watch = StallWatch(0.1)
    assert not watch.update(0.0, heard=True)
    assert not watch.update(5.0, heard=False), "the whole machine was held up"
    assert not watch.update(5.01, heard=True)
    assert not watch.update(10.0, heard=False)
    verdicts = [watch.update(10.0 + 0.01 * k, heard=False) for k in range(1, 20)]
    assert any(verdicts), "but silence while it is awake counts on"


@pytest.mark.parametrize("kind", [heartbeat.RECORDER_CHANNEL, heartbeat.READY, heartbeat.PROBLEM])
def test_other_datagrams_are_no_beats(kind: bytes) -> None:
    assert heartbeat.unpack(kind) is None
