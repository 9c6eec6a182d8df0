"""A broker that sends anything: no message ends the ground station, sets its clock, or prevents commands."""

from __future__ import annotations

import asyncio
import io
import itertools
import json
from collections.abc import Iterator
from functools import cache
from typing import Any

import aiomqtt
import pytest
from msgspec.structs import replace
from rich.console import Console

from companion.ground.protocol.access import broker_access
from companion.ground.protocol.commands import Accepted, Verifier, make_command
from companion.ground.protocol.connection import Connection
from companion.ground.protocol.messages import VERSION, Preflight, PreflightRow, Presence, Stream, Topic
from companion.ground.protocol.proof import with_proof, with_proofs
from companion.ground.station.hub import Hub, Outbox
from companion.ground.station.station import Station
from companion.ground.station.text_view import StationStatus, render, status_line
from companion.ground.station.vehicles import LIVE_S, VehicleTracker
from companion.ground.telemetry.scene import scene_of
from companion.model.codec import to_json, to_jsonable
from companion.model.types import OperatorCommand
from companion.runtime.tasks import until_first
from tests.broker import Broker
from tests.ground.monitor_rig import ANNA, OPERATORS, SIGNER, until
from tests.ground.vehicle import ack_of, flight, played_vehicle, state_of

STREAM = "companion/rig/stream"
AROUND = StationStatus("connected", True, "anna", None)


def stream_of(t_s: float = 1.0, session: str = "s1", **values: Any) -> Stream:
    return replace(flight()[1][30], session=session, t_s=t_s, **values)


def proven(stream: Stream, vehicle: str = "rig") -> bytes:
    return to_json(with_proofs(stream, vehicle, [b"b" * 32, ANNA.key]))


def flying(t_s: float = 100.0) -> VehicleTracker:
    """Return the tracker of anna's ground station after one proven message, at 50 s of the local clock."""
    watch = VehicleTracker(signer=SIGNER)
    assert watch.receive(STREAM, proven(stream_of(t_s)), False, 50.0) is not None
    return watch


# -- the clock that commands are dated by ------------------------------------------------------------------------------


def forged(watch: VehicleTracker) -> dict[str, bytes]:
    genuine = with_proofs(stream_of(100.05), "rig", [ANNA.key])
    return {
        "no proof": to_json(stream_of(160.0)),
        "the proof of another message": to_json(replace(genuine, t_s=160.0)),
        "proven with another key": to_json(with_proofs(stream_of(160.0), "rig", [b"x" * 32])),
        "proven for another vehicle": proven(stream_of(160.0), "other"),
        "of another flight": to_json(stream_of(160.0, "s2")),
        "many proofs": to_json(stream_of(160.0, proofs=("0" * 32,) * 500)),
        "proofs that are no text of ours": to_json(stream_of(160.0, proofs=("\ud800", "", "\0"))),
        "another hold": to_json(replace(genuine, hold=7)),
    }


@pytest.mark.parametrize("name", forged(VehicleTracker()))
def test_a_forged_stream_does_not_make_a_station_sign_for_the_future(name: str) -> None:
    """A command signed 60 s ahead is refused now, but valid for whoever replays it 60 s later."""
    watch = flying()
    assert watch.receive(STREAM, forged(watch)[name], False, 50.1) is None
    known = watch.vehicles["rig"].proven
    assert known is not None
    assert (known.session, known.now_ms(50.1), known.hold) == ("s1", 100_100, 0)
    command = make_command(OperatorCommand.START, "rig", known.session, "anna", ANNA.key, known.now_ms(50.1))
    assert isinstance(Verifier(OPERATORS, "rig", "s1").check(to_json(command), False, 100.11), Accepted)


def test_a_copy_of_an_earlier_message_is_not_shown_as_new() -> None:
    watch, copy = VehicleTracker(signer=SIGNER), proven(stream_of(99.0))
    assert watch.receive(STREAM, copy, False, 49.0) is not None
    assert watch.receive(STREAM, proven(stream_of(100.0)), False, 50.0) is not None
    assert watch.receive(STREAM, copy, False, 50.1) is None


def test_a_copy_of_the_newest_message_does_not_make_a_dead_link_look_alive() -> None:
    """Sent repeatedly it would set the clock back, and every command would be refused as stale."""
    watch, copy = flying(), proven(stream_of(100.0))
    for k in range(1, 401):
        now_s = 50.0 + k / 20
        assert watch.receive(STREAM, copy, False, now_s) is None
    known = watch.vehicles["rig"].proven
    assert known is not None and not known.live(70.0)
    assert known.now_ms(70.0) == 120_000
    command = make_command(OperatorCommand.HOLD, "rig", known.session, "anna", ANNA.key, known.now_ms(70.0))
    assert isinstance(Verifier(OPERATORS, "rig", "s1").check(to_json(command), False, 120.01), Accepted)


def test_a_recording_of_an_earlier_flight_does_not_replace_the_current_one() -> None:
    now, before = stream_of(100.0, "now", wall_s=2000.0), stream_of(500.0, "before", wall_s=1000.0)
    watch = VehicleTracker(signer=SIGNER)
    for k in range(40):  # the recording plays already when the flight begins, and goes on
        watch.receive(STREAM, proven(replace(before, t_s=500.0 + k / 20)), False, 50.0 + k / 20)
    known = watch.vehicles["rig"]
    assert known.proven is not None and known.proven.session == "before"
    for k in range(40):
        assert watch.receive(STREAM, proven(replace(now, t_s=100.0 + k / 20)), False, 52.0 + k / 20) is not None
        assert watch.receive(STREAM, proven(replace(before, t_s=502.0 + k / 20)), False, 52.01 + k / 20) is None
    assert (known.session, known.proven.session) == ("now", "now")


def test_of_two_flights_under_one_name_the_first_is_shown_and_commanded_while_it_lasts() -> None:
    """As of two simulations on one computer: a command would go to the one that sent last."""
    watch = VehicleTracker(signer=SIGNER)
    for k in range(40):
        for session, late_s in (("one", 0.0), ("two", 0.02)):
            now_s = 50.0 + k / 20 + late_s
            message = proven(stream_of(100.0 + k / 20, session, wall_s=2000.0 + now_s))
            assert (watch.receive(STREAM, message, False, now_s) is not None) == (session == "one")
            known = watch.vehicles["rig"].proven
            assert known is not None and known.session == "one"
    assert watch.rejected_text == f"{STREAM!r}: is of another flight under the name of the one that is shown"
    assert watch.receive(STREAM, proven(stream_of(103.0, "two", wall_s=2053.0)), False, 53.0) is not None


def test_the_next_flight_is_taken_though_the_clock_on_the_wall_was_set_back() -> None:
    watch = flying()
    later = proven(stream_of(1.0, "s2", wall_s=5.0))
    assert watch.receive(STREAM, later, False, 50.5) is None
    assert watch.receive(STREAM, later, False, 50.0 + LIVE_S) is not None
    known = watch.vehicles["rig"].proven
    assert known is not None and (known.session, known.now_ms(51.0)) == ("s2", 1000)


def test_without_a_key_everything_is_shown() -> None:
    watch = VehicleTracker()
    for t_s in (100.0, 160.0):
        assert watch.receive(STREAM, to_json(stream_of(t_s)), False, 50.0) is not None
    assert watch.vehicles["rig"].proven is None


def test_an_answer_without_the_vehicles_proof_is_rejected() -> None:
    """Otherwise anyone who reads the nonce could answer "landing" and end the attempts."""
    ack = ack_of("s1", command=OperatorCommand.LAND, text="landing", action="land")
    watch, topic = VehicleTracker(signer=SIGNER), "companion/rig/ack"
    assert watch.receive(topic, to_json(ack), False, 50.0) is None
    assert watch.receive(topic, to_json(replace(with_proof(ack, "rig", ANNA.key), accepted=False)), False, 50.0) is None
    assert watch.receive(topic, to_json(with_proof(ack, "other", ANNA.key)), False, 50.0) is None
    assert watch.receive(topic, to_json(with_proof(ack, "rig", ANNA.key)), False, 50.0) is not None
    assert watch.receive(topic, to_json(replace(ack, operator="bert")), False, 50.0) is not None


# -- numbers and everything else ---------------------------------------------------------------------------------------

HOSTILE = (
    "NaN", "-Infinity", '"nan"', "1e999", "9" * 400, "9" * 5000, "-1e300", "1e12", "1e-320", "-1", str(2**63), "true", "null", '"x"',
    "{}", "[" * 5000 + "]" * 5000, '"' + "y" * 150_000 + '"', '"\\ud800"', '"\\u0000\\u001b[2J\\u202e"', "[1,2,3]", '{"v":2,"v":2}',
)  # fmt: skip


@cache
def genuine() -> dict[Topic, dict[str, Any]]:
    """Return one valid message of each topic, as data."""
    config, _, events = flight()
    scene = scene_of(config, "s1", [(0.0, 0.0, 1.0), (1.0, 0.0, 1.0)], mission_s=21.0)
    ack = ack_of("s1", operator="bert")
    records = {
        Topic.STATE: state_of("rig", "s1"),
        Topic.SCENE: scene,
        Topic.PREFLIGHT: Preflight(VERSION, "s1", (PreflightRow("px4_link", "ok", "3 ms"),)),
        Topic.EVENTS: replace(events, session="s1", lines=events.lines[:2]),
        Topic.STREAM: stream_of(hold=1, proofs=("0" * 32,)),
        Topic.ACK: ack,
    }
    return {topic: json.loads(to_json(record)) for topic, record in records.items()}


def places(data: Any, path: tuple[str | int, ...] = ()) -> Iterator[tuple[str | int, ...]]:
    """Yield the paths of all values and containers in the data; of a list only the first element."""
    yield path
    items = data.items() if isinstance(data, dict) else enumerate(data[:1]) if isinstance(data, list) else ()
    for key, value in items:
        yield from places(value, (*path, key))


def corrupted(data: Any, path: tuple[str | int, ...], raw: str) -> bytes:
    """Return the message with a JSON text at one path."""
    if not path:
        return raw.encode()
    copy = json.loads(json.dumps(data))
    inner = copy
    for key in path[:-1]:
        inner = inner[key]
    inner[path[-1]] = "@here@"
    return json.dumps(copy).replace('"@here@"', raw).encode()


def everything_hostile() -> Iterator[tuple[Topic, bytes]]:
    for topic, data in genuine().items():
        for path in places(data):
            for raw in HOSTILE:
                yield topic, corrupted(data, path, raw)
        payload = json.dumps(data).encode()
        for other in (
            payload[:-1],
            payload.decode().encode("utf-16"),
            b"\xef\xbb\xbf" + payload,
            b"\xff" + payload,
            payload * 2,
            b"",
        ):
            yield topic, other


def test_no_message_raises_anywhere_in_a_ground_station() -> None:
    """Every value at every path of every message passes the tracker, the hub and the terminal display."""
    watch, signed = VehicleTracker(), VehicleTracker(signer=SIGNER)
    hub, outbox = Hub(watch, ""), Outbox()
    hub.add(outbox, 0.0)
    console = Console(file=io.TextIOWrapper(io.BytesIO(), encoding="utf-8"), width=100)
    now_s, taken = 50.0, 0
    for topic, payload in everything_hostile():
        now_s += 0.001
        signed.receive(topic.of("rig"), payload, False, now_s)
        received = watch.receive(topic.of("rig"), payload, False, now_s)
        if received is None:
            continue
        taken += 1
        hub.publish(received)
        known = watch.vehicles["rig"]
        console.print(render(known, now_s, AROUND))
        status_line(known, now_s).encode()
        watch.present(now_s)
        Hub(watch, "").add(Outbox(), now_s)
    assert taken > 100, "what is merely odd is shown"
    assert watch.rejected > 1500 and signed.rejected > 1500


async def test_land_is_sent_and_answered_whatever_a_hostile_broker_sends(broker: Broker) -> None:
    changes: list[str] = []

    station = Station(
        broker_access(broker.url, None, None), SIGNER, None, lambda heard: None, lambda connected, text: changes.append(text)
    )  # fmt: skip

    async def fight() -> None:
        async with (
            played_vehicle(broker.port, OPERATORS, session="s1") as vehicle,
            aiomqtt.Client("127.0.0.1", broker.port, protocol=aiomqtt.ProtocolVersion.V5) as hostile,
        ):
            watch = station.tracker
            await until(lambda: "rig" in watch.vehicles and watch.vehicles["rig"].proven is not None)
            for number, (topic, payload) in enumerate(itertools.islice(everything_hostile(), 0, None, 7)):
                await hostile.publish(topic.of("rig"), payload, qos=number % 200 == 0)
            for lie in (
                state_of("rig", "s1", presence=Presence.ENDED, outcome="completed"),
                state_of("rig", "s1", commands=False, text="hears nothing"),
                state_of("rig", "another flight"),
            ):
                await hostile.publish(Topic.STATE.of("rig"), to_json(lie), qos=1, retain=True)
                await until(lambda lie=lie: watch.vehicles["rig"].state == lie)  # type: ignore[misc]
                ack = await station.commands.send("rig", OperatorCommand.LAND, lambda note: None)
                assert ack is not None and ack.accepted
            assert [command.command for command in vehicle.accepted] == [OperatorCommand.LAND] * 3
            assert watch.rejected > 200
        assert [text for text in changes if not text.startswith("connected")] == []

    await until_first(station.run(), fight())


async def test_an_exception_while_a_message_is_handled_costs_that_message_only(broker: Broker) -> None:
    """An exception while a message is handled costs that message, neither the connection nor a command."""

    def fails(heard: object) -> None:
        raise ZeroDivisionError("of our own")

    changes: list[str] = []
    station = Station(
        broker_access(broker.url, None, None), SIGNER, None, fails, lambda connected, text: changes.append(text)
    )

    async def fight() -> None:
        async with played_vehicle(broker.port, OPERATORS):
            await until(lambda: station.tracker.rejected > 10)
            ack = await station.commands.send("rig", OperatorCommand.LAND, lambda note: None)
            assert ack is not None and ack.accepted
        assert "ZeroDivisionError: 'of our own'" in (station.tracker.rejected_text or "")
        assert len(changes) == 1

    await until_first(station.run(), fight())


async def test_ctrl_c_before_the_broker_has_answered_prints_nothing() -> None:
    said: list[str] = []
    asyncio.get_running_loop().set_exception_handler(lambda loop, context: said.append(str(context["message"])))
    accepted: asyncio.Queue[tuple[asyncio.StreamReader, asyncio.StreamWriter]] = asyncio.Queue()
    async with await asyncio.start_server(lambda *streams: accepted.put_nowait(streams), "127.0.0.1", 0) as silent:
        access = broker_access(f"mqtt://127.0.0.1:{silent.sockets[0].getsockname()[1]}", None, None)
        connection = Connection(access, "ground", lambda *message: None, packet_max_bytes=1000, answer_s=30.0)
        opening = asyncio.ensure_future(connection.open())
        reader, writer = await accepted.get()
        assert await reader.readexactly(1) == b"\x10"  # CONNECT
        await until(lambda: connection._misc_task is not None)
        opening.cancel()
        await asyncio.wait((opening,))
        writer.transport.abort()
        await until(lambda: connection._client.socket() is None)  # paho has seen that the broker is gone
        await connection.shut_down()
    assert opening.cancelled() and said == []


def test_proofs_are_of_the_whole_message() -> None:
    stream = with_proofs(stream_of(), "rig", [ANNA.key])
    data = to_jsonable(stream)
    watch = VehicleTracker(signer=SIGNER)
    for name in data.keys() - {"v", "session", "proofs"}:
        less = {key: value for key, value in data.items() if key != name}
        watch.receive(STREAM, json.dumps(less).encode(), False, 50.0)
    assert not watch.vehicles or watch.vehicles["rig"].proven is None
