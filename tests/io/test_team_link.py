"""The link between two vehicles over real sockets: what arrives, what is rejected, and when it arrives in simulated time."""

from __future__ import annotations

import math
import socket
from collections.abc import AsyncIterator
from contextlib import asynccontextmanager
from pathlib import Path
from typing import Any

import pytest
from hypothesis import given
from hypothesis import strategies as st

from companion.io import team_link
from companion.io.protocols import DeviceError
from companion.io.team_link import TeamLink, TeamSender, TeamSettings, decoded, direction, encoded
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
    clock = flight_clock()
    async with TeamLink(settings[0], clock) as one, TeamLink(settings[1], clock) as two:
        yield one, two


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
        guardian = TeamSender(settings[0])
        guardian.announce(said(3.0), 0.0)
        guardian.close()
        arrives(two, said(3.0))
        one._sender._counter, one._sender._due_s = 0, -math.inf
        datagram = encoded(SAID, 5, KEY, one._sender._direction)
        one._sender._socket.sendto(datagram, one._sender._to)
        wait_until(lambda: two.newest() is not None and two.counts().repeated == 1, lambda: str(two.counts()))
        assert two.newest() is not None and two.newest().said == said(3.0)  # type: ignore[union-attr]


def _changed(datagram: bytes, at: int) -> bytes:
    return datagram[:at] + bytes((datagram[at] ^ 1,)) + datagram[at + 1 :]


REJECTED: dict[str, tuple[str, Any]] = {
    "another key": ("forged", lambda way: encoded(said(9.0), 1 << 62, bytes(32), way)),
    "sent back": ("forged", lambda way: encoded(said(9.0), 1 << 62, KEY, direction(LOOPBACK, LOOPBACK, 1))),
    "counter changed": ("forged", lambda way: _changed(encoded(said(9.0), 1 << 62, KEY, way), 5)),
    "state changed": ("forged", lambda way: _changed(encoded(said(9.0), 1 << 62, KEY, way), 20)),
    "cut off": ("forged", lambda way: encoded(said(9.0), 1 << 62, KEY, way)[:-1]),
    "another version": ("malformed", lambda way: b"CTL0" + encoded(said(9.0), 1 << 62, KEY, way)[4:]),
    "empty": ("malformed", lambda way: b""),
    "too long": ("malformed", lambda way: bytes(2000)),
    "not finite": ("malformed", lambda way: encoded(said(math.nan), 1 << 62, KEY, way)),
    "infinite": ("malformed", lambda way: encoded(said(math.inf), 1 << 62, KEY, way)),
    "another record": ("malformed", lambda way: _proven(b"\x80", way)),
    "repeated": ("repeated", lambda way: encoded(said(9.0), 100, KEY, way)),
    "older": ("repeated", lambda way: encoded(said(9.0), 99, KEY, way)),
}


def _proven(packet: bytes, way: bytes) -> bytes:
    text = team_link._HEAD.pack(team_link.MAGIC, 1 << 62) + packet
    return text + team_link._proof(way + text, KEY)


@pytest.mark.parametrize(("counted", "datagram"), REJECTED.values(), ids=REJECTED)
async def test_a_datagram_that_is_not_a_newer_announcement_is_rejected_and_counted(
    settings: tuple[TeamSettings, TeamSettings], counted: str, datagram: Any
) -> None:
    async with linked(settings) as (one, two):
        with socket.socket(type=socket.SOCK_DGRAM) as sender:
            way, to = one._sender._direction, (LOOPBACK, two.port)
            sender.sendto(encoded(SAID, 100, KEY, way), to)
            arrives(two, SAID)
            sender.sendto(datagram(way), to)
            wait_until(
                lambda: two.newest() is not None and getattr(two.counts(), counted) == 1, lambda: str(two.counts())
            )
            assert two.newest() is not None and two.newest().said == SAID  # type: ignore[union-attr]
            assert sum(two.counts()) == 2
            sender.sendto(encoded(said(4.0), 101, KEY, way), to)
            arrives(two, said(4.0))


async def test_a_datagram_from_another_computer_is_rejected(settings: tuple[TeamSettings, TeamSettings]) -> None:
    async with linked(settings) as (one, two):
        with socket.socket(type=socket.SOCK_DGRAM) as stranger:
            stranger.bind(("127.0.0.2", 0))
            stranger.sendto(encoded(SAID, 1 << 62, KEY, one._sender._direction), (LOOPBACK, two.port))
            wait_until(lambda: two.newest() is None and two.counts().foreign == 1, lambda: str(two.counts()))


@given(st.binary(max_size=600))
def test_no_bytes_raise(datagram: bytes) -> None:
    way = direction(LOOPBACK, LOOPBACK, 1)
    assert decoded(datagram, KEY, way) in ("malformed", "forged")
    assert isinstance(decoded(_proven(datagram, way), KEY, way), str)


def test_a_datagram_fits_into_the_limit_with_room() -> None:
    assert len(encoded(SAID, 1 << 62, KEY, b"")) == 12 + len(to_packet(SAID)) + 16 < 200


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
    heard: list[list[tuple[float, float, float] | None]] = []
    for first in (True, False):
        world.now_s = 0.5 if first else 10.5
        origin_s, seen = world.now_s, list[tuple[float, float, float] | None]()
        async with TeamLink(settings[0], world.now) as one, TeamLink(settings[1], world.now) as two:
            for tick in range(12):
                world.now_s = origin_s + 0.005 * tick
                if first:
                    one.announce(said(float(tick)))
                newest = two.newest()
                if not first:
                    one.announce(said(float(tick)))
                at_s = None if newest is None else round(newest.stamp_s - origin_s, 6)
                seen.append(
                    None if newest is None or at_s is None else (0.005 * tick, at_s, newest.said.position_world_m[0])
                )
        heard.append(seen)
    assert heard[0] == heard[1]
    assert heard[0][:2] == [None, (0.005, 0.002, 0.0)] and heard[0][5] == (0.025, 0.022, 4.0)
