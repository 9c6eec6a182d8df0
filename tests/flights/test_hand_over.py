"""A slow computation on the ground, and an error of our own in mid-air, without a guardian: the flight process hands the vehicle to PX4
and still feeds it motion capture.
"""

from __future__ import annotations

import os
import signal
from pathlib import Path

from companion.analysis.log import FlightLog
from companion.model.exit_codes import EXIT_ABORTED
from tests.support import HOVER, hooked, read_summary, sandbox_in, set_options


def test_a_slow_computation_is_late_in_simulated_time_and_an_internal_error_in_the_air_lands_by_px4(
    tmp_path: Path,
) -> None:
    """60 ms of processor time, tick after tick: as long as on a vehicle, although the world waits. In one tick alone it says nothing: a
    virtual machine that stands still for so long counts it as well.

    A full disk under flight.log costs the traceback, not the landing. With room on it, it is there: tests/launcher/test_team.py.
    """
    hooks = tmp_path / "hooks"
    hooks.mkdir()
    (hooks / "sitecustomize.py").write_text(_BREAKING, encoding="utf-8")
    hovers = set_options(**{"mission.phases[1].duration_s": 60.0})
    with sandbox_in(tmp_path / "sandbox", hooked(hooks)) as sandbox:
        out = sandbox.cwd / "out"
        with sandbox.start("fly", HOVER, "--sitl", "--out", "out", *hovers) as running:
            running.wait_for("  take-off\n")
            os.kill(int((out / "guardian.pid").read_text()), signal.SIGKILL)
            ended = running.end()
        sandbox.assert_nobody_left()
        log, summary = FlightLog.read(out / "flight.mcap"), read_summary(out)
    assert ended.code == EXIT_ABORTED, ended
    assert ended.err_lines == ["guardian: the guardian process was ended by SIGKILL; see out/guardian.log"]
    assert [event["id"] for event in summary["events"]] == ["loop_late", "takeoff", "guardian_lost"], (
        "the core ended in the air"
    )
    assert summary["outcome"] == "aborted", "PX4 stands disarmed, and the world saw no crash"
    assert log.closed and log.outputs[-1].mission_t_s > 1.0
    alone = next(k for k, inputs in enumerate(log.inputs) if inputs.tick == 51)
    assert log.inputs[alone].t_s - log.inputs[alone - 1].t_s < 0.01
    slow = next(k for k, inputs in enumerate(log.inputs) if inputs.tick == 105)
    assert log.inputs[slow].t_s - log.inputs[slow - 1].t_s >= 0.06
    assert log.sent[slow].setpoint_sent_s - log.inputs[slow].t_s >= 0.06


_BREAKING = """
import sys, time

if "companion.flight.main" in sys.orig_argv:
    import companion.core.flight_core

    sys.stderr = open("/dev/full", "w")

    class Breaking(companion.core.flight_core.FlightCore):
        alone = False

        def step(self, inputs):
            if inputs.tick == 50 or 100 <= inputs.tick < 108:
                until_s = time.thread_time() + 0.06
                while time.thread_time() < until_s:
                    pass
            outputs = super().step(inputs)
            self.alone = self.alone or any(event.id == "guardian_lost" for event in outputs.events)
            if self.alone and outputs.mission_t_s > 1.2:
                raise ZeroDivisionError("a bug")
            return outputs

    companion.core.flight_core.FlightCore = Breaking
"""
