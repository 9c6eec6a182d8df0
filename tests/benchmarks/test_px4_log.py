"""Modes, and times after a fault, are read from PX4's own log."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from benchmarks.px4_log import AfterFault, Change, Px4Log
from sitl.px4.hil_link import Px4Error

FAULT_S = 20.0


def log(*changes: Change, vision_s: tuple[float, ...] = (), setpoint_s: tuple[float, ...] = ()) -> Px4Log:
    return Px4Log(
        changes=changes,
        vision_s=np.array(vision_s),
        setpoint_s=np.array(setpoint_s),
        estimate_s=np.zeros(0),
        position_ned_m=np.zeros((0, 3)),
        parameters={},
    )


HOLD = Change(2.0, "HOLD", armed=False, failsafe=False)
OFFBOARD = Change(10.0, "OFFBOARD", armed=True, failsafe=False)
LAND = Change(20.14, "LAND", armed=True, failsafe=False)
DISARMED = Change(23.5, "OFFBOARD", armed=False, failsafe=False)


def test_a_takeover_is_reported_in_seconds_since_the_fault() -> None:
    vision = (*np.arange(19.0, 20.0, 0.005), *np.arange(20.1, 23.0, 0.005))
    setpoints = (*np.arange(19.0, 20.002, 0.005), *np.arange(20.144, 23.0, 0.004))
    found = log(HOLD, OFFBOARD, LAND, DISARMED, vision_s=vision, setpoint_s=setpoints).after(FAULT_S)
    assert found.last_setpoint_s == pytest.approx(0.0, abs=1e-6), "those of PX4's own landing do not count"
    assert found.vision_gap_s == pytest.approx(0.105)
    assert found.mode == "LAND"
    assert found.mode_s == pytest.approx(0.14)
    assert found.failsafe_s is None
    assert found.disarmed_s == pytest.approx(3.5)


def test_px4s_own_failsafe_is_distinguished_from_a_command() -> None:
    failsafe = Change(20.6, "LAND", armed=True, failsafe=True)
    assert log(OFFBOARD, failsafe).after(FAULT_S).failsafe_s == pytest.approx(0.6)


def test_what_never_happened_is_none() -> None:
    assert log(HOLD, OFFBOARD).after(FAULT_S) == AfterFault(
        last_setpoint_s=None, vision_gap_s=None, mode=None, mode_s=None, failsafe_s=None, disarmed_s=None
    )


def test_only_modes_flown_while_armed_are_listed() -> None:
    assert log(HOLD, OFFBOARD, LAND, DISARMED).modes() == "OFFBOARD, LAND"


def test_a_file_that_is_no_ulog_is_refused_in_one_line(tmp_path: Path) -> None:
    pytest.importorskip("pyulog")
    file = tmp_path / "flight.ulg"
    file.write_bytes(b"no ulog")
    with pytest.raises(Px4Error, match="expected a ULog of PX4"):
        Px4Log.read(file)
    with pytest.raises(Px4Error, match="expected a ULog of PX4"):
        Px4Log.read(tmp_path / "missing.ulg")
