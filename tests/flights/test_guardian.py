"""A guardian that is missing refuses the flight, over real wires.

A flight process that it lands, after an error: test_lockstep.py; with the interpreter held: test_px4.py; killed:
tests/launcher/test_team.py. A guardian that dies in the air: test_shared_flight.py.
"""

from __future__ import annotations

import os
import signal
from pathlib import Path

from companion.analysis.log import FlightLog
from companion.model.exit_codes import EXIT_REFUSED
from tests.support import HOVER, hooked, read_summary, sandbox_in

FLY = ("fly", HOVER, "--sitl", "--out", "out")


def test_without_a_guardian_nothing_takes_off(tmp_path: Path) -> None:
    """It cannot even start: what it needs is broken."""
    broken = tmp_path / "packages"
    broken.mkdir()
    hook = "import sys\nif 'companion.guardian' in sys.orig_argv:\n    raise SystemExit('a broken guardian')\n"
    (broken / "sitecustomize.py").write_text(hook, encoding="utf-8")
    with sandbox_in(tmp_path / "sandbox", hooked(broken)) as sandbox:
        ended = sandbox.run(*FLY)
        sandbox.assert_nobody_left()
        summary = read_summary(sandbox.cwd / "out")
    assert ended.code == EXIT_REFUSED, ended.err
    assert "guardian: its process ended before it was ready" in ended.err
    assert summary["outcome"] == "refused"


def test_a_slow_computation_is_late_in_simulated_time_and_a_guardian_that_dies_before_take_off_refuses_the_flight(
    tmp_path: Path,
) -> None:
    """60 ms of processor time, tick after tick: as long as on a vehicle, although the world waits. In one tick alone it says nothing: a
    virtual machine that stands still for so long counts it as well.
    """
    hooks = tmp_path / "hooks"
    hooks.mkdir()
    (hooks / "sitecustomize.py").write_text(_SLOW, encoding="utf-8")
    with sandbox_in(tmp_path / "sandbox", hooked(hooks)) as sandbox:
        with sandbox.start(*FLY) as running:
            running.wait_for("  offboard\n")
            os.kill(int((sandbox.cwd / "out/guardian.pid").read_text()), signal.SIGKILL)
            ended = running.end()
        sandbox.assert_nobody_left()
        summary = read_summary(sandbox.cwd / "out")
        log = FlightLog.read(sandbox.cwd / "out/flight.mcap")
    assert ended.code == EXIT_REFUSED, ended.err
    ids = [event["id"] for event in summary["events"]]
    assert "guardian_lost" in ids
    assert "takeoff" not in ids
    alone = next(k for k, inputs in enumerate(log.inputs) if inputs.tick == 51)
    assert log.inputs[alone].t_s - log.inputs[alone - 1].t_s < 0.01
    slow = next(k for k, inputs in enumerate(log.inputs) if inputs.tick == 105)
    assert log.inputs[slow].t_s - log.inputs[slow - 1].t_s >= 0.06
    assert log.sent[slow].setpoint_sent_s - log.inputs[slow].t_s >= 0.06
    assert "loop_late" in [event.id for outputs in log.outputs for event in outputs.events]


_SLOW = """
import sys, time

if "companion.flight.main" in sys.orig_argv:
    import companion.core.flight_core

    class Slow(companion.core.flight_core.FlightCore):
        def step(self, inputs):
            if inputs.tick == 50 or 100 <= inputs.tick < 120:
                until_s = time.thread_time() + 0.06
                while time.thread_time() < until_s:
                    pass
            return super().step(inputs)

    companion.core.flight_core.FlightCore = Slow
"""
