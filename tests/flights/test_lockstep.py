"""Flights in simulated time: a busy computer makes them slower and changes nothing, and they are those of the fast loop."""

from __future__ import annotations

import contextlib
import json
import os
import subprocess
import sys
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path

import pytest
from msgspec import Struct

from companion.analysis.log import FlightLog
from companion.model.exit_codes import EXIT_BAD_INPUT, EXIT_OK
from companion.model.types import Inputs
from companion.sitl_config.loader import SitlConfig
from sitl.fast.loop import FastFlight
from tests.flights.test_px4 import assert_landed_by_the_guardian
from tests.support import HOVER, SHORT_CATCH, Ended, Sandbox, read_summary, run_here, sandbox_in

FLOAT32 = 1e-6
"""Rounding of positions, attitudes and forces on the wires, with what the flight makes of it within some seconds."""
APART_M = 0.005
"""After a count of a servo or of the force sensor was rounded the other way."""


@contextlib.contextmanager
def busy_programs(count: int) -> Iterator[None]:
    """Programs that take all that they get of the processors, for a second of CPU time each."""
    busy = "import time\nwhile time.process_time() < 1.0: pass"
    programs = [subprocess.Popen([sys.executable, "-c", busy]) for _ in range(count)]
    try:
        yield
    finally:
        for program in programs:
            program.kill()
            program.wait()


SETTINGS = ("--set", "vehicle.devices.mocap.ball={kind: marker}", "vehicle.devices.autopilot.setpoint_path=direct")
IN_LAB = ("fly", SHORT_CATCH, "--sitl", "--world", "lab", "--seed", "1", "--out", "out", *SETTINGS)
HANGS, HANGS_S = "hold_gil", 4.8
"""A fault, and its time after arming: at the greatest speed."""


@dataclass(frozen=True)
class Flown:
    """A flight that is over."""

    ended: Ended
    out: Path
    log: FlightLog


@pytest.fixture(scope="module")
def flown(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Flown]:
    """A flight in a drawn laboratory, with its report. A catch over wires: test_ground_commands.py."""
    with sandbox_in(tmp_path_factory.mktemp("lockstep")) as sandbox:
        ended = sandbox.run(*IN_LAB, report=True)
        sandbox.assert_nobody_left()
        assert (ended.code, ended.err) == (EXIT_OK, ""), ended
        out = sandbox.cwd / "out"
        yield Flown(ended, out, FlightLog.read(out / "flight.mcap"))


def test_it_leaves_a_summary_a_report_and_a_log_that_replays(flown: Flown) -> None:
    summary, world = read_summary(flown.out), read_summary(flown.out)["world"]
    assert "completed" in flown.ended.out
    assert summary["outcome"] == "completed"
    assert (summary["controller"], summary["preset"]) == ("adaptive", "recommended")
    assert summary["payload_kg"] == world["payload_kg"] > 0.0
    assert world["name"] == "lab" and world["drawn"]
    assert "world" not in json.loads((flown.out / "config.json").read_text(encoding="utf-8"))
    assert summary["autopilot"]["kind"] == "stub"
    assert summary["rms"]["pre"]["e_p_m"] < 0.06
    assert summary["rms"]["pre"]["e_q_deg"] < 8.0
    assert summary["tether"]["min_slack_m"] > 0.25
    assert summary["recorder"]["samples"] == summary["loop"]["ticks"] > 1500
    assert summary["recorder"]["dropped"] == 0
    wanted = ["takeoff", "touchdown"]
    assert [event["id"] for event in summary["events"] if event["id"] in wanted] == wanted
    assert (flown.out / "report.html").stat().st_size > 50_000
    assert len(list(flown.out.glob("*.png"))) >= 4
    replayed = run_here("replay", flown.out / "flight.mcap")
    assert replayed.code == EXIT_OK, (replayed.out, replayed.err)


def test_beside_busy_programs_it_repeats_itself_bit_for_bit_until_it_hangs_and_the_guardian_lands(
    flown: Flown, sandbox: Sandbox
) -> None:
    """With setpoints straight onto the link, not by MAVSDK's Offboard plugin."""
    fault = f"world.faults=[{{kind: {HANGS}, t_s: {HANGS_S}}}]"
    with sandbox.start(*IN_LAB, "--speed", "3", "--set", fault) as running:
        running.wait_for("  take-off\n")
        with busy_programs(len(os.sched_getaffinity(0))):
            ended = running.end()
    sandbox.assert_nobody_left()
    again = FlightLog.read(sandbox.cwd / "out/flight.mcap")
    for name in ("inputs", "outputs", "sent"):
        for one, other in zip(getattr(again, name), getattr(flown.log, name), strict=False):
            assert one == other, (name, differing(one, other))
    assert again.metadata["flight"]["clock"] == "simulated"
    assert_landed_by_the_guardian(sandbox, ended, HANGS)


def differing(one: Struct, other: Struct) -> dict[str, object]:
    """Return the fields that differ, by name."""
    pairs = ((name, getattr(one, name), getattr(other, name)) for name in one.__struct_fields__)
    return {
        name: differing(a, b) if isinstance(a, Struct) and isinstance(b, Struct) else (a, b)
        for name, a, b in pairs
        if a != b
    }


def counts(inputs: Inputs) -> object:
    """What the wires carry in counts, and what follows from them."""
    assert inputs.arm is not None
    force = None if inputs.force is None else (inputs.force.force_sensor_n, inputs.force.torque_sensor_nm)
    return inputs.arm.angle_rad, inputs.arm.velocity_rad_s, inputs.arm.torque_nm, force


def difference(one: Sequence[float], other: Sequence[float]) -> float:
    return max(abs(a - b) for a, b in zip(one, other, strict=True))


def test_it_is_the_flight_of_the_fast_loop(flown: Flown) -> None:
    """Tick by tick: equal to the rounding of the wires until the first count differs, and then by millimetres."""
    log = flown.log
    config = SitlConfig.model_validate_json((flown.out / "sitl_config.json").read_text(encoding="utf-8"))
    fast = FastFlight(config).run()
    assert [o.phase for o in fast.outputs][:2000] == [o.phase for o in log.outputs][:2000]
    equal, balls = True, 0
    for ours, theirs in zip(fast.inputs, log.inputs, strict=False):
        assert ours.t_s == theirs.t_s
        assert ours.mocap is not None and theirs.mocap is not None
        assert ours.vehicle is not None and theirs.vehicle is not None
        assert ours.mocap.stamp_s == theirs.mocap.stamp_s
        assert ours.markers is not None and theirs.markers is not None
        assert ours.markers.frame_number - ours.mocap.frame_number == 0 == theirs.markers.stamp_s - theirs.mocap.stamp_s
        assert theirs.markers.exposed_s == pytest.approx(ours.markers.exposed_s, abs=1e-6)
        balls = max(balls, len(ours.markers.markers))
        equal = equal and counts(ours) == counts(theirs)
        allowed_m = FLOAT32 if equal else APART_M
        assert difference(ours.mocap.position_world_m, theirs.mocap.position_world_m) < allowed_m, ours.t_s
        assert difference(ours.vehicle.position_world_m, theirs.vehicle.position_world_m) < allowed_m, ours.t_s
        if equal:
            assert difference(ours.vehicle.attitude_wxyz, theirs.vehicle.attitude_wxyz) < FLOAT32, ours.t_s
            assert ours.vehicle.imu_stamp_s == theirs.vehicle.imu_stamp_s
            for one, other in zip(ours.markers.markers, theirs.markers.markers, strict=True):
                assert difference(one.position_world_m, other.position_world_m) < APART_M, "a ball that rolls"
    assert balls >= 2, "the ball, and a reflection"
    in_flight = [k for k, output in enumerate(log.outputs) if output.mission_t_s > 1.0]
    assert counts(fast.inputs[in_flight[0]]) == counts(log.inputs[in_flight[0]])
    assert abs(len(fast.outputs) - len(log.outputs)) <= 3


@pytest.mark.parametrize(
    ("words", "line"),
    [
        (("--sitl", "--speed", "0"), "--speed 0: expected a number above 0, such as 0.25, or max"),
        (("--sitl", "--speed", "nan"), "--speed nan: expected a number above 0, such as 0.25, or max"),
        (("--sitl", "--speed", "fast"), "--speed fast: expected a number above 0, such as 0.25, or max"),
        (("--sitl", "--speed", "max", "--real-time"), "--speed max: expected not together with --real-time"),
        (("--speed", "2"), "--speed: expected only with --sitl"),
        (("--real-time",), "--real-time: expected only with --sitl"),
    ],
)
def test_a_speed_that_cannot_be_flown_is_refused_in_one_line(words: tuple[str, ...], line: str) -> None:
    ended = run_here("fly", HOVER, *words)
    assert ended.code == EXIT_BAD_INPUT
    assert ended.out == ""
    assert len(ended.err_lines) == 1 and line in ended.err
