"""Ctrl-C, bad input and missing devices: each ends a commissioning tool with one line, and changes nothing."""

from __future__ import annotations

import signal
import time
from collections.abc import Iterator
from pathlib import Path

import pytest

from companion.model.exit_codes import EXIT_ABORTED, EXIT_BAD_INPUT, EXIT_REFUSED
from tests.commissioning.test_mocap_wires import VEHICLE
from tests.support import CATCH, DEADLINE_S, Running, Sandbox, World, run_here, sandbox_in, set_options


@pytest.fixture(scope="module")
def world(tmp_path_factory: pytest.TempPathFactory) -> Iterator[World]:
    with sandbox_in(tmp_path_factory.mktemp("world")) as around, World(around) as made:
        yield made


def wait_for_error(running: Running, text: str) -> None:
    """Until standard error has shown it: there people are reported what to do."""
    deadline_s = time.monotonic() + DEADLINE_S
    while text not in running._text("err"):
        assert running._pump(deadline_s), (text, running._text("out"), running._text("err"))


@pytest.mark.parametrize(
    ("words", "shown", "last"),
    [
        (("mocap", "check", "--seconds", 300), "watching", "companion mocap: interrupted"),
        (("mocap", "align", CATCH, "--json"), "1/4", "cancelled; nothing was changed"),
        (("latency",), "hold the vehicle up", "companion latency: interrupted"),
        (("ft", "check", "--weight", 1), "empty and untouched", "companion ft: interrupted"),
    ],
    ids=lambda value: " ".join(map(str, value[:2])) if isinstance(value, tuple) else "",
)
def test_ctrl_c_ends_it(
    sandbox: Sandbox, world: World, tmp_path: Path, words: tuple[object, ...], shown: str, last: str
) -> None:
    vehicle = VEHICLE.read_bytes()
    with sandbox.start(*words, "--vehicle", VEHICLE, *world.addresses()) as running:
        wait_for_error(running, shown)
        running.signal(signal.SIGINT)
        ended = running.end()
    assert (ended.code, ended.out) == (EXIT_ABORTED, ""), ended
    assert last in ended.err_lines[-1]
    assert VEHICLE.read_bytes() == vehicle


@pytest.mark.parametrize(
    "words",
    [
        ("ft", "check", "--weight", "0"),
        ("ft", "check", "--weight", "nan"),
        ("ft", "check", "--arm-pose", "90"),
        ("ft", "check", "--arm-pose", "10,0"),
        ("ft", "tare", "--seconds", "1"),
        ("latency", "--taps", "2"),
        ("latency", "--seconds", "nan"),
        ("latency", "--taps", "many"),
        ("mocap", "check", "--seconds", "0"),
        ("mocap", "check", "--seconds", "nan"),
        ("mocap", "check", "--vehicle", "none.yaml"),
    ],
    ids=" ".join,
)
def test_bad_input_opens_nothing(words: tuple[str, ...]) -> None:
    ended = run_here(*words, *(() if "--vehicle" in words else ("--vehicle", VEHICLE)))
    assert ended.code == EXIT_BAD_INPUT
    assert len(ended.err_lines) == 1


@pytest.mark.parametrize("part", ["scan", "setup", "zero", "jog", "friction", "reboot"])
def test_a_tool_of_the_arm_refuses_a_vehicle_without_one(part: str) -> None:
    parts = ("vehicle.arm", "vehicle.tool", "vehicle.devices.arm", "vehicle.devices.force")
    ended = run_here("arm", part, "--vehicle", VEHICLE, *set_options(**dict.fromkeys(parts)))
    assert ended.code == EXIT_BAD_INPUT
    [line] = ended.err_lines
    assert line == f"companion arm {part}: expected a vehicle with an arm, but arm is null in {VEHICLE}"


LOOPBACK = {"mocap.server": "127.0.0.1", "mocap.interface": "127.0.0.1"}
POSE = ("--arm-pose", "90,0")


@pytest.mark.parametrize(
    ("words", "devices", "expected"),
    [
        (("ft", "check", *POSE), {"force.port": "/dev/no-such-port"}, "no such port"),
        (("ft", "tare", *POSE), {"force": None}, "vehicle 'tarot650-2r' has none; add devices.force"),
        (("mocap", "check"), {**LOOPBACK, "mocap.command_port": 9}, "no server answers on this segment"),
    ],
)
def test_a_missing_device_is_reported(words: tuple[str, ...], devices: dict[str, object], expected: str) -> None:
    settings = set_options(**{f"vehicle.devices.{key}": value for key, value in devices.items()})
    ended = run_here(*words, "--vehicle", VEHICLE, *settings)
    assert ended.code == EXIT_REFUSED
    assert expected in ended.out
    assert "Traceback" not in ended.err


def test_a_missing_px4_is_reported(world: World) -> None:
    address = {"address": "serial:///dev/ttyNONE:921600"}
    ended = run_here("latency", "--vehicle", VEHICLE, *world.addresses(autopilot=address))
    assert ended.code == EXIT_REFUSED
    assert "the serial port /dev/ttyNONE, found No such file" in ended.out
    assert "Traceback" not in ended.err
