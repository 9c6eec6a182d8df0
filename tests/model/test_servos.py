"""The two tables of servos, the companion's and the simulated world's, agree with the e-manual and with each other."""

from __future__ import annotations

import pytest

from companion.model.servos import SERVOS, WITHOUT_CURRENT_CONTROL, ServoKind, model_text
from sitl.servo.kinds import KINDS
from tests.support import ROOT

E_MANUAL = {
    # Model number, current limit, and the constants in N m/A that newer pages of the e-manual print for some models.
    "XM430-W210": (1030, 3.209, None),
    "XM540-W270": (1120, 5.506, None),
    "XH430-W210": (1010, 1.743, None),
    "XH430-V210": (1050, 0.923, 3.714),
    "XH430-V350": (1040, 0.923, 4.714),
    "XC330-M288": (1240, 2.352, None),
    "XL330-M288": (1200, 1.750, None),
}


@pytest.mark.parametrize("name", E_MANUAL)
def test_a_row_agrees_with_the_e_manual(name: str) -> None:
    kind = next(kind for kind in SERVOS.values() if kind.name == name)
    number, limit_a, nm_a = E_MANUAL[name]
    assert kind.number == number
    assert kind.current_limit_max_counts * kind.current_unit_a == pytest.approx(limit_a, abs=1e-3)
    if nm_a is not None:
        assert kind.torque_per_amp_nm_a == pytest.approx(nm_a, abs=1e-3)


@pytest.mark.parametrize("kind", SERVOS.values(), ids=lambda kind: kind.name)
def test_the_simulated_servo_has_the_same_units_and_limits(kind: ServoKind) -> None:
    simulated = KINDS[kind.name]
    assert (simulated.number, simulated.amp_per_count) == (kind.number, kind.current_unit_a)
    assert (simulated.current_counts, simulated.temperature_c) == (
        kind.current_limit_max_counts,
        kind.temperature_max_c,
    )
    assert simulated.nm_per_amp == pytest.approx(kind.torque_per_amp_nm_a, rel=0.005)
    assert simulated.firmware >= kind.firmware_min
    low_v, high_v, supply_v = simulated.volts
    assert low_v <= kind.voltage_v[0] <= supply_v <= kind.voltage_v[1] <= high_v


def test_every_model_number_belongs_to_one_name() -> None:
    numbers = [kind.number for kind in SERVOS.values()] + list(WITHOUT_CURRENT_CONTROL.values())
    assert len(set(numbers)) == len(numbers) and KINDS.keys() == SERVOS.keys()
    assert model_text(1020) == "XM430-W350 (model 1020)"
    assert model_text(1060) == "XL430-W250 (model 1060)"
    assert model_text(7) == "unknown model 7"


@pytest.mark.parametrize("kind", SERVOS.values(), ids=lambda kind: kind.name)
def test_the_hardware_page_lists_the_servo(kind: ServoKind) -> None:
    row = f"| {kind.name} | {kind.number} | {1e3 * kind.current_unit_a:g} mA | {kind.current_limit_max_counts} | "
    assert (
        row + f"{kind.stall_torque_nm:g} N m, {kind.stall_current_a:g} A |" in (ROOT / "docs/hardware.md").read_text()
    )
