"""The launcher outlives its children and leaves nothing behind: Ctrl-C, a killed launcher.

A flight that hangs beside its guardian: tests/flights/test_armed_externally.py. A world that dies: test_team.py.
"""

from __future__ import annotations

import json
import os
import re
import signal
import socket
import time
from collections.abc import Iterator
from contextlib import closing, contextmanager
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import pytest
from pymavlink import mavutil

from companion.analysis.log import FlightLog
from companion.launcher.guardian_process import GuardianProcess
from companion.launcher.launcher import Launcher
from companion.launcher.sitl_process import SitlProcess
from companion.model.exit_codes import EXIT_ABORTED, EXIT_REFUSED
from companion.model.launcher_messages import (
    AnyMessage,
    GuardianEnded,
    GuardianStatus,
    Message,
    RefusedFlight,
    TookOver,
    WorldAtRest,
)
from companion.runtime import ipc
from companion.sitl_config.loader import load_sitl
from tests.runtime.test_cores import CORES, affinities
from tests.support import DEADLINE_S, HOVER, Sandbox, read_summary, sandbox_in, set_options, wait_until

FLY = ("fly", HOVER, "--sitl", "--out", "out", "--set", "mission.phases[1].duration_s=1.0")
IN_FLIGHT = "  take-off\n"
"""Printed when the rotors lift the vehicle."""
PROCESSES = {
    "flight": "companion.flight.main",
    "guardian": "companion.guardian",
    "recorder": "companion.recorder.main",
    "world": "sitl",
    "launcher": "companion",
}


def events_of(summary: dict[str, Any]) -> list[str]:
    return [event["id"] for event in summary["events"]]


def test_given_up_while_the_world_starts(sandbox: Sandbox) -> None:
    with sandbox.start(*FLY) as running:
        running.wait_for("Ctrl-C lands")
        running.signal(signal.SIGTERM)
        ended = running.end()
    sandbox.assert_nobody_left()
    assert (ended.code, ended.err) == (EXIT_ABORTED, "")
    summary = read_summary(sandbox.cwd / "out")
    assert summary["outcome"] == "aborted"
    assert "takeoff" not in events_of(summary)


@contextmanager
def motive_that_never_answers() -> Iterator[tuple[socket.socket, list[str]]]:
    """Return a silent server's socket and the options for it; motion capture is the first device to be opened."""
    with closing(socket.socket(socket.AF_INET, socket.SOCK_DGRAM)) as motive:
        motive.bind(("127.0.0.1", 0))
        motive.settimeout(DEADLINE_S)
        there = {
            "server": "127.0.0.1",
            "interface": "127.0.0.1",
            "transport": "unicast",
            "command_port": motive.getsockname()[1],
        }
        yield motive, set_options(**{f"vehicle.devices.mocap.{key}": value for key, value in there.items()})


def test_given_up_in_the_background_while_a_device_is_being_opened(sandbox: Sandbox) -> None:
    """Shells ignore SIGINT there.

    The numbers of flight and guardian are there for as long as they live: one that is left behind may belong to another process.
    """
    numbers = [sandbox.cwd / "out/flight.pid", sandbox.cwd / "out/guardian.pid"]
    with (
        motive_that_never_answers() as (motive, options),
        sandbox.start("fly", HOVER, "--out", "out", *options, background=True) as running,
    ):
        assert motive.recv(100)  # the flight process speaks to it
        wait_until(lambda: all(path.exists() for path in numbers), lambda: "no process numbers")
        found = [sandbox.pid_of(PROCESSES["flight"]), sandbox.pid_of(PROCESSES["guardian"])]
        assert found == [int(path.read_text()) for path in numbers]
        running.signal(signal.SIGINT)
        ended = running.end()
    sandbox.assert_nobody_left()
    assert (ended.code, ended.err) == (EXIT_ABORTED, "")
    assert read_summary(sandbox.cwd / "out")["outcome"] == "aborted"
    assert not (sandbox.cwd / "out/flight.mcap").exists()
    assert not any(path.exists() for path in numbers)


def test_killed_while_a_device_is_being_opened(sandbox: Sandbox) -> None:
    with (
        motive_that_never_answers() as (motive, options),
        sandbox.start("fly", HOVER, "--out", "out", *options) as running,
    ):
        assert motive.recv(100)
        running.process.kill()
        sandbox.assert_nobody_left(DEADLINE_S)


@pytest.mark.real_time
def test_given_up_before_arming(sandbox: Sandbox) -> None:
    """With a core of its own, if there are several: the flight alone runs on it, and the terminal says what it got."""
    own, rest = (CORES[-1:], CORES[:-1]) if len(CORES) > 1 else ([], CORES)
    options = set_options(**{"vehicle.computer.cpus": own, "vehicle.computer.lock_memory": False})
    with sandbox.start(*FLY, "--real-time", *options) as running:
        running.wait_for("  wait\n")  # it weighs the net for a second
        memory = Path(f"/proc/{sandbox.pid_of(PROCESSES['flight'])}/status").read_text(errors="replace")
        found = {name: affinities(sandbox.pid_of(module)) for name, module in PROCESSES.items()}
        running.signal(signal.SIGINT)
        running.wait_for("landing commanded")
        running.signal(signal.SIGINT)
        ended = running.end()
    sandbox.assert_nobody_left()
    assert ended.code == EXIT_ABORTED
    assert "Traceback" not in ended.err
    summary = read_summary(sandbox.cwd / "out")
    assert summary["outcome"] == "aborted"
    assert "operator_land" in events_of(summary)  # and what lateness brings about, in real time
    log = FlightLog.read(sandbox.cwd / "out/flight.mcap")
    assert log.closed
    assert not any(inputs.status is not None and inputs.status.armed for inputs in log.inputs)

    assert re.search(r"^VmLck:\s+0 kB$", memory, re.MULTILINE), memory
    assert found == {name: {frozenset(own if own and name == "flight" else rest)} for name in PROCESSES}
    printed = re.search(r"real time +(.*)", ended.out)
    assert printed is not None and f"CPUs {','.join(map(str, own or rest))};" in printed[1], ended.out
    assert sorted(os.sched_getaffinity(0)) == CORES


def test_killed_launcher_leaves_a_flight_that_lands_by_itself(sandbox: Sandbox) -> None:
    """Slower than real time: MAVSDK lives on the computer's clock, and hears a heartbeat of PX4 every 3.3 s; PX4 is not lost."""
    with sandbox.start(*FLY, "--speed", "0.3") as running:
        running.wait_for(IN_FLIGHT)
        running.process.kill()
        sandbox.assert_nobody_left(DEADLINE_S)
    log = FlightLog.read(sandbox.cwd / "out/flight.mcap")
    assert log.closed
    events = [event.id for outputs in log.outputs for event in outputs.events]
    assert events == ["takeoff", "operator_land", "touchdown"]
    last = log.inputs[-1]
    assert last.status is not None and not last.status.armed
    assert last.mocap is not None and last.mocap.position_world_m[2] < 0.4
    assert (sandbox.cwd / "out/flight.log").read_text(encoding="utf-8") == ""
    assert (sandbox.cwd / "out/sitl.log").read_text(encoding="utf-8") == ""


@pytest.mark.parametrize(
    ("package", "line"),
    [
        (
            "mujoco",
            r"sitl: the simulated world ended with exit code 1 (ImportError: a broken mujoco); see out/sitl.log",
        ),
        (
            "mavsdk",
            r"flight: the flight process ended with exit code 1 (ImportError: a broken mavsdk); see out/flight.log",
        ),
    ],
)
def test_process_that_cannot_start_is_named_in_one_line(tmp_path: Path, package: str, line: str) -> None:
    broken = tmp_path / "packages"
    broken.mkdir()
    (broken / f"{package}.py").write_text(f"raise ImportError('a broken {package}')\n", encoding="utf-8")
    with sandbox_in(tmp_path / "sandbox", {"PYTHONPATH": str(broken)}) as sandbox:
        ended = sandbox.run(*FLY)
        sandbox.assert_nobody_left()
        summary = read_summary(sandbox.cwd / "out")
    assert (ended.code, ended.err) == (EXIT_REFUSED, f"{line}\n")
    assert summary["outcome"] == "refused"


def test_a_flight_process_that_ends_while_the_launcher_is_busy_is_heard_to_its_last_word(tmp_path: Path) -> None:
    """Its refusal may come after `select` has returned without it, and before the launcher asks whether the process has ended."""
    heard: list[AnyMessage] = []
    launcher = Launcher(load_sitl(HOVER), tmp_path, sitl=None, on_message=heard.append)
    ours, theirs = socket.socketpair(socket.AF_UNIX, socket.SOCK_SEQPACKET)
    ours.setblocking(False)

    def ends() -> int:
        ipc.send(theirs, RefusedFlight(("because",)))
        return EXIT_REFUSED

    guardian: Any = SimpleNamespace(open=False, channel=None, receive=tuple, took_over=False, hangs=bool)
    process: Any = SimpleNamespace(poll=ends)
    with ours, theirs:
        launcher._watch(process, ours, guardian, None)
    assert heard == [RefusedFlight(("because",))]


@pytest.mark.parametrize("message", [TookOver(hangs=True), GuardianStatus(), GuardianEnded(True, False)], ids=str)
def test_each_message_of_the_guardian_says_that_it_has_taken_over(message: Message) -> None:
    """The first may be lost in a full channel: the launcher would kill a guardian that lands the vehicle."""
    guardian = GuardianProcess.__new__(GuardianProcess)
    ours, theirs = socket.socketpair(socket.AF_UNIX, socket.SOCK_SEQPACKET)
    ours.setblocking(False)
    guardian.channel, guardian.open, guardian.events, guardian.took_over = ours, True, [], False
    guardian._clock = time.monotonic
    with ours, theirs:
        assert guardian.receive() == [] and not guardian.took_over
        assert ipc.send(theirs, message)
        assert guardian.receive() == [message] and guardian.took_over


def test_a_world_that_does_not_leave_is_heard_to_its_last_word(tmp_path: Path) -> None:
    # Armed, it would stay until its rotors stand: longer than the launcher waits.
    world = SitlProcess.start(load_sitl(HOVER), tmp_path)
    try:
        address = world.devices()["autopilot"]["address"].removeprefix("udpout://")
        with closing(mavutil.mavlink_connection(f"udpout:{address}", source_system=255)) as ground:
            ground.mav.param_set_send(1, 1, b"COM_DISARM_PRFLT", 0.0, mavutil.mavlink.MAV_PARAM_TYPE_REAL32)
            deadline_s = time.monotonic() + DEADLINE_S
            armed = False
            while not armed:
                assert time.monotonic() < deadline_s, "the world's PX4 did not arm"
                ground.mav.set_attitude_target_send(0, 1, 1, 0b111, [1.0, 0.0, 0.0, 0.0], 0.0, 0.0, 0.0, 0.0)
                ground.mav.command_long_send(1, 1, mavutil.mavlink.MAV_CMD_DO_SET_MODE, 0, 1, 6, 0, 0, 0, 0, 0)
                ground.mav.command_long_send(1, 1, mavutil.mavlink.MAV_CMD_COMPONENT_ARM_DISARM, 0, 1, 0, 0, 0, 0, 0, 0)
                said = world.messages(time.monotonic() + 0.05)
                armed = WorldAtRest(False) in list(said)
    finally:
        world.stop()
    assert world.ended
    assert world.process.returncode == 0, "it was killed"
    assert world.final["payload_kg"] == json.loads((tmp_path / "sitl_config.json").read_text())["world"]["payload_kg"]
    assert not world.final["crashed"]
