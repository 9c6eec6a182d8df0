"""The baselines keep the contract of every control law, and complete the catch."""

import numpy as np
import pytest
from baselines.mpc import Axis

from companion.testing import check_law
from sitl.testing import check_catch

LAWS = ("pid", "indi", "l1", "mpc")


@pytest.mark.parametrize("law", LAWS)
def test_it_keeps_the_contract(law: str) -> None:
    check_law(law)


@pytest.mark.parametrize("law", LAWS)
def test_it_completes_the_catch(law: str) -> None:
    check_catch(law)


def test_the_program_ends_at_the_reference_and_keeps_its_limits() -> None:
    axis, h, lag_s, most = Axis(80.0, 10.0, 0.1), 0.001, 0.1, 0.5
    e, e_dot, r, w, asked = 0.5, 0.0, 0.0, 0.0, []
    for k in range(8000):
        if k % 20 == 0:
            w = axis.solve(np.array((e, e_dot, r)), -most, most)
            asked.append(w)
        e, e_dot, r = e + h * e_dot, e_dot + h * r, r + h * (w - r) / lag_s
    assert min(asked) == pytest.approx(-most)
    assert max(map(abs, asked)) <= most + 1e-9
    assert abs(e) < 1e-3
    assert abs(e_dot) < 1e-3
