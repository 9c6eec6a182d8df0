"""`companion arm setup` and `companion arm scan` for a vehicle with a clamp, on a bus over a real pty."""

from __future__ import annotations

import shutil
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path

from companion.config.loader import load_vehicle
from companion.model.exit_codes import EXIT_OK
from sitl.servo.bus import ServoBus
from sitl.servo.model import ServoModel
from tests.commissioning.arm_rig import Rig, bad_ids, keys, row_of, served
from tests.commissioning.test_arm_faults import searched
from tests.io.arm_rig import register
from tests.support import ROOT, sandbox_in

__all__ = ["searched"]

FILE = ROOT / "configs/vehicles/tarot650_2r_clamp.yaml"


@contextmanager
def bench(folder: Path, *servos: ServoModel) -> Iterator[Rig]:
    mine = Path(shutil.copy(FILE, folder / "mine.yaml"))
    with sandbox_in(folder / "tool") as sandbox, served(ServoBus(servos)) as port:
        yield Rig(sandbox, port, mine)


def settings(clamp: ServoModel) -> tuple[int, int, int, int]:
    return clamp.servo_id, clamp.baud_bps, register(clamp, 11), register(clamp, 9)


def test_a_servo_with_another_id_becomes_the_clamps(tmp_path: Path, searched: Callable[..., None]) -> None:
    searched(57_600)
    clamp = ServoModel(7, baud_bps=57_600, kind="XL330-M288")
    joints = [ServoModel(joint.servo_id, kind=joint.kind.name) for joint in load_vehicle(FILE).arm.joints]
    with bench(tmp_path, *joints, clamp) as one:
        _, found = one.json("scan")
        assert {"arm.scan.ids", "arm.scan.baud", "arm.scan.joint3.operating_mode"} <= bad_ids(found)
        assert keys(found) == {"tool.jaws.servo_id": 7}
        code, done = one.json("setup", "--yes")
        assert code == EXIT_OK, done
        assert settings(clamp) == (3, 3_000_000, 5, 0)
        assert [register(joint, 11) for joint in joints] == [0, 0]
        code, found = one.json("scan")
        assert code == EXIT_OK and row_of(found, "arm.scan.joint3.operating_mode")["ok"]


def test_a_servo_out_of_the_box_is_set_up_alone_and_its_id_is_that_of_a_joint(
    tmp_path: Path, searched: Callable[..., None]
) -> None:
    searched(57_600)
    clamp = ServoModel(1, baud_bps=57_600, kind="XL330-M288")
    with bench(tmp_path, clamp) as one:
        _, found = one.json("scan")
        assert keys(found).get("tool.jaws.servo_id") is None
        code, done = one.json("setup", "--yes", "--joint", "3")
        assert code == EXIT_OK, done
        assert settings(clamp) == (3, 3_000_000, 5, 0)


def test_an_error_of_the_clamp_is_cleared_by_the_reboot(tmp_path: Path) -> None:
    clamp = ServoModel(3, kind="XL330-M288")
    joints = [ServoModel(joint.servo_id, kind=joint.kind.name) for joint in load_vehicle(FILE).arm.joints]
    clamp.trip_overload()
    with bench(tmp_path, *joints, clamp) as one:
        code, found = one.json("reboot", "--yes")
        assert code == EXIT_OK, found
        assert found["servos"][-1] == {"name": "servo 3 (clamp)", "before": 0x20, "after": 0}
    assert register(clamp, 70) == 0
