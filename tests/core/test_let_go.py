"""When a vehicle that holds a bar lets it go."""

from __future__ import annotations

from typing import Any

import pytest
from msgspec.structs import replace

from companion.core.flight_state import FlightState
from companion.core.let_go import let_go_if_better, team_state_of
from companion.core.state_machine import transition
from companion.core.transition import Parameters, Transition
from companion.mission.active_plan import ActiveTrajectory
from companion.mission.air import HeldBar, Observation
from companion.mission.plan import Plan
from companion.model.flight_stage import Stage
from companion.model.team import ClampCommand, Grip, PartnerState, TeamState
from companion.model.types import ArmState, Inputs, Outcome, Reference, SafetyAction
from companion.phases.carry.carry import Carrying
from companion.safety.autopilot_landing import AutopilotLanding
from companion.safety.supervisor import SupervisorState
from companion.sitl_config.team import load_team
from tests.safety.healthy import ZERO3, healthy

CONFIG = load_team("carry", world="ideal").left
PARAMETERS = Parameters.of(CONFIG)
BAR = HeldBar(stands_m=0.35, let_go_m=0.45)
CARRY_RAD = (1.309, 0.349)
"""The clamp is 0.49 m below the body's origin."""
T_S = 20.0


def state(**fields: Any) -> FlightState:
    held = replace(
        PARAMETERS.initial_state(), stage=Stage.MISSION, grip=Grip.CARRYING, bar=BAR, clamp=ClampCommand.CLOSE
    )
    return replace(held, **fields)


def inputs(height_m: float, partner: PartnerState | None) -> Inputs:
    i = healthy(0, T_S)
    assert i.vehicle is not None and i.mocap is not None and i.arm is not None
    at = (0.0, 0.0, height_m)
    arm: ArmState = replace(i.arm, angle_rad=CARRY_RAD)
    level = (1.0, 0.0, 0.0, 0.0)
    vehicle = replace(i.vehicle, position_world_m=at, attitude_wxyz=level)
    mocap = replace(i.mocap, position_world_m=at, attitude_wxyz=level)
    return replace(i, vehicle=vehicle, mocap=mocap, arm=arm, partner=partner)


def said(**fields: Any) -> PartnerState:
    nominal = TeamState(grip=Grip.CARRYING, holds=False, lands=False, px4_lands=False, position_world_m=ZERO3)
    return PartnerState(stamp_s=T_S - 0.01, said=replace(nominal, **fields))


def observed(
    i: Inputs, force_n: float | None, reference: Reference | None = None, shows_n: float | None = None
) -> Observation:
    return Observation(
        inputs=i,
        airborne=True,
        armed_by_others=False,
        standing=None,
        reference=reference,
        tether=None,
        thrust_share=1.0,
        pose_s=i.t_s,
        dt_s=0.005,
        force_world_n=None if force_n is None else (0.0, 0.0, -force_n),
        disturbance_world_n=None if shows_n is None else (0.0, 0.0, -shows_n),
        position_error_m=ZERO3,
        yaw_error_rad=0.0,
    )


def after(
    held: FlightState,
    height_m: float = 1.3,
    partner: PartnerState | None = None,
    force_n: float = 2.0,
    texts: list[str] | None = None,
    shows_n: float | None = None,
) -> FlightState:
    """The state after a tick; the texts of its events are added to `texts`."""
    t = Transition(PARAMETERS, held, (), observed(inputs(height_m, partner), force_n, shows_n=shows_n))
    let_go_if_better(t)
    if texts is not None:
        texts += [event.text for event in t.events]
    return t.state


def let_go(found: FlightState) -> bool:
    assert (found.clamp is ClampCommand.OPEN) is (found.bar is None) is (found.grip is Grip.FREE)
    return found.bar is None


def on_the_way(**fields: Any) -> tuple[FlightState, Reference]:
    """A state in the phase `carry`, and the last reference; `fields` of the phase's state have other values."""
    plan = Plan.build(CONFIG.mission, CONFIG.vehicle)
    carry = plan.segments[2]
    way_s = carry.start_s + 6.0
    own = Carrying(bar=BAR, along_world=(0.0, -1.0, 0.0), pose=(0.0, 0.0, 1.0, 0.0), begun_s=0.0, begun_offset_m=ZERO3)
    course = ActiveTrajectory(plan, T_S - way_s)
    return state(course=course, own=replace(own, **fields), engaged=carry, mission_start_s=0.0), plan.reference(way_s)


@pytest.mark.parametrize("action", [SafetyAction.NOMINAL, SafetyAction.HOLD])
def test_a_lifted_bar_that_is_not_felt_lands_the_vehicle_in_a_hold_too(action: SafetyAction) -> None:
    """A bar that has slipped out of the other clamp tilts, and by that holds both."""
    found, reference = on_the_way(bar=replace(BAR), light_s=T_S - 1.1)
    if action is SafetyAction.HOLD:
        assert found.course is not None
        found = replace(found, supervisor=SupervisorState(action, "bar_tilted", T_S), course=found.course.hold(T_S))
    found, request = transition(PARAMETERS, found, (), observed(inputs(1.3, said()), 0.0, reference))
    assert [event.id for event in request.events] == ["bar_lost"]
    assert (found.aborting, found.supervisor.action) == (True, SafetyAction.LAND)


@pytest.mark.parametrize("force_n", [0.0, None])
def test_without_the_force_a_bar_is_carried_on_along_the_path_as_planned(force_n: float | None) -> None:
    """An unmeasured force once counted as one of 0: the bar seemed lost, and the vehicle landed with it."""
    found, reference = on_the_way(weight_n=0.0, light_s=T_S - 1.1, tension_n=3.0, offset_m=0.1, rate_m_s=0.2)
    for _ in range(2000):
        found, request = transition(PARAMETERS, found, (), observed(inputs(1.3, said()), force_n, reference))
        if force_n == 0.0:
            assert [event.id for event in request.events] == ["bar_lost"]
            return
        assert (request.events, found.aborting, found.supervisor.action) == ((), False, SafetyAction.NOMINAL)
    own = found.own
    assert isinstance(own, Carrying)
    assert found.expected.carry is not None and found.expected.carry.weight_n is None
    assert abs(own.offset_m) < 0.005 and abs(own.rate_m_s) < 0.005


def test_a_bar_that_is_carried_is_kept_at_any_height() -> None:
    for height_m in (0.85, 1.3):
        assert not let_go(after(state(), height_m, said()))
        assert not let_go(after(state(), height_m, said(px4_lands=True))), "the rules land it first"


@pytest.mark.parametrize("stage", [Stage.MISSION, Stage.AUTOPILOT_LAND])
def test_a_bar_that_pulls_too_hard_is_let_go_at_any_height(stage: Stage) -> None:
    assert not let_go(after(state(stage=stage), 1.3, said(), force_n=17.0))
    assert let_go(after(state(stage=stage), 1.3, said(), force_n=19.0))


def test_a_wrong_force_sensor_alone_lets_no_bar_go() -> None:
    """The limit is 18 N; the vehicle's motion, which shows a sudden pull later, must show half of it."""
    assert not let_go(after(state(), 1.3, said(), force_n=25.0, shows_n=8.0))
    assert let_go(after(state(), 1.3, said(), force_n=25.0, shows_n=10.0))
    assert not let_go(after(state(), 1.3, said(), force_n=17.0, shows_n=25.0))


def test_a_bar_that_is_let_go_in_the_mission_stays_let_go_and_the_vehicle_lands() -> None:
    """Over more than one tick: the phase would command the clamp to close again."""
    found, reference = on_the_way()
    for force_n in (17.0, 19.0, 2.0, 2.0):
        i = inputs(1.3, said())
        found, _ = transition(PARAMETERS, found, (), observed(i, force_n, reference))
        if force_n == 17.0:
            assert not let_go(found)
        else:
            assert let_go(found)
            assert (found.stage, found.aborting, found.supervisor.action) == (Stage.MISSION, True, SafetyAction.LAND)
            assert found.outcome is Outcome.ABORTED


def test_a_vehicle_that_falls_lets_go_at_once() -> None:
    assert let_go(after(state(supervisor=SupervisorState(action=SafetyAction.TERMINATE)), 1.3, said()))


def test_a_landing_of_both_opens_the_clamp_at_its_time_and_not_by_height() -> None:
    landing = state(aborting=True, opens_s=T_S + 0.01)
    assert not let_go(after(landing, 0.85, said(lands=True)))
    assert let_go(after(replace(landing, opens_s=T_S), 0.85, said(lands=True)))


@pytest.mark.parametrize(
    "partner",
    [None, said(px4_lands=True), said(grip=Grip.FREE), replace(said(), stamp_s=T_S - 0.4)],
    ids=["never heard", "landed by PX4", "free", "silent"],
)
def test_a_landing_of_one_alone_lets_go_when_the_feet_are_low(partner: PartnerState | None) -> None:
    landing = state(aborting=True)
    assert not let_go(after(landing, 0.96, partner))
    assert let_go(after(landing, 0.93, partner))


def test_a_vehicle_that_px4_lands_lets_go_when_the_feet_are_low() -> None:
    landing, texts = state(stage=Stage.AUTOPILOT_LAND), list[str]()
    assert not let_go(after(landing, 0.96, said(), texts=texts))
    assert let_go(after(landing, 0.93, said(), texts=texts))
    assert let_go(after(landing, 0.8, said(), texts=texts))
    assert texts == [f"the bar is let go: its feet are {height_m} m above the floor" for height_m in ("0.09", "0.00")]


@pytest.mark.parametrize("pilot", [False, True])
def test_the_time_of_a_landing_that_px4_or_a_pilot_has_taken_over_does_not_open_the_clamp(pilot: bool) -> None:
    by_px4 = AutopilotLanding.begin(T_S, PARAMETERS.clearance_m, PARAMETERS.tilt_max_rad, pilot, pose_s=T_S)
    landing = state(stage=Stage.AUTOPILOT_LAND, aborting=True, opens_s=T_S - 1.0, landing=by_px4)
    assert not let_go(after(landing, 1.6, said(lands=True)))
    assert let_go(after(landing, 0.93, said(lands=True)))


@pytest.mark.parametrize(
    ("aborting", "action", "announced"),
    [
        (False, SafetyAction.WARN, (False, False)),
        (False, SafetyAction.HOLD, (True, False)),
        (True, SafetyAction.RETRACT, (True, False)),
        (True, SafetyAction.LAND, (True, True)),
        (False, SafetyAction.LAND, (True, False)),
    ],
)
def test_a_hold_and_an_aborted_flight_that_lands_are_announced(
    aborting: bool, action: SafetyAction, announced: tuple[bool, bool]
) -> None:
    held = state(aborting=aborting, supervisor=SupervisorState(action, "cause", T_S))
    found = team_state_of(held, inputs(1.3, None), "files")
    assert (found.holds, found.lands, found.position_world_m) == (*announced, (0.0, 0.0, 1.3))
    assert found.agreed == "files"
    assert team_state_of(held, replace(inputs(1.3, None), vehicle=None, mocap=None), None).server_s is None
