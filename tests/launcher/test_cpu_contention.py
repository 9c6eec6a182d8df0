"""A busy computer is reported next to the events that it causes."""

from __future__ import annotations

import os
import subprocess
import sys

import pytest
from msgspec.structs import replace

from companion.launcher.cpu_contention import (
    CAUSED_BY_LATENESS,
    CpuContention,
    ProcessWait,
    contention_message,
    longest_wait,
    read_core_waits,
)
from companion.model.check_row import Level, Row
from companion.model.launcher_messages import FlightEvent, Message, PreflightDone, RefusedFlight
from companion.model.types import SafetyAction, Severity
from companion.preflight.evaluation import CHECKS
from companion.safety.rules import RULES
from tests.support import wait_until


@pytest.mark.parametrize(
    ("flight", "world", "late_s", "busy"),
    [
        (0.01, 0.02, 0.0003, False),  # a quiet computer
        (0.14, 0.14, 0.0049, False),
        (0.04, 0.04, 0.050, False),  # late by itself: nobody took its core
        (0.05, 0.37, 0.0034, True),  # measured: 16 busy programs on two cores, no joint state from the arm
        (0.16, 0.02, 0.0, True),
        (0.06, 0.02, 0.006, True),
    ],
)
def test_the_line_comes_by_the_schedulers_figures(flight: float, world: float, late_s: float, busy: bool) -> None:
    line = contention_message((ProcessWait("flight process", flight), ProcessWait("simulated world", world)), late_s)
    assert (line is not None) is busy


def test_the_line_says_how_long_who_waited_and_what_to_do() -> None:
    assert contention_message((ProcessWait("flight process", 0.123), ProcessWait("simulated world", 0.4)), 0.0231) == (
        "this computer is too busy (flight process waited 12 % of the time for a core, simulated world waited 40 % of the time for a "
        "core, ticks are 23 ms late); close other programs, or allow real-time priority (see docs/raspberry-pi.md, section Real time)"
    )


def test_nothing_is_said_where_the_kernel_does_not_count() -> None:
    assert contention_message((), 1.0) is None
    assert longest_wait("flight process", {}, {}, 3.0) == ProcessWait("flight process", 0.0)


def test_the_thread_that_waited_longest_speaks_for_its_process() -> None:
    wait = longest_wait("flight process", {1: 10.0, 2: 5.0, 3: 1.0}, {1: 10.3, 2: 6.5, 4: 99.0}, 3.0)
    assert wait.share == pytest.approx(0.5)


def test_every_id_that_lateness_may_cause_exists() -> None:
    known = {rule.id for rule in RULES} | {check.id for check in CHECKS} | {"guardian_took_over"}
    assert known >= CAUSED_BY_LATENESS


LOST = FlightEvent(
    tick=1, t_s=1.0, mission_t_s=0.0, id="arm_lost", severity=Severity.CRITICAL, action=SafetyAction.LAND, text=""
)
ROW = Row(id="arm.reads", title="", ok=False, read="")
REFUSED = RefusedFlight(("arm: no joint state",), device_failed=True)


@pytest.mark.parametrize(
    ("message", "judged"),
    [
        (LOST, True),
        (replace(LOST, id="guardian_took_over", action=SafetyAction.AUTOPILOT_LAND), True),
        (replace(LOST, action=SafetyAction.WARN, severity=Severity.WARNING), False),
        (replace(LOST, id="operator_land"), False),
        (PreflightDone((ROW,)), True),
        (PreflightDone((replace(ROW, level=Level.WARN), replace(ROW, ok=True))), False),
        (PreflightDone((replace(ROW, id="px4.battery"),)), False),
        (REFUSED, True),
        (RefusedFlight(("px4.battery: 3.2 V a cell",)), False),
    ],
    ids=str,
)
def test_it_is_judged_when_something_happens_that_lateness_may_cause(message: Message, judged: bool) -> None:
    waited_s = iter([1.0, 2.2])
    monitor = CpuContention({"flight process": 7}, lambda pid: {pid: next(waited_s)})
    monitor.sample(10.0)
    line = monitor.on_message(message, 13.0)
    assert (line is not None) is judged
    assert monitor.message == line
    if line is not None:
        assert "flight process waited 40 % of the time" in line
        assert monitor.on_message(message, 13.1) is None, "once is enough"


def test_a_process_that_has_ended_is_judged_by_its_last_sample() -> None:
    """The flight process ends when it reports a device that does not open."""
    reads = iter([{7: 1.0}, {7: 2.2}, {}])
    monitor = CpuContention({"flight process": 7}, lambda pid: next(reads))
    monitor.sample(10.0)
    monitor.sample(13.0)
    line = monitor.on_message(REFUSED, 13.0)
    assert line is not None
    assert "flight process waited 40 % of the time" in line


def test_programs_that_share_a_core_are_seen_to_wait() -> None:
    """Real processes and the real scheduler."""
    cpu = min(os.sched_getaffinity(0))
    spin = f"import os\nos.sched_setaffinity(0, [{cpu}])\nwhile True: pass"
    programs = [subprocess.Popen([sys.executable, "-c", spin]) for _ in range(2)]
    pid = programs[0].pid
    try:
        wait_until(
            lambda: sum(read_core_waits(pid).values()) > 0.5, lambda: f"it never waited: {read_core_waits(pid)}", 60.0
        )
    finally:
        for program in programs:
            program.kill()
            program.wait()
    assert read_core_waits(pid) == {}, "it is gone"
