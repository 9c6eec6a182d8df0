"""The recorder's channel shared with the guardian: its lines are logged, nothing is miscounted, and the flight closes the log."""

from __future__ import annotations

import os
import socket
from pathlib import Path

from mcap.reader import make_reader

from companion.model.codec import to_packet
from companion.model.packets import LogLine
from companion.model.types import Severity
from companion.recorder.client import RecorderProcess

GUARDIANS_LINE = to_packet(LogLine(t_s=1.5, severity=Severity.WARNING, source="guardian_land", text="of the guardian"))


def lines_of(path: Path) -> bytes:
    with open(path, "rb") as file:
        return b"".join(message.data for _, _, message in make_reader(file).iter_messages(topics=["/log"]))


def shared(path: Path) -> tuple[RecorderProcess, socket.socket]:
    recorder = RecorderProcess.start(path, config_json="{}", epoch_offset_ns=0)
    return recorder, socket.socket(fileno=os.dup(recorder.client.fileno()))


def test_the_flight_closes_the_log_though_the_guardian_holds_the_channel(tmp_path: Path) -> None:
    recorder, guardian = shared(tmp_path / "flight.mcap")
    with guardian:
        recorder.client.text(1.0, Severity.INFO, "flight", "of the flight")
        guardian.send(GUARDIANS_LINE)
        recorder.client.text(2.0, Severity.INFO, "flight", "of the flight again")
        report = recorder.finish()
    assert (report.error, report.dropped) == (None, 0)
    assert lines_of(tmp_path / "flight.mcap").count(b"of the") == 3


def test_the_log_ends_with_the_guardian_when_the_flight_is_dead(tmp_path: Path) -> None:
    recorder, guardian = shared(tmp_path / "flight.mcap")
    with guardian:
        recorder.client._socket.close()  # as the kernel does it for a process that was killed
        guardian.send(GUARDIANS_LINE)
        assert recorder.process.poll() is None
    assert recorder.process.wait(20.0) == 0
    assert recorder.process.stdout is not None
    recorder.process.stdout.close()
    assert b"of the guardian" in lines_of(tmp_path / "flight.mcap")
