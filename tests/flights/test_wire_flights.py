"""Faults of wires and of other programs, met over real wires: `companion fly --sitl` as a user runs it. A catch:
test_ground_commands.py.
"""

from __future__ import annotations

import socket
from collections.abc import Iterator
from contextlib import ExitStack, contextmanager

import pytest

from companion.analysis.contact import rotor_distance_m
from companion.analysis.log import FlightLog
from companion.model.exit_codes import EXIT_ABORTED
from companion.model.frames import euler_zyx_from_quat
from tests.support import HOVER, Sandbox, World, read_summary, set_options
from tests.wires import bridged, plugged, serial_line

FLIPS_S, ARM_LOST_S, LATE_S = 3.4, 4.4, 4.9
"""After arming: every second pose is turned by 180 deg for a second, the arm's servo falls silent in the hover, and during the landing
frames wait behind Motive's stamp.
"""


def test_a_body_that_flickers_is_flown_through_a_lost_arm_lands_it_and_poses_that_wait_on_the_network_are_noticed(
    sandbox: Sandbox,
) -> None:
    """Frames at 120 Hz start no tick. Poses that another program sends to PX4: test_shared_flight.py."""
    faults = [
        {"kind": "mocap_flip", "t_s": FLIPS_S, "duration_s": 0.8},
        {"kind": "servo_loss", "t_s": ARM_LOST_S},
        {"kind": "mocap_network", "t_s": LATE_S, "size": 0.15},
    ]
    far = [{"point_m": [50.0, 0.0, 1.0], "normal": [-1.0, 0.0, 0.0]}]
    hovers = {"mission.phases[1].duration_s": 2.0}
    options = {"world.faults": faults, "world.mocap_rate_hz": 120.0, "world.surfaces": far, **hovers}
    ended = sandbox.run("fly", HOVER, "--sitl", "--out", "out", *set_options(**options))
    sandbox.assert_nobody_left()
    summary = read_summary(sandbox.cwd / "out")
    log = FlightLog.read(sandbox.cwd / "out/flight.mcap")
    assert ended.code == EXIT_ABORTED, ended
    assert summary["outcome"] == "aborted"  # and not lost: PX4 landed and is disarmed, whoever noticed the floor first
    wanted = ["takeoff", "mocap_jump", "arm_lost", "mocap_too_late"]
    assert [event["id"] for event in summary["events"] if event["id"] in wanted] == wanted
    yaws_rad = [euler_zyx_from_quat(i.vehicle.attitude_wxyz)[2] for i in log.inputs if i.vehicle is not None]
    assert max(yaws_rad) - min(yaws_rad) < 0.2, "PX4 got none of the turned poses"
    late_s = [i.mocap.latency_s for i in log.inputs if i.mocap is not None and i.mocap.latency_s is not None]
    assert max(late_s) == pytest.approx(0.155, abs=0.01), "the log has the age at arrival"
    distance_m = rotor_distance_m(summary)
    assert distance_m is not None and 50.0 < distance_m < 51.0


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
