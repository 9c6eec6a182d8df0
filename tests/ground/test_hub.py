"""State of the vehicles and its distribution to viewers, without sockets."""

from __future__ import annotations

import asyncio
import json
from typing import Any

import pytest
from msgspec.structs import replace

from companion.ground.protocol.messages import VERSION, Events, Presence, Topic
from companion.ground.protocol.proof import Signer, with_proofs
from companion.ground.station.hub import FRESH_S, OUTBOX_MAX, TOO_SLOW, Hub, Outbox
from companion.ground.station.vehicles import LIVE_S, VEHICLES_MAX, ReceivedRecord, VehicleTracker
from companion.ground.station.web_guard import host_allowed, origin_allowed, same_token
from companion.model.codec import to_json
from tests.ground.monitor_rig import ANNA, SIGNER
from tests.ground.vehicle import ack_of, flight, state_of
from tests.support import DEADLINE_S

SESSION = "s1"


def stream_of(session: str = SESSION, t_s: float = 1.0, **values: Any) -> bytes:
    return to_json(replace(flight()[1][30], session=session, t_s=t_s, **values))


def took(outbox: Outbox) -> list[Any]:
    """Return the content of an outbox."""

    async def take() -> list[str]:
        async with asyncio.timeout(DEADLINE_S):
            return await outbox.take()

    return [json.loads(text) for text in asyncio.run(take())]


RUBBISH: dict[str, tuple[str, bytes]] = {
    "no JSON": ("companion/rig/stream", b"\xff{"),
    "deep JSON": ("companion/rig/stream", b"[" * 100_000),
    "another version": ("companion/rig/stream", stream_of().replace(b'"v":2', b'"v":3')),
    "a field too many": ("companion/rig/stream", stream_of()[:-1] + b',"hack":1}'),
    "a field of another kind": ("companion/rig/stream", stream_of(phase="catch").replace(b'"catch"', b"7")),
    "no number of JSON": (
        "companion/rig/stream",
        stream_of(progress=0.25).replace(b'"progress":0.25', b'"progress":NaN'),
    ),
    "a number beyond all": (
        "companion/rig/stream",
        stream_of(progress=0.25).replace(b'"progress":0.25', b'"progress":1e999'),
    ),
    "another record": ("companion/rig/state", stream_of()),
    "another vehicle": ("companion/rig/state", to_json(state_of("other", SESSION))),
    "oversized": ("companion/rig/events", b" " * 200_001),
    "not a vehicle name": ("companion/<b>/stream", stream_of()),
    "a command": ("companion/rig/command", stream_of()),
    "no topic of ours": ("companion/rig/stream/deeper", stream_of()),
    "empty": ("companion/rig/stream", b""),
}


@pytest.mark.parametrize(("topic", "payload"), RUBBISH.values(), ids=RUBBISH.keys())
def test_an_invalid_message_is_counted_and_not_stored(topic: str, payload: bytes) -> None:
    watch = VehicleTracker()
    assert watch.receive(topic, payload, False, 0.0) is None
    assert watch.rejected == 1
    assert watch.rejected_text is not None and watch.rejected_text.isprintable()
    assert not watch.vehicles


def test_a_retained_record_that_is_deleted_is_not_counted_as_invalid() -> None:
    watch = VehicleTracker()
    assert watch.receive("companion/rig/state", b"", True, 0.0) is None
    assert watch.rejected == 0


def test_a_retained_stream_does_not_look_alive() -> None:
    watch = VehicleTracker()
    assert watch.receive("companion/rig/stream", stream_of(), True, 0.0) is None
    assert not watch.vehicles["rig"].live(0.0)


def test_a_late_message_has_its_delay() -> None:
    watch = VehicleTracker()
    first = watch.receive("companion/rig/stream", stream_of(t_s=1.0), False, 100.0)
    late = watch.receive("companion/rig/stream", stream_of(t_s=1.05), False, 103.0)
    assert first is not None and first.age_s == pytest.approx(0.0, abs=2e-3)
    assert late is not None and late.age_s == pytest.approx(2.95, abs=2e-3)


def test_a_new_flight_has_a_clock_of_its_own_and_an_old_retained_state_does_not_bring_the_old_one_back() -> None:
    watch = VehicleTracker()
    watch.receive("companion/rig/stream", stream_of(t_s=500.0), False, 100.0)
    watch.receive("companion/rig/stream", stream_of("s2", t_s=1.0), False, 101.0)
    watch.receive("companion/rig/state", to_json(state_of("rig", SESSION, presence=Presence.ENDED)), True, 101.0)
    known = watch.vehicles["rig"]
    assert known.session == "s2"
    assert known.clock.now_ms(102.0) == pytest.approx(2000, abs=1)
    assert not known.ended(200.0)


@pytest.mark.parametrize("signer", [None, SIGNER])
def test_a_flood_of_vehicles_does_not_push_out_the_one_that_flies_or_is_proven(signer: Signer | None) -> None:
    """A vehicle with a proven message is kept even if it is silent."""
    watch, proven = VehicleTracker(signer=signer), with_proofs(flight()[1][30], "rig", [ANNA.key])
    for number in range(3 * VEHICLES_MAX):
        if signer is None or number == 0:
            watch.receive("companion/rig/stream", to_json(proven), False, number + 0.5)
        watch.receive(f"companion/fake-{number}/state", to_json(state_of(f"fake-{number}", "s")), True, number + 0.6)
    assert len(watch.vehicles) == VEHICLES_MAX
    assert watch.vehicles["rig"].stream is not None


def test_vehicles_that_ended_or_were_lost_are_not_present() -> None:
    watch = VehicleTracker()
    for name, presence in (("flies", Presence.FLYING), ("over", Presence.ENDED), ("gone", Presence.LOST)):
        watch.receive(f"companion/{name}/state", to_json(state_of(name, SESSION, presence=presence)), True, 0.0)
    watch.receive("companion/heard/stream", stream_of(), False, 0.0)
    assert watch.present(0.0) == ["flies", "heard"]
    assert watch.present(2 * LIVE_S) == ["flies"]


def test_only_one_vehicle_is_watched_if_one_is_named() -> None:
    watch = VehicleTracker("rig")
    watch.receive("companion/other/stream", stream_of(), False, 0.0)
    watch.receive("companion/rig/stream", stream_of(), False, 0.0)
    assert list(watch.vehicles) == ["rig"] and watch.rejected == 0


def test_the_newest_stream_wins_and_nothing_else_is_lost() -> None:
    outbox = Outbox()
    for number in range(5):
        outbox.put_stream("rig", f'"rig {number}"')
        outbox.put_stream("other", f'"other {number}"')
        outbox.put(f'"event {number}"')
    assert took(outbox) == [f"event {number}" for number in range(5)] + ["rig 4", "other 4"]


def test_a_viewer_that_would_lose_an_event_is_disconnected_and_one_that_misses_streams_is_not() -> None:
    outbox = Outbox()
    for _ in range(10 * OUTBOX_MAX):
        outbox.put_stream("rig", "{}")
    for _ in range(OUTBOX_MAX):
        outbox.put("{}")
    assert outbox.close_reason is None
    outbox.put("{}")
    assert outbox.close_reason is TOO_SLOW


def test_an_idle_viewer_costs_bounded_memory_however_many_vehicles_are_made_up() -> None:
    outbox = Outbox()
    for number in range(10 * VEHICLES_MAX):
        outbox.put_stream(f"fake-{number}", str(number))
    assert took(outbox) == list(range(9 * VEHICLES_MAX, 10 * VEHICLES_MAX))


def test_a_few_huge_messages_fill_an_outbox() -> None:
    outbox = Outbox()
    for _ in range(30):
        outbox.put("x" * 200_000)
    assert outbox.close_reason is TOO_SLOW


def test_a_late_viewer_gets_the_known_state_but_no_old_stream() -> None:
    watch = VehicleTracker()
    hub = Hub(watch, "no broker yet")
    watch.receive("companion/rig/state", to_json(state_of("rig", SESSION)), True, 0.0)
    watch.receive("companion/rig/events", to_json(Events(v=VERSION, session=SESSION, count=0, lines=())), True, 0.0)
    watch.receive("companion/rig/stream", stream_of(), False, 10.0)
    soon, late = Outbox(), Outbox()
    hub.add(soon, 10.0 + 0.9 * FRESH_S)
    hub.add(late, 10.0 + 1.1 * FRESH_S)
    assert [message["kind"] for message in took(soon)] == ["broker", "state", "events", "stream"]
    assert [message["kind"] for message in took(late)] == ["broker", "state", "events"]


def test_all_viewers_get_the_same_text_and_a_removed_one_gets_nothing() -> None:
    hub = Hub(VehicleTracker(), "no broker yet")
    outboxes = [Outbox() for _ in range(3)]
    for outbox in outboxes:
        hub.add(outbox, 0.0)
        took(outbox)
    hub.remove(outboxes[0])
    hub.publish(ReceivedRecord("rig", Topic.ACK, ack_of(SESSION, "00")))
    outboxes[0].put("{}")
    assert took(outboxes[0]) == [{}]
    first, second = (took(outbox) for outbox in outboxes[1:])
    assert first == second and first[0]["kind"] == "ack" and first[0]["data"]["text"] == "holding"


HOSTS: dict[str, tuple[str | None, str, bool]] = {
    "address": ("127.0.0.1:8642", "127.0.0.1", True),
    "name": ("localhost:8642", "127.0.0.1", True),
    "ssh -L": ("LOCALHOST:9000", "127.0.0.1", True),
    "IPv6": ("[::1]:8642", "::1", True),
    "rebinding": ("evil.example:8642", "127.0.0.1", False),
    "rebinding, looks like loopback": ("127.0.0.1.evil.example", "127.0.0.1", False),
    "another address": ("192.168.1.5:8642", "127.0.0.1", False),
    "none": (None, "127.0.0.1", False),
    "rubbish": ("127.0.0.1:8642@evil", "127.0.0.1", False),
    "the host given": ("ground.lab:8642", "ground.lab", True),
    "everywhere, by address": ("192.168.1.5:8642", "0.0.0.0", True),
    "everywhere, rebinding": ("evil.example:8642", "0.0.0.0", False),
}


@pytest.mark.parametrize(("header", "listens_on", "allowed"), HOSTS.values(), ids=HOSTS.keys())
def test_host_headers(header: str | None, listens_on: str, allowed: bool) -> None:
    assert host_allowed(header, listens_on) is allowed


ORIGINS: dict[str, tuple[str | None, bool, bool]] = {
    "same": ("http://127.0.0.1:8642", False, True),
    "same, TLS": ("https://127.0.0.1:8642", True, True),
    "TLS here, plain there": ("http://127.0.0.1:8642", True, False),
    "another port": ("http://127.0.0.1:8643", False, False),
    "another name of the same computer": ("http://localhost:8642", False, False),
    "elsewhere": ("http://evil.example", False, False),
    "a file": ("null", False, False),
    "none": (None, False, False),
    "rubbish": ("http://[", False, False),
}


@pytest.mark.parametrize(("origin", "tls", "allowed"), ORIGINS.values(), ids=ORIGINS.keys())
def test_origins(origin: str | None, tls: bool, allowed: bool) -> None:
    assert origin_allowed(origin, "127.0.0.1:8642", tls=tls) is allowed


def test_tokens() -> None:
    assert same_token("abc", "abc")
    for other in ("", "ab", "abcd", "ABC", None, 7, ["abc"], "\ud800"):
        assert not same_token(other, "abc")
