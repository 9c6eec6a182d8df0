"""Single ticks of a slide: the force along the way, the turn against a tip beside its path, and how both end."""

from __future__ import annotations

import math
from typing import Any, cast

import pytest
from msgspec.structs import replace

from companion.config.loader import load_flight
from companion.core.flight_core import within_friction
from companion.core.flight_state import FlightState, Request
from companion.core.transition import Parameters
from companion.mission.plan import Plan
from companion.model.contact import ContactMode, ContactState
from companion.model.frames import quat_from_euler_zyx
from companion.model.types import Inputs, Vec3
from companion.phases.contact import force as c
from companion.phases.contact import sliding
from companion.phases.contact.slide import Slide
from tests.core.test_reactions import ids, in_plan, tick
from tests.safety.healthy import healthy, put

CONFIG = load_flight("configs/missions/slide.yaml", overrides=["mission.phases[3].face_m=null"])
P = Parameters.of(CONFIG)
PLAN = Plan.build(CONFIG.mission, CONFIG.vehicle)
SLIDE = next(segment for segment in PLAN.segments if segment.index == 4)
PHASE = cast(Slide, CONFIG.mission.phases[4])
NOW_S, DT_S, INTO = healthy().t_s, 0.005, (1.0, 0.0, 0.0)
MOST_N = 0.8 * 3.0 + 0.5
"""Largest friction of 3 N at 0.8, and 0.5 N more. The way leads down by 0.5 m at 0.05 m/s."""


def pressing(**fields: Any) -> ContactState:
    begun = replace(c.begun(NOW_S - 5.0, INTO, (0.0, 0.0, 0.0)), mode=ContactMode.PRESS, touches=1, wanted_n=3.0)
    begun = replace(begun, force_n=3.0)
    return replace(sliding.begun(begun, PHASE.stroke), **fields)


SLIDING = pressing(mode=ContactMode.SLIDE)


def seen(off_m: Vec3, plan_s: float) -> Inputs:
    """The tip is this far from the reference of the plan."""
    reference = PLAN.reference(plan_s)
    x, y, z = (p + d for p, d in zip(reference.position_world_m, off_m, strict=True))
    level = {"position_world_m": (x, y, z), "attitude_wxyz": quat_from_euler_zyx(0.0, 0.0, reference.yaw_rad)}
    return put("arm", angle_rad=reference.arm_rad)(put("mocap", **level)(put("vehicle", **level)(healthy())))


def step(
    contact: ContactState, off_m: Vec3 = (0.0, 0.0, 0.0), force_n: float = 3.0, **observed: Any
) -> tuple[ContactState, FlightState, Request]:
    plan_s = SLIDE.start_s + 2.0
    state = in_plan(plan_s, PLAN, P, own=contact, engaged=SLIDE)
    given = {"inputs": seen(off_m, plan_s), "dt_s": DT_S, "force_world_n": (-force_n, 0.0, 0.0), **observed}
    after, request = tick(state, parameters=P, **given)
    assert after.expected.contact is not None
    return after.expected.contact, after, request


def test_the_way_leads_from_where_the_tip_is_by_that_of_the_mission() -> None:
    assert sliding.way(SLIDING) == pytest.approx((0.0, 0.0, -1.0))
    assert SLIDING.shift.length_m == pytest.approx(0.5)
    assert SLIDING.shift.from_m == pytest.approx((0.0, 0.0, 0.0))


def test_a_slanted_way_from_where_the_last_one_ended_is_followed_without_lag_or_turn() -> None:
    """On a wall right and up are -y and z: by 0.3 m to the right and 0.4 m down, from (0.01, 0.1, 0.2); half of it is done."""
    from_m = (0.01, 0.1, 0.2)
    moved = replace(SLIDING, shift=replace(SLIDING.shift, from_m=from_m, to_m=from_m, way_m=0.0, length_m=0.0))
    slanted = sliding.begun(moved, PHASE.model_copy(update={"displacement_m": (0.3, -0.4)}).stroke)
    assert sliding.way(slanted) == pytest.approx((0.0, -0.6, -0.8))
    half = replace(slanted, mode=ContactMode.SLIDE, shift=replace(slanted.shift, way_m=0.25, rate_m_s=0.05))
    step_m = 0.05 * DT_S
    contact, _, _ = step(half, (0.01, 0.1 - 0.15 - 0.6 * step_m, 0.2 - 0.2 - 0.8 * step_m))
    assert (contact.lag_m, contact.steer_rad) == pytest.approx((0.0, 0.0), abs=1e-6)
    contact, _, _ = step(half, (0.01, 0.1 - 0.15 + 0.6 * 0.02, 0.2 - 0.2 + 0.8 * 0.02))
    assert contact.lag_m == pytest.approx(0.02 + step_m, abs=1e-6)
    force_n = 30.0 * contact.lag_m + contact.lag_integral_n
    assert contact.slide_world_n == pytest.approx((0.0, -0.6 * force_n, -0.8 * force_n))


def test_a_slide_begins_once_the_force_is_reached_and_its_path_where_the_tip_is() -> None:
    contact, _, _ = step(pressing(wanted_n=2.9), (0.0, 0.03, 0.02))
    assert contact.mode is ContactMode.PRESS and contact.slide_world_n == (0.0, 0.0, 0.0)
    contact, _, _ = step(pressing(), (0.0, 0.03, 0.02))
    assert contact.mode is ContactMode.SLIDE
    assert contact.beside_m == pytest.approx((0.0, 0.03, 0.02), abs=1e-9)
    assert contact.lag_m == pytest.approx(0.0, abs=1e-9)


def test_a_tip_behind_is_pushed_along_by_its_lag_and_the_integral_of_it_within_the_friction() -> None:
    contact, _, _ = step(SLIDING, (0.0, 0.0, 0.02))  # the way leads down, the tip is above
    assert contact.lag_m == pytest.approx(0.02, abs=2e-4)
    assert contact.lag_integral_n == pytest.approx(40.0 * DT_S * contact.lag_m)
    force_n = 30.0 * contact.lag_m + contact.lag_integral_n
    assert contact.slide_world_n == pytest.approx((0.0, 0.0, -force_n))
    contact, _, _ = step(replace(SLIDING, lag_integral_n=MOST_N), (0.0, 0.0, 0.04))
    assert contact.lag_integral_n == pytest.approx(MOST_N)
    assert contact.slide_world_n == pytest.approx((0.0, 0.0, -MOST_N))
    contact, _, _ = step(replace(SLIDING, lag_integral_n=-MOST_N), (0.0, 0.0, -0.04))
    assert contact.slide_world_n == pytest.approx((0.0, 0.0, MOST_N))


@pytest.mark.parametrize(("left_m", "steer_rad"), [(0.01, -0.1), (-0.01, 0.1), (0.05, -0.20944), (-0.05, 0.20944)])
def test_a_tip_beside_its_path_turns_the_yaw_setpoint_by_12_deg_at_most(left_m: float, steer_rad: float) -> None:
    assert step(SLIDING, (0.0, left_m, 0.0))[0].steer_rad == pytest.approx(steer_rad, abs=1e-4)


@pytest.mark.parametrize(
    ("off_m", "stuck_s", "event"),
    [(0.052, 0.494, None), (0.052, 0.496, "contact_stuck"), (0.048, 0.9, None), (-0.052, 0.496, "contact_stuck")],
)
def test_a_tip_5_cm_off_for_half_a_second_is_stuck(off_m: float, stuck_s: float, event: str | None) -> None:
    contact, _, request = step(replace(SLIDING, stuck_s=stuck_s), (0.0, 0.0, off_m))
    assert ids(request) == ([] if event is None else [event])
    assert (contact.mode is ContactMode.LEAVE) is (event is not None)


def test_what_the_motion_shows_beyond_the_sensor_is_believed_by_nine_tenths_within_2_n() -> None:
    contact, _, _ = step(replace(SLIDING, disagreement_n=1.0, unseen_n=0.3))
    assert contact.unseen_n == pytest.approx(0.3 + DT_S / 1.5 * (0.9 - 0.3))
    assert step(replace(SLIDING, disagreement_n=3.9, unseen_n=2.0))[0].unseen_n == 2.0
    assert step(replace(SLIDING, disagreement_n=-3.9, unseen_n=-2.0))[0].unseen_n == -2.0


def test_without_contact_the_reference_stops_and_nothing_pushes_along() -> None:
    moving = replace(SLIDING, shift=replace(SLIDING.shift, way_m=0.1, rate_m_s=0.05), lag_integral_n=1.0)
    going, _, _ = step(moving, (0.0, 0.0, -0.1))
    assert going.shift.rate_m_s == pytest.approx(0.05)
    lost, _, _ = step(replace(moving, slide_world_n=(0.0, 0.0, -1.0)), (0.0, 0.0, -0.1), force_n=0.1)
    assert lost.shift.rate_m_s < 0.05
    assert (lost.lag_integral_n, lost.slide_world_n) == (0.0, (0.0, 0.0, 0.0))


def test_the_slide_ends_with_its_way_and_the_plan_goes_on() -> None:
    arrived = replace(SLIDING, shift=replace(SLIDING.shift, way_m=0.49995, rate_m_s=0.001))
    contact, state, _ = step(arrived, (0.0, 0.0, -0.5))
    assert contact.mode is ContactMode.PRESS
    assert state.course is not None and state.course.pace(NOW_S)[0] == pytest.approx(SLIDE.end_s)


def test_after_a_slide_force_and_turn_end_gradually() -> None:
    slid = replace(SLIDING, slide_world_n=(0.0, 0.0, -2.0), unseen_n=1.0, steer_rad=0.1)
    after = sliding.released(slid, DT_S)
    assert after.slide_world_n == pytest.approx((0.0, 0.0, -2.0 + 3.0 * DT_S))
    assert after.unseen_n == pytest.approx(1.0 - 1.5 * DT_S)
    assert after.steer_rad == pytest.approx(0.1 * (1.0 - DT_S / 0.3))
    assert sliding.released(replace(slid, slide_world_n=(0.0, 0.0, 0.01)), DT_S).slide_world_n == (0.0, 0.0, 0.0)
    assert sliding.released(replace(slid, slide_world_n=(0.0, 0.0, 0.0)), DT_S).unseen_n == 0.0


def test_a_reading_across_the_tool_counts_up_to_the_largest_friction() -> None:
    assert PHASE.expects(pressing()).friction_max_n is None
    most_n = PHASE.expects(SLIDING).friction_max_n
    assert most_n is not None and most_n == pytest.approx(MOST_N)
    assert within_friction(INTO, most_n, (-3.0, 2.0, -2.0)) == (-3.0, 2.0, -2.0)
    size_n = math.hypot(6.0, 8.0)
    limited = within_friction(INTO, most_n, (-3.0, 6.0, -8.0))
    assert limited == pytest.approx((-3.0, 6.0 * MOST_N / size_n, -8.0 * MOST_N / size_n))
