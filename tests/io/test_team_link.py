"""The link between two vehicles over real sockets: what arrives, what is rejected, and when it arrives in simulated time."""

from __future__ import annotations

import math
import socket
import time
from collections.abc import AsyncIterator
from contextlib import asynccontextmanager
from pathlib import Path
from typing import Any

import pytest
from hypothesis import given
from hypothesis import strategies as st
from msgspec.structs import replace

from companion.io import team_link
from companion.io.protocols import DeviceError
from companion.io.team_link import LOST_S, Announcement, TeamLink, TeamSender, TeamSettings, decoded, direction, encoded
from companion.model.codec import to_packet
from companion.model.observations import LinkCounts
from companion.model.team import Grip, TeamState, Together
from companion.runtime.clock import flight_clock
from tests.support import free_udp_port, wait_until

KEY = bytes(range(32))
LOOPBACK = "127.0.0.1"
SAID = TeamState(
    grip=Grip.READY,
    together=Together(go_server_s=12.25),
    holds=False,
    lands=False,
    px4_lands=False,
    position_world_m=(1.0, -0.5, 0.75),
)


def said(x_m: float) -> TeamState:
    return TeamState(grip=Grip.FREE, holds=True, lands=True, px4_lands=False, position_world_m=(x_m, 0.0, 0.0))


@pytest.fixture
def settings(tmp_path: Path) -> tuple[TeamSettings, TeamSettings]:
    """Return the settings of both vehicles."""
    file = tmp_path / "team.key"
    file.write_bytes(KEY)
    one, two = free_udp_port(), free_udp_port()
    return TeamSettings(one, LOOPBACK, two, str(file)), TeamSettings(two, LOOPBACK, one, str(file))


@asynccontextmanager
async def linked(settings: tuple[TeamSettings, TeamSettings]) -> AsyncIterator[tuple[TeamLink, TeamLink]]:
    """Open both ends, which know each other's sessions."""
    clock = flight_clock()
    async with TeamLink(settings[0], clock) as one, TeamLink(settings[1], clock) as two:
        one._sender.answers, two._sender.answers = two._sender.session, one._sender.session
        yield one, two


def datagram(
    one: TeamLink,
    two: TeamLink,
    state: TeamState,
    counter: int,
    *,
    key: bytes = KEY,
    way: bytes = b"",
    session: int = 0,
    answers: int | None = None,
) -> bytes:
    """Return what `one` sends to `two`, or something like it."""
    to = two._sender.session if answers is None else answers
    return encoded(Announcement(session or one._sender.session, to, counter, state), key, way or one._sender._direction)


def throw(one: TeamLink, data: bytes) -> None:
    """Send a datagram from another port of `one`'s computer."""
    with socket.socket(type=socket.SOCK_DGRAM) as sender:
        sender.sendto(data, one._sender._to)


def counted(link: TeamLink, name: str, number: int = 1) -> None:
    """Wait until this many datagrams were rejected for one reason."""
    wait_until(lambda: (link.newest(), getattr(link.counts(), name))[1] == number, lambda: str(link.counts()))


def arrives(link: TeamLink, wanted: TeamState) -> float:
    """Wait until this is the newest announcement; return its stamp."""
    wait_until(lambda: (found := link.newest()) is not None and found.said == wanted, lambda: str(link.counts()))
    newest = link.newest()
    assert newest is not None
    return newest.stamp_s


async def test_each_vehicle_hears_what_the_other_announces(settings: tuple[TeamSettings, TeamSettings]) -> None:
    async with linked(settings) as (one, two):
        assert (one.newest(), two.newest()) == (None, None)
        began_s = one._clock()
        one.announce(SAID)
        two.announce(said(2.0))
        assert began_s <= arrives(two, SAID) <= two._clock()
        arrives(one, said(2.0))
        assert one.counts() == two.counts() == LinkCounts(sent=1, received=1)


async def test_an_announcement_in_every_tick_is_sent_50_times_a_second(
    settings: tuple[TeamSettings, TeamSettings],
) -> None:
    sender = TeamSender(settings[0])
    for tick in range(200):
        sender.announce(SAID, 0.5 + 0.005 * tick)
    sender.close()
    assert sender.sent + sender.unsent == 50


async def test_the_guardian_is_heard_from_another_port_and_the_flight_process_before_it_no_more(
    settings: tuple[TeamSettings, TeamSettings],
) -> None:
    async with linked(settings) as (one, two):
        one.announce(SAID)
        arrives(two, SAID)
        assert two.partner_session == one._sender.session
        guardian = TeamSender(settings[0])
        guardian.answers = one._sender.answers
        guardian.announce(said(3.0), 0.0)
        guardian.close()
        arrives(two, said(3.0))
        one._sender._due_s = -math.inf
        one.announce(SAID)
        counted(two, "repeated")
        assert newest_of(two) == said(3.0)


def newest_of(link: TeamLink) -> TeamState:
    newest = link.newest()
    assert newest is not None
    return newest.said


async def meet(one: TeamLink, two: TeamLink) -> None:
    """Let both announce until each has heard the other anew."""
    before = [link.counts().received for link in (one, two)]

    def met() -> bool:
        one.announce(SAID)
        two.announce(said(2.0))
        one.newest()
        two.newest()
        return all(link.counts().received > count for link, count in zip((one, two), before, strict=True))

    wait_until(met, lambda: f"{one.counts()} {two.counts()}")


async def test_two_that_were_just_started_meet(settings: tuple[TeamSettings, TeamSettings]) -> None:
    clock = flight_clock()
    async with TeamLink(settings[0], clock) as one, TeamLink(settings[1], clock) as two:
        await meet(one, two)
        assert (newest_of(one), newest_of(two)) == (said(2.0), SAID)
        assert 1 <= one.counts().unanswered + two.counts().unanswered <= 4


@pytest.mark.parametrize("steps_ns", [-3600 * 10**9, 3600 * 10**9], ids=["back", "forward"])
async def test_one_that_is_started_again_is_heard_after_a_step_of_the_clock(
    settings: tuple[TeamSettings, TeamSettings], monkeypatch: pytest.MonkeyPatch, steps_ns: int
) -> None:
    clock = flight_clock()
    async with TeamLink(settings[1], clock) as two:
        async with TeamLink(settings[0], clock) as one:
            one._sender._counter = 1 << 40  # it has announced for long
            await meet(one, two)
        real_ns, real_s = time.time_ns, time.time
        monkeypatch.setattr("time.time_ns", lambda: real_ns() + steps_ns)
        monkeypatch.setattr("time.time", lambda: real_s() + steps_ns * 1e-9)
        async with TeamLink(settings[0], clock) as again:
            await meet(again, two)
            assert two.counts().repeated == again.counts().repeated == 0


async def test_a_recording_of_an_earlier_flight_is_not_heard_and_does_not_disturb(
    settings: tuple[TeamSettings, TeamSettings],
) -> None:
    """Both processes are new, and the key is that of the recording."""
    clock = flight_clock()
    async with linked(settings) as (one, two):
        recorded = [datagram(one, two, said(9.0), 10 + n) for n in range(3)]
        earlier = one._sender.session
    async with TeamLink(settings[0], clock) as one, TeamLink(settings[1], clock) as two:
        throw(one, recorded[0])
        counted(two, "unanswered")
        assert two.newest() is None
        assert two._sender.answers == earlier, "it may be the other vehicle, and must show that it hears"
        await meet(one, two)
        rejected = two.counts().unanswered
        throw(one, recorded[1])
        counted(two, "unanswered", rejected + 1)
        assert two._sender.answers == one._sender.session
        assert newest_of(two) == SAID


async def test_a_process_that_another_has_replaced_is_not_heard_again(
    settings: tuple[TeamSettings, TeamSettings],
) -> None:
    async with linked(settings) as (one, two):
        for number, session in enumerate((5, 6, 7)):
            throw(one, datagram(one, two, said(float(number)), 100 - number, session=session))
            arrives(two, said(float(number)))
        for number, session in enumerate((5, 6)):
            throw(one, datagram(one, two, said(9.0), 1 << 62, session=session))
            counted(two, "repeated", number + 1)
        assert newest_of(two) == said(2.0)


async def test_another_process_is_answered_only_once_the_present_one_is_silent(
    settings: tuple[TeamSettings, TeamSettings],
) -> None:
    now_s = 1.0
    async with TeamLink(settings[0], flight_clock()) as one, TeamLink(settings[1], lambda: now_s) as two:
        present = one._sender.session
        for at_s, answered in ((1.0, present), (1.0 + 0.9 * LOST_S, present), (1.0 + 1.1 * LOST_S, 5)):
            two._hear(1.0, Announcement(present, two._sender.session, int(1e9 * at_s), SAID))
            two._hear(at_s, Announcement(5, 0, 1, SAID))
            assert two._sender.answers == answered


def _changed(datagram: bytes, at: int) -> bytes:
    return datagram[:at] + bytes((datagram[at] ^ 1,)) + datagram[at + 1 :]


REJECTED: dict[str, tuple[str, Any]] = {
    "another key": ("forged", lambda one, two: datagram(one, two, said(9.0), 1 << 62, key=bytes(32))),
    "sent back": (
        "forged",
        lambda one, two: datagram(one, two, said(9.0), 1 << 62, way=direction(LOOPBACK, LOOPBACK, 1)),
    ),
    "session changed": ("forged", lambda one, two: _changed(datagram(one, two, said(9.0), 1 << 62), 5)),
    "answer changed": ("forged", lambda one, two: _changed(datagram(one, two, said(9.0), 1 << 62), 13)),
    "counter changed": ("forged", lambda one, two: _changed(datagram(one, two, said(9.0), 1 << 62), 21)),
    "state changed": ("forged", lambda one, two: _changed(datagram(one, two, said(9.0), 1 << 62), 36)),
    "cut off": ("forged", lambda one, two: datagram(one, two, said(9.0), 1 << 62)[:-1]),
    "another version": ("malformed", lambda one, two: b"CTL1" + datagram(one, two, said(9.0), 1 << 62)[4:]),
    "empty": ("malformed", lambda *_: b""),
    "too long": ("malformed", lambda *_: bytes(2000)),
    "not finite": ("malformed", lambda one, two: datagram(one, two, said(math.nan), 1 << 62)),
    "infinite": ("malformed", lambda one, two: datagram(one, two, said(math.inf), 1 << 62)),
    "another record": ("malformed", lambda one, _: _proven(b"\x80", one._sender._direction)),
    "repeated": ("repeated", lambda one, two: datagram(one, two, said(9.0), 100)),
    "older": ("repeated", lambda one, two: datagram(one, two, said(9.0), 99)),
    "to no process": ("unanswered", lambda one, two: datagram(one, two, said(9.0), 1 << 62, answers=0)),
    "to another process": ("unanswered", lambda one, two: datagram(one, two, said(9.0), 1 << 62, answers=5)),
}


def _proven(packet: bytes, way: bytes) -> bytes:
    text = team_link._HEAD.pack(team_link.MAGIC, 1, 1, 1 << 62) + packet
    return text + team_link._proof(way + text, KEY)


@pytest.mark.parametrize(("reason", "made"), REJECTED.values(), ids=REJECTED)
async def test_a_datagram_that_is_not_a_newer_announcement_is_rejected_and_counted(
    settings: tuple[TeamSettings, TeamSettings], reason: str, made: Any
) -> None:
    async with linked(settings) as (one, two):
        throw(one, datagram(one, two, SAID, 100))
        arrives(two, SAID)
        throw(one, made(one, two))
        counted(two, reason)
        assert newest_of(two) == SAID
        assert two._sender.answers == one._sender.session
        assert sum(two.counts()) == 2
        throw(one, datagram(one, two, said(4.0), 101))
        arrives(two, said(4.0))


async def test_a_datagram_from_another_computer_is_rejected(settings: tuple[TeamSettings, TeamSettings]) -> None:
    async with linked(settings) as (one, two):
        with socket.socket(type=socket.SOCK_DGRAM) as stranger:
            stranger.bind(("127.0.0.2", 0))
            stranger.sendto(datagram(one, two, SAID, 1 << 62), (LOOPBACK, two.port))
            wait_until(lambda: two.newest() is None and two.counts().foreign == 1, lambda: str(two.counts()))


@given(st.binary(max_size=600))
def test_no_bytes_raise(data: bytes) -> None:
    way = direction(LOOPBACK, LOOPBACK, 1)
    assert decoded(data, KEY, way) in ("malformed", "forged")
    assert isinstance(decoded(_proven(data, way), KEY, way), str)


def test_a_datagram_fits_into_the_limit_with_room() -> None:
    full = replace(SAID, agreed="0123456789abcdef", system_id=255, server_s=12.25)
    assert len(encoded(Announcement(1 << 62, 1 << 62, 1 << 62, full), KEY, b"")) == 28 + len(to_packet(full)) + 16 < 400


@pytest.mark.parametrize(
    ("key", "text"),
    [
        (None, "devices.team.key_file: .*team.key: No such file or directory; expected a file with 32 random bytes"),
        (KEY[:31], "devices.team.key_file: .*team.key: has 31 bytes; expected a file with 32 random bytes or more"),
    ],
)
def test_a_key_that_is_missing_or_short_is_one_line(
    settings: tuple[TeamSettings, TeamSettings], key: bytes | None, text: str
) -> None:
    assert settings[0].key_file is not None
    file = Path(settings[0].key_file)
    file.unlink() if key is None else file.write_bytes(key)
    with pytest.raises(DeviceError, match=text) as raised:
        TeamSender(settings[0])
    assert "\n" not in str(raised.value)


async def test_without_a_key_file_the_link_is_not_opened(settings: tuple[TeamSettings, TeamSettings]) -> None:
    bare = TeamSettings(settings[0].port, LOOPBACK, settings[0].partner_port, None)
    with pytest.raises(DeviceError, match=r"devices\.team\.key_file: missing"):
        await TeamLink(bare, flight_clock()).__aenter__()


async def test_a_port_in_use_is_one_line(settings: tuple[TeamSettings, TeamSettings]) -> None:
    async with linked(settings):
        with pytest.raises(
            DeviceError, match=r"another program holds the port; close it or change devices\.team\.port"
        ):
            await TeamLink(settings[0], flight_clock()).__aenter__()


class World:
    """Simulated time, which both vehicles share."""

    now_s = 0.5

    def now(self) -> float:
        return self.now_s


async def test_in_simulated_time_it_does_not_matter_who_works_first_at_one_instant(
    settings: tuple[TeamSettings, TeamSettings], monkeypatch: pytest.MonkeyPatch
) -> None:
    world = World()
    monkeypatch.setattr("companion.runtime.simulated_time.current", lambda: world)
    heard: list[list[tuple[float, float] | None]] = []
    for first in (True, False):
        world.now_s = 0.5 if first else 10.5
        origin_s, seen = world.now_s, list[tuple[float, float] | None]()
        async with TeamLink(settings[0], world.now) as one, TeamLink(settings[1], world.now) as two:
            for tick in range(12):
                world.now_s = origin_s + 0.005 * tick
                for link in (one, two) if first else (two, one):
                    newest = link.newest()
                    link.announce(said(float(tick)))
                    if link is two:
                        at_s = None if newest is None else round(newest.stamp_s - origin_s, 6)
                        seen.append(None if newest is None or at_s is None else (at_s, newest.said.position_world_m[0]))
        heard.append(seen)
    assert heard[0] == heard[1]
    assert heard[0][:5] == 5 * [None], "the first announcements, 20 ms apart, only let the two meet"
    assert heard[0][5] == (0.022, 4.0) and heard[0][9] == (0.042, 8.0)
