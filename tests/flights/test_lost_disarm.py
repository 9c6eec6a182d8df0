"""A request to disarm leaves as one datagram, which may be lost: over real wires the next one goes out and the flight ends disarmed."""

from __future__ import annotations

import os
from pathlib import Path

import pytest

from companion.analysis.log import FlightLog
from companion.model.exit_codes import EXIT_OK
from tests.support import HOVER, read_summary, sandbox_in

_DEAF_ONCE = """
import sys

if "sitl" in sys.orig_argv:
    from sitl.autopilot.receive import Receiver

    class Heard:
        disarms = 0

    handle = Receiver.handle

    def deaf_once(self, link, message):
        if message.get_type() == "COMMAND_LONG" and message.command == 400 and message.param1 == 0.0:
            Heard.disarms += 1
            with open({file!r}, "w") as file:
                file.write(str(Heard.disarms))
            if Heard.disarms == 1:
                return
        handle(self, link, message)

    Receiver.handle = deaf_once
"""


@pytest.mark.flight
def test_a_lost_request_to_disarm_is_made_again_and_the_flight_ends_disarmed(tmp_path: Path) -> None:
    (tmp_path / "sitecustomize.py").write_text(_DEAF_ONCE.format(file=str(tmp_path / "disarms")), encoding="utf-8")
    path = os.pathsep.join(filter(None, (str(tmp_path), os.environ.get("PYTHONPATH"))))
    with sandbox_in(tmp_path / "sandbox", {"PYTHONPATH": path}) as sandbox:
        ended = sandbox.run("fly", HOVER, "--sitl", "--out", "out")
        sandbox.assert_nobody_left()
        summary, log = read_summary(sandbox.cwd / "out"), FlightLog.read(sandbox.cwd / "out/flight.mcap")
    assert ended.code == EXIT_OK, (ended.out, ended.err)
    assert int((tmp_path / "disarms").read_text(encoding="utf-8")) >= 2, "the first one was lost"
    assert summary["outcome"] == "completed"
    status = log.inputs[-1].status
    assert status is not None and not status.armed
