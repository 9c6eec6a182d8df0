"""A flight of the fast loop as the file that a flight leaves."""

from __future__ import annotations

import select
from pathlib import Path

from companion.analysis.log import FlightLog
from companion.recorder.client import RecorderProcess
from tests.support import DEADLINE_S


def record(log: FlightLog, path: Path) -> Path:
    """The log as a file, through the real recorder."""
    recorder = RecorderProcess.start(path, config_json=log.config_json or "", epoch_offset_ns=0, deadline_s=DEADLINE_S)
    for row in log.rows():
        # Faster than real time the channel would drop, as it must in flight; here every tick matters.
        select.select([], [recorder.client], [], DEADLINE_S)
        recorder.client.record(*row)
    report = recorder.finish(DEADLINE_S)
    assert (report.dropped, report.error) == (0, None)
    return path
