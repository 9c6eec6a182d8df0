"""`companion px4 params` from outside, against the stub's MAVLink port and against a peer that sees each byte."""

from __future__ import annotations

import asyncio
import json
from pathlib import Path

import pytest
from pymavlink.dialects.v20 import common as mavlink

from companion.io.px4.transfer import compare
from companion.model.exit_codes import EXIT_BAD_INPUT, EXIT_OK, EXIT_REFUSED
from companion.px4 import params_file
from companion.px4.params_file import single
from companion.px4.required import file_values
from tests.commands import companion
from tests.io.px4_peer import Px4Peer
from tests.io.stub_rig import standing_stub
from tests.support import Ended, free_udp_port

SPOILED = {"EKF2_EV_CTRL": 3, "COM_OF_LOSS_T": 5.0, "EKF2_HGT_REF": 0}


def params(port: int, *words: object, code: int = EXIT_OK) -> Ended:
    return companion("px4", "params", "--address", f"udpin://127.0.0.1:{port}", *words, code=code)


async def test_diff_write_diff_on_the_stub(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("companion.io.px4.params.ASKS", 1)  # every read asks for the ports that the stub does not have
    backup = tmp_path / "old.params"

    async def run(*words: object, code: int = EXIT_OK) -> Ended:
        return await asyncio.to_thread(params, port, *words, code=code)

    port = free_udp_port()
    async with standing_stub(port, SPOILED) as stub:
        found = json.loads((await run("--diff", "--json", code=EXIT_REFUSED)).out)
        assert found["ok"] is False
        assert {row["name"]: (row["px4"], row["reboot"]) for row in found["differs"]} == {
            "EKF2_EV_CTRL": (3, False),
            "COM_OF_LOSS_T": (5.0, False),
            "EKF2_HGT_REF": (0, True),
        }
        assert set(found["absent_port"]) == {"MAV_1_CONFIG", "MAV_1_MODE", "MAV_1_RATE", "SER_TEL2_BAUD"}
        assert "written" not in found

        revision = stub.params.revision
        found = json.loads((await run("--write", "--json", "--backup", backup)).out)
        assert set(found["written"]) == set(SPOILED)
        assert found["reboot"] == ["EKF2_HGT_REF"]
        assert stub.params.revision == revision + len(SPOILED), "only what differed was written"
        assert all(stub.params[name] == single(file_values()[name]) for name in SPOILED)
        assert params_file.read(backup).values == {1: SPOILED}

        assert "nothing differs" in (await run("--diff")).out
        assert "reboot PX4: EKF2_HGT_REF" in (await run("--write", backup, "--backup", tmp_path / "older.params")).out
        assert all(stub.params[name] == value for name, value in SPOILED.items())


@pytest.fixture
def mine(tmp_path: Path) -> Path:
    path = tmp_path / "mine.params"
    path.write_text(params_file.text({"MPC_THR_HOVER": 0.5, "COM_RC_IN_MODE": 3}), encoding="utf-8")
    return path


def test_writing_is_refused_while_armed(mine: Path) -> None:
    port = free_udp_port()
    with Px4Peer(port) as peer:
        peer.base_mode |= mavlink.MAV_MODE_FLAG_SAFETY_ARMED
        ended = params(port, "--write", mine, "--backup", mine.with_name("old"), code=EXIT_REFUSED)
        assert "expected a disarmed PX4, but it is armed" in ended.err
        assert peer.of("PARAM_SET") == []
        assert "2 differ" in params(port, "--diff", mine, code=EXIT_REFUSED).out
    assert not mine.with_name("old").exists()


def test_old_values_are_kept_before_anything_is_written(mine: Path) -> None:
    port = free_udp_port()
    with Px4Peer(port) as peer:
        ended = params(port, "--write", mine, "--backup", mine, code=EXIT_BAD_INPUT)
        assert "already exists; choose another name (nothing was written)" in ended.err
        assert peer.of("PARAM_SET") == []


def test_a_name_that_px4_does_not_have_is_not_all_written(tmp_path: Path) -> None:
    path = tmp_path / "mine.params"
    path.write_text(params_file.text({"NO_SUCH_ONE": 1, "COM_RC_IN_MODE": 3}), encoding="utf-8")
    port = free_udp_port()
    with Px4Peer(port) as peer:
        ended = params(port, "--write", path, "--backup", tmp_path / "old.params", code=EXIT_REFUSED)
        assert "NO_SUCH_ONE       PX4 does not have this parameter" in ended.out
        assert peer.params["COM_RC_IN_MODE"] == 3


def test_only_the_rows_of_this_px4_are_written(tmp_path: Path) -> None:
    path, backup = tmp_path / "mine.params", tmp_path / "old.params"
    path.write_text(
        "7\t1\tCOM_RC_IN_MODE\t3\t6\n7\t124\tSDLOG_MODE\t3\t6\n1\t1\tMPC_THR_HOVER\t0.9\t9\n", encoding="utf-8"
    )
    port = free_udp_port()
    with Px4Peer(port) as peer:
        peer.params["MAV_SYS_ID"] = 7
        said = params(port, "--write", path, "--backup", backup).out
        assert [message.param_id for message in peer.of("PARAM_SET")] == ["COM_RC_IN_MODE"]
        assert "skipped, because it is not this vehicle's PX4: vehicle 1, component 1: MPC_THR_HOVER" in said
        assert "skipped, because it is not this vehicle's PX4: vehicle 7, component 124: SDLOG_MODE" in said
        assert params_file.read(backup).values == {7: {"COM_RC_IN_MODE": 4}}, "the backup can be restored"

        peer.params["MAV_SYS_ID"] = 8
        ended = params(port, "--write", path, "--backup", tmp_path / "older", code=EXIT_BAD_INPUT)
        assert "expected parameters of vehicle 8 (MAV_SYS_ID of this PX4), found those of vehicle 7, 1" in ended.err


def test_another_type_than_px4s_is_reported_and_not_written(tmp_path: Path) -> None:
    path = tmp_path / "mine.params"
    path.write_text(params_file.text({"MPC_THR_HOVER": 1}), encoding="utf-8")
    port = free_udp_port()
    with Px4Peer(port) as peer:
        ended = params(port, "--write", path, "--backup", tmp_path / "old.params", code=EXIT_REFUSED)
        assert "MPC_THR_HOVER: PX4 has a REAL32, but the file has an INT32; correct the file" in ended.out
        assert peer.of("PARAM_SET") == []


def test_a_comparison_knows_values_as_px4_stores_them() -> None:
    comparison = compare({"A": 0.1, "B": 1, "MAV_1_CONFIG": 102}, {"A": single(0.1), "B": 1})
    assert comparison.same
    assert comparison.absent_port == ("MAV_1_CONFIG",)
    assert not compare({"A": 0.1, "C": 1}, {"A": 0.1}).same


def test_a_parameter_of_another_version_is_left_out() -> None:
    comparison = compare({"A": 1, "SENS_GPS0_DELAY": 5}, {"A": 1})
    assert comparison.same
    assert comparison.absent == ()
    assert not compare({"SENS_GPS0_DELAY": 5}, {"SENS_GPS0_DELAY": 110}).same, "where it is, it counts"


def test_what_is_measured_on_each_installation_and_a_port_that_is_not_there_do_not_differ() -> None:
    """As `companion sitl --px4` shows it: its motion capture is 10 ms late, and a simulator has MAV_1_RATE but no TELEM2."""
    simulated = {**file_values(), "EKF2_EV_DELAY": 10.0, "MAV_1_RATE": 0}
    del simulated["SER_TEL2_BAUD"]
    found = compare(file_values(), simulated)
    assert found.same
    assert [(one.name, one.px4, one.file) for one in found.measured] == [("EKF2_EV_DELAY", 10.0, 5.0)]
    assert set(found.absent_port) == {"MAV_1_CONFIG", "MAV_1_MODE", "MAV_1_RATE", "SER_TEL2_BAUD"}
    assert "MAV_1_RATE" in {one.name for one in compare(file_values(), {**file_values(), "MAV_1_RATE": 0}).differences}


@pytest.mark.parametrize("found_ms", [0.0, 31.0])
def test_a_delay_that_nobody_measured_or_that_cannot_be_flown_differs(found_ms: float) -> None:
    found = compare(file_values(), {**file_values(), "EKF2_EV_DELAY": found_ms})
    assert [one.name for one in found.differences] == ["EKF2_EV_DELAY"]
    assert found.measured == ()


def test_a_file_that_holds_a_measured_value_itself_is_written() -> None:
    wanted = {"EKF2_EV_DELAY": 12.0}
    assert [one.name for one in compare(wanted, {"EKF2_EV_DELAY": 10.0}).differences] == ["EKF2_EV_DELAY"]
