"""The contract of control laws: those of the companion keep it, and each way to break it is found and named."""

from __future__ import annotations

from pathlib import Path

import pytest

from companion.config.controller import PRESETS
from companion.testing import check_law
from sitl.testing import check_catch
from tests.machines import vehicle_with_joints
from tests.plugins.installed import LAW, STEP, on_path, write_law
from tests.support import SHORT_CATCH


@pytest.mark.parametrize(("law", "preset"), [(law, preset) for law, presets in PRESETS.items() for preset in presets])
def test_a_law_of_the_companion_keeps_the_contract(law: str, preset: str) -> None:
    check_law(law, preset)


@pytest.mark.parametrize(("law", "joints"), [("adaptive", 0), ("adaptive", 3), ("csc", 3), ("psc", 0)])
def test_a_law_of_the_companion_keeps_the_contract_with_any_arm(law: str, joints: int, tmp_path: Path) -> None:
    vehicle = tmp_path / "vehicle.yaml"
    vehicle.write_text(vehicle_with_joints(joints).model_dump_json())
    check_law(law, PRESETS[law][-1], vehicle)


HEAD = "import math, random\nfrom msgspec.structs import force_setattr, replace\n"
INTEGRAL = "self.i = getattr(self, 'i', 0.0) + {when} * dt_s * (reference.position_world_m[{axis}] - state.position_world_m[{axis}])"
BROKEN = [
    (
        "wrench = replace(wrench, collective_n=math.nan if dt_s > 0.04 else 1.0)",
        "of random inputs: step returns collective_n = nan, which is not finite",
    ),
    (
        "wrench = replace(wrench, collective_n=wrench.collective_n + random.random())",
        "the same inputs twice: tick 0: collective_n = ",
    ),
    (
        "Lift.calls = getattr(Lift, 'calls', 0.0) + 1.0; wrench = replace(wrench, collective_n=Lift.calls)",
        "the same inputs twice: tick 0: collective_n = ",
    ),
    ("force_setattr(state, 'airborne', not state.airborne)", "lift/stiff: the law has changed its inputs"),
    (
        "wrench = replace(wrench, collective_n=wrench.collective_n * 1.05)",
        "lift/stiff: the thrust at hover is 1.050 of the weight",
    ),
    (
        "wrench = replace(wrench, attitude_wxyz=(math.cos(0.05), math.sin(0.05), 0.0, 0.0))",
        "lift/stiff: the attitude at hover is tilted by 5.7 deg",
    ),
    (
        INTEGRAL.format(when="True", axis=2) + "; wrench = replace(wrench, collective_n=max(0.0, wrench.collective_n + 2.0 * self.i))",
        "after 5 s on the ground, 0.3 m from the reference on each axis, the command at hover differs",
    ),
    (
        INTEGRAL.format(when="state.airborne", axis=2)
        + "; wrench = replace(wrench, collective_n=max(0.0, wrench.collective_n + self.i))",
        "after 5 s of saturated thrust, the command at hover differs from the command after one such tick: thrust ",
    ),
    (
        INTEGRAL.format(when="state.airborne", axis=0)
        + "; half = 0.5 * math.atan(0.01 * self.i); wrench = replace(wrench, attitude_wxyz=(math.cos(half), 0.0, math.sin(half), 0.0))",
        "after 5 s at the tilt limit, the command at hover differs from the command after one such tick: thrust ",
    ),
]  # fmt: skip


@pytest.mark.parametrize(("line", "found"), BROKEN)
def test_a_law_that_breaks_the_contract_is_told_how(tmp_path: Path, line: str, found: str) -> None:
    write_law(tmp_path, HEAD + LAW + STEP + f"{line}\n        return wrench\n")
    with on_path(tmp_path), pytest.raises(AssertionError) as caught:
        check_law("lift", "stiff")
    assert found in str(caught.value)


@pytest.mark.parametrize(
    ("line", "found"),
    [
        (
            "1 / (state.position_world_m[2] < 0.5 or state.position_world_m[2] == 1.0)",
            "lift: raises in flight: ZeroDivisionError",
        ),
        ("wrench = replace(wrench, collective_n=0.6 * wrench.collective_n)", "lift: no catch was detected: "),
        ("wrench = replace(wrench, collective_n=0.1 * wrench.collective_n)", "lift: the mission was not completed: "),
    ],
)  # fmt: skip
def test_a_law_that_does_not_complete_the_catch_is_told_why(tmp_path: Path, line: str, found: str) -> None:
    write_law(tmp_path, HEAD + LAW + STEP + f"{line}\n        return wrench\n")
    with on_path(tmp_path), pytest.raises(AssertionError) as caught:
        check_catch("lift", mission=SHORT_CATCH)
    assert str(caught.value).startswith(found)
