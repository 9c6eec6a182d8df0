"""The flight's own cores: what is not the flight keeps off them, and without another core it stays where it is."""

from __future__ import annotations

import json
import os
import subprocess
import sys
from pathlib import Path

import pytest
from hypothesis import given
from hypothesis import strategies as st

from companion.config.loader import load_flight
from companion.recorder.client import RecorderProcess
from companion.runtime.cores import listed, others, usable_cpus
from tests.support import HOVER

CORES = sorted(os.sched_getaffinity(0))
several = pytest.mark.skipif(len(CORES) < 2, reason="this computer has one core")
SETS = st.frozensets(st.integers(0, 7))


def affinities(pid: int) -> set[frozenset[int]]:
    """Of all threads of a process."""
    return {frozenset(os.sched_getaffinity(int(thread.name))) for thread in Path(f"/proc/{pid}/task").iterdir()}


def test_the_cores_are_found_on_a_thread_of_their_own() -> None:
    assert set(usable_cpus()) >= set(CORES)
    assert sorted(os.sched_getaffinity(0)) == CORES


@several
def test_usable_cores_include_those_outside_the_own_affinity_mask() -> None:
    ask = f"import os; os.sched_setaffinity(0, {{{CORES[0]}}}); "
    ask += "from companion.runtime.cores import usable_cpus; print(list(usable_cpus()))"
    ended = subprocess.run([sys.executable, "-c", ask], capture_output=True, text=True, check=True)
    assert json.loads(ended.stdout) == list(usable_cpus())


@given(own=SETS, now=SETS, usable=SETS)
def test_the_others_are_never_the_flights_own(own: frozenset[int], now: frozenset[int], usable: frozenset[int]) -> None:
    found = others(own, now, usable)
    assert not found & own
    assert found <= now | usable
    if now - own:
        assert found in (now - own, frozenset()) and bool(found) == bool(now & own)


@pytest.mark.parametrize(
    ("own", "now", "usable", "found"),
    [
        ({2, 3}, {0, 1, 2, 3}, {0, 1, 2, 3}, {0, 1}),
        ({2, 3}, {0, 1}, {0, 1, 2, 3}, set()),  # isolcpus=2,3: it is off them already
        ({2, 3}, {2, 3}, {0, 1, 2, 3}, {0, 1}),  # a service with CPUAffinity=2,3
        ({2, 3}, {1, 2, 3}, {0, 1, 2, 3}, {1}),  # started by taskset: no further than it was sent
        ({0, 1}, {0, 1}, {0, 1}, set()),
    ],
)
def test_other_processes_get_the_usable_cores_that_the_flight_does_not_use(
    own: set[int], now: set[int], usable: set[int], found: set[int]
) -> None:
    assert others(own, now, usable) == found


def test_cores_are_written_as_the_kernel_writes_them() -> None:
    assert [listed(cpus) for cpus in ((), (3,), (1, 0), (0, 2, 3, 4, 7))] == ["", "3", "0-1", "0,2-4,7"]


@several
def test_a_process_keeps_off_with_all_its_threads_and_what_it_starts() -> None:
    own = CORES[-1]
    program = f"""
import json, os, subprocess, sys, threading
from pathlib import Path
from companion.runtime.cores import keep_off
done = threading.Event()
thread = threading.Thread(target=done.wait)
thread.start()
keep_off([{own}])
here = [sorted(os.sched_getaffinity(int(task.name))) for task in Path("/proc/self/task").iterdir()]
done.set()
child = subprocess.run([sys.executable, "-c", "import os; print(sorted(os.sched_getaffinity(0)))"], capture_output=True, text=True)
keep_off({CORES})
print(json.dumps([*here, json.loads(child.stdout), sorted(os.sched_getaffinity(0))]))
"""
    ended = subprocess.run([sys.executable, "-c", program], capture_output=True, text=True, check=True)
    rest = [core for core in CORES if core != own]
    *moved, stayed = json.loads(ended.stdout)
    assert len(moved) >= 3 and all(cpus == rest for cpus in moved)
    assert stayed == rest, "there is nowhere else to go"


@several
def test_the_recorder_leaves_the_cores_of_the_flight_that_starts_it(tmp_path: Path) -> None:
    own = CORES[-1]
    config = load_flight(HOVER, overrides=[f"vehicle.computer.cpus=[{own}]", "vehicle.ground.mqtt=null"])
    os.sched_setaffinity(0, {own})
    try:
        recorder = RecorderProcess.start(tmp_path / "a.mcap", config_json=config.model_dump_json(), epoch_offset_ns=0)
    finally:
        os.sched_setaffinity(0, CORES)
    try:
        found = affinities(recorder.process.pid)
    finally:
        report = recorder.finish()
    assert found and all(own not in cpus for cpus in found)
    assert report.error is None


def test_a_recorder_whose_configuration_names_no_cores_stays(tmp_path: Path) -> None:
    recorder = RecorderProcess.start(tmp_path / "a.mcap", config_json="{}", epoch_offset_ns=0)
    found = affinities(recorder.process.pid)
    assert recorder.finish().error is None
    assert found == {frozenset(CORES)}
