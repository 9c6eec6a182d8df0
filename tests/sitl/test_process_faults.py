"""Faults of the flight process: their effect on a process, and the world's report."""

from __future__ import annotations

import os
import signal
import subprocess
import sys
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

import pytest

from sitl.autopilot.modes import NavState
from sitl.faults.processes import FlightFaultKind, ProcessFaults, environment, inject_process_fault
from tests.support import DEADLINE_S, wait_until

START = (1.0, 2.0, 1.5)
LEVEL = (1.0, 0.0, 0.0, 0.0)
# A thread beside a main thread that ticks: each writes its own letter. The names are those of the real flight process.
_FLIGHT = """
import os, sys, threading, time
def beside():
    while True:
        os.write(1, b"t")
        time.sleep(0.005)
threading.Thread(target=beside, daemon=True).start()
while True:
    os.write(1, b"m")
    time.sleep(0.005)
"""


@contextmanager
def flight_process(kind: FlightFaultKind) -> Iterator[subprocess.Popen[bytes]]:
    """A process with the flight process's arguments and the hooks for this fault."""
    process = subprocess.Popen(
        [sys.executable, "-c", _FLIGHT, "companion.flight.main"],
        stdout=subprocess.PIPE,
        env={**os.environ, **environment({kind})},
    )
    assert process.stdout is not None
    os.set_blocking(process.stdout.fileno(), False)
    try:
        yield process
    finally:
        process.kill()
        process.wait(DEADLINE_S)
        process.stdout.close()


def letters(process: subprocess.Popen[bytes]) -> set[str]:
    """Return which threads have written since the last call."""
    assert process.stdout is not None
    return set((process.stdout.read() or b"").decode())


@pytest.mark.parametrize(
    ("kind", "left"), [("kill_flight", ""), ("stop_flight", ""), ("hold_gil", ""), ("stall_loop", "t")]
)
def test_which_threads_still_run(kind: FlightFaultKind, left: str) -> None:
    with flight_process(kind) as process:
        seen: set[str] = set()

        def both() -> bool:
            seen.update(letters(process))
            return seen == {"m", "t"}

        wait_until(both, lambda: f"only {seen} run")
        faults = ProcessFaults()
        faults.pid = process.pid
        assert faults.inject(kind, 5.0, START, 100)
        # After a hundred letters of the thread, or a spell without any, the main thread has had every chance.
        spells = 0
        while "m" in (found := letters(process)) or spells < 5:
            spells += "m" not in found
            try:
                process.wait(0.05)
            except subprocess.TimeoutExpired:
                continue
        assert letters(process) <= set(left)
        if left:
            wait_until(lambda: letters(process) == {"t"}, lambda: "the thread does not run on")
        state = (
            Path(f"/proc/{process.pid}/stat").read_text().rpartition(")")[2].split()[0]
            if process.poll() is None
            else "-"
        )
        assert (state == "T") == (kind == "stop_flight")
        assert (process.poll() == -signal.SIGKILL) == (kind == "kill_flight")


def test_hooks_only_where_they_are_needed() -> None:
    assert environment({"kill_flight", "stop_flight", "mocap_loss"}) == {}
    assert "faults/hang" in environment({"hold_gil"})["PYTHONPATH"]
    assert environment({"stall_loop"}, 0.2)["COMPANION_SITL_STALL_S"] == "0.2"
    done = subprocess.run(
        [sys.executable, "-c", "import signal; print(signal.getsignal(signal.SIGUSR1) is signal.SIG_DFL)"],
        env={**os.environ, **environment({"hold_gil"})},
        capture_output=True,
        text=True,
        check=True,
    )
    assert done.stdout == "True\n", "another process is left alone"


@pytest.fixture
def injected() -> Iterator[ProcessFaults]:
    with subprocess.Popen([sys.executable, "-c", "input()"], stdin=subprocess.PIPE) as process:
        faults = ProcessFaults()
        faults.pid = process.pid
        assert faults.inject("stop_flight", 5.0, START, 100)
        assert not faults.inject("kill_flight", 5.1, START, 100), "once"
        yield faults
        process.kill()


def test_the_report_shows_late_setpoints_a_gap_in_vision_and_drift(injected: ProcessFaults) -> None:
    poses = 100
    for k in range(1, 2001):
        t_s = 5.0 + 0.002 * k
        setpoint_at_s = 5.0 + min(0.002 * k, 0.3)  # a stale setpoint is re-sent for 0.3 s
        poses += t_s < 5.05 or t_s > 5.45
        nav_state = NavState.LAND if t_s > 5.8 else NavState.OFFBOARD
        if injected.watch(t_s, setpoint_at_s, poses, nav_state, armed=t_s < 8.0):
            injected.sample((1.0 + 0.3 * min(1.0, t_s - 5.0), 2.0 - 0.4 * min(1.0, t_s - 5.0), 1.0), LEVEL)
    report = injected.report()
    assert report is not None
    assert report["last_setpoint_s"] == pytest.approx(0.3)
    assert report["vision_gap_s"] == pytest.approx(0.4, abs=0.005)
    assert report["vision_back_s"] == pytest.approx(0.45, abs=0.005)
    assert report["land_s"] == pytest.approx(0.8, abs=0.005)
    assert report["disarmed_s"] == pytest.approx(3.0, abs=0.005)
    assert report["drift_m"] == pytest.approx(0.5)


_WRITER = """
import sys
with open(sys.argv[2], "wb", buffering=0) as file:
    file.write(b"before")
    print("ready", flush=True)
    sys.stdin.readline()
    try:
        file.write(b"after")
    except OSError as error:
        print(error.errno, flush=True)
"""


@pytest.fixture
def recorder(tmp_path: Path) -> Iterator[subprocess.Popen[str]]:
    """A child process with the recorder's command line that writes on request."""
    command = [sys.executable, "-c", _WRITER, "companion.recorder.main", str(tmp_path / "log")]
    process = subprocess.Popen(command, stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True)
    try:
        assert process.stdout is not None
        assert process.stdout.readline() == "ready\n"
        yield process
    finally:
        process.kill()
        process.communicate(timeout=DEADLINE_S)


def test_on_a_full_disk_the_recorder_alone_cannot_write(recorder: subprocess.Popen[str], tmp_path: Path) -> None:
    assert inject_process_fault("disk_full", os.getpid())
    out, _ = recorder.communicate("\n", timeout=DEADLINE_S)
    assert out.strip().isdigit(), "its write went through"
    assert (tmp_path / "log").read_bytes() == b"before"
    (tmp_path / "other").write_bytes(b"x" * 10_000)


def test_the_recorder_is_found_among_the_children_and_killed(recorder: subprocess.Popen[str]) -> None:
    assert inject_process_fault("kill_recorder", os.getpid())
    assert recorder.wait(DEADLINE_S) == -9
    assert not inject_process_fault("kill_recorder", os.getpid()), "there is none any more"
