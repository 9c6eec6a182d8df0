"""A hold comes to rest on the planned way, and going on takes it from there."""

from __future__ import annotations

import math
from functools import cache
from itertools import pairwise

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from companion.config.loader import load_flight
from companion.mission.active_plan import HOLD_DECELERATION_M_S2, ActiveTrajectory
from companion.mission.plan import Plan
from companion.model.types import Reference
from tests.mission.test_plan import accelerations, rates, values

START_S = 100.0
STEP_S = 0.005


@cache
def plan(name: str) -> Plan:
    config = load_flight(f"configs/missions/{name}.yaml")
    return Plan.build(config.mission, config.vehicle)


def assert_rates_are_derivatives(samples: list[Reference]) -> None:
    for before, after in pairwise(samples):
        for a, b, va, vb in zip(values(before), values(after), rates(before), rates(after), strict=True):
            assert (b - a) / STEP_S == pytest.approx(0.5 * (va + vb), abs=2e-3)
            assert abs(vb - va) < 0.05, "a step"


@settings(max_examples=40)
@given(
    st.sampled_from(["catch", "circuit"]), st.floats(0.0, 17.0), st.lists(st.floats(0.05, 4.0), min_size=1, max_size=6)
)
def test_any_holds_and_resumptions_are_smooth_and_on_the_planned_way(
    name: str, first_s: float, pauses_s: list[float]
) -> None:
    whole = plan(name)
    course = ActiveTrajectory(whole, START_S)
    t_s = START_S + first_s
    samples = [course.reference(t_s)]
    for count, pause_s in enumerate(pauses_s):
        course = (course.resume if count % 2 else course.hold)(t_s)
        assert course.held is (count % 2 == 0)
        for _ in range(math.ceil(pause_s / STEP_S)):
            t_s += STEP_S
            plan_s, rate, _, _ = course.pace(t_s)
            assert 0.0 <= rate <= 1.0
            samples.append(course.reference(t_s))
            assert values(samples[-1]) == values(whole.reference(plan_s))
    assert_rates_are_derivatives(samples)


@pytest.mark.parametrize("at_s", [1.0, 2.9, 3.2, 6.5, 9.4, 14.0])
def test_a_hold_comes_to_rest_and_stays_and_the_rest_of_the_plan_follows(at_s: float) -> None:
    whole = plan("catch")
    course = ActiveTrajectory(whole, START_S)
    before = course.reference(START_S + at_s)
    course = course.hold(START_S + at_s)
    course = course.hold(START_S + at_s + 0.1)  # asked again: nothing new
    speed = math.hypot(*before.velocity_world_m_s)
    rest_s = START_S + at_s + max(0.5, 1.875 * speed / HOLD_DECELERATION_M_S2) + 1e-9
    rest = course.reference(rest_s)
    assert rates(rest) == pytest.approx([0.0] * 6, abs=1e-9)
    assert accelerations(rest) == pytest.approx([0.0] * 5, abs=1e-9)
    assert course.reference(rest_s + 30.0) == rest
    assert math.dist(rest.position_world_m, before.position_world_m) <= 1.2 * speed * (rest_s - START_S - at_s)
    course = course.resume(rest_s + 30.0)
    left_s = course.left_s(rest_s + 30.0)
    assert course.left_s(rest_s + 40.0) == pytest.approx(left_s - 10.0 + 0.25, abs=0.3)
    end = course.reference(rest_s + 30.0 + left_s + 10.0)
    assert values(end) == values(whole.reference(whole.duration_s))


def test_untouched_it_is_the_plan_itself() -> None:
    whole = plan("catch")
    course = ActiveTrajectory(whole, START_S)
    for k in range(200):
        t_s = START_S + 0.1 * k
        assert course.reference(t_s) == whole.reference(t_s - START_S)
        assert course.segment(t_s) is whole.segment(t_s - START_S)
