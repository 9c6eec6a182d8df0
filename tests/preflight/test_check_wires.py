"""`companion check` and the preflight of `companion fly` over real wires: a sound world passes; what is wrong in it is reported by the
right rows, and refuses.
"""

from __future__ import annotations

import asyncio
import io
import json
import os
import signal
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest
from rich.console import Console

from companion.cli.check import show
from companion.model.check_row import Row
from companion.model.codec import from_jsonable
from companion.model.exit_codes import EXIT_ABORTED, EXIT_OK, EXIT_REFUSED
from companion.preflight import evaluation, frames, mocap
from companion.px4 import required
from companion.px4.versions import has
from companion.sitl_config.loader import load_sitl
from sitl.servo.bus import ServoBus
from sitl.servo.model import ServoModel, ServoRefusal
from sitl.servo.protocol import StatusError
from tests.support import CATCH, HOVER, Ended, Sandbox, World, read_summary, sandbox_in, set_options
from tests.wires import serial_line

OPERATING_MODE, MODE_POSITION = 11, 3


@pytest.fixture
def sandbox(tmp_path: Path) -> Iterator[Sandbox]:
    """With a state folder of its own: nobody's hand test counts."""
    with sandbox_in(tmp_path, {"XDG_STATE_HOME": str(tmp_path / "state")}) as sandbox:
        yield sandbox


def rows_in(text: str) -> dict[str, dict[str, Any]]:
    """Rows of a document by their ids: of `check --json`, or `preflight.json`."""
    document = json.loads(text)
    assert document["schema_version"] == 1
    rows = {row["id"]: row for row in document["rows"]}
    assert len(rows) == len(document["rows"])
    assert document["ok"] == (not refusing(rows))
    return rows


def refusing(rows: dict[str, dict[str, Any]]) -> set[str]:
    return {name for name, row in rows.items() if not row["ok"] and row["level"] == "refuse"}


def test_a_sound_world_may_fly_and_every_row_is_reported(sandbox: Sandbox) -> None:
    reflection = "world.markers={on: true, stray_per_s: 0, fixed_m: [[2.0, 1.0, 0.03], [1.0, 1.0, 9.0]]}"
    ball = ("--set", "vehicle.devices.mocap.ball={kind: marker}", reflection)
    ended = sandbox.run("check", CATCH, "--sitl", "--json", *ball)
    sandbox.assert_nobody_left()
    assert (ended.code, ended.err) == (EXIT_OK, ""), ended
    rows = rows_in(ended.out)
    assert not refusing(rows)
    assert rows["mocap.ball"]["read"] == "2 to 2 single markers, 1 to 1 of them in the room"
    # The simulated world has no port TELEM2, and nobody moves it by hand.
    params = {f"px4.param.{one.name}" for one in required.WANTED if not one.hardware and has(one.name, (1, 16))}
    assert (
        set(rows)
        == {check.id for check in evaluation.CHECKS} - {frames.HAND_TEST.id, mocap.BAR.id} | {"px4.firmware"} | params
    )
    assert all(row["read"] and row["why"] for row in rows.values())


def test_a_wrong_setting_refuses_the_flight(sandbox: Sandbox, tmp_path: Path) -> None:
    """Joint angle, force bias, and two parameters and the kill switch of PX4, in the world alone, and another start in the mission."""
    wrong = (
        "mission.start.arm_deg=[140, 120]",
        "world.force_bias_n=[30, 0, 0]",
        "world.px4_params={COM_OBL_RC_ACT: 0, EKF2_EV_CTRL: 0}",
        "world.faults=[{kind: kill_switch, after: start, t_s: 0}]",
    )
    elsewhere = set_options(**{"mission.start.position_m": [-0.5, 0.0]})
    expected = {
        "mission.arm",
        "frames.place",
        "force.tare",
        "px4.param.COM_OBL_RC_ACT",
        "px4.param.EKF2_EV_CTRL",
        "px4.vision",
        "px4.kill_switch",
    }
    with sandbox_in(tmp_path / "world") as around, World(around, CATCH, wrong) as world:
        flown = sandbox.run("fly", CATCH, "--out", "out", *world.addresses(), *elsewhere)
        assert flown.code == EXIT_REFUSED, flown
        assert (world.armings, world.crashes) == (0, 0)
    sandbox.assert_nobody_left()
    for start in (
        "arm at the start: (140, 120) deg, wanted (165, 140)",
        "start position in the motion-capture axes: (-1.0",
        "force sensor tare: (",
        "COM_OBL_RC_ACT: 0, wanted 4; set",
        "EKF2_EV_CTRL: 0, wanted 11 or 15; set EKF2_EV_CTRL to 11 (companion px4 params --write)",
        "EKF2 fuses motion capture: the estimator reports no valid ",
    ):
        assert [line for line in flown.err_lines if line.startswith(start)], (start, flown.err)
    summary = read_summary(sandbox.cwd / "out")
    assert (summary["outcome"], summary["events"]) == ("refused", [])
    rows = rows_in((sandbox.cwd / "out/preflight.json").read_text(encoding="utf-8"))
    assert expected <= refusing(rows) and len(flown.err_lines) == len(refusing(rows)), flown.err
    follows = refusing(rows) - expected
    assert all(name.startswith(("px4.", "frames.")) for name in follows), f"not of an estimate without poses: {follows}"
    printed = io.StringIO()
    show(
        Console(file=printed, width=200),
        [from_jsonable(Row, row) for row in rows.values()],
        load_sitl(CATCH),
        simulated=False,
    )
    assert "the vehicle may not fly." in printed.getvalue()
    assert "-> set COM_OBL_RC_ACT to 4" in printed.getvalue()
    assert "(140, 120) deg" in rows["mission.arm"]["read"]
    assert rows["force.tare"]["read"].startswith("(30.0, ")
    assert rows["px4.param.COM_OBL_RC_ACT"]["fix"].startswith("set COM_OBL_RC_ACT to 4")
    assert rows["frames.hand_test"]["level"] == "warn" and not rows["frames.hand_test"]["ok"]
    assert not (sandbox.cwd / "out/flight.mcap").exists()


class StubbornServo(ServoModel):
    """It stays in position mode: its EEPROM takes no other one."""

    def __init__(self, servo_id: int) -> None:
        super().__init__(servo_id)
        super().write(OPERATING_MODE, bytes([MODE_POSITION]))

    def write(self, address: int, data: bytes) -> None:
        if address <= OPERATING_MODE < address + len(data):
            raise ServoRefusal(StatusError.ACCESS)
        super().write(address, data)


def test_in_a_sound_world_devices_that_do_not_open_are_rows_and_ctrl_c_arms_nothing(
    sandbox: Sandbox, tmp_path: Path
) -> None:
    """No force sensor, and a servo that refuses its operating mode; then a flight that is interrupted in its preflight."""

    async def check(world: World) -> Ended:
        async with ServoBus([StubbornServo(1), StubbornServo(2)]) as bus:
            options = world.addresses(arm={"port": bus.path}, force={"port": "/dev/ttyNONE"})
            return await asyncio.to_thread(sandbox.run, "check", CATCH, "--json", *options)

    longer = set_options(**{"vehicle.safety.preflight_s": 60.0})
    with sandbox_in(tmp_path / "world") as around, World(around) as world:
        ended = asyncio.run(check(world))
        with sandbox.start("fly", CATCH, "--out", "out", *longer, *world.addresses()) as running:
            running.wait_for("all devices ... ")
            running.signal(signal.SIGINT)
            given_up = running.end()
        assert (world.armings, world.crashes) == (0, 0)
    sandbox.assert_nobody_left()
    assert ended.code == EXIT_REFUSED, ended
    rows = rows_in(ended.out)
    assert refusing(rows) == {"arm.device", "force.device"}
    assert "writing operating mode (register 11) was refused" in rows["arm.device"]["read"]
    assert "/dev/ttyNONE: no such port" in rows["force.device"]["read"]
    assert rows["px4.vision"]["ok"] and rows["mocap.rate"]["ok"] and rows["frames.gravity"]["ok"]
    assert (given_up.code, given_up.err) == (EXIT_ABORTED, ""), given_up
    assert read_summary(sandbox.cwd / "out")["outcome"] == "aborted"
    assert not (sandbox.cwd / "out/preflight.json").exists()


def test_ctrl_c_during_a_check_leaves_nothing(sandbox: Sandbox) -> None:
    with serial_line() as (far, port):
        options = set_options(**{"vehicle.devices.force.port": port, "vehicle.devices.mocap.interface": "127.0.0.1"})
        with sandbox.start("check", HOVER, *options) as running:
            assert os.read(far, 1)  # it speaks to the sensor
            running.signal(signal.SIGINT)
            ended = running.end()
    sandbox.assert_nobody_left()
    assert (ended.code, ended.out, ended.err) == (EXIT_ABORTED, "", "companion check: interrupted\n"), ended
