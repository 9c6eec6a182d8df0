"""Cores of its own over real wires: the flight alone runs on them, and the terminal says what it got. It lifts nothing."""

from __future__ import annotations

import os
import re
import signal
from pathlib import Path

import pytest

from companion.model.exit_codes import EXIT_ABORTED
from tests.runtime.test_cores import CORES, affinities, several
from tests.support import HOVER, sandbox_in, set_options

pytestmark = pytest.mark.flight
OF = {
    "flight": "companion.flight.main",
    "guardian": "companion.guardian",
    "recorder": "companion.recorder.main",
    "world": "sitl",
    "launcher": "companion",
}


@several
def test_the_flight_alone_runs_on_its_cores(tmp_path: Path) -> None:
    own = CORES[-1]
    rest = frozenset(CORES) - {own}
    options = set_options(**{"vehicle.computer.cpus": [own], "vehicle.computer.lock_memory": False})
    with sandbox_in(tmp_path) as sandbox, sandbox.start("fly", HOVER, "--sitl", "--out", "out", *options) as flying:
        flying.wait_for("real time")
        memory = Path(f"/proc/{sandbox.pid_of(OF['flight'])}/status").read_text(encoding="ascii", errors="replace")
        assert re.search(r"^VmLck:\s+0 kB$", memory, re.MULTILINE), memory
        found = {name: affinities(sandbox.pid_of(module)) for name, module in OF.items()}
        flying.signal(signal.SIGINT)
        ended = flying.end()
        sandbox.assert_nobody_left()
    assert found == {name: {frozenset({own}) if name == "flight" else rest} for name in OF}
    assert ended.code == EXIT_ABORTED, ended
    told = re.search(r"real time +(.*)", ended.out)
    assert told is not None and f"CPUs {own};" in told[1], ended.out
    assert sorted(os.sched_getaffinity(0)) == CORES
