"""Lists of gains: one file of gains fits an arm of any number of joints."""

from __future__ import annotations

import pytest

from companion.config.controller import AdaptiveConfig, PscConfig
from companion.config.document import ConfigError
from companion.config.gains import fitted
from companion.config.loader import load_flight
from tests.support import CATCH


def test_the_first_gains_are_used_and_the_last_one_is_repeated() -> None:
    assert fitted((1.0, 2.0, 3.0), 2) == (1.0, 2.0)
    assert fitted((1.0, 2.0, 3.0), 3) == (1.0, 2.0, 3.0)
    assert fitted((1.0, 2.0, 3.0), 5) == (1.0, 2.0, 3.0, 3.0, 3.0)
    assert fitted((1.0,), 0) == ()


@pytest.mark.parametrize("joints", [1, 3, 7])
def test_a_file_may_have_one_gain_for_each_joint_or_fewer(joints: int) -> None:
    given = load_flight(CATCH).controller
    assert isinstance(given, AdaptiveConfig)
    changes = {key: fitted(getattr(given, key), 6 + joints) for key in given.gain_lists}
    assert len(AdaptiveConfig.model_validate(given.model_dump() | changes).phi) == 6 + joints
    partitioned = load_flight(CATCH, None, "psc").controller
    assert isinstance(partitioned, PscConfig)
    changes = {key: fitted(getattr(partitioned, key), joints) for key in partitioned.gain_lists}
    assert len(PscConfig.model_validate(partitioned.model_dump() | changes).arm_damping_kd) == joints


REFUSED = [
    ("adaptive", "phi=[1, 1, 1, 1, 1, 1]", "phi: expected a list of 7 to 13 numbers > 0, got [1, 1, 1, 1, 1, 1]"),
    ("adaptive", "phi=[1, 1, 1, 1, 1, 1, 1]", "phi: expected 8 values, as many as inertia_md has, got 7"),
    ("csc", "damping_kd=[1, 1, 1, 1, 1, 1, 1]", "damping_kd: expected 8 values, as many as inertia_md has, got 7"),
    (
        "adaptive",
        "inertia_md=[1, 1, 1, 1, 1, 1, 1]",
        "inertia_md: expected 8 values, as many as lambda_gain has, got 7",
    ),
    ("adaptive", "moment_rate=[]", "moment_rate: expected a list of 1 to 7 numbers >= 0, got []"),
    ("adaptive", "found_for.mass_kg=0", "found_for.mass_kg: expected a number > 0, got 0"),
    ("psc", "arm_stiffness_kp=[]", "arm_stiffness_kp: expected a list of 1 to 7 numbers > 0, got []"),
    ("psc", "arm_stiffness_kp=[1]", "arm_stiffness_kp: expected 2 values, as many as arm_inertia_md has, got 1"),
]


@pytest.mark.parametrize(("law", "change", "text"), REFUSED)
def test_lists_of_unequal_or_impossible_length_are_refused_in_one_line(law: str, change: str, text: str) -> None:
    with pytest.raises(ConfigError) as refused:
        load_flight(CATCH, None, law, overrides=[f"controller.{change}"])
    assert str(refused.value) == f"--set controller.{text}"
