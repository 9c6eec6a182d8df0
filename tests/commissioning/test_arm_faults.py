"""`companion arm` against emulated servos over a real pty, one thing wrong each time: found, and what is proposed puts it right."""

from __future__ import annotations

import asyncio
import os
from collections.abc import Callable
from functools import partial
from pathlib import Path

import pytest

from companion.cli.main import main
from companion.commissioning.arm import scan as arm_scan
from companion.commissioning.arm.scan import judge, scan
from companion.config.loader import load_vehicle
from companion.io.dynamixel.port import usb_latency_ms
from companion.model.exit_codes import EXIT_ABORTED, EXIT_BAD_INPUT, EXIT_OK, EXIT_REFUSED
from sitl.servo.bus import ServoBus
from sitl.servo.model import ServoModel
from tests.commissioning.arm_rig import FILES, HAND, SHIPPED, Rig, bad_ids, bench, keys, rig, row_of, served
from tests.support import sandbox_in

OUT_OF_THE_BOX = {
    f"arm.scan.joint{n}.{name}" for n in (1, 2) for name in ("return_delay_time", "operating_mode")
}  # fmt: skip
RIGHT_ZERO_COUNT = round(1024 + 12 / 360 * 4096)
SET_UP = "return_delay_us: 0, operating_mode: 0"
"""Knobs of a servo that needs no setup."""


@pytest.fixture(autouse=True)
def searched(monkeypatch: pytest.MonkeyPatch) -> Callable[..., None]:
    """Full scans of this process try the vehicle file's baud rate and those only that a test asks for: each takes a second."""

    def search(*bauds: int) -> None:
        monkeypatch.setattr(arm_scan, "SEARCHED", bauds)

    search()
    return search


def test_servos_out_of_their_boxes_are_set_up_and_nothing_else_is_wrong(tmp_path: Path) -> None:
    with bench(tmp_path) as one:
        code, found = one.json("scan", "--baud", FILES, process=True)
        assert (code, bad_ids(found), keys(found)) == (EXIT_REFUSED, OUT_OF_THE_BOX, {})
        assert {row_of(found, name)["fix"] for name in OUT_OF_THE_BOX} == {"companion arm setup"}
        code, left = one.json("setup")
        assert (code, left["outcome"]) == (EXIT_REFUSED, "not written"), "there is no terminal to ask at"
        code, done = one.json("setup", "--yes")
        assert (code, done["outcome"]) == (EXIT_OK, "written")
        changes = {change["register"]: (change["before"], change["after"]) for change in done["servos"][0]["changes"]}
        assert changes == {9: ("500 us", "0 us"), 11: ("3 (position)", "0 (current)")}
        assert one.json("scan", "--baud", FILES)[0] == EXIT_OK
        code, done = one.json("setup", "--yes")
        assert (code, done["outcome"]) == (EXIT_OK, "nothing to do")
        one.assert_check_passes_the_arm()


def test_a_wrong_id_is_found_and_the_file_or_the_servo_is_changed(tmp_path: Path) -> None:
    with bench(tmp_path, "[{}, {id: 7}]") as one:
        assert not one.check_rows()["arm.device"].ok
        before = one.vehicle.read_text(encoding="utf-8")
        code, found = one.json("scan", "--write")
        assert code == EXIT_REFUSED, "settings are still those of the box"
        assert row_of(found, "arm.scan.ids")["fix"].startswith("companion arm setup gives servo 7 the id 2")
        assert keys(found) == {"arm.joints[1].servo_id": 7}
        assert load_vehicle(one.vehicle).arm.joints[1].servo_id == 7
        assert Path(f"{one.vehicle}.bak").read_text(encoding="utf-8") == before
        one.assert_check_passes_the_arm()

        one.vehicle.write_text(before, encoding="utf-8")
        code, done = one.json("setup", "--yes")
        assert code == EXIT_OK
        assert (7, "7", "2") in {(c["register"], c["before"], c["after"]) for c in done["servos"][1]["changes"]}
        assert one.check_rows()["arm.device"].ok


def test_a_wrong_baud_rate_is_found_and_set_last(tmp_path: Path, searched: Callable[..., None]) -> None:
    searched(1_000_000, 57_600)
    with bench(tmp_path, "[{baud: 57600, id: 4}, {baud: 1000000}]") as one:
        code, found = one.json("scan")
        assert code == EXIT_REFUSED
        assert {(servo["id"], servo["baud"], servo["joint"]) for servo in found["servos"]} == {
            (4, 57600, 1),
            (2, 1000000, 2),
        }
        assert row_of(found, "arm.scan.baud")["fix"] == "companion arm setup sets every servo to 3000000"
        alone = one.json("scan", "--baud", "57600")[1]
        assert (alone["bauds"], [servo["id"] for servo in alone["servos"]]) == ([57600], [4])
        fix = "servo 1 and 2 does not answer at 57600 baud: companion arm scan without --baud tries all rates"
        assert row_of(one.json("scan", "--baud", FILES)[1], "arm.scan.ids")["fix"] == fix.replace("57600", FILES)
        code, done = one.json("setup", "--yes")
        assert code == EXIT_OK
        assert [[c["register"] for c in servo["changes"]] for servo in done["servos"]] == [[9, 11, 7, 8], [9, 11, 8]]
        one.assert_check_passes_the_arm()


def test_servos_that_agree_on_another_baud_rate_may_be_what_the_file_says(
    tmp_path: Path, searched: Callable[..., None]
) -> None:
    searched(1_000_000)
    with bench(tmp_path, f"[{{baud: 1000000, {SET_UP}}}, {{baud: 1000000, {SET_UP}}}]") as one:
        code, found = one.json("scan", "--write")
        assert (code, bad_ids(found), keys(found)) == (EXIT_OK, {"arm.scan.baud"}, {"devices.arm.baud": 1000000})
        one.assert_check_passes_the_arm()


def test_two_servos_with_one_id_are_not_set_up_together(tmp_path: Path, searched: Callable[..., None]) -> None:
    """As they come: both id 1 at 57600 baud. Nobody can write to one of them alone before one is unplugged."""
    searched(57_600)
    with bench(tmp_path, "[{baud: 57600}, {baud: 57600, id: 1}]") as one:
        code, found = one.json("scan", "--baud", "57600")
        assert code == EXIT_REFUSED and found["garbled_at"] == [57600]
        assert "companion arm setup --joint 1" in row_of(found, "arm.scan.collision")["fix"]
        code, refused = one.json("setup", "--yes")
        assert (code, refused["outcome"], refused["servos"]) == (EXIT_REFUSED, "refused", [])


def test_two_servos_with_one_id_are_set_up_one_at_a_time(tmp_path: Path, searched: Callable[..., None]) -> None:
    """The elbow's servo after the shoulder's: it still has the shoulder's id."""
    searched(57_600)
    with bench(tmp_path, "[{connected: false}, {baud: 57600, id: 1}]") as one:
        code, done = one.json("setup", "--yes", "--joint", "2")
        assert (code, done["outcome"]) == (EXIT_OK, "written")
        code, found = one.json("scan", "--baud", FILES)
        assert [(servo["id"], servo["baud"]) for servo in found["servos"]] == [(2, 3000000)]
        assert code == EXIT_REFUSED and bad_ids(found) == {"arm.scan.ids"}, "the other one is not there"


def test_swapped_servos_a_reversed_sign_and_a_wrong_zero_are_found_by_hand(tmp_path: Path) -> None:
    with rig(tmp_path, "world.servos=[{id: 2, zero_error_deg: 12}, {id: 1, reversed: true}]", HAND) as one:
        assert not one.check_rows()["arm.device"].ok
        code, found = one.json("zero", "--write")
        assert code == EXIT_OK and found["swapped"]
        assert set(keys(found)) == {
            "arm.joints[0].servo_id", "arm.joints[0].zero_count", "arm.joints[1].servo_id", "arm.joints[1].sign"
        }  # fmt: skip
        first, second = load_vehicle(one.vehicle).arm.joints
        assert (first.servo_id, first.sign, second.servo_id, second.sign, second.zero_count) == (2, 1, 1, 1, 3072)
        assert first.zero_count == pytest.approx(RIGHT_ZERO_COUNT, abs=8)
        one.assert_check_passes_the_arm()


def test_doubled_friction_and_a_weaker_motor_are_measured(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Joint limits about hanging and fast sweeps keep it short."""
    monkeypatch.setattr("companion.commissioning.arm.sweep.SPEEDS_DEG_S", (12.0, 20.0))
    weak = "{torque_per_amp_error: 0.1}"
    knobs = ("world.joint_friction_nm=0.08", f"world.servos=[{weak}, {weak}]", "mission.start.arm_deg=[100,0]")
    narrow = (
        "vehicle.arm.joints[0].angle_deg=[77,103]",
        "vehicle.arm.joints[1].angle_deg=[-10,28]",
        "vehicle.safety.fold_arm_deg=[100,0]",
        "vehicle.arm.poses={}",
    )
    with rig(tmp_path, *knobs, HAND) as one:
        ended = one.run("friction", "--yes", "--write", *(word for limits in narrow for word in ("--set", limits)))
        assert ended.code == EXIT_OK, ended
        for words in ("joint 2 to 0 deg, on the way", "joint 2 to 25 deg, at 12 deg/s"):
            assert words in ended.out
        arm = load_vehicle(one.vehicle).arm
        assert arm.torque_per_amp_nm_a == pytest.approx(1.3 / 1.1, rel=0.05)
        assert arm.joint_friction_nm == pytest.approx(0.08, abs=0.02)
        one.assert_check_passes_the_arm()


def test_an_overload_is_cleared_by_a_reboot_that_was_confirmed(tmp_path: Path) -> None:
    servos = [ServoModel(joint.servo_id) for joint in load_vehicle(SHIPPED).arm.joints]
    servos[1].trip_overload()
    with sandbox_in(tmp_path) as sandbox, served(ServoBus(servos)) as port:
        one = Rig(sandbox, port, SHIPPED)
        assert one.run("reboot").code == EXIT_ABORTED, "there is no terminal to ask at"
        code, found = one.json("reboot", "--yes")
    assert (code, [(servo["before"], servo["after"]) for servo in found["servos"]]) == (EXIT_OK, [(0, 0), (32, 0)])


def test_an_adapter_with_the_factory_latency_timer_is_found(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """On a real pty, with the file that the kernel would show for an FTDI adapter."""
    monkeypatch.setattr(arm_scan, "usb_latency_ms", partial(usb_latency_ms, sysfs=tmp_path))

    async def look(latency: str) -> dict[str, str]:
        async with ServoBus([ServoModel(1), ServoModel(2)]) as bus:
            timer = tmp_path / os.path.basename(bus.path) / "device/latency_timer"
            timer.parent.mkdir(parents=True, exist_ok=True)
            timer.write_text(latency, encoding="utf-8")
            vehicle = load_vehicle(SHIPPED, [f"vehicle.devices.arm.port={bus.path}"])
            found = await asyncio.to_thread(scan, vehicle.arm_device, only=int(FILES))
            return {row.id: row.fix for row in judge(found, vehicle).rows if not row.ok and row.read.endswith(" ms")}

    slow = asyncio.run(look("16\n"))
    assert slow.keys() == {"arm.scan.usb_latency"} and "udev rule" in slow["arm.scan.usb_latency"]
    assert asyncio.run(look("1\n")) == {}


@pytest.mark.parametrize("tool", ["scan", "setup", "zero", "jog", "friction"])
def test_a_port_that_is_not_there_is_one_line(tmp_path: Path, tool: str, capsys: pytest.CaptureFixture[str]) -> None:
    words = ["--joint", "1", "--to", "90"] if tool == "jog" else []
    yes = ["--yes"] if tool in ("setup", "jog", "friction") else []
    code = main(
        ["arm", tool, *words, *yes, "--vehicle", str(SHIPPED), "--set", f"vehicle.devices.arm.port={tmp_path}/none"]
    )
    err = capsys.readouterr().err.splitlines()
    assert code == EXIT_REFUSED and len(err) == 1 and f"{tmp_path}/none: no such port" in err[0]


def test_a_baud_rate_that_the_servos_do_not_have_is_bad_input(capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["arm", "scan", "--baud", "3000001", "--vehicle", str(SHIPPED)]) == EXIT_BAD_INPUT
    expected = "--baud 3000001: expected one of 9600, 57600, 115200, 1000000, 2000000, 3000000, 4000000\n"
    assert capsys.readouterr().err == expected
