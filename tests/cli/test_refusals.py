"""Devices that are not there or not as they must be, on the hardware path: `companion fly` without --sitl against a simulated
world that runs on its own. Each time: exit 3, one clear line, never armed, nothing left, and everything free for the next attempt.

The autopilot and the force sensor (before the refused start at the end) each have a whole `fly`; of the rest the line is read where
a flight opens its devices, in this process.
"""

from __future__ import annotations

import re
import socket
from collections.abc import Iterator, Mapping
from contextlib import closing
from dataclasses import dataclass, field, replace
from pathlib import Path

import pytest
import serial

from companion.config.loader import load_flight
from companion.io.devices import open_devices
from companion.io.protocols import DeviceError
from companion.model.exit_codes import EXIT_REFUSED
from companion.runtime.clock import flight_clock
from companion.runtime.event_loop import run
from tests.support import CATCH, Ended, Sandbox, World, read_summary, sandbox_in, serial_line, set_options

"""Tests that share one world run in one process."""
QUICK = {"discovery_timeout_s": 1.0}


@pytest.fixture(scope="module")
def world(tmp_path_factory: pytest.TempPathFactory) -> Iterator[World]:
    with sandbox_in(tmp_path_factory.mktemp("world")) as sandbox, World(sandbox) as world:
        yield world


def udp_port() -> socket.socket:
    """A UDP port of 127.0.0.1 that is taken, and on which nobody speaks."""
    taken = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
    taken.bind(("127.0.0.1", 0))
    return taken


def refused(sandbox: Sandbox, world: World, *options: str, events: bool = False) -> Ended:
    """Fly the catch with these options; asserts everything that all refusals have in common.

    That the computer is too busy may be said beside each of them, and is left out here.
    """
    armings = world.armings
    ended = sandbox.run("fly", CATCH, "--out", "out", *options)
    sandbox.assert_nobody_left()
    assert ended.code == EXIT_REFUSED, ended
    assert "Traceback" not in ended.err + ended.out
    assert (sandbox.cwd / "out/flight.log").read_text(encoding="utf-8") == ""
    assert (world.armings, world.crashes) == (armings, 0)
    assert world.process.poll() is None
    summary = read_summary(sandbox.cwd / "out")
    assert summary["outcome"] == "refused"
    assert bool([event for event in summary["events"] if event["id"] != "computer_busy"]) == events
    lines = [line for line in ended.err.splitlines(keepends=True) if not line.startswith("this computer is too busy")]
    return replace(ended, err="".join(lines))


@dataclass(frozen=True)
class Wrong:
    """One thing that is wrong, and the line that says so."""

    line: str
    but: Mapping[str, Mapping[str, object]] = field(default_factory=dict)
    """Device settings."""
    also: Mapping[str, object] = field(default_factory=dict)
    """Other settings."""


WRONG = {
    "autopilot on a serial port that is not there": Wrong(
        r"^autopilot serial:///dev/ttyNONE:921600: expected the serial port /dev/ttyNONE, found No such file.*; plug",
        {"autopilot": {"address": "serial:///dev/ttyNONE:921600"}},
    ),
    "servo id that does not exist": Wrong(
        r"^arm bus /dev/pts/\d+: servo 7 \(joint 2\): does not answer at 3000000 baud; ids that answer: 1, 2; check",
        also={"vehicle.arm.joints[1].servo_id": 7},
    ),
    "arm port that is not there": Wrong(
        r"^arm bus /dev/ttyNONE: no such port; .*; correct devices\.arm\.port or plug",
        {"arm": {"port": "/dev/ttyNONE"}},
    ),
    "arm port that is a file": Wrong(
        r"^arm bus /etc/hostname: is not a usable serial port", {"arm": {"port": "/etc/hostname"}}
    ),
    "arm baud rate": Wrong(
        r"^arm bus /dev/pts/\d+: servo 1 \(joint 1\): does not answer at 57600 baud; .*; check .*baud rate",
        {"arm": {"baud": 57600}},
    ),
    "mocap body never seen": Wrong(
        r"^mocap 127\.0\.0\.1:\d+: rigid body id 7 was never seen within .*streams: 1 \"tarot650-2r\"; set devices\.mocap",
        {"mocap": {"rigid_body_id": 7}},
    ),
    "mocap version": Wrong(
        r"^mocap 127\.0\.0\.1:\d+: .* speaks NatNet 4\.1, expected 3\.0; set .*devices\.mocap\.natnet_version$",
        {"mocap": {"natnet_version": "3.0"}},
    ),
    "mocap interface of another machine": Wrong(
        r"^mocap 127\.0\.0\.1:\d+: cannot open UDP 192\.0\.2\.1:0: .*; set devices\.mocap\.interface",
        {"mocap": {"interface": "192.0.2.1"}},
    ),
    "force port that is not there": Wrong(
        r"^force sensor /dev/ttyNONE: no such port; .*; plug the sensor in or set devices\.force\.port$",
        {"force": {"port": "/dev/ttyNONE"}},
    ),
}


def line_at_opening(world: World, *options: str) -> str:
    """The line of the device at which a flight with these options ends. Nothing is armed."""
    config = load_flight(CATCH, overrides=[word for word in options if word != "--set"], hardware=True)

    async def opening() -> None:
        async with open_devices(config, flight_clock()):
            pass

    with pytest.raises(DeviceError) as caught:
        run(opening())
    assert (world.armings, world.crashes) == (0, 0)
    return str(caught.value)


def refused_at_opening(world: World, *options: str) -> str:
    """The same; and no port stays open."""
    line = line_at_opening(world, *options)
    with (
        serial.Serial(world.devices["arm"]["port"], exclusive=True),
        serial.Serial(world.devices["force"]["port"], exclusive=True),
    ):
        return line


@pytest.mark.parametrize("case", WRONG)
def test_names(world: World, case: str) -> None:
    wrong = WRONG[case]
    line = refused_at_opening(world, *world.addresses(**wrong.but), *set_options(**wrong.also))
    assert re.search(wrong.line, line), (wrong.line, line)


def assert_one_line(ended: Ended, pattern: str) -> None:
    assert len(ended.err_lines) == 1, ended.err
    assert re.search(pattern, ended.err_lines[0]), (pattern, ended.err)


def test_refuses_an_autopilot_address_on_which_nobody_speaks(sandbox: Sandbox, world: World) -> None:
    with closing(udp_port()) as nobody:
        autopilot = {"address": f"udpout://127.0.0.1:{nobody.getsockname()[1]}", **QUICK}
        ended = refused(sandbox, world, *world.addresses(autopilot=autopilot))
    assert_one_line(
        ended, r"^autopilot udpout://.*: expected a PX4 heartbeat within 1 s, found none; power the autopilot"
    )


def test_names_a_busy_udp_port(world: World) -> None:
    with closing(udp_port()) as busy:
        port = busy.getsockname()[1]
        autopilot = {"address": f"udpin://127.0.0.1:{port}", **QUICK}
        line = refused_at_opening(world, *world.addresses(autopilot=autopilot))
    assert re.search(
        rf"^autopilot udpin://.*: expected port {port} to be free, found another program on it; stop", line
    )


@pytest.mark.parametrize(
    ("device", "refusal"),
    [
        ("arm", r"^arm bus /dev/pts/\d+: port is busy; another program .*: close that one$"),
        ("force", r"^force sensor /dev/pts/\d+: in use by another program; close it"),
    ],
)
def test_names_a_port_that_another_program_holds(world: World, device: str, refusal: str) -> None:
    with serial.Serial(world.devices[device]["port"], exclusive=True):
        line = line_at_opening(world, *world.addresses())
    assert re.search(refusal, line)


@pytest.mark.parametrize(
    ("device", "refusal"),
    [
        ("arm", r"^arm bus PORT: servo 1 \(joint 1\): does not answer .*; no servo answers at all; check its"),
        ("force", "^force sensor PORT: no answer .* nothing was received; check the sensor's power and cable$"),
    ],
)
def test_names_a_device_that_is_silent(world: World, device: str, refusal: str) -> None:
    with serial_line() as (_, port):
        line = refused_at_opening(world, *world.addresses(**{device: {"port": port}}))
    assert re.search(refusal.replace("PORT", port), line)


def test_names_a_silent_mocap_server(world: World) -> None:
    with closing(udp_port()) as silent:
        port = silent.getsockname()[1]
        line = refused_at_opening(world, *world.addresses(mocap={"command_port": port}))
    assert re.search(
        rf"^mocap 127\.0\.0\.1:{port}: no answer to the NatNet connect request within .*; is Motive running", line
    )


def test_refuses_a_start_other_than_the_missions_though_it_refused_before(
    sandbox: Sandbox, world: World, tmp_path: Path
) -> None:
    """The force sensor's port is wrong first. Then the arm and the vehicle both stand elsewhere: one line for each, and no other."""
    wrong = WRONG["force port that is not there"]
    with sandbox_in(tmp_path / "refused") as its:
        assert_one_line(refused(its, world, *world.addresses(**wrong.but)), wrong.line)
    start = {"mission.start.arm_deg": [150.0, 140.0], "mission.start.position_m": [-0.5, 0.0]}
    ended = refused(sandbox, world, *world.addresses(), *set_options(**start))
    assert len(ended.err_lines) == 2, ended.err
    for pattern in (
        r"^arm at the start: \(165, 140\) deg, wanted \(150, 140\) ± 10 deg; move the arm there by hand",
        r"^start position in the motion-capture axes: \(-1\.0\d, -?0\.0\d\) m, 0\.50 m away, wanted \(-0\.5, 0\) m, .*; carry the",
    ):
        assert [line for line in ended.err_lines if re.search(pattern, line)], (pattern, ended.err)
