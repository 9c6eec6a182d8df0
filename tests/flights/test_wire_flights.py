"""Whole missions over real wires: `companion fly --sitl` as a user runs it."""

from __future__ import annotations

import json
import socket
from collections.abc import Iterator
from contextlib import ExitStack, contextmanager
from dataclasses import dataclass
from typing import Any

import pytest

from companion.analysis.contact import rotor_distance_m
from companion.analysis.log import FlightLog
from companion.model.exit_codes import EXIT_ABORTED, EXIT_OK
from companion.model.frames import euler_zyx_from_quat
from companion.model.types import AutopilotRequest
from tests.core.test_sliding import short_slide
from tests.support import (
    HOVER,
    HOVERS_S,
    SHORT_CATCH,
    Ended,
    Sandbox,
    World,
    bridged,
    plugged,
    read_summary,
    run_here,
    sandbox_in,
    serial_line,
    set_options,
)

"""Tests that look at one flight run in one process."""
PAYLOAD_KG = 0.2
LANDS_S = 0.5
"""From the lost arm to the lost poses: the landing is under way, and above the floor."""


@dataclass(frozen=True)
class Flown:
    """A flight that is over."""

    sandbox: Sandbox
    ended: Ended

    @property
    def summary(self) -> dict[str, Any]:
        return read_summary(self.sandbox.cwd / "out")


@pytest.fixture(scope="module")
def the_catch(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Flown]:
    """A catch of `PAYLOAD_KG` with the preflight and the report of `make fly`; once for everybody who only looks at it. The mission of
    `make fly` is flown by test_ground_commands.py.
    """
    options = set_options(**{"world.payload_kg": PAYLOAD_KG, "vehicle.safety.preflight_s": 5.0})
    with sandbox_in(tmp_path_factory.mktemp("catch")) as sandbox:
        ended = sandbox.run("fly", SHORT_CATCH, "--sitl", "--out", "out", *options, report=True)
        sandbox.assert_nobody_left()
        yield Flown(sandbox, ended)


def test_the_catch(the_catch: Flown) -> None:
    ended, summary = the_catch.ended, the_catch.summary
    assert (ended.code, ended.err) == (EXIT_OK, ""), ended
    assert "completed" in ended.out
    assert summary["outcome"] == "completed"
    assert (summary["controller"], summary["preset"], summary["payload_kg"]) == ("adaptive", "recommended", PAYLOAD_KG)
    assert summary["world"]["payload_kg"] == PAYLOAD_KG
    assert (summary["world"]["name"], summary["world"]["drawn"]) == ("ideal", {})
    assert "world" not in json.loads((the_catch.sandbox.cwd / "out/config.json").read_text(encoding="utf-8"))
    assert summary["autopilot"]["kind"] == "stub"
    assert 2.0 < summary["catch_t_s"] < 4.0
    assert summary["rms"]["post"]["e_p_m"] < 0.06
    assert summary["rms"]["post"]["e_q_deg"] < 8.0
    assert summary["tether"]["min_slack_m"] > 0.25
    assert summary["recorder"]["samples"] == summary["loop"]["ticks"] > 2000
    assert summary["recorder"]["dropped"] == 0
    wanted = ["takeoff", "catch", "touchdown"]
    assert [event["id"] for event in summary["events"] if event["id"] in wanted] == wanted


def test_it_leaves_a_report_with_its_plots(the_catch: Flown) -> None:
    out = the_catch.sandbox.cwd / "out"
    assert (out / "report.html").stat().st_size > 50_000
    assert len(list(out.glob("*.png"))) >= 4


def test_its_log_replays_bit_for_bit(the_catch: Flown) -> None:
    replayed = run_here("replay", the_catch.sandbox.cwd / "out/flight.mcap")
    assert replayed.code == EXIT_OK, (replayed.out, replayed.err)


def test_a_lost_arm_lands_it_and_another_programs_end_is_found(tmp_path_factory: pytest.TempPathFactory) -> None:
    """The simulated world sends the poses to PX4 on a link of its own; the companion has the report of PX4's estimator alone. The
    arm's servo falls silent in the hover, and the other program during the landing.
    """
    with sandbox_in(tmp_path_factory.mktemp("external")) as sandbox:
        faults = [{"kind": "servo_loss", "t_s": HOVERS_S}, {"kind": "mocap_loss", "t_s": HOVERS_S + LANDS_S}]
        far = [{"point_m": [50.0, 0.0, 1.0], "normal": [-1.0, 0.0, 0.0]}]
        options = {"vehicle.devices.mocap.type": "external", "world.faults": faults, "world.surfaces": far}
        ended = sandbox.run("fly", HOVER, "--sitl", "--out", "out", *set_options(**options))
        sandbox.assert_nobody_left()
        summary = read_summary(sandbox.cwd / "out")
    assert ended.code == EXIT_ABORTED, ended
    assert summary["outcome"] == "aborted"  # and not lost: PX4 landed and is disarmed, whoever noticed the floor first
    wanted = ["takeoff", "arm_lost", "vision_lost"]
    assert [event["id"] for event in summary["events"] if event["id"] in wanted] == wanted
    assert summary["latency_ms"]["mocap_to_setpoint"]["p99"] is None
    distance_m = rotor_distance_m(summary)
    assert distance_m is not None and 50.0 < distance_m < 51.0


def test_a_body_that_flickers_is_flown_through_and_poses_that_wait_on_the_network_land_it(
    tmp_path_factory: pytest.TempPathFactory,
) -> None:
    """Frames at 120 Hz start no tick; every second pose is turned by 180 deg for a second. Then frames wait behind Motive's stamp."""
    with sandbox_in(tmp_path_factory.mktemp("flickers")) as sandbox:
        faults = [
            {"kind": "mocap_flip", "t_s": HOVERS_S, "duration_s": 1.0},
            {"kind": "mocap_network", "t_s": HOVERS_S + 1.2, "size": 0.15},
        ]
        options = {"world.faults": faults, "world.mocap_rate_hz": 120.0}
        ended = sandbox.run("fly", HOVER, "--sitl", "--out", "out", *set_options(**options))
        sandbox.assert_nobody_left()
        summary = read_summary(sandbox.cwd / "out")
        log = FlightLog.read(sandbox.cwd / "out/flight.mcap")
    assert ended.code == EXIT_ABORTED, ended
    wanted = ["mocap_jump", "mocap_too_late"]
    assert [event["id"] for event in summary["events"] if event["id"].startswith("mocap")][:2] == wanted
    yaws_rad = [euler_zyx_from_quat(i.vehicle.attitude_wxyz)[2] for i in log.inputs if i.vehicle is not None]
    assert max(yaws_rad) - min(yaws_rad) < 0.2, "PX4 got none of the turned poses"
    late_s = [i.mocap.latency_s for i in log.inputs if i.mocap is not None and i.mocap.latency_s is not None]
    assert max(late_s) == pytest.approx(0.155, abs=0.01), "the log has the age at arrival"


def test_a_tip_slides_along_a_wall(tmp_path_factory: pytest.TempPathFactory) -> None:
    with sandbox_in(tmp_path_factory.mktemp("slide")) as sandbox:
        options = [part for override in short_slide(0.5) for part in ("--set", override)]
        ended = sandbox.run("fly", "slide", "--sitl", "--world", "ideal", "--out", "out", *options)
        sandbox.assert_nobody_left()
        summary = read_summary(sandbox.cwd / "out")
    assert ended.code == EXIT_OK, ended
    contact = summary["contact"]
    assert contact["slid_m"] == pytest.approx(0.3, abs=0.03)
    assert contact["path_rms_m"] < 0.04 and contact["rms_error_n"] < 1.5


def test_a_kill_switch_ends_the_setpoints_and_its_release_moves_nothing(
    tmp_path_factory: pytest.TempPathFactory,
) -> None:
    """Engaged at full take-off thrust, before the vehicle lifts, and released before PX4 disarms."""
    with sandbox_in(tmp_path_factory.mktemp("kill")) as sandbox:
        fault = {"kind": "kill_switch", "t_s": 2.3, "duration_s": 0.8}
        options = set_options(**{"world.faults": [fault], "world.px4_params": {"COM_KILL_DISARM": 1.0}})
        ended = sandbox.run("fly", HOVER, "--sitl", "--out", "out", *options)
        sandbox.assert_nobody_left()
        summary = read_summary(sandbox.cwd / "out")
        log = FlightLog.read(sandbox.cwd / "out/flight.mcap")
    assert ended.code == EXIT_ABORTED, ended
    assert [event["id"] for event in summary["events"]] == ["takeoff", "killed"]
    killed = next(o.tick for o in log.outputs if any(event.id == "killed" for event in o.events))
    after = [o for o in log.outputs if o.tick >= killed]
    assert all(o.attitude is None and o.request is AutopilotRequest.NONE for o in after)
    heights_m = [i.vehicle.position_world_m[2] for i in log.inputs if i.tick >= killed and i.vehicle is not None]
    assert max(heights_m) - heights_m[0] < 0.03


def test_a_serial_link_to_px4_that_comes_back_in_the_air_is_landed_and_not_lost(sandbox: Sandbox) -> None:
    name = sandbox.tmp.parent / "px4"
    with World(sandbox, HOVER, ["world.payload_kg=0"]) as world, ExitStack() as stack:
        px4 = ("127.0.0.1", int(world.devices["autopilot"]["address"].rpartition(":")[2]))
        udp = stack.enter_context(socket.socket(type=socket.SOCK_DGRAM))

        @contextmanager
        def cable() -> Iterator[None]:
            with serial_line() as (far, port), plugged(name, port), bridged(udp, px4, lambda: far):
                yield

        with cable():
            addresses = world.addresses(autopilot={"address": f"serial://{name}:921600"})
            flight = stack.enter_context(sandbox.start("fly", HOVER, "--out", "out", *addresses))
            flight.wait_for("  hold\n")
        flight.wait_for("no position, attitude or IMU sample")
        with cable():
            ended = flight.end()
        assert (ended.code, ended.err) == (EXIT_ABORTED, ""), (ended.out, ended.err)
        assert "the connection has ended" in ended.out and "the connection is open again" in ended.out
        assert read_summary(sandbox.cwd / "out")["outcome"] == "aborted"  # by the flight, without the guardian
        assert world.armings == 1 and not world.crashes
    sandbox.assert_nobody_left()
