"""Datagrams are stamped by the kernel on arrival, however late they are read."""

from __future__ import annotations

import socket
import struct
import time

import pytest

from companion.config.loader import load_flight
from companion.io import arrival
from companion.io.arrival import STAMP_ROOM_BYTES, arrived_s, stamp_arrivals
from companion.runtime.clock import flight_clock
from tests.support import CATCH, DEADLINE_S

_SO_TIMESTAMPNS = 35


def note(seconds_ago: float) -> list[tuple[int, int, bytes]]:
    then_ns = time.time_ns() - int(seconds_ago * 1e9)
    stamp = struct.pack("=qq", then_ns // 1_000_000_000, then_ns % 1_000_000_000)
    return [(socket.SOL_SOCKET, _SO_TIMESTAMPNS, stamp)]


def test_a_datagram_that_waited_is_as_old_as_it_is(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(arrival, "_WAITED_MAX_S", 60.0)  # this computer may be busier than a flight's
    clock = flight_clock()
    with (
        socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as receiver,
        socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as sender,
    ):
        receiver.bind(("127.0.0.1", 0))
        receiver.settimeout(DEADLINE_S)
        stamp_arrivals(receiver)
        for _ in range(100):
            before_s = clock()
            sender.sendto(b"1", receiver.getsockname())
            sent_s = clock()
            time.sleep(0.05)  # the reader is busy
            data, notes, _, _ = receiver.recvmsg(100, STAMP_ROOM_BYTES)
            assert data == b"1"
            if not notes:
                pytest.skip("no stamps here: an emulated kernel")
            arrival_s = arrived_s(notes, clock)
            assert arrival_s > before_s - 0.001
            if arrival_s < sent_s + 0.045:
                return
        pytest.fail("stamped when it was read")  # the kernel begins to stamp arrivals some time after it was asked


def test_without_a_stamp_it_has_just_arrived() -> None:
    assert arrived_s([], lambda: 7.25) == 7.25
    assert arrived_s([(socket.SOL_SOCKET, _SO_TIMESTAMPNS, b"short")], lambda: 7.25) == 7.25


@pytest.mark.parametrize("seconds_ago", [-3600.0, -0.1, 0.11, 3600.0])
def test_a_wall_clock_that_was_set_dates_nothing(seconds_ago: float) -> None:
    assert arrived_s(note(seconds_ago), lambda: 7.25) == 7.25


def test_a_stamp_of_a_moment_ago_counts(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(arrival, "_WAITED_MAX_S", 60.0)
    assert arrived_s(note(0.2), lambda: 7.25) <= 7.05


def test_a_wall_clock_that_was_set_makes_no_frame_look_lost() -> None:
    assert load_flight(CATCH).vehicle.safety.mocap_timeout_s > arrival._WAITED_MAX_S
