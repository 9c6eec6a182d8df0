from __future__ import annotations

import json
import os
import resource
import select
import signal
import socket
import subprocess
import sys
import time
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import msgspec
import pytest
from mcap.exceptions import EndOfFile
from mcap.reader import NonSeekingReader, make_reader

from companion.io.protocols import DeviceError
from companion.model.codec import differences, from_json
from companion.model.outputs import Outputs, Sent
from companion.model.packets import CommandAnswer, read_packet
from companion.model.types import (
    AutopilotRequest,
    Event,
    GroundCommand,
    Inputs,
    OperatorCommand,
    PhaseKind,
    SafetyAction,
    Severity,
)
from companion.recorder.client import RecorderClient, RecorderProcess, epoch_offset_ns
from tests.analysis.synthetic_flight import sent_at
from tests.support import DEADLINE_S, level_pose

EPOCH_NS = 1_700_000_000_000_000_000


def asked(command: OperatorCommand) -> GroundCommand:
    return GroundCommand(command=command, operator="anna", nonce="a1", hold=0, t_s=1.0)


def tick(k: int, text: str = "") -> tuple[Inputs, Outputs, Sent]:
    t_s = k * 0.005
    pose = level_pose(t_s, frame_number=k, position_world_m=(0.1 * k, 1 / 3, 1.0))
    events = (
        (Event(t_s=t_s, id="note", severity=Severity.WARNING, action=SafetyAction.WARN, text=text),) if text else ()
    )
    return (
        Inputs(tick=k, t_s=t_s, mocap=pose, command=OperatorCommand.NONE, recorder_dropped=0),
        Outputs(
            tick=k,
            t_s=t_s,
            mission_t_s=0.0,
            phase="ground",
            phase_kind=PhaseKind.GROUND,
            progress=0.0,
            request=AutopilotRequest.NONE,
            action=SafetyAction.NOMINAL,
            events=events,
            mocap_trusted=True,
            limited_by=(),
        ),
        sent_at(k, t_s),
    )


def offer(recorder: RecorderProcess, ticks: range) -> None:
    for k in ticks:
        select.select([], [recorder.client], [], DEADLINE_S)
        recorder.client.record(*tick(k))


def started(directory: Path) -> RecorderProcess:
    return RecorderProcess.start(
        directory / "flight.mcap",
        config_json='{"a": 0.1}',
        epoch_offset_ns=EPOCH_NS,
        metadata={"mission": "catch"},
        deadline_s=DEADLINE_S,
    )


@pytest.fixture
def recorder(tmp_path: Path) -> Iterator[RecorderProcess]:
    recorder = started(tmp_path)
    yield recorder
    recorder.finish(DEADLINE_S)


def rows(path: Path, topic: str) -> list[Any]:
    """Return messages read with the mcap library, through the summary of the closed file."""
    with path.open("rb") as file:
        return [(m.log_time, json.loads(m.data)) for _, _, m in make_reader(file).iter_messages(topics=[topic])]


def readable_ticks(path: Path) -> list[int]:
    """Return the ticks of a file that may lack its end, read with the mcap library's streaming reader."""
    ticks: list[int] = []
    with path.open("rb") as file:
        try:
            for _, _, message in NonSeekingReader(file).iter_messages(topics=["/inputs"], log_time_order=False):
                ticks.append(json.loads(message.data)["tick"])
        except EndOfFile:
            pass
    return ticks


def test_every_tick_is_in_the_log_with_its_stamp_schema_and_metadata(recorder: RecorderProcess) -> None:
    offer(recorder, range(500))
    recorder.client.text(1.0, Severity.INFO, "px4", "hello")
    recorder.client.metadata("autopilot", {"firmware": "1.16.1"})
    report = recorder.finish(DEADLINE_S)
    assert (report.samples, report.dropped, report.error) == (500, 0, None)
    for topic, cls, part in (("/inputs", Inputs, 0), ("/outputs", Outputs, 1), ("/sent", Sent, 2)):
        found = rows(recorder.path, topic)
        assert len(found) == 500
        for k, (log_time, data) in enumerate(found):
            assert log_time == EPOCH_NS + k * 5_000_000
            assert differences(from_json(cls, json.dumps(data).encode()), tick(k)[part]) is None
    with recorder.path.open("rb") as file:
        reader = make_reader(file)
        summary = reader.get_summary()
        metadata = {record.name: record.metadata for record in reader.iter_metadata()}
    assert summary is not None
    assert {schema.name for schema in summary.schemas.values()} >= {"companion.Inputs", "foxglove.FrameTransform"}
    assert {channel.topic for channel in summary.channels.values()} >= {"/inputs", "/outputs", "/sent", "/tf", "/log"}
    assert metadata["config"] == {"json": '{"a": 0.1}'}
    assert metadata["flight"] == {"mission": "catch"}
    assert metadata["autopilot"] == {"firmware": "1.16.1"}
    assert metadata["recorder"] == {"samples": "500", "dropped": "0"}
    assert {"version_python", "version_numpy", "version_mavsdk", "epoch_offset_ns"} <= metadata["companion"].keys()


def test_events_and_answers_reach_the_log_channel_for_people_and_count_as_packets(recorder: RecorderProcess) -> None:
    recorder.client.record(*tick(0, "something odd"))
    offer(recorder, range(1, 10))
    recorder.client.ack(asked(OperatorCommand.LAND), True, "landing", tick(9)[1])
    offer(recorder, range(10, 20))
    report = recorder.finish(DEADLINE_S)
    assert (report.samples, report.dropped, report.error) == (20, 0, None)
    with recorder.path.open("rb") as file:
        odd, answer = [m.data for _, _, m in make_reader(file).iter_messages(topics=["/log"])]
    assert b"something odd" in odd
    assert b"anna" in answer and b"landing" in answer


def test_a_full_channel_drops_and_counts_without_waiting() -> None:
    ours, theirs = socket.socketpair(socket.AF_UNIX, socket.SOCK_SEQPACKET)
    with theirs:
        client = RecorderClient(ours)
        offered = 0
        while client.dropped < 100:  # there is no reader: every call must return
            client.record(*tick(offered))
            offered += 1
        assert client.samples + client.dropped == offered
        assert client.samples > 50
        client.close()


def test_dropped_ticks_are_counted_by_the_recorder_too(recorder: RecorderProcess) -> None:
    os.kill(recorder.process.pid, signal.SIGSTOP)
    offered = 0
    while recorder.client.dropped < 50:
        recorder.client.record(*tick(offered))
        offered += 1
    os.kill(recorder.process.pid, signal.SIGCONT)
    offer(recorder, range(offered, offered + 1))
    report = recorder.finish(DEADLINE_S)
    assert report.error is None
    assert (report.samples, report.dropped) == (offered + 1 - 50, 50)
    assert len(rows(recorder.path, "/inputs")) == report.samples


def test_a_dead_recorder_does_not_touch_the_flight(recorder: RecorderProcess) -> None:
    offer(recorder, range(10))
    assert not recorder.client.gone
    recorder.process.kill()
    recorder.process.wait(DEADLINE_S)
    assert not recorder.client.record(*tick(10))
    recorder.client.text(0.0, Severity.INFO, "x", "y")
    assert recorder.client.gone and recorder.client.take_commands() == []
    report = recorder.finish(DEADLINE_S)
    assert (report.samples, report.dropped) == (10, 2)
    assert report.error is not None
    assert "recorder process has ended" in report.error


def test_a_killed_recorder_leaves_a_log_that_lacks_at_most_its_last_moment(recorder: RecorderProcess) -> None:
    offer(recorder, range(400))
    # Two seconds of ticks are offered at once; then silence, in which the recorder flushes.
    deadline_s = time.monotonic() + DEADLINE_S
    while len(readable_ticks(recorder.path)) < 400:
        assert time.monotonic() < deadline_s, "the recorder does not flush while the channel is silent"
        select.select([], [], [], 0.05)
    recorder.process.kill()
    recorder.process.wait(DEADLINE_S)
    assert readable_ticks(recorder.path) == list(range(400))


FLIGHT = """
import os, sys, time
sys.path.insert(0, sys.argv[2])
from pathlib import Path
from companion.recorder.client import RecorderProcess
from tests.recorder.test_recorder import tick, EPOCH_NS
from tests.support import DEADLINE_S
recorder = RecorderProcess.start(Path(sys.argv[1]), config_json="{}", epoch_offset_ns=EPOCH_NS, deadline_s=60.0)
print(recorder.process.pid, flush=True)
k = 0
while True:
    recorder.client.record(*tick(k))
    os.write(1, b"%d\\n" % k)
    k += 1
    time.sleep(0.005)
"""


def test_the_log_of_a_flight_killed_by_9_is_closed_and_whole(tmp_path: Path) -> None:
    path = tmp_path / "flight.mcap"
    command = [sys.executable, "-c", FLIGHT, str(path), str(Path(__file__).parents[2])]
    with subprocess.Popen(command, stdout=subprocess.PIPE, text=True) as flight:
        assert flight.stdout is not None
        recorder_pid = int(flight.stdout.readline())
        pidfd = os.pidfd_open(recorder_pid)
        recorded = -1
        while recorded < 200:
            recorded = int(flight.stdout.readline())
        flight.kill()
        recorded = int([str(recorded), *flight.stdout.read().split()][-1])
    ended, _, _ = select.select([pidfd], [], [], DEADLINE_S)
    os.close(pidfd)
    assert ended, "the recorder did not end by itself"
    ticks = [data["tick"] for _, data in rows(path, "/sent")]
    # What was handed over before the kill is there; one more tick may have gone out unreported.
    assert ticks == list(range(len(ticks)))
    assert len(ticks) - 1 in (recorded, recorded + 1)


def test_a_full_disk_is_said_once_and_the_log_so_far_is_kept(tmp_path: Path, capfd: pytest.CaptureFixture[str]) -> None:
    recorder = started(tmp_path)
    resource.prlimit(recorder.process.pid, resource.RLIMIT_FSIZE, (2**19, 2**19))  # some chunks
    offered = 0
    deadline_s = time.monotonic() + DEADLINE_S
    while recorder.client.error is None:
        assert time.monotonic() < deadline_s, "the flight reports nothing"
        offer(recorder, range(offered, offered + 100))
        offered += 100
    reported = recorder.client.error
    offer(recorder, range(offered, offered + 100))
    offered += 100
    report = recorder.finish(DEADLINE_S)
    readable = readable_ticks(recorder.path)
    assert report.error is not None
    assert "File too large" in report.error
    assert str(recorder.path) in report.error
    assert readable == list(range(report.samples))
    assert 0 < report.samples < offered
    assert report.samples + report.dropped == offered
    assert reported == report.error
    assert capfd.readouterr().err.count("File too large") == 1


@pytest.mark.parametrize("number", [signal.SIGINT, signal.SIGHUP])
def test_sigterm_closes_the_log_and_ctrl_c_and_a_closed_terminal_do_not(
    recorder: RecorderProcess, number: signal.Signals
) -> None:
    offer(recorder, range(50))
    recorder.process.send_signal(number)
    offer(recorder, range(50, 100))
    recorder.process.send_signal(signal.SIGTERM)
    recorder.process.wait(DEADLINE_S)
    assert [data["tick"] for _, data in rows(recorder.path, "/inputs")] == list(range(100))


def test_an_impossible_path_is_refused_in_one_line_before_the_flight(tmp_path: Path) -> None:
    taken = tmp_path / "taken.mcap"
    taken.touch()
    for path, reason in ((tmp_path / "no" / "where.mcap", "No such file"), (taken, "already exists")):
        with pytest.raises(DeviceError) as refusal:
            RecorderProcess.start(path, config_json="{}", epoch_offset_ns=0, deadline_s=DEADLINE_S)
        assert str(path) in str(refusal.value)
        assert reason in str(refusal.value)
        assert "\n" not in str(refusal.value)


def test_a_record_that_cannot_be_written_is_counted_and_named(recorder: RecorderProcess) -> None:
    inputs, outputs, sent = tick(0)
    broken = Outputs(**{**{f: getattr(outputs, f) for f in Outputs.__struct_fields__}, "events": None})
    recorder.client.record(inputs, broken, sent)
    offer(recorder, range(1, 3))
    report = recorder.finish(DEADLINE_S)
    assert (report.samples, report.dropped) == (2, 1)
    assert report.error is not None
    assert "packet 0 could not be written" in report.error


@pytest.mark.parametrize("value", [object(), 2**70], ids=["object", "huge"])
def test_a_record_that_cannot_be_packed_is_counted_and_never_reaches_the_control_tick(value: object) -> None:
    ours, theirs = socket.socketpair(socket.AF_UNIX, socket.SOCK_SEQPACKET)
    with ours, theirs:
        client = RecorderClient(ours)
        inputs, outputs, sent = tick(0)
        broken = msgspec.structs.replace(outputs, progress=value)
        assert not client.record(inputs, broken, sent)
        assert client.record(inputs, outputs, sent)
        assert (client.samples, client.dropped) == (1, 1)
        assert client.error is not None and "could not be packed" in client.error


def test_epoch_offset_is_the_wall_clock_at_zero_of_the_flight_clock() -> None:
    before_ns = time.time_ns()
    offset_ns = epoch_offset_ns(10.0)
    assert before_ns <= offset_ns + 10_000_000_000 <= time.time_ns()


# -- what the recorder tells -----------------------------------------------------------------------------------------


@pytest.fixture
def channel() -> Iterator[tuple[RecorderClient, socket.socket]]:
    """The flight's end of a channel, and the recorder's end as a bare socket."""
    ours, theirs = socket.socketpair(socket.AF_UNIX, socket.SOCK_SEQPACKET)
    client = RecorderClient(ours)
    with theirs:
        yield client, theirs
    client.close()


def say(recorder: socket.socket, **message: object) -> None:
    recorder.send(json.dumps(message).encode())


def test_commands_are_heard_in_the_tick_in_which_they_are_there(channel: tuple[RecorderClient, socket.socket]) -> None:
    client, recorder = channel
    say(recorder, command="hold", operator="anna", nonce="a1", hold=0, t_s=1.0)
    say(recorder, command="resume", operator="bob", nonce="b2", hold=3, t_s=2.0)
    client.record(*tick(0))
    assert client.take_commands() == [
        asked(OperatorCommand.HOLD),
        GroundCommand(command=OperatorCommand.RESUME, operator="bob", nonce="b2", hold=3, t_s=2.0),
    ]
    client.record(*tick(1))
    assert client.take_commands() == []


def test_more_than_fit_into_a_tick_wait_for_the_next_and_none_is_lost(
    channel: tuple[RecorderClient, socket.socket],
) -> None:
    client, recorder = channel
    for number in range(40):
        say(recorder, command="hold", operator="anna", nonce=str(number), hold=0, t_s=1.0)
    heard = []
    for k in range(3):
        client.record(*tick(k))
        heard.append([int(asked.nonce) for asked in client.take_commands()])
    assert [len(nonces) for nonces in heard] == [16, 16, 8]
    assert [number for nonces in heard for number in nonces] == list(range(40))


@pytest.mark.parametrize(
    "message",
    [
        b"no json",
        b"\xff\xfe",
        b"[1, 2]",
        b"null",
        b'{"command": "hold"}',
        b'{"command": "none", "operator": "anna", "nonce": "1"}',
        b'{"command": "fall", "operator": "anna", "nonce": "1"}',
        b'{"command": ["hold"], "operator": "anna", "nonce": "1"}',
        b'{"command": "hold", "operator": null, "nonce": "1"}',
        b'{"error": 7}',
        b'{"ground": {}}',
        b"[" * 4000,
    ],
)
def test_what_cannot_be_understood_is_nothing(channel: tuple[RecorderClient, socket.socket], message: bytes) -> None:
    client, recorder = channel
    recorder.send(message)
    say(recorder, ground="connected")
    client.record(*tick(0))
    assert (client.take_commands(), client.error, client.telemetry_status) == ([], None, "connected")


def test_an_error_and_the_way_to_the_ground_are_known_the_newest_counts(
    channel: tuple[RecorderClient, socket.socket],
) -> None:
    client, recorder = channel
    say(recorder, ground="connected to mqtt://127.0.0.1:1883")
    say(recorder, error="recorder: full")
    say(recorder, ground="not connected")
    client.record(*tick(0))
    assert (client.telemetry_status, client.error, client.gone) == ("not connected", "recorder: full", False)


def test_an_answer_is_a_packet_in_its_turn(channel: tuple[RecorderClient, socket.socket]) -> None:
    client, recorder = channel
    client.record(*tick(0))
    client.ack(asked(OperatorCommand.HOLD), True, "holding", tick(250)[1])
    recorder.recv(2**20)
    assert read_packet(recorder.recv(2**20)) == CommandAnswer(
        number=1,
        nonce="a1",
        operator="anna",
        command=OperatorCommand.HOLD,
        accepted=True,
        text="holding",
        t_s=1.25,
        phase="ground",
        action=SafetyAction.NOMINAL,
    )
