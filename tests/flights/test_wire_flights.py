"""Whole missions over real wires: `companion fly --sitl` as a user runs it, in real time.

Limits are wide enough for a loaded machine; the sharp figures are tested in the fast closed loop.
"""

from __future__ import annotations

import json
import os
import signal
import subprocess
import sys
import time
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import pytest
from mcap.reader import make_reader

from companion.analysis.log import FlightLog
from companion.types import PhaseKind
from sitl.campaign import row_of
from tests.flights.test_fast_flights import configured, flown

pytestmark = pytest.mark.flight
MISSION = "configs/missions/catch.yaml"
PAYLOAD_KG = 0.2
TIMEOUT_S = 120

CONTRACT = {
    "outcome": None,
    "controller": None,
    "preset": None,
    "payload_kg": None,
    "catch_t_s": None,
    "rms": {"pre": {"e_p_m", "e_q_deg", "e_alpha_deg"}, "post": {"e_p_m", "e_q_deg", "e_alpha_deg"}},
    "impedance_error": {"position_n", "arm_nm"},
    "final_e_z_m": None,
    "loop": {"rate_hz", "ticks", "missed", "lateness_ms"},
    "latency_ms": {"mocap_to_setpoint", "joint_read_to_write"},
    "recorder": {"samples", "dropped"},
    "events": None,
    "tether": {"min_slack_m"},
}


class Flight:
    """A running `companion fly`; every process of it carries a mark in its environment."""

    def __init__(self, out: Path, *options: str) -> None:
        self.out = out
        self.mark = f"COMPANION_TEST_MARK={os.getpid()}-{time.monotonic_ns()}"
        name, value = self.mark.split("=")
        self.process = subprocess.Popen(
            [sys.executable, "-m", "companion.cli", "fly", MISSION, "--sitl", "--out", str(out), *options],
            stdout=subprocess.PIPE,
            stderr=subprocess.STDOUT,
            text=True,
            env={**os.environ, name: value, "PYTHONUNBUFFERED": "1"},
            start_new_session=True,
        )

    def wait_for_line(self, words: str) -> None:
        """Until the flight prints a line with these words."""
        assert self.process.stdout is not None
        for line in self.process.stdout:
            if words in line:
                return
        raise AssertionError(f"the flight ended without saying {words!r}")

    def finish(self) -> tuple[int, str]:
        """Exit code and the rest of the output."""
        output, _ = self.process.communicate(timeout=TIMEOUT_S)
        return self.process.returncode, output

    def left_behind(self) -> list[int]:
        """Processes of this flight that still run."""
        mark = self.mark.encode()
        found = []
        for folder in Path("/proc").iterdir():
            if folder.name.isdecimal() and int(folder.name) != os.getpid():
                try:
                    if mark in (folder / "environ").read_bytes():
                        found.append(int(folder.name))
                except OSError:
                    continue
        return found

    def end(self) -> None:
        """Whatever a failed test left of it in the middle."""
        for pid in self.left_behind():
            os.kill(pid, signal.SIGKILL)
        self.process.wait(10)
        if self.process.stdout is not None:
            self.process.stdout.close()

    def summary(self) -> dict[str, Any]:
        """summary.json."""
        read: dict[str, Any] = json.loads((self.out / "summary.json").read_text())
        return read

    def event_ids(self) -> list[str]:
        """Ids of the events in the order of the log."""
        return [event["id"] for event in self.summary()["events"]]


Fly = Callable[..., Flight]


@pytest.fixture
def fly(tmp_path: Path) -> Iterator[Fly]:
    """Starts flights."""
    started: list[Flight] = []

    def start(*options: str) -> Flight:
        started.append(Flight(tmp_path / f"flight{len(started)}", *options))
        return started[-1]

    yield start
    for flight in started:
        flight.end()


@dataclass(frozen=True)
class Flown:
    """A flight that is over."""

    flight: Flight
    code: int
    output: str


@pytest.fixture(scope="module")
def the_catch(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Flown]:
    """The catch of `PAYLOAD_KG`, flown once for everybody who only looks at it."""
    flight = Flight(tmp_path_factory.mktemp("catch") / "flight", "--set", f"world.payload_kg={PAYLOAD_KG}")
    try:
        yield Flown(flight, *flight.finish())
    finally:
        flight.end()


def test_the_catch(the_catch: Flown) -> None:
    flight, code, output = the_catch.flight, the_catch.code, the_catch.output
    assert code == 0, output
    assert "completed" in output
    summary = flight.summary()
    for key, parts in CONTRACT.items():
        assert key in summary
        if parts is not None:
            assert set(parts) <= set(summary[key])
    assert summary["outcome"] == "completed"
    assert (summary["controller"], summary["preset"], summary["payload_kg"]) == ("adaptive", "recommended", PAYLOAD_KG)
    assert 6.0 < summary["catch_t_s"] < 7.0
    assert summary["rms"]["post"]["e_p_m"] < 0.08
    assert summary["rms"]["post"]["e_q_deg"] < 4.0
    assert summary["tether"]["min_slack_m"] > 0.25
    assert summary["recorder"]["samples"] == summary["loop"]["ticks"] > 3000
    assert summary["recorder"]["dropped"] == 0
    assert flight.event_ids()[0] == "takeoff"
    assert (flight.out / "report.html").stat().st_size > 50_000
    assert len(list(flight.out.glob("*.png"))) >= 4
    assert flight.left_behind() == []

    replayed = subprocess.run(
        [sys.executable, "-m", "companion.cli", "replay", str(flight.out / "flight.mcap")],
        capture_output=True,
        text=True,
        timeout=TIMEOUT_S,
    )
    assert replayed.returncode == 0, replayed.stdout + replayed.stderr


def test_the_fast_loop_says_what_the_wires_say(the_catch: Flown) -> None:
    """Position error after the catch, same mission and seed: within 20 %."""
    assert the_catch.code == 0, the_catch.output
    over_wires_m = the_catch.flight.summary()["rms"]["post"]["e_p_m"]
    [row, *_] = row_of(configured(f"world.payload_kg={PAYLOAD_KG}"), flown(PAYLOAD_KG, "recommended", 1), None)
    assert over_wires_m == pytest.approx(row["rms"]["post"]["e_p_m"], rel=0.2)


def test_a_lost_arm_lands_it(fly: Fly) -> None:
    flight = fly("--set", "world.faults=[{kind: servo_loss, t_s: 6}]")
    code, output = flight.finish()
    assert code == 4, output
    summary = flight.summary()
    assert summary["outcome"] == "aborted"
    assert "arm_lost" in flight.event_ids()
    assert flight.left_behind() == []


def test_the_flight_process_killed_in_mid_flight_is_landed_and_leaves_a_whole_log_and_no_orphan(fly: Fly) -> None:
    flight = fly()
    flight.wait_for_line("stabilise")
    killed_ns = time.time_ns()
    os.kill(int((flight.out / "flight.pid").read_text()), signal.SIGKILL)
    code, output = flight.finish()
    assert code == 4, output
    assert flight.summary()["outcome"] == "aborted"
    assert flight.event_ids()[-1] == "guardian_landed"
    assert flight.left_behind() == []
    with open(flight.out / "flight.mcap", "rb") as file:
        reader = make_reader(file)
        summary = reader.get_summary()
        assert summary is not None
        assert summary.statistics is not None
        last_ns = max(message.log_time for _, _, message in reader.iter_messages(topics=["/outputs"]))
    assert killed_ns - last_ns < 0.3e9
    log = FlightLog.read(flight.out / "flight.mcap")
    assert log.missing_ticks() == 0
    assert log.outputs[-1].phase_kind is PhaseKind.FLIGHT
