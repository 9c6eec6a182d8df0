"""Devices that are not there or not as they must be, on the hardware path: `companion fly` without --sitl against a simulated
world that runs on its own. Each time: exit 3, one clear line, never armed, nothing left, and everything free for the next attempt.

The force sensor has a whole `fly`; the lines of the rest are read where a program opens its devices, in this process.
"""

from __future__ import annotations

import re
from collections.abc import Iterator, Mapping
from dataclasses import dataclass, field, replace

import pytest
import serial

from companion.config.loader import load_flight
from companion.io.devices import open_available
from companion.model.exit_codes import EXIT_REFUSED
from companion.runtime.clock import flight_clock
from companion.runtime.event_loop import run
from tests.support import CATCH, Ended, Sandbox, World, read_summary, sandbox_in, set_options


@pytest.fixture(scope="module")
def world(tmp_path_factory: pytest.TempPathFactory) -> Iterator[World]:
    with sandbox_in(tmp_path_factory.mktemp("world")) as sandbox, World(sandbox) as world:
        yield world


def refused(sandbox: Sandbox, world: World, *options: str) -> Ended:
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
    assert not [event for event in summary["events"] if event["id"] != "computer_busy"]
    lines = [line for line in ended.err.splitlines(keepends=True) if not line.startswith("this computer is too busy")]
    return replace(ended, err="".join(lines))


@dataclass(frozen=True)
class Wrong:
    """One thing that is wrong, and the line that says so."""

    line: str
    but: Mapping[str, object] = field(default_factory=dict)
    """Settings of the device."""
    also: Mapping[str, object] = field(default_factory=dict)
    """Other settings."""


FORCE_PORT = Wrong(
    r"^force sensor /dev/ttyNONE: no such port; .*; plug the sensor in or set devices\.force\.port$",
    {"port": "/dev/ttyNONE"},
)
WRONG: dict[str, Wrong] = {
    "autopilot": Wrong(
        r"^autopilot serial:///dev/ttyNONE:921600: expected the serial port /dev/ttyNONE, found No such file.*; plug",
        {"address": "serial:///dev/ttyNONE:921600"},
    ),
    "arm": Wrong(
        r"^arm bus /dev/pts/\d+: servo 7 \(joint 2\): does not answer at 3000000 baud; ids that answer: 1, 2; check",
        also={"vehicle.arm.joints[1].servo_id": 7},
    ),
    "mocap": Wrong(
        r"^mocap 127\.0\.0\.1:\d+: rigid body id 7 was never seen within .*streams: 1 \"tarot650-2r\"; set devices\.mocap",
        {"rigid_body_id": 7},
    ),
    "force": FORCE_PORT,
}


def test_names_what_is_wrong_with_each_device_and_leaves_no_port_open(world: World) -> None:
    """Each device is refused in its own words (`tests/io` has every reason), and nothing is armed."""
    but = {device: one.but for device, one in WRONG.items()}
    also = {key: value for one in WRONG.values() for key, value in one.also.items()}
    options = [word for word in (*world.addresses(**but), *set_options(**also)) if word != "--set"]

    async def opening() -> dict[str, str]:
        async with open_available(load_flight(CATCH, overrides=options, hardware=True), flight_clock()) as available:
            return available.failures

    found = run(opening())
    assert found.keys() == WRONG.keys(), found
    for device, one in WRONG.items():
        assert re.search(one.line, found[device]), (one.line, found[device])
    assert (world.armings, world.crashes) == (0, 0)
    with (
        serial.Serial(world.devices["arm"]["port"], exclusive=True),
        serial.Serial(world.devices["force"]["port"], exclusive=True),
    ):
        pass


def test_a_flight_whose_force_sensor_is_missing_is_refused(sandbox: Sandbox, world: World) -> None:
    """A start other than the mission's: tests/preflight/test_check_wires.py."""
    ended = refused(sandbox, world, *world.addresses(force=FORCE_PORT.but))
    assert len(ended.err_lines) == 1 and re.search(FORCE_PORT.line, ended.err_lines[0]), ended.err
