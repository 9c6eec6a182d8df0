"""The law keeps the contract of every control law, and completes the catch."""

from lab_lqr import LqrConfig, lqr_gains

from companion.testing import check_law
from sitl.testing import check_catch


def test_it_keeps_the_contract() -> None:
    check_law("lqr")


def test_it_completes_the_catch() -> None:
    for preset in LqrConfig.presets:
        check_catch("lqr", preset)


def test_its_gains_solve_the_problem() -> None:
    ki, kp, kd = lqr_gains((4.0, 1.0, 1.0))
    assert abs(ki - 2.0) < 1e-9  # ki^2 is the cost of the integral
    assert abs(kp**2 - 2.0 * ki * kd - 1.0) < 1e-9
    assert abs(kd**2 - 2.0 * kp - 1.0) < 1e-9
