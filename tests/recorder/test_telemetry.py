"""Telemetry as a ground station receives it: the real recorder process with a synthetic flight, and a real mosquitto."""

from __future__ import annotations

import json
import os
import signal
from collections.abc import Iterator
from pathlib import Path

import jsonschema
import pytest

from companion.analysis.log import FlightLog
from companion.ground.protocol.messages import (
    RETAINED,
    Ack,
    Events,
    Preflight,
    Presence,
    Scene,
    State,
    Stream,
    Topic,
    decode,
)
from companion.model.types import GroundCommand, OperatorCommand, Severity
from tests.broker import Broker, loopback_broker
from tests.recorder.telemetry_rig import VEHICLE, Listener, flight_with, log_lines, rows
from tests.support import DEADLINE_S, free_port, wait_until
from tools.docs.telemetry import schema_of


@pytest.fixture
def broker(tmp_path: Path) -> Iterator[Broker]:
    with loopback_broker(tmp_path) as broker:
        yield broker


def test_every_topic_follows_its_schema_and_is_there_for_those_who_come_late(tmp_path: Path, broker: Broker) -> None:
    with Listener(broker.port) as listener, flight_with(tmp_path, broker.url) as flight:
        client = flight.recorder.client
        client.metadata("preflight", {"json": json.dumps([{"id": "px4", "level": "ok", "text": "well"}])})
        client.metadata("plan", {"json": json.dumps([[0, 0, 0.3], [1.5, 0, 1]]), "mission_s": "21.5"})
        flight.begin(listener)
        state = listener.wait(Topic.STATE, State, lambda state: state.presence is Presence.FLYING and state.commands)
        flight.fly(600)
        client.text(2.9, Severity.WARNING, "px4", "Preflight Fail: ears are cold")
        asked = GroundCommand(command=OperatorCommand.HOLD, operator="anna", nonce="0" * 32, hold=0, t_s=3.0)
        client.ack(asked, True, "holding", rows()[600][1])
        flight.fly(2000)
        listener.wait(Topic.STREAM, Stream, lambda stream: stream.t_s > 5.0)
        flight.fly(len(rows()))
        report = flight.finish()
        listener.wait(Topic.STATE, State, lambda state: state.presence is Presence.ENDED)
        assert (report.samples, report.dropped, report.error) == (len(rows()), 0, None)
        for topic in Topic:
            heard = listener.of(topic)
            assert heard or topic is Topic.COMMAND
            for payload in heard:
                jsonschema.Draft202012Validator(schema_of(topic)).validate(json.loads(payload))
        ack = listener.wait(Topic.ACK, Ack)
        assert (ack.session, ack.command, ack.accepted, ack.text) == (
            state.session,
            OperatorCommand.HOLD,
            True,
            "holding",
        )
        streams = [decode(Stream, payload) for payload in listener.of(Topic.STREAM)]
        assert [stream.seq for stream in streams] == sorted({stream.seq for stream in streams})
        assert {stream.session for stream in streams} == {state.session}
        assert streams[-1].t_s == pytest.approx(rows()[-1][0].t_s, abs=1e-3)
    assert (state.vehicle, state.simulated, state.mission, state.law) == (VEHICLE, True, "catch", "adaptive")
    with Listener(broker.port) as late:
        ended = late.wait(Topic.STATE, State)
        assert (ended.presence, ended.outcome, ended.session) == (Presence.ENDED, "completed", state.session)
        assert not ended.commands
        late.wait(Topic.EVENTS, Events)
        scene, preflight = late.wait(Topic.SCENE, Scene), late.wait(Topic.PREFLIGHT, Preflight)
        assert (scene.path_world_m, scene.mission_s) == (((0.0, 0.0, 0.3), (1.5, 0.0, 1.0)), 21.5)
        assert [(row.id, row.level, row.text) for row in preflight.rows] == [("px4", "ok", "well")]
        events = late.wait(Topic.EVENTS, Events)
        assert set(late.retained()) == RETAINED
    reported = [event.id for row in rows() for event in row[1].events]
    assert sorted(line.id for line in events.lines) == sorted([*reported, "px4"])
    assert events.count == len(reported) + 1
    log = FlightLog.read(flight.path)
    assert len(log.inputs) == len(rows())
    assert log.metadata["recorder"]["session"] == state.session
    # The log is closed before the last one leaves.
    assert int(log.metadata["recorder"]["stream_sent"]) >= len(streams) - 1
    lines = log_lines(flight.path)
    assert any("hold of anna: holding" in line for line in lines)
    assert any(f"connected to {broker.url}" in line for line in lines)


def test_a_killed_recorder_is_lost_by_the_brokers_word(tmp_path: Path, broker: Broker) -> None:
    with Listener(broker.port) as listener, flight_with(tmp_path, broker.url) as flight:
        flight.begin(listener)
        flying = listener.wait(Topic.STATE, State, lambda state: state.presence is Presence.FLYING)
        flight.recorder.process.kill()
        lost = listener.wait(Topic.STATE, State, lambda state: state.presence is Presence.LOST)
        assert (lost.session, lost.wall_s, lost.commands) == (flying.session, 0.0, False)
    with Listener(broker.port) as late:
        assert late.wait(Topic.STATE, State).presence is Presence.LOST


def test_a_flight_process_that_dies_is_silent_first_and_lost_with_its_channel(tmp_path: Path, broker: Broker) -> None:
    with Listener(broker.port) as listener, flight_with(tmp_path, broker.url) as flight:
        flight.begin(listener)
        flight.fly(200)
        listener.wait(Topic.STATE, State, lambda state: state.presence is Presence.FLYING)
        silent = listener.wait(Topic.STATE, State, lambda state: state.presence is Presence.SILENT)
        assert silent.text is not None and "guardian" in silent.text
        flight.fly(400)
        back = len(listener.of(Topic.STATE))
        wait_until(
            lambda: any(
                decode(State, payload).presence is Presence.FLYING for payload in listener.of(Topic.STATE)[back - 1 :]
            ),
            lambda: "the flight is not seen to go on",
        )
        os.close(os.dup(flight.recorder.client.fileno()))
        flight.recorder.client._socket.close()  # as the kernel does for a process that is gone
        lost = listener.wait(Topic.STATE, State, lambda state: state.presence is Presence.LOST)
        assert lost.wall_s > 0.0 and lost.text is not None and "without notice" in lost.text
        flight.recorder.process.wait(DEADLINE_S)
    assert len(FlightLog.read(flight.path).inputs) == 400


def test_a_broker_that_dies_and_comes_back_costs_no_sample_and_is_reported_everything_again(
    tmp_path: Path, broker: Broker
) -> None:
    with flight_with(tmp_path, broker.url) as flight:
        with Listener(broker.port) as listener:
            flight.begin(listener)
            flight.fly(700)
            listener.wait(Topic.EVENTS, Events, lambda events: events.count == 1)
            broker.kill()
        flight.wait(
            lambda: "no broker" in (flight.recorder.client.telemetry_status or ""),
            "the flight does not report the loss",
        )
        flight.fly(2500)
        broker.start()
        with Listener(broker.port) as listener:
            events = listener.wait(Topic.EVENTS, Events, lambda events: events.count >= 3)
            assert [line.id for line in events.lines] == ["phase_takeoff", "phase_flight", "catch"]
            state = listener.wait(Topic.STATE, State, lambda state: state.commands)
            listener.forget(Topic.STREAM)
            flight.begin(listener)
            assert listener.wait(Topic.SCENE, Scene).session == state.session
            flight.fly(3600)
            listener.wait(Topic.STREAM, Stream, lambda stream: stream.t_s > 17.0)
            flight.wait(
                lambda: (flight.recorder.client.telemetry_status or "").startswith("connected"),
                "the flight does not report the return",
            )
            flight.fly(len(rows()))
            report = flight.finish()
            listener.wait(Topic.STATE, State, lambda state: state.presence is Presence.ENDED)
    assert (report.samples, report.dropped, report.error) == (len(rows()), 0, None)
    log = FlightLog.read(flight.path)
    assert len(log.inputs) == len(rows())
    assert int(log.metadata["recorder"]["broker_connections"]) == 2
    reported = [line for line in log_lines(flight.path) if "broker at" in line or "connected to" in line]
    assert len(reported) == 3, reported


def test_a_broker_that_takes_nothing_costs_no_sample_and_holds_nobody(tmp_path: Path, broker: Broker) -> None:
    with Listener(broker.port) as listener, flight_with(tmp_path, broker.url) as flight:
        flight.begin(listener)
        broker.signal(signal.SIGSTOP)
        flight.fly(len(rows()))
        report = flight.finish()
        broker.signal(signal.SIGCONT)
        assert (report.samples, report.dropped, report.error) == (len(rows()), 0, None)
        # It could not receive the end in time: then the last word is the will's, or the end if it took that after all.
        listener.wait(Topic.STATE, State, lambda state: state.presence in (Presence.LOST, Presence.ENDED))
    assert len(FlightLog.read(flight.path).inputs) == len(rows())


def test_no_broker_at_all_is_reported_once_and_costs_no_sample(tmp_path: Path) -> None:
    url = f"mqtt://127.0.0.1:{free_port()}"
    with flight_with(tmp_path, url) as flight:
        flight.wait(lambda: flight.recorder.client.telemetry_status is not None, "the flight reports nothing")
        assert flight.recorder.client.telemetry_status == f"no broker at {url}, trying: Connection refused"
        # Its thread yields to everything; 10 s of ticks in a moment could be over before it has written its line.
        flight.wait(lambda: any("no broker" in line for line in log_lines(flight.path)), "not in the log")
        flight.fly(2000)
        report = flight.finish()
    assert (report.samples, report.dropped, report.error) == (2000, 0, None)
    assert sum("no broker" in line for line in log_lines(flight.path)) == 1
