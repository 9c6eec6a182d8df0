"""The fast closed loop: what it records of the world, its settings, and its clean-up."""

from __future__ import annotations

import gc
import math
from collections.abc import Iterator
from functools import cache

import pytest
from msgspec.structs import replace

from companion.control.types import PlantState, Wrench
from companion.model.servos import WATCHDOG_ERROR
from companion.model.types import Joints, Outcome, PhaseKind, Reference, SafetyAction
from companion.sitl_config.loader import SitlConfig, load_sitl
from sitl.fast.loop import FastFlight, FastResult
from sitl.faults.timing import ARMED_SEEN_S
from tests.support import LOW_HOVER

LOW = tuple(f"{key}={value}" for key, value in LOW_HOVER.items())


def configured(*overrides: str) -> SitlConfig:
    return load_sitl("configs/missions/hover.yaml", overrides=("world.payload_kg=0", *LOW, *overrides))


@cache
def flown(*overrides: str) -> FastResult:
    return FastFlight(configured(*overrides)).run()


@pytest.fixture
def collector() -> Iterator[None]:
    was_on = gc.isenabled()
    yield
    (gc.enable if was_on else gc.disable)()


def test_the_truth_that_is_made_afterwards_is_the_one_of_the_tick() -> None:
    flight = FastFlight(configured())
    seen = []
    step = flight.core.step

    def watched(inputs):  # type: ignore[no-untyped-def]
        seen.append(flight.plant.truth)
        return step(inputs)

    flight.core.step = watched  # type: ignore[method-assign]
    result = flight.run(limit_s=8.2)
    assert len(seen) == len(result.inputs) > 1000
    assert result.truth == seen
    assert result.truth is result.truth, "made once"


@pytest.mark.usefixtures("collector")
@pytest.mark.parametrize("on", [True, False])
def test_the_garbage_collector_is_left_as_it_was(on: bool) -> None:
    (gc.enable if on else gc.disable)()
    FastFlight(configured()).run(limit_s=0.6)
    assert gc.isenabled() is on
    broken = FastFlight(configured())
    broken.core.step = None  # type: ignore[assignment, method-assign]
    with pytest.raises(TypeError):
        broken.run(limit_s=0.6)
    assert gc.isenabled() is on


def test_answers_that_come_10_ms_late_do_not_make_the_arm_swing() -> None:
    late = "world.faults=[{kind: bus_delay, after: start, t_s: 0.6, size: 0.01}]"
    result = FastFlight(load_sitl("configs/missions/catch.yaml", world="lab", overrides=("world.seed=2003", late))).run(
        9.6
    )
    ages_s = [i.t_s - i.arm.measured_s for i in result.inputs[-200:] if i.arm is not None]
    assert all(0.0099 < age_s < 0.0201 for age_s in ages_s)
    assert [event.id for o in result.outputs for event in o.events if event.id.startswith("joint_")] == [
        "joint_states_late"
    ]


def test_the_arm_delay_delays_the_currents_and_nothing_else() -> None:
    prompt, late = flown(), flown("world.arm_delay_s=0.01")
    assert late.outputs[-1].outcome is Outcome.COMPLETED

    def first_current_s(result: FastResult) -> float:
        return next(i.t_s for i in result.inputs if i.arm is not None and any(i.arm.torque_nm))

    def first_command_s(result: FastResult) -> float:
        return next(o.t_s for o in result.outputs if o.arm_torque_nm is not None and any(o.arm_torque_nm))

    assert first_command_s(late) == first_command_s(prompt)
    # Seen at ticks of 5 ms, given at steps of 2 ms.
    assert first_current_s(late) - first_current_s(prompt) == pytest.approx(0.010, abs=0.0051)
    before = [k for k, i in enumerate(late.inputs) if i.t_s < first_command_s(late)]
    assert [late.inputs[k] for k in before] == [prompt.inputs[k] for k in before]


def test_a_silent_servo_lets_go_and_that_is_reported_when_it_answers_again() -> None:
    """As over the wire: the watchdog trips, and the driver restarts it and reports it in one state."""
    result = flown("world.faults=[{kind: servo_loss, t_s: 3.5, duration_s: 0.12}]")
    armed_s = next(i.t_s for i in result.inputs if i.status is not None and i.status.armed)
    told = [i.t_s - armed_s for i in result.inputs if i.arm is not None and i.arm.hardware_error != (0, 0)]
    assert told == [pytest.approx(3.62 - ARMED_SEEN_S, abs=0.011)] * len(told)
    assert len({i.arm.stamp_s for i in result.inputs if i.arm is not None and any(i.arm.hardware_error)}) == 1
    errors = {i.arm.hardware_error for i in result.inputs if i.arm is not None}
    assert errors == {(0, 0), (WATCHDOG_ERROR, 0)}
    back = next(i for i in result.inputs if i.arm is not None and any(i.arm.hardware_error))
    assert back.arm is not None and back.arm.torque_nm[0] == 0.0
    assert any(event.id == "arm_let_go" for o in result.outputs for event in o.events)


@pytest.mark.parametrize(
    ("torques_nm", "text"),
    [((float("nan"), 0.1), "joint torque (nan, 0.1) is not finite"), (None, "0 joint torques for 2 joints")],
    ids=["nan", "none"],
)
def test_a_law_whose_torques_stay_unusable_is_landed_by_px4_with_the_arm_folded(
    torques_nm: Joints | None, text: str
) -> None:
    """From 1 s after take-off on the law's joint torques are unusable, and the arm is limp; a single such tick does no harm."""
    flight = FastFlight(configured())
    law, ticks = flight.core._control._controller, 0
    step = law.step

    def with_unusable_torques(dt_s: float, state: PlantState, reference: Reference, vertical_scale: float) -> Wrench:
        nonlocal ticks
        wrench, ticks = step(dt_s, state, reference, vertical_scale), ticks + (vertical_scale >= 1.0)
        return replace(wrench, arm_torque_nm=torques_nm) if ticks in (100, 110) or ticks > 200 else wrench

    law.step = with_unusable_torques  # type: ignore[method-assign]
    result = flight.run()
    events = [(o.t_s, event) for o in result.outputs for event in o.events]
    assert [event.id for _, event in events].count("torque_refused") == 1
    at_s, event = next(found for found in events if found[1].id == "torque_refused")
    refused_s = [o.t_s for o in result.outputs if o.arm_torque_nm is None and o.phase_kind is not PhaseKind.GROUND]
    assert event.action is SafetyAction.AUTOPILOT_LAND and text in event.text
    assert at_s - refused_s[2] == pytest.approx(0.1, abs=0.02), "the two single ticks did not count"
    assert not result.crashed and not result.armed and result.outputs[-1].outcome is Outcome.ABORTED
    fold_deg = flight.config.vehicle.fold_arm_deg
    assert result.inputs[-1].arm is not None
    assert [math.degrees(angle) for angle in result.inputs[-1].arm.angle_rad] == pytest.approx(fold_deg, abs=5.0)
