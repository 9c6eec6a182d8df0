"""Single ticks of a contact: when each mode ends, and what makes the vehicle leave the surface."""

from __future__ import annotations

import math
from typing import Any

import pytest
from msgspec.structs import replace

from companion.config.loader import load_flight
from companion.core.flight_state import FlightState, Request
from companion.core.transition import Parameters
from companion.mission.plan import Plan
from companion.model.contact import ContactMode, ContactState, TouchedPoint
from companion.model.types import Inputs, Outcome, SafetyAction, Vec3
from companion.phases.contact import force as c
from companion.phases.contact.base import opening_of
from companion.safety.supervisor import SupervisorState
from tests.core.test_reactions import HERE, after, ids, in_plan, tick
from tests.safety.healthy import healthy, put

CONFIG = load_flight("configs/missions/press.yaml", overrides=["mission.phases[3].face_m=null"])
P = Parameters.of(CONFIG)
PLAN = Plan.build(CONFIG.mission, CONFIG.vehicle)
APPROACH, PRESS, DETACH, AFTER = (
    next(segment for segment in PLAN.segments if segment.index == index) for index in (3, 4, 5, 6)
)
NOW_S, DT_S, TOUCH_N = healthy().t_s, 0.005, 1.0
INTO: Vec3 = (1.0, 0.0, 0.0)
"""Phases of the mission: an approach along +x of at most 0.35 m, touch at 1 N, a press with 5 N, a detach with 0.1 m/s."""
assert opening_of(P.phases[:4]).touch_n == TOUCH_N


def contact(mode: ContactMode, since_s: float = 0.0, **fields: Any) -> ContactState:
    begun = c.begun(NOW_S - since_s, INTO, (0.0, 0.0, 0.0))
    return replace(begun, mode=mode, **fields)


def at_plan(plan_s: float, now: ContactState | None, segment: Any = APPROACH, **fields: Any) -> FlightState:
    return in_plan(plan_s, PLAN, P, own=now, engaged=None if now is None else segment, **fields)


def step(state: FlightState, force_n: float = 0.0, **observed: Any) -> tuple[FlightState, Request]:
    """One tick in which the surface pushes back with a force."""
    force = (-force_n, 0.0, 0.0)
    return tick(state, parameters=P, **{"force_world_n": force, "dt_s": DT_S, **observed})


IN_APPROACH, IN_PRESS = APPROACH.start_s + 3.0, PRESS.start_s + 3.0
PRESSING = contact(ContactMode.PRESS, 3.0, touches=1, wanted_n=5.0, force_n=5.0, offset_m=0.2, touched_offset_m=0.2)


def pressing(**fields: Any) -> FlightState:
    return at_plan(IN_PRESS, replace(PRESSING, **fields), PRESS)


def mode_of(state: FlightState) -> ContactMode | None:
    return None if state.expected.contact is None else state.expected.contact.mode


def plan_s(state: FlightState) -> float:
    assert state.course is not None
    return state.course.pace(NOW_S)[0]


def test_a_contact_begins_with_its_approach_and_the_rest_of_a_failed_one_is_skipped() -> None:
    state, _ = step(at_plan(IN_APPROACH, None))
    assert mode_of(state) is ContactMode.TARE and state.expected.contact is not None
    assert state.expected.contact.direction_world == INTO
    for inside, segment in ((IN_APPROACH, APPROACH), (IN_PRESS, PRESS), (DETACH.start_s + 0.01, DETACH)):
        state, _ = step(at_plan(inside, None, skips=True))
        assert state.expected.contact is None and plan_s(state) == pytest.approx(segment.end_s)
        assert state.skips
    assert not step(at_plan(AFTER.start_s + 0.1, None, skips=True))[0].skips


@pytest.mark.parametrize("mode", [ContactMode.TARE, ContactMode.APPROACH, ContactMode.PRESS])
def test_a_contact_that_begins_during_a_hold_is_left_at_once(mode: ContactMode) -> None:
    held = SupervisorState(SafetyAction.HOLD, "operator_hold", NOW_S - 0.2)
    state, _ = step(at_plan(IN_APPROACH, None, supervisor=held))
    assert mode_of(state) is ContactMode.TARE
    state, _ = step(at_plan(IN_APPROACH, contact(mode, 1.1, offset_m=0.1, touches=1), supervisor=held))
    assert mode_of(state) is ContactMode.LEAVE
    state, _ = step(at_plan(IN_APPROACH, contact(mode, 1.1), supervisor=held))
    assert mode_of(state) is None and state.skips


@pytest.mark.parametrize(
    ("since_s", "mode"), [(0.99, ContactMode.TARE), (1.01, ContactMode.APPROACH)], ids=["weighing", "weighed"]
)
def test_the_force_is_averaged_for_a_second_before_the_approach(since_s: float, mode: ContactMode) -> None:
    state, _ = step(at_plan(IN_APPROACH, contact(ContactMode.TARE, since_s)))
    assert mode_of(state) is mode
    assert plan_s(state) == pytest.approx(IN_APPROACH)


def test_the_plan_waits_before_the_end_of_the_approach() -> None:
    state, _ = step(at_plan(APPROACH.end_s + 0.1, contact(ContactMode.APPROACH, 5.0)))
    assert APPROACH.end_s - 1e-5 < plan_s(state) < APPROACH.end_s


def test_a_force_that_lasts_for_15_ms_is_a_touch_and_the_press_begins() -> None:
    state = at_plan(IN_APPROACH, contact(ContactMode.APPROACH, 5.0, offset_m=0.11, rate_m_s=0.03))
    for expected in (ContactMode.APPROACH, ContactMode.APPROACH, ContactMode.PRESS):
        before = state.expected.contact
        state, request = step(state, 1.1)
        assert mode_of(state) is expected
    assert ids(request) == ["touched"]
    assert state.expected.contact is not None and before is not None
    assert (state.expected.contact.touches, state.expected.contact.wanted_n) == (1, TOUCH_N)
    assert state.expected.contact.touched_offset_m == state.expected.contact.offset_m > before.offset_m
    assert plan_s(state) == pytest.approx(APPROACH.end_s)
    short = at_plan(IN_APPROACH, contact(ContactMode.APPROACH, 5.0, beyond_s=0.011))
    assert mode_of(step(short, 0.9)[0]) is ContactMode.APPROACH, "below the threshold"


@pytest.mark.parametrize(
    ("fields", "force_n", "event"),
    [
        ({"offset_m": 0.349}, 0.0, None),
        ({"offset_m": 0.351}, 0.0, "surface_missing"),
        ({"offset_m": 0.299, "touches": 1, "touched_offset_m": 0.2}, 0.0, None),
        ({"offset_m": 0.301, "touches": 1, "touched_offset_m": 0.2}, 0.0, "contact_lost"),
        ({"touches": 1, "beyond_s": 0.011}, 2.0, "touched"),
        ({"touches": 2, "beyond_s": 0.011}, 2.0, "contact_bounce"),
    ],
)
def test_an_approach_ends_at_a_missing_or_a_bouncing_surface(
    fields: dict[str, Any], force_n: float, event: str | None
) -> None:
    state, request = step(at_plan(IN_APPROACH, contact(ContactMode.APPROACH, 5.0, **fields)), force_n)
    found = ids(request)
    assert found == [] if event is None else event in found
    leaves = event not in (None, "touched")
    assert (mode_of(state) is ContactMode.LEAVE) is leaves
    assert state.outcome is (Outcome.ABORTED if leaves else None)
    if event == "touched":
        assert plan_s(state) == pytest.approx(APPROACH.start_s), "the press begins anew"


@pytest.mark.parametrize(
    ("observed", "event"),
    [
        ({}, None),
        ({"force_world_n": None}, "contact_lost"),
        ({"position_error_m": (-0.079, 0.2, 0.0)}, None),
        ({"position_error_m": (-0.081, 0.0, 0.0)}, "contact_disagrees"),  # something blocks the vehicle
        ({"position_error_m": (0.081, 0.0, 0.0)}, "contact_lost"),  # it pushes against nothing
        ({"yaw_error_rad": 0.087}, None),
        ({"yaw_error_rad": -0.088}, "contact_slipped"),  # 5 deg
    ],
)
@pytest.mark.parametrize("mode", [ContactMode.PRESS, ContactMode.APPROACH])
def test_what_contradicts_the_contact_leads_away_from_the_surface(
    mode: ContactMode, observed: dict[str, Any], event: str | None
) -> None:
    state = pressing() if mode is ContactMode.PRESS else at_plan(IN_APPROACH, contact(mode, 5.0))
    state, request = step(state, 5.0 if mode is ContactMode.PRESS else 0.0, **observed)
    assert ids(request) == ([] if event is None else [event])
    if event is None:
        assert mode_of(state) is mode and state.outcome is None
    else:
        assert (
            mode_of(state) is ContactMode.LEAVE and state.expected.contact is not None and state.expected.contact.failed
        )
        assert state.outcome is Outcome.ABORTED
        assert state.course is not None and state.course.held


@pytest.mark.parametrize(
    ("fields", "disturbance_n", "event"),
    [
        ({"disagreed_s": 0.096, "disagreement_n": 4.5}, -10.0, "contact_disagrees"),
        ({"disagreed_s": 0.094, "disagreement_n": 4.5}, -10.0, None),
        ({"disagreed_s": 0.5, "disagreement_n": 3.5}, -5.0, None),
        ({"disagreed_s": 0.5, "push_n": 8.0, "unopposed_n": 4.5}, 0.0, "contact_lost"),
        ({"disagreed_s": 0.5, "push_n": 3.9, "unopposed_n": 4.5}, 0.0, None),
    ],
)
def test_a_force_that_the_vehicles_motion_does_not_show_ends_the_contact_after_a_tenth_of_a_second(
    fields: dict[str, Any], disturbance_n: float, event: str | None
) -> None:
    _, request = step(pressing(**fields), 5.0, disturbance_world_n=(disturbance_n, 0.0, 0.0))
    assert ids(request) == ([] if event is None else [event])


def test_a_press_without_contact_for_a_second_waits_half_a_second_and_approaches_again() -> None:
    state, request = step(pressing(beyond_s=0.98), 0.1)
    assert mode_of(state) is ContactMode.PRESS and ids(request) == []
    state, request = step(pressing(beyond_s=0.996), 0.1)
    assert mode_of(state) is ContactMode.LOST and ids(request) == ["contact_interrupted"]
    assert mode_of(step(pressing(beyond_s=0.996), 0.4)[0]) is ContactMode.PRESS, "above a third of the touch"
    for since_s, mode in ((0.49, ContactMode.LOST), (0.51, ContactMode.APPROACH)):
        slid = replace(PRESSING.shift, to_m=(0.0, 0.0, -0.5), length_m=0.5, way_m=0.1)
        lost = at_plan(IN_PRESS, contact(ContactMode.LOST, since_s, touches=1, push_n=3.0, shift=slid), PRESS)
        state, _ = step(lost)
        assert mode_of(state) is mode and state.expected.contact is not None
        assert state.expected.contact.push_n == pytest.approx(3.0 - 15.0 * DT_S)
        assert state.expected.contact.touches == 1
        assert state.expected.contact.shift.rate_m_s == 0.0


def test_a_detach_releases_the_force_first_then_moves_back_and_ends_with_its_phase() -> None:
    state, _ = step(at_plan(DETACH.start_s + 0.1, replace(PRESSING, push_n=4.0), PRESS), 5.0)
    assert mode_of(state) is ContactMode.LEAVE and state.engaged == DETACH
    state, _ = step(state, 5.0)
    assert state.expected.contact is not None
    assert state.expected.contact.push_n == pytest.approx(4.0 - 15.0 * DT_S)
    assert state.expected.contact.offset_m == pytest.approx(0.2)
    back = at_plan(DETACH.start_s + 0.1, contact(ContactMode.LEAVE, 1.0, offset_m=0.1), DETACH)
    state, _ = step(back)
    assert state.expected.contact is not None and 0.0 < state.expected.contact.offset_m < 0.1
    home = at_plan(DETACH.start_s + 0.1, contact(ContactMode.LEAVE, 1.0, touches=2), DETACH)
    state, _ = step(home)  # nothing was shifted: RETURN ends at once
    assert state.expected.contact is None and not state.skips
    assert plan_s(state) == pytest.approx(DETACH.end_s)


def test_after_a_failed_contact_the_rest_is_skipped_and_the_plan_goes_on_where_it_was_held() -> None:
    failed = at_plan(IN_PRESS, contact(ContactMode.RETURN, 1.0, failed=True), PRESS)
    assert failed.course is not None
    held = replace(failed, course=failed.course.hold(NOW_S - 5.0))
    state, _ = step(held)
    assert state.expected.contact is None and state.skips
    assert state.course is not None and not state.course.held
    assert plan_s(state) < PRESS.end_s - 1.0


def test_a_landing_during_a_press_leads_back_from_the_surface_first() -> None:
    state, _ = step(pressing(), 5.0)
    state, _ = after(state, "operator_land", SafetyAction.LAND, parameters=P)
    assert state.course is not None and state.expected.contact is None
    plan, (x, y, z) = state.course.plan, HERE
    assert plan.segments[0].name == "back"
    assert plan.reference(plan.segments[0].end_s).position_world_m == pytest.approx((x - 0.2, y, z), abs=1e-3)


@pytest.mark.parametrize("force_n", [4.9, 5.0])
def test_the_tip_beside_its_point_is_reported_once_the_force_is_reached(force_n: float) -> None:
    def seen(first_rad: float) -> list[tuple[str, str]]:
        i: Inputs = put("arm", angle_rad=(first_rad, PLAN.reference(IN_PRESS).arm_rad[1]))(healthy())
        reference = PLAN.reference(IN_PRESS)
        level = {"position_world_m": reference.position_world_m, "attitude_wxyz": (1.0, 0.0, 0.0, 0.0)}
        there = put("mocap", **level)(put("vehicle", **level)(i))
        state = pressing(wanted_n=4.999 if force_n == 5.0 else 4.9, offset_m=0.0)
        return [(event.id, event.text) for event in step(state, 5.0, inputs=there)[1].events]

    straight = PLAN.reference(IN_PRESS).arm_rad[0]
    text = "the tool presses 21 cm beside the point of the mission (limit 5 cm)"
    assert seen(straight) == []
    assert seen(straight + 0.3) == ([("contact_beside", text)] if force_n == 5.0 else [])


FACING = Parameters.of(load_flight("configs/missions/press.yaml"))
"""Three light touches, 0.2 m apart, find the normal of the wall first."""


def test_the_points_to_touch_lie_right_and_up_of_the_direction() -> None:
    begun = c.begun(NOW_S - 1.1, (0.48, 0.36, -0.8), (0.0, 0.0, 0.0))
    state, _ = tick(at_plan(IN_APPROACH, begun), parameters=FACING, force_world_n=(0.0, 0.0, 0.0), dt_s=DT_S)
    assert state.expected.contact is not None and state.expected.contact.mode is ContactMode.SHIFT
    right, up, low_m = (0.6, -0.8, 0.0), (0.64, 0.48, 0.6), 0.2 / math.sqrt(12.0)
    first = tuple(-0.1 * r - low_m * u for r, u in zip(right, up, strict=True))
    assert state.expected.contact.shift.to_m == pytest.approx(first)


@pytest.mark.parametrize(
    ("since_s", "force_n", "samples", "points"),
    [(0.39, 1.0, 7, 0), (0.41, 1.0, 8, 0), (0.41, 0.2, 7, 0), (0.89, 1.0, 8, 0), (0.91, 1.0, 0, 1)],
)
def test_a_point_is_averaged_for_half_a_second_after_it_has_settled_for_0_4_s(
    since_s: float, force_n: float, samples: int, points: int
) -> None:
    held = contact(ContactMode.PRESS, since_s, touches=1, wanted_n=1.0, force_n=force_n, samples=7)
    state, _ = tick(at_plan(IN_APPROACH, held), parameters=FACING, force_world_n=(-force_n, 0.0, 0.0), dt_s=DT_S)
    assert state.expected.contact is not None
    assert (state.expected.contact.samples, len(state.expected.contact.points)) == (samples, points)
    assert state.expected.contact.mode is (ContactMode.BACK if points else ContactMode.PRESS)


@pytest.mark.parametrize(
    ("touched", "push_n", "mode"),
    [(1, 0.0, ContactMode.BACK), (1, 1.0, ContactMode.BACK), (3, 0.0, ContactMode.LEAVE)],
    ids=["moves back", "releases first", "no plane"],
)
def test_from_a_point_it_moves_back_and_gives_up_if_the_points_lie_on_no_plane(
    touched: int, push_n: float, mode: ContactMode
) -> None:
    points = (TouchedPoint(NOW_S - 1.0, (1.0, 0.0, 1.0), 1.0),) * touched
    back = contact(ContactMode.BACK, 0.5, points=points, offset_m=0.3, touched_offset_m=0.3, push_n=push_n)
    state, request = tick(at_plan(IN_APPROACH, back), parameters=FACING, force_world_n=(0.0, 0.0, 0.0), dt_s=DT_S)
    assert state.expected.contact is not None and state.expected.contact.mode is mode
    assert ids(request) == (["surface_missing"] if touched == 3 else [])
    assert (state.expected.contact.push_n < push_n) is (push_n > 0.0)
    assert (state.expected.contact.offset_m < 0.3) is (push_n == 0.0 and touched == 1)


def test_the_last_point_completes_the_surface() -> None:
    points = tuple(TouchedPoint(NOW_S - 9.0, tip, 1.0) for tip in ((1.5, 0.1, 1.0), (1.5, -0.1, 1.0)))
    held = contact(ContactMode.PRESS, 0.91, touches=1, wanted_n=1.0, force_n=1.0, mean_tip_m=(1.5, 0.0, 1.2))
    held = replace(held, samples=10**6)
    for before, complete in ((points[:1], False), (points, True)):
        state, _ = tick(
            at_plan(IN_APPROACH, replace(held, points=before)), parameters=FACING, force_world_n=(-1.0, 0.0, 0.0),
            dt_s=DT_S,
        )  # fmt: skip
        assert state.expected.contact is not None and (state.expected.contact.surface is not None) is complete
