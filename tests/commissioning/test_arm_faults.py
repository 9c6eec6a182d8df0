"""`companion arm` against the simulated world over a real pty, one thing wrong each time: found, and what is proposed puts it right."""

from __future__ import annotations

import asyncio
import os
import re
import select
import signal
import subprocess
import sys
import time
from pathlib import Path

import pytest

from companion.commissioning.arm_scan import judge, scan
from companion.config.loader import load_vehicle
from companion.exit_codes import EXIT_ABORTED, EXIT_BAD_INPUT, EXIT_OK, EXIT_REFUSED
from sitl.servo_bus import ServoBus
from sitl.servo_model import ServoModel
from tests.commissioning.arm_rig import SHIPPED, bad_ids, keys, rig, row_of
from tests.support import DEADLINE_S

pytestmark = pytest.mark.waits

OUT_OF_THE_BOX = {
    f"arm.scan.joint{n}.{name}" for n in (1, 2) for name in ("return_delay_time", "operating_mode")
}  # fmt: skip
HAND = "world.arm_hand=true"
FILES = "3000000"
"""The shipped vehicle file's baud rate: to look at it alone takes a second."""


def test_servos_out_of_their_boxes_are_set_up_and_nothing_else_is_wrong(tmp_path: Path) -> None:
    with rig(tmp_path) as one:
        code, found = one.json("scan")
        assert (code, bad_ids(found), keys(found)) == (EXIT_REFUSED, OUT_OF_THE_BOX, {})
        assert {row_of(found, name)["fix"] for name in OUT_OF_THE_BOX} == {"companion arm setup"}
        code, left = one.json("setup")
        assert (code, left["outcome"]) == (EXIT_REFUSED, "not written"), "nobody could be asked"
        assert bad_ids(one.json("scan", "--baud", FILES)[1]) == OUT_OF_THE_BOX
        code, done = one.json("setup", "--yes")
        assert (code, done["outcome"]) == (EXIT_OK, "written")
        changes = {change["register"]: (change["before"], change["after"]) for change in done["servos"][0]["changes"]}
        assert changes == {9: ("500 us", "0 us"), 11: ("3 (position)", "0 (current)")}
        assert one.json("setup", "--yes")[1]["outcome"] == "nothing to do"
        assert one.json("scan", "--baud", FILES)[0] == EXIT_OK
        one.assert_check_passes_the_arm()


def test_a_wrong_id_is_found_and_the_file_or_the_servo_gives_way(tmp_path: Path) -> None:
    with rig(tmp_path, "world.servos=[{}, {id: 7}]") as one:
        assert not one.check_rows()["arm.device"]["ok"]
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
        one.assert_check_passes_the_arm()


def test_a_wrong_baud_rate_is_found_and_set_last(tmp_path: Path) -> None:
    with rig(tmp_path, "world.servos=[{baud: 57600, id: 4}, {baud: 1000000}]") as one:
        code, found = one.json("scan")
        assert code == EXIT_REFUSED
        assert {(servo["id"], servo["baud"], servo["joint"]) for servo in found["servos"]} == {
            (4, 57600, 1),
            (2, 1000000, 2),
        }
        assert row_of(found, "arm.scan.baud")["fix"] == "companion arm setup brings every servo to 3000000"
        alone = one.json("scan", "--baud", "57600")[1]
        assert (alone["bauds"], [servo["id"] for servo in alone["servos"]]) == ([57600], [4])
        fix = "servo 1 and 2 does not answer at 57600 baud: companion arm scan without --baud looks at all rates"
        assert row_of(one.json("scan", "--baud", FILES)[1], "arm.scan.ids")["fix"] == fix.replace("57600", FILES)
        code, done = one.json("setup", "--yes")
        assert code == EXIT_OK
        assert [[c["register"] for c in servo["changes"]] for servo in done["servos"]] == [[9, 11, 7, 8], [9, 11, 8]]
        one.assert_check_passes_the_arm()


def test_servos_that_agree_on_another_baud_rate_may_be_what_the_file_says(tmp_path: Path) -> None:
    with rig(tmp_path, "world.servos=[{baud: 1000000, return_delay_us: 0, operating_mode: 0}, "
             "{baud: 1000000, return_delay_us: 0, operating_mode: 0}]") as one:  # fmt: skip
        code, found = one.json("scan", "--baud", "1000000")
        assert (code, bad_ids(found), keys(found)) == (EXIT_REFUSED, {"arm.scan.baud"}, {"devices.arm.baud": 1000000})
        assert one.json("scan", "--write")[0] == EXIT_OK
        one.assert_check_passes_the_arm()


def test_two_servos_with_one_id_are_set_up_one_at_a_time(tmp_path: Path) -> None:
    """As they come: both id 1 at 57600 baud. Nobody can write to one of them alone before one is unplugged."""
    (tmp_path / "both").mkdir()
    with rig(tmp_path / "both", "world.servos=[{baud: 57600}, {baud: 57600, id: 1}]") as one:
        code, found = one.json("scan", "--baud", "57600")
        assert code == EXIT_REFUSED and found["garbled_at"] == [57600]
        assert "companion arm setup --joint 1" in row_of(found, "arm.scan.collision")["fix"]
        code, refused = one.json("setup", "--yes")
        assert (code, refused["outcome"], refused["servos"]) == (EXIT_REFUSED, "refused", [])
    for joint, servos in (
        (1, "[{baud: 57600}, {connected: false}]"),
        (2, "[{connected: false}, {baud: 57600, id: 1}]"),
    ):
        (tmp_path / str(joint)).mkdir()
        with rig(tmp_path / str(joint), f"world.servos={servos}") as one:
            code, done = one.json("setup", "--yes", "--joint", str(joint))
            assert (code, done["outcome"]) == (EXIT_OK, "written")
            code, found = one.json("scan", "--baud", FILES)
            assert [(servo["id"], servo["baud"]) for servo in found["servos"]] == [(joint, 3000000)]
            assert code == EXIT_REFUSED and bad_ids(found) == {"arm.scan.ids"}, "the other one is not there"


def test_swapped_servos_a_reversed_sign_and_a_wrong_zero_are_found_by_hand(tmp_path: Path) -> None:
    with rig(tmp_path, "world.servos=[{id: 2, zero_error_deg: 12}, {id: 1, reversed: true}]", HAND) as one:
        assert not one.check_rows()["arm.device"]["ok"]
        code, found = one.json("zero", "--write")
        assert code == EXIT_OK and found["swapped"]
        assert set(keys(found)) == {
            "arm.joints[0].servo_id", "arm.joints[0].zero_count", "arm.joints[1].servo_id", "arm.joints[1].sign"
        }  # fmt: skip
        first, second = load_vehicle(one.vehicle).arm.joints
        assert (first.servo_id, first.sign, second.servo_id, second.sign, second.zero_count) == (2, 1, 1, 1, 3072)
        assert first.zero_count == pytest.approx(1024 + 12 / 360 * 4096, abs=8)
        one.assert_check_passes_the_arm()
        # Of the arm in its stand the world knows the truth: where it stood before the tool came it is told by the new numbers.
        code, again = one.json("zero")
        assert (code, again["swapped"], keys(again)) == (EXIT_OK, False, {})


def test_doubled_friction_and_a_weaker_motor_are_measured(tmp_path: Path) -> None:
    weak = "{torque_per_amp_error: 0.1}"
    with rig(tmp_path, "world.joint_friction_nm=0.08", f"world.servos=[{weak}, {weak}]", HAND) as one:
        with one.start("friction", "--yes", "--write") as running:
            running.wait_for("joint 2 to 0 deg, on the way")
            running.wait_for("joint 2 to 70 deg, at 9 deg/s")
            ended = running.end()
        assert ended.code == EXIT_OK, ended
        arm = load_vehicle(one.vehicle).arm
        assert arm.torque_per_amp_nm_a == pytest.approx(1.3 / 1.1, rel=0.02)
        assert arm.joint_friction_nm == pytest.approx(0.08, abs=0.01)
        assert "cannot tell" not in ended.out
        one.assert_check_passes_the_arm()


def test_jog_moves_one_joint_and_stays_within_the_walls(tmp_path: Path) -> None:
    with rig(tmp_path, HAND) as one:
        code, done = one.json("jog", "--joint", "2", "--to", "120", "--yes")
        assert (code, done["stopped"]) == (EXIT_OK, "")
        assert done["angle_deg"] == pytest.approx([165.0, 120.0], abs=1.0)
        assert max(done["load_max_nm"]) < 0.5
        for words, told in (
            (("--joint", "2", "--to", "149"), "expected -7 to 147 deg"),
            (("--joint", "2"), "--joint N and --to DEG belong together"),
            ((), "no terminal to take keys from"),
            (("--joint", "3", "--to", "0"), "expected 1 (shoulder) or 2 (elbow), got '3'"),
        ):
            ended = one.run("jog", *words, "--yes")
            assert ended.code == EXIT_BAD_INPUT and told in ended.err and len(ended.err_lines) == 1, ended
        ended = one.run("jog", "--joint", "2", "--to", "100")
        assert ended.code == EXIT_BAD_INPUT and "add --yes" in ended.err


def test_jog_stops_when_gravity_does_not_explain_the_load(tmp_path: Path) -> None:
    """The world's arm is far heavier than the vehicle file's: as if it leaned on something."""
    with rig(tmp_path, HAND, "vehicle.tool.net_mass_kg=0.6") as one:
        code, done = one.json("jog", "--joint", "2", "--to", "60", "--yes")
        assert code == EXIT_REFUSED
        assert "beside gravity; look what is in its way" in done["stopped"] or "from where it is led" in done["stopped"]


def test_ctrl_c_leaves_the_arm_limp(tmp_path: Path) -> None:
    with rig(tmp_path, HAND) as one:
        with one.start("friction", "--yes") as running:
            running.wait_for("joint 1 to 90 deg, on the way")
            running.signal(signal.SIGINT)
            ended = running.end()
        assert ended.code == EXIT_ABORTED and ended.err_lines == ["companion arm: interrupted"], ended
        limp = scan(load_vehicle(one.vehicle, [f"vehicle.devices.arm.port={one.port}"]).devices.arm, only=int(FILES))
        assert [servo.as_json()["torque_on"] for servo in limp.servos] == [False, False]
        assert [servo.as_json()["watchdog"] for servo in limp.servos] == ["off", "off"]
        one.sandbox.assert_nobody_left()


@pytest.mark.parametrize("background", [False, True], ids=["terminal", "background"])
def test_ctrl_c_during_zero_puts_the_lights_out(tmp_path: Path, background: bool) -> None:
    with rig(tmp_path) as one:
        with one.start("zero", background=background) as running:
            running.wait_for("1/3  hold the whole arm")
            running.signal(signal.SIGINT)
            ended = running.end()
        assert ended.code == EXIT_ABORTED, ended
        one.sandbox.assert_nobody_left()


def test_an_adapter_with_the_factory_latency_timer_is_found(tmp_path: Path) -> None:
    """On a real pty, with the file that the kernel would show for an FTDI adapter."""

    async def look(latency: str) -> dict[str, str]:
        async with ServoBus([ServoModel(1), ServoModel(2)]) as bus:
            timer = tmp_path / os.path.basename(bus.path) / "device/latency_timer"
            timer.parent.mkdir(parents=True, exist_ok=True)
            timer.write_text(latency, encoding="utf-8")
            vehicle = load_vehicle(SHIPPED, [f"vehicle.devices.arm.port={bus.path}"])
            found = await asyncio.to_thread(scan, vehicle.devices.arm, sysfs=tmp_path, only=int(FILES))
            return {row.id: row.fix for row in judge(found, vehicle).rows if not row.ok and row.read.endswith(" ms")}

    assert asyncio.run(look("16\n")).keys() == {"arm.scan.usb_latency"}
    assert "udev rule" in asyncio.run(look("16\n"))["arm.scan.usb_latency"]
    assert asyncio.run(look("1\n")) == {}


@pytest.mark.parametrize("tool", ["scan", "setup", "zero", "jog", "friction"])
def test_a_port_that_is_not_there_is_one_line(tmp_path: Path, tool: str, capsys: pytest.CaptureFixture[str]) -> None:
    from companion.cli import main

    words = ["--joint", "1", "--to", "90"] if tool == "jog" else []
    yes = ["--yes"] if tool in ("setup", "jog", "friction") else []
    code = main(
        ["arm", tool, *words, *yes, "--vehicle", str(SHIPPED), "--set", f"vehicle.devices.arm.port={tmp_path}/none"]
    )
    err = capsys.readouterr().err.splitlines()
    assert code == EXIT_REFUSED and len(err) == 1 and f"{tmp_path}/none: no such port" in err[0]


def test_a_baud_rate_that_the_servos_do_not_have_is_bad_input(capsys: pytest.CaptureFixture[str]) -> None:
    from companion.cli import main

    assert main(["arm", "scan", "--baud", "3000001", "--vehicle", str(SHIPPED)]) == EXIT_BAD_INPUT
    expected = "--baud 3000001: expected one of 9600, 57600, 115200, 1000000, 2000000, 3000000, 4000000\n"
    assert capsys.readouterr().err == expected


def test_keys_at_a_terminal_move_the_arm_and_q_lets_go(tmp_path: Path) -> None:
    with rig(tmp_path, HAND) as one:
        ours, theirs = os.openpty()
        try:
            process = subprocess.Popen(
                [sys.executable, "-m", "companion.cli", "arm", "jog", "--yes", *one.options()],
                cwd=one.sandbox.cwd,
                env={**one.sandbox.environment, "TERM": "xterm"},
                stdin=theirs,
                stdout=theirs,
                stderr=theirs,
                start_new_session=True,
            )
            os.close(theirs)
            seen = read_until(ours, r"joint 2\s.* 1(39|40)\.\d deg")
            os.write(ours, b"2-")
            seen += read_until(ours, r"joint 2\s.* 13[78]\.\d deg")
            os.write(ours, b"q")
            seen += read_until(ours, "the arm is limp")
            assert process.wait(DEADLINE_S) == EXIT_OK, seen
        finally:
            os.close(ours)
        one.sandbox.assert_nobody_left()


def read_until(terminal: int, pattern: str) -> str:
    """What the terminal shows, until it shows this."""
    deadline_s, seen = time.monotonic() + DEADLINE_S, ""
    while not re.search(pattern, seen):
        left_s = deadline_s - time.monotonic()
        assert left_s > 0 and select.select([terminal], [], [], left_s)[0], (pattern, seen)
        seen += os.read(terminal, 65536).decode(errors="replace")
    return seen
