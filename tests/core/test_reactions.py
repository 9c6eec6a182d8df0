"""What the core does with a tick's most severe event: one transition at a time, from a state that the test makes up."""

from __future__ import annotations

import dataclasses
import math
import re
from types import SimpleNamespace
from typing import Any

import pytest
from msgspec.structs import replace

from companion.config.loader import load_flight
from companion.core.flight_state import FlightState, Request
from companion.core.state_machine import transition
from companion.core.transition import Parameters
from companion.mission.active_plan import ActiveTrajectory
from companion.mission.air import NOTHING, Air, Expectation, Observation
from companion.mission.phase import phases_of
from companion.mission.plan import Plan
from companion.model.algebra import plus
from companion.model.flight_stage import Stage
from companion.model.outputs import TetherState
from companion.model.team import Grip
from companion.model.types import (
    AutopilotRequest,
    Event,
    FlightMode,
    OperatorCommand,
    Outcome,
    PhaseKind,
    SafetyAction,
    Severity,
    Vec3,
)
from companion.phases.contact import force
from companion.safety.autopilot_landing import AutopilotLanding
from companion.safety.supervisor import SupervisorState
from tests.control.states import at_rest
from tests.safety.healthy import SLOW, healthy, put

CONFIG = load_flight("configs/missions/catch.yaml")
P = Parameters.of(CONFIG)
PLAN = Plan.build(CONFIG.mission, CONFIG.vehicle)
ANCHOR: Vec3 = (0.0, -1.2, 0.0)  # configs/vehicles/tarot650_2r.yaml
PULLS = [replace(SLOW, taut=True), replace(SLOW, snagged=True)]
HERE: Vec3 = (0.0, 0.3, 1.0)
"""The anchor lies towards -y."""


def in_plan(plan_s: float = 6.0, plan: Plan = PLAN, parameters: Parameters = P, **fields: Any) -> FlightState:
    """In the air, some time into the mission; `fields` of the state have other values."""
    begun_s = healthy().t_s - plan_s
    times = {"entered_s": begun_s, "course": ActiveTrajectory(plan, begun_s), "mission_start_s": begun_s}
    return replace(parameters.initial_state(), **({"stage": Stage.MISSION, "plan": plan} | times | fields))


def tick(
    state: FlightState, *events: Event, parameters: Parameters = P, **observed: Any
) -> tuple[FlightState, Request]:
    """The state and the requests after one tick."""
    observation = {
        "inputs": healthy(),
        "airborne": True,
        "armed_by_others": False,
        "standing": None,
        "reference": at_rest(HERE, 0.4, P.fold_rad),
        "tether": SLOW,
        "thrust_share": 1.0,
        "pose_s": healthy().t_s,
        "dt_s": 0.005,
        "force_world_n": None,
        "disturbance_world_n": None,
        "position_error_m": (0.0, 0.0, 0.0),
        "yaw_error_rad": 0.0,
    }
    return transition(parameters, state, events, Observation(**{**observation, **observed}))


def after(
    state: FlightState, event_id: str, action: SafetyAction, *, velocity: Vec3 = (0.0, 0.0, 0.0), **observed: Any
) -> tuple[FlightState, Request]:
    """The state and the requests after a tick with one event."""
    event = Event(t_s=healthy().t_s, id=event_id, severity=Severity.CRITICAL, action=action, text="")
    reference = replace(at_rest(HERE, 0.4, P.fold_rad), velocity_world_m_s=velocity)
    return tick(state, event, **{"reference": reference, **observed})


def ids(request: Request) -> list[str]:
    return [event.id for event in request.events]


def start_velocity(state: FlightState) -> Vec3:
    assert state.course is not None and state.aborting
    return state.course.plan.reference(0.0).velocity_world_m_s


OUTWARD_UP: Vec3 = (0.1, 0.4, 0.3)


@pytest.mark.parametrize("tether", PULLS)
def test_a_landing_with_a_taut_tether_does_not_first_fly_on_outward_or_up(tether: TetherState) -> None:
    state, _ = after(in_plan(), "arm_lost", SafetyAction.LAND, velocity=OUTWARD_UP, tether=tether)
    assert start_velocity(state) == pytest.approx((0.1, 0.0, 0.0))


def test_a_landing_with_a_slack_tether_brakes_from_the_present_velocity() -> None:
    state, _ = after(in_plan(), "arm_lost", SafetyAction.LAND, velocity=OUTWARD_UP)
    assert start_velocity(state) == pytest.approx(OUTWARD_UP)
    assert state.outcome is Outcome.ABORTED


CONTACT = phases_of(load_flight("press").mission)[3]


def touching(towards: Vec3) -> FlightState:
    own = force.begun(healthy().t_s, towards, (0.0, 0.0, 0.0))
    return replace(in_plan(), own=own, expected=CONTACT.expects(own))


@pytest.mark.parametrize(
    ("towards", "retracts"),
    [
        ((0.0, -1.0, 0.0), False),
        ((0.6, -0.8, 0.0), False),
        ((0.8, -0.6, 0.0), False),
        ((0.0, 1.0, 0.0), True),
        (None, True),
    ],
)
def test_no_retract_leads_through_the_surface_between_vehicle_and_anchor(towards: Vec3 | None, retracts: bool) -> None:
    state = in_plan() if towards is None else touching(towards)
    state, request = after(state, "tether_taut", SafetyAction.RETRACT, tether=PULLS[0])
    assert ("no_room_to_stay" in ids(request)) is not retracts
    assert state.supervisor.action is (SafetyAction.RETRACT if retracts else SafetyAction.LAND)
    assert state.course is not None and state.aborting and state.expected.contact is None
    last = state.course.plan.reference(state.course.plan.duration_s).position_world_m
    nearer_m = math.dist(HERE[:2], ANCHOR[:2]) - math.dist(last[:2], ANCHOR[:2])
    assert nearer_m > 0.3 if retracts else nearer_m < 0.05


@pytest.mark.parametrize("mode", [FlightMode.MANUAL, FlightMode.HOLD])
def test_a_flip_under_a_pilot_begins_no_landing_of_the_companions_own(mode: FlightMode) -> None:
    """A new landing would command LAND to a pilot in HOLD."""
    now_s = healthy().t_s
    landing = AutopilotLanding.begin(now_s - 1.0, P.clearance_m, P.tilt_max_rad, pilot=True, pose_s=now_s)
    flown = replace(
        P.initial_state(),
        stage=Stage.AUTOPILOT_LAND,
        entered_s=now_s - 1.0,
        landing=landing,
        outcome=Outcome.ABORTED,
        supervisor=SupervisorState(SafetyAction.AUTOPILOT_LAND, "pilot_took_over", now_s - 1.0),
    )
    state, request = after(flown, "crashed", SafetyAction.TERMINATE, inputs=put("status", mode=mode)(healthy()))
    assert request.autopilot is AutopilotRequest.NONE
    assert state.pilot_flies
    assert state.outcome is Outcome.ABORTED


@pytest.mark.parametrize("height_m", [0.3, 0.58, 0.62])
def test_a_hold_near_the_floor_is_a_landing(height_m: float) -> None:
    """There it would hang in its own downwash, 0.3 m above standing height and lower."""
    assert P.clearance_m == 0.3
    at_s = next(k * 0.005 for k in range(2000) if PLAN.reference(k * 0.005).position_world_m[2] >= height_m)
    state, request = after(in_plan(at_s), "too_fast", SafetyAction.HOLD)
    lands = height_m < 0.6
    assert ("no_room_to_stay" in ids(request)) is lands
    assert state.course is not None and state.course.held is not lands
    assert state.supervisor.action is (SafetyAction.LAND if lands else SafetyAction.HOLD)


@pytest.mark.parametrize("action", [SafetyAction.HOLD, SafetyAction.RETRACT])
def test_a_landing_that_has_begun_is_not_interrupted(action: SafetyAction) -> None:
    landing = next(segment for segment in PLAN.segments if segment.kind is PhaseKind.LANDING)
    assert PLAN.reference(landing.start_s).position_world_m[2] > 0.7, "high enough to hold"
    before = in_plan(landing.start_s + 0.1)
    state, request = after(before, "tether_taut", action, tether=PULLS[0])
    assert state.stage is Stage.MISSION and state.course is not None and not state.course.held
    if action is SafetyAction.HOLD:
        assert state.course == before.course and "no_room_to_stay" not in ids(request)
    else:
        assert state.aborting and state.supervisor.action is SafetyAction.LAND


@pytest.mark.parametrize(
    ("action", "since_s", "event"),
    [
        (SafetyAction.HOLD, 19.9, None),
        (SafetyAction.HOLD, 20.1, "hold_expired"),
        (SafetyAction.RETRACT, 11.9, None),
        (SafetyAction.RETRACT, 12.1, "retract_expired"),
    ],
)
def test_a_hold_or_retract_ends_in_a_landing_although_nothing_else_happens(
    action: SafetyAction, since_s: float, event: str | None
) -> None:
    state = replace(in_plan(), supervisor=SupervisorState(action, "before", healthy().t_s - since_s))
    state, request = tick(state)
    assert ids(request) == ([] if event is None else [event])
    assert state.supervisor.action is (action if event is None else SafetyAction.LAND)
    assert state.aborting is (event is not None)


@pytest.mark.parametrize(("standing", "resumed"), [(None, True), ("too little tether left", False)])
def test_a_resume_ends_a_hold_unless_a_rule_still_requires_one(standing: str | None, resumed: bool) -> None:
    held = in_plan()
    assert held.course is not None
    supervisor = SupervisorState(SafetyAction.HOLD, "operator_hold", healthy().t_s - 5.0)
    held = replace(held, supervisor=supervisor, course=held.course.hold(healthy().t_s - 5.0))
    assert not tick(held)[1].resumed
    state, request = after(held, "operator_resume", SafetyAction.NOMINAL, standing=standing)
    assert request.resumed is resumed
    assert state.course is not None and state.course.held is not resumed
    refused = [event for event in request.events if event.id == "resume_refused"]
    assert [(event.text, event.severity) for event in refused] == ([] if resumed else [(standing, Severity.WARNING)])


@pytest.mark.parametrize(
    ("stage", "waits", "by_others", "takeoff_cancelled"),
    [
        (Stage.WAIT, True, False, False),
        (Stage.READY, True, False, False),
        (Stage.OFFBOARD, True, False, True),
        (Stage.WAIT, False, False, True),
        (Stage.OFFBOARD, False, True, False),
        (Stage.SPOOL, False, False, False),
    ],
)
def test_a_hold_before_take_off_calls_it_off_unless_the_flight_waits_for_its_start(
    stage: Stage, waits: bool, by_others: bool, takeoff_cancelled: bool
) -> None:
    before = replace(in_plan(), stage=stage, entered_s=healthy().t_s, armed_by_others=by_others)
    held = replace(put("status", armed=False)(healthy()), command=OperatorCommand.HOLD)
    parameters = dataclasses.replace(P, waits_for_start=waits)
    waiting = replace(before.waiting, tare_start_s=healthy().t_s)
    _, request = tick(replace(before, waiting=waiting), parameters=parameters, inputs=held, airborne=False)
    assert ("takeoff_cancelled" in ids(request)) is takeoff_cancelled


def test_before_take_off_a_fault_refuses_the_flight_and_the_operators_word_ends_it() -> None:
    armed = replace(P.initial_state(), stage=Stage.OFFBOARD, entered_s=healthy().t_s - 1.0)
    for cause, outcome in (("arm_lost", Outcome.REFUSED), ("operator_land", Outcome.ABORTED)):
        state, _ = after(armed, cause, SafetyAction.LAND, airborne=False, reference=None)
        assert (state.stage, state.outcome) == (Stage.STAND_DOWN, outcome)


def test_armed_by_others_and_unseen_by_motion_capture_px4s_height_counts_for_nothing() -> None:
    """The companion has sent PX4 no pose, so PX4's height may have drifted."""
    state, unseen = replace(P.initial_state(), entered_s=healthy().t_s), replace(healthy(), mocap=None)
    state, _ = after(state, "armed_externally", SafetyAction.AUTOPILOT_LAND, armed_by_others=True, inputs=unseen)
    assert state.stage is Stage.AUTOPILOT_LAND and state.landing is not None
    assert state.landing.pose_s == state.landing.stop.pose_s == -math.inf


def test_armed_by_others_a_flip_is_not_taken_as_known_from_before() -> None:
    """Its rotors are stopped after 0.3 s, as in every other landing."""
    over = {"attitude_wxyz": (0.0, 1.0, 0.0, 0.0), "specific_force_body_m_s2": (0.0, 0.0, 0.0)}
    i = replace(put("vehicle", **over)(healthy()), mocap=None)
    state = replace(P.initial_state(), entered_s=healthy().t_s)
    _, request = after(state, "armed_externally", SafetyAction.AUTOPILOT_LAND, armed_by_others=True, inputs=i)
    assert request.autopilot is AutopilotRequest.LAND


def held_by(cause: str, **fields: Any) -> FlightState:
    """In a hold of the mission's plan."""
    state, since_s = in_plan(), healthy().t_s - 5.0
    assert state.course is not None
    supervisor = SupervisorState(SafetyAction.HOLD, cause, since_s)
    return replace(state, **({"supervisor": supervisor, "course": state.course.hold(since_s)} | fields))


@pytest.mark.parametrize(("standing", "cause"), [(None, "partner_holds"), ("too little tether left", "operator_hold")])
def test_a_resume_with_a_bar_waits_for_the_other_vehicle(standing: str | None, cause: str) -> None:
    held = held_by("operator_hold", grip=Grip.CARRYING)
    state, request = after(held, "operator_resume", SafetyAction.NOMINAL, standing=standing)
    assert (state.supervisor.action, state.supervisor.cause) == (SafetyAction.HOLD, cause)
    assert ("resume_refused" in ids(request)) is (standing is not None)
    assert not request.resumed


@pytest.mark.parametrize(
    ("event_id", "action", "cause"),
    [
        ("too_fast", SafetyAction.HOLD, "too_fast"),
        ("partner_holds", SafetyAction.HOLD, "partner_holds"),
        ("force_lost", SafetyAction.WARN, "partner_holds"),
    ],
)
def test_a_vehicle_that_holds_for_the_other_and_finds_a_reason_of_its_own_is_held_by_that(
    event_id: str, action: SafetyAction, cause: str
) -> None:
    assert after(held_by("partner_holds"), event_id, action)[0].supervisor.cause == cause


def test_of_two_reasons_in_one_tick_the_one_of_its_own_holds_it() -> None:
    own, partner = (
        Event(t_s=healthy().t_s, id=name, severity=Severity.WARNING, action=SafetyAction.HOLD, text="")
        for name in ("operator_hold", "partner_holds")
    )
    for events in ((own, partner), (partner, own)):
        state, _ = tick(in_plan(grip=Grip.CARRYING), *events)
        assert (state.supervisor.action, state.supervisor.cause) == (SafetyAction.HOLD, "operator_hold")


def test_a_resume_without_a_hold_changes_nothing() -> None:
    for grip in (Grip.FREE, Grip.CARRYING):
        before = in_plan(grip=grip)
        for standing in (None, "too little tether left"):
            state, request = after(before, "operator_resume", SafetyAction.NOMINAL, standing=standing)
            assert ids(request) == ["operator_resume"] and not request.resumed
            assert (state.supervisor, state.course) == (before.supervisor, before.course)


def test_a_landing_in_front_of_a_surface_first_moves_back_from_it() -> None:
    back_m = (0.1, -0.15, 0.2)
    state, _ = after(in_plan(expected=Expectation(back_m=back_m)), "arm_lost", SafetyAction.LAND)
    assert state.course is not None
    plan = state.course.plan
    places = [plan.reference(k * 0.01).position_world_m for k in range(round(100 * plan.duration_s))]
    assert min(math.dist(place, plus(HERE, back_m)) for place in places) < 0.01


def test_a_landing_goes_on_without_px4s_state() -> None:
    landing = next(segment for segment in PLAN.segments if segment.kind is PhaseKind.LANDING)
    before = in_plan(landing.start_s + 0.1)
    assert tick(before, inputs=replace(healthy(), vehicle=None))[0].touchdown is before.touchdown


class Probe(SimpleNamespace):
    """A phase that shows what it is given; its state is an empty expectation."""

    title, acts, ends, fails = "probe", True, False, False

    def begin(self, air: Air) -> Expectation | None:
        return None if self.ends else self.step(air, NOTHING)

    def step(self, air: Air, own: Expectation) -> Expectation | None:
        if self.fails:
            raise ValueError("boom")
        self.seen = (air.nominal, air.holds, air.waits)
        return None if self.ends else own

    def leave(self, own: Expectation, t_s: float) -> Expectation | None:
        return self.step(self.air, own) if self.fails else None if self.ends else own

    def expects(self, own: Expectation) -> Expectation:
        return own


def probed(probe: Probe) -> Parameters:
    return dataclasses.replace(P, phases=(probe,) * len(P.phases), acts=True)  # type: ignore[arg-type]


ENGAGED = PLAN.segment(6.0)


@pytest.mark.parametrize(
    ("action", "cause", "standing", "seen"),
    [
        (SafetyAction.NOMINAL, None, None, (True, False, False)),
        (SafetyAction.WARN, "force_lost", None, (False, False, False)),
        (SafetyAction.HOLD, "too_fast", None, (False, True, False)),
        (SafetyAction.HOLD, "partner_holds", None, (False, True, True)),
        (SafetyAction.HOLD, "partner_holds", "a rule", (False, True, False)),
    ],
)
def test_a_phase_sees_whether_the_flight_holds_and_waits(
    action: SafetyAction, cause: str | None, standing: str | None, seen: tuple[bool, bool, bool]
) -> None:
    probe = Probe()
    held = held_by("", supervisor=SupervisorState(action, cause, healthy().t_s), own=NOTHING, engaged=ENGAGED)
    assert tick(held, parameters=probed(probe), standing=standing)[0].own is NOTHING
    assert probe.seen == seen


@pytest.mark.parametrize("own", [None, NOTHING])
def test_a_phase_that_is_over_or_does_not_begin_moves_the_plan_to_its_end(own: Expectation | None) -> None:
    before = in_plan(own=own, engaged=None if own is None else ENGAGED)
    state, _ = tick(before, parameters=probed(Probe(ends=True)))
    assert state.course is not None and (state.own, state.skips) == (None, False)
    assert state.course.pace(healthy().t_s)[0] == pytest.approx(ENGAGED.end_s)


@pytest.mark.parametrize("ends", [False, True])
def test_a_hold_lets_the_phase_leave_what_it_does(ends: bool) -> None:
    before = in_plan(own=NOTHING, engaged=ENGAGED)
    state, _ = after(before, "too_fast", SafetyAction.HOLD, parameters=probed(Probe(ends=ends)))
    assert (state.own, state.skips) == ((None, True) if ends else (NOTHING, False))


def test_a_phase_that_raises_an_error_is_named_with_the_place_of_it() -> None:
    """After a hold the plan's time may have passed the end of the phase."""
    phases = tuple(Probe(fails=True, title=f"probe {index}") for index in range(len(P.phases)))
    before = in_plan(ENGAGED.end_s + 0.1, own=NOTHING, engaged=ENGAGED)
    _, request = tick(before, parameters=dataclasses.replace(P, phases=phases, acts=True))  # type: ignore[arg-type]
    (text,) = [event.text for event in request.events if event.id == "phase_failed"]
    assert re.fullmatch(rf"phase 'probe {ENGAGED.index}' failed: .*boom.* \(test_reactions\.py:\d+\)", text)
