"""The hand test at a terminal: a round of the simulated hand to its record, and its ends over real wires."""

from __future__ import annotations

import asyncio
import io
import json
import os
import pty
import signal
import termios
from collections.abc import Callable, Coroutine, Iterator
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import pytest
from rich.console import Console

from companion.config.devices import MocapDevice
from companion.io.devices import AvailableDevices, PoseForwarder, open_available
from companion.io.mocap.driver import MocapDriver
from companion.model.check_row import Row
from companion.model.types import AutopilotRequest, FlightMode, MocapPose, VehicleState
from companion.preflight.hand_test import command
from companion.preflight.hand_test import evaluation as hand_test_evaluation
from companion.preflight.hand_test import record as hand_record
from companion.preflight.hand_test.command import run_hand_test
from companion.preflight.hand_test.steps import HandSample
from companion.runtime.clock import flight_clock
from companion.sitl_config.loader import SitlConfig, load_sitl
from sitl.world.handling import ROUND_S
from tests.io.stub_rig import standing_stub
from tests.io.test_px4_stub import companion
from tests.preflight.hand_rig import Standing
from tests.preflight.hand_rig import world as simulated
from tests.support import CATCH, DEADLINE_S, Sandbox, World, free_udp_port, sandbox_in


@pytest.fixture(scope="module")
def sandbox(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Sandbox]:
    with sandbox_in(tmp_path_factory.mktemp("hand")) as made:
        yield made


@pytest.fixture(scope="module")
def world(sandbox: Sandbox) -> Iterator[World]:
    with World(sandbox, overrides=["world.payload_kg=0"]) as made:
        yield made


@pytest.fixture
def config(world: World) -> SitlConfig:
    """Of a companion whose devices are the world's."""
    return load_sitl(CATCH, overrides=[word for word in world.addresses() if word != "--set"])


def terminal() -> Console:
    return Console(file=io.StringIO(), force_terminal=True, width=160)


def text_of(console: Console) -> str:
    assert isinstance(console.file, io.StringIO)
    return console.file.getvalue()


async def over_wires(
    config: SitlConfig, console: Console, beside: Callable[[], Coroutine[Any, Any, None]]
) -> list[Row]:
    """The rows of a test on the world's wires; `beside` runs while it does."""
    async with open_available(config, flight_clock()) as edges:
        assert not edges.failures
        async with asyncio.timeout(DEADLINE_S), asyncio.TaskGroup() as group:
            group.create_task(beside())
            return await run_hand_test(edges, config, console)


async def said(console: Console, words: str) -> None:
    """Until the console has been told something."""
    async with asyncio.timeout(DEADLINE_S):
        while words not in text_of(console):  # noqa: ASYNC110 - a console has no event
            await asyncio.sleep(0.01)


class Played:
    """Motion capture and PX4 of a machine that is carried: each look at the poses is the next of its samples, 5 ms later."""

    server = SimpleNamespace(protocol_version="4.1")

    def __init__(self, samples: Iterator[HandSample]) -> None:
        self._samples = samples

    def latest(self) -> MocapPose | None:
        self._now = next(self._samples)
        return self._now.pose

    def vehicle(self) -> VehicleState | None:
        return self._now.vehicle

    def status(self) -> Any:
        return SimpleNamespace(heartbeat_stamp_s=self._now.t_s, armed=self._now.armed)


def test_a_whole_round_passes_and_is_kept(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    """In the machine's own time: this computer's stands still."""
    monkeypatch.setattr(command, "time", SimpleNamespace(monotonic=lambda: 0.0))
    monkeypatch.setattr(command, "LOOK_PERIOD_S", 0.0)
    config, console, path = simulated("hand=true"), terminal(), tmp_path / "state" / "hand-tests.json"
    machine: Any = Played(Standing(config).samples(4.0 + ROUND_S))
    rows = asyncio.run(run_hand_test(AvailableDevices(PoseForwarder(), machine, machine), config, console, record=path))
    assert all(row.ok for row in rows), [row.line() for row in rows if not row.ok]
    assert [row.id for row in rows] == [*(check.id for check in hand_test_evaluation.CHECKS), "hand.record"]
    for words in ("1/4", "2/4", "lift it straight up", "3/4", "forward", "4/4", "to the left", "put it back"):
        assert words in text_of(console)
    setup = hand_record.Setup.of(config.vehicle, "4.1")
    passed, changed = hand_record.on_record(setup, hand_record.load(path))
    assert passed.startswith("passed on 20")
    assert not changed
    (kept,) = json.loads(path.read_text(encoding="utf-8"))["passed"]
    assert kept["measured"]["hand.turn"].startswith("IMU +4")


def test_any_key_ends_it_and_the_terminal_is_as_before(config: SitlConfig, monkeypatch: pytest.MonkeyPatch) -> None:
    keyboard, tty = pty.openpty()
    console = terminal()
    try:
        with open(tty, closefd=False) as stdin:
            monkeypatch.setattr("sys.stdin", stdin)
            before = termios.tcgetattr(tty)

            async def press() -> None:
                await said(console, "1/4")
                assert termios.tcgetattr(tty) != before
                os.write(keyboard, b" ")

            rows = asyncio.run(over_wires(config, console, press))
            assert termios.tcgetattr(tty) == before
    finally:
        os.close(keyboard)
        os.close(tty)
    assert [(row.id, row.read, row.refuses) for row in rows] == [("hand.done", "ended by the operator", True)]


def test_it_is_refused_when_px4_is_armed() -> None:
    config = load_sitl(CATCH)

    async def go() -> list[Row]:
        port = free_udp_port()
        async with standing_stub(port), companion(port) as half:
            half.request = AutopilotRequest.OFFBOARD
            await half.until(lambda status: status.mode is FlightMode.OFFBOARD, "OFFBOARD")
            half.request = AutopilotRequest.ARM
            await half.until(lambda status: status.armed, "ARM")
            half.request = AutopilotRequest.NONE
            mocap = MocapDriver(MocapDevice(server="127.0.0.1", rigid_body_id=1), flight_clock(), lambda _: None)
            edges = AvailableDevices(PoseForwarder(), half.autopilot, mocap)
            return await run_hand_test(edges, config, terminal())

    (row,) = asyncio.run(go())
    assert row.refuses
    assert row.read.startswith("PX4 reports that it is armed")


def test_without_motion_capture_or_px4_it_says_which() -> None:
    config = load_sitl(CATCH)
    (row,) = asyncio.run(run_hand_test(AvailableDevices(PoseForwarder()), config, terminal()))
    assert row.read == "motion capture is not connected"


def test_ctrl_c_ends_it_and_is_itself_again_and_scripts_keep_their_standard_output(
    config: SitlConfig, capsys: pytest.CaptureFixture[str]
) -> None:
    async def interrupt() -> None:
        os.kill(os.getpid(), signal.SIGINT)

    async def go() -> list[Row]:
        before = signal.getsignal(signal.SIGINT)
        async with open_available(config, flight_clock()) as edges, asyncio.TaskGroup() as group:
            # Tasks begin at the first await: the test listens by then.
            group.create_task(interrupt())
            rows = await run_hand_test(edges, config, Console(), True)
        assert signal.getsignal(signal.SIGINT) == before
        return rows

    (row,) = asyncio.run(go())
    assert (row.id, row.read) == ("hand.done", "ended by the operator")
    captured = capsys.readouterr()
    assert captured.out == ""
    assert "hand test" in captured.err
