"""Each stage of a flight: what it waits for, for how long, and what it requests meanwhile."""

from __future__ import annotations

import dataclasses
import math
from typing import Any

import msgspec
import pytest

from companion.config.devices import TeamDevice
from companion.core.flight_state import FlightState, Tare
from companion.core.readiness import missing_inputs
from companion.mission.active_plan import ActiveTrajectory
from companion.mission.plan import Plan
from companion.mission.settled import SettledEstimate
from companion.model.flight_stage import PILOT_FLIES, Stage
from companion.model.types import (
    AutopilotRequest,
    Event,
    FlightMode,
    Inputs,
    LandedState,
    Outcome,
    PhaseKind,
    SafetyAction,
    Severity,
)
from companion.safety.autopilot_landing import AutopilotLanding
from companion.safety.rotor_stop import RotorStop
from companion.safety.touchdown import Sinking
from tests.core.test_reactions import CONFIG, P, after, ids, in_plan, tick
from tests.safety.faults import EXTERNAL
from tests.safety.healthy import fed_by_another, healthy, put, with_partner

replace = msgspec.structs.replace
NOW_S = healthy().t_s
NONE, OFFBOARD, ARM = AutopilotRequest.NONE, AutopilotRequest.OFFBOARD, AutopilotRequest.ARM
DISARM, FORCE_DISARM, LAND = AutopilotRequest.DISARM, AutopilotRequest.FORCE_DISARM, AutopilotRequest.LAND


def in_stage(stage: Stage, elapsed_s: float, **changes: Any) -> FlightState:
    plan = Plan.build(CONFIG.mission, CONFIG.vehicle)
    course = ActiveTrajectory(plan, NOW_S - elapsed_s)
    fields = {"stage": stage, "entered_s": NOW_S - elapsed_s, "plan": plan, "course": course, **changes}
    return replace(P.initial_state(), **fields)


def px4(mode: FlightMode = FlightMode.OFFBOARD, *, armed: bool = True, landed: bool = False) -> Inputs:
    state = LandedState.ON_GROUND if landed else LandedState.IN_AIR
    return put("status", mode=mode, armed=armed, landed=state)(healthy())


OTHER = FlightMode.OTHER


def at_start(x_m: float = -1.0) -> Inputs:
    """On the ground at the mission's start, or beside it, with the arm folded."""
    level = {"position_world_m": (x_m, 0.0, 0.3), "attitude_wxyz": (1.0, 0.0, 0.0, 0.0)}
    i = put("mocap", **level)(put("vehicle", **level)(px4(OTHER, armed=False, landed=True)))
    return put("arm", angle_rad=P.fold_rad)(i)


def armed_at(x_m: float) -> Inputs:
    return put("status", mode=FlightMode.OFFBOARD, armed=True)(at_start(x_m))


@pytest.mark.parametrize(
    ("stage", "elapsed_s", "inputs", "request_", "next_", "event"),
    [
        (Stage.OFFBOARD, 0.79, px4(OTHER), NONE, Stage.OFFBOARD, None),
        (Stage.OFFBOARD, 0.81, px4(OTHER), OFFBOARD, Stage.OFFBOARD, None),
        (Stage.OFFBOARD, 0.79, px4(), NONE, Stage.OFFBOARD, None),  # PX4 arms on a stream of setpoints only
        (Stage.OFFBOARD, 0.81, px4(), NONE, Stage.ARM, None),
        (Stage.OFFBOARD, 7.99, px4(OTHER), OFFBOARD, Stage.OFFBOARD, None),
        (Stage.OFFBOARD, 8.01, px4(OTHER), NONE, Stage.STAND_DOWN, "offboard_refused"),
        (Stage.ARM, 0.0, px4(armed=False), ARM, Stage.ARM, None),
        (Stage.ARM, 9.99, px4(armed=False), ARM, Stage.ARM, None),
        (Stage.ARM, 10.01, px4(armed=False), NONE, Stage.STAND_DOWN, "arming_refused"),
        (Stage.ARM, 1.0, armed_at(-1.0), NONE, Stage.SPOOL, None),
        (Stage.ARM, 1.0, armed_at(-0.7), NONE, Stage.STAND_DOWN, "start_refused"),  # carried away since the start
        (Stage.ARM, 1.0, replace(armed_at(-0.7), arm=None), NONE, Stage.SPOOL, None),  # a rule's matter
        (Stage.SPOOL, 1.19, px4(), NONE, Stage.SPOOL, None),
        (Stage.SPOOL, 1.21, px4(), NONE, Stage.MISSION, "takeoff"),
        (Stage.TOUCHDOWN, 0.39, px4(), NONE, Stage.TOUCHDOWN, None),
        (Stage.TOUCHDOWN, 0.41, px4(), NONE, Stage.DISARM, None),
        (Stage.DISARM, 1.0, px4(armed=False), NONE, Stage.DONE, None),
        (Stage.DISARM, 7.99, px4(), NONE, Stage.DISARM, None),
        (Stage.DISARM, 8.01, px4(), NONE, Stage.AUTOPILOT_LAND, "disarm_refused"),
        (Stage.DISARM, 0.1, px4(OTHER), NONE, Stage.AUTOPILOT_LAND, "disarm_refused"),
        (Stage.DISARM, 0.1, px4(FlightMode.HOLD), NONE, Stage.AUTOPILOT_LAND, "pilot_took_over"),
        (Stage.STAND_DOWN, 1.0, px4(armed=False), NONE, Stage.DONE, None),
        (Stage.STAND_DOWN, 7.99, px4(), NONE, Stage.STAND_DOWN, None),
        (Stage.STAND_DOWN, 8.01, px4(), NONE, Stage.DONE, "disarm_refused"),
        (Stage.STAND_DOWN, 8.01, px4(FlightMode.MANUAL), NONE, Stage.AUTOPILOT_LAND, "pilot_took_over"),
    ],
)
def test_each_stage_waits_requests_and_gives_up_in_its_time(
    stage: Stage, elapsed_s: float, inputs: Inputs, request_: AutopilotRequest, next_: Stage, event: str | None
) -> None:
    airborne = stage in (Stage.SPOOL, Stage.TOUCHDOWN, Stage.DISARM)
    state, request = tick(in_stage(stage, elapsed_s), inputs=inputs, airborne=airborne)
    assert request.autopilot is request_
    assert state.stage is next_
    assert ids(request) == ([] if event is None else [event])
    if event == "pilot_took_over":
        assert state.pilot_flies and state.outcome is Outcome.ABORTED


def standing(seconds: float) -> RotorStop:
    """Evidence of this much rest on the ground."""
    stop = RotorStop.begin(P.clearance_m, P.tilt_max_rad)
    for k in range(round(seconds / 0.02)):
        stop = stop.update(on_floor(NOW_S - seconds + k * 0.02))
    return stop


def on_floor(t_s: float, *, landed: bool = True) -> Inputs:
    i = healthy(t_s=t_s)
    i = put("vehicle", position_world_m=(0.0, 0.0, 0.3), velocity_world_m_s=(0.0, 0.0, 0.0))(i)
    i = put("mocap", position_world_m=(0.0, 0.0, 0.3))(i)
    return put("status", landed=LandedState.ON_GROUND if landed else LandedState.IN_AIR)(i)


@pytest.mark.parametrize(
    ("stage", "rest_s", "landed", "request_"),
    [
        (Stage.DISARM, 1.0, True, DISARM),
        (Stage.DISARM, 0.2, True, NONE),
        (Stage.DISARM, 1.0, False, NONE),
        (Stage.DISARM, 4.5, False, FORCE_DISARM),
        (Stage.STAND_DOWN, 1.0, False, DISARM),
        (Stage.STAND_DOWN, 0.2, False, NONE),
    ],
)
def test_rotors_are_stopped_on_evidence_only(
    stage: Stage, rest_s: float, landed: bool, request_: AutopilotRequest
) -> None:
    state = in_stage(stage, 5.0, rotor_stop=standing(rest_s))
    _, request = tick(state, inputs=on_floor(NOW_S, landed=landed), airborne=False)
    assert request.autopilot is request_


@pytest.mark.parametrize(("requested_s", "next_"), [(1.49, Stage.STAND_DOWN), (1.51, Stage.DONE)])
def test_not_armed_is_believed_1_5_s_after_the_last_request_to_arm(requested_s: float, next_: Stage) -> None:
    """PX4's HEARTBEAT comes once a second: rotors that spool up look disarmed."""
    state = in_stage(Stage.STAND_DOWN, 3.0, arm_requested_s=NOW_S - requested_s)
    assert tick(state, inputs=px4(armed=False), airborne=False)[0].stage is next_


@pytest.mark.parametrize(("heard_after_s", "next_"), [(-0.1, Stage.STAND_DOWN), (0.1, Stage.DONE)])
def test_not_armed_is_believed_of_a_heartbeat_after_the_request_to_arm(heard_after_s: float, next_: Stage) -> None:
    state = in_stage(Stage.STAND_DOWN, 4.0, arm_requested_s=NOW_S - 4.0)
    silent = put("status", heartbeat_stamp_s=NOW_S - 4.0 + heard_after_s)(px4(armed=False))
    assert tick(state, inputs=silent, airborne=False)[0].stage is next_


def test_a_flight_that_never_asked_px4_to_arm_ends_without_its_heartbeat() -> None:
    silent = replace(healthy(), status=None)
    assert tick(in_stage(Stage.STAND_DOWN, 0.1), inputs=silent, airborne=False)[0].stage is Stage.DONE


@pytest.mark.parametrize(("late_s", "lands"), [(4.9, False), (5.1, True)])
def test_a_plan_that_ends_without_touchdown_is_landed_by_px4_after_five_seconds(late_s: float, lands: bool) -> None:
    plan_s = Plan.build(CONFIG.mission, CONFIG.vehicle).duration_s
    state, request = tick(in_plan(plan_s + late_s), pose_s=NOW_S - 1.0)
    assert (state.stage is Stage.AUTOPILOT_LAND) is lands
    assert not lands or (state.landing is not None and state.landing.pose_s == NOW_S), "that of this tick"
    assert ids(request) == (["no_touchdown"] if lands else [])
    assert state.outcome is (Outcome.ABORTED if lands else None)
    assert not state.pilot_flies


def test_spool_up_and_touchdown_scale_the_thrust() -> None:
    assert in_stage(Stage.SPOOL, 0.6).vertical_scale(NOW_S) == pytest.approx(0.35)
    assert in_stage(Stage.SPOOL, 2.0).vertical_scale(NOW_S) == pytest.approx(0.7)
    assert in_stage(Stage.MISSION, 0.2).vertical_scale(NOW_S) == pytest.approx(0.85)
    assert in_stage(Stage.MISSION, 0.5).vertical_scale(NOW_S) == 1.0
    assert in_stage(Stage.MISSION, 0.2, aborting=True).vertical_scale(NOW_S) == pytest.approx(0.85)
    assert in_stage(Stage.TOUCHDOWN, 0.1).vertical_scale(NOW_S) == pytest.approx(0.7 * 0.75)
    assert in_stage(Stage.TOUCHDOWN, 0.5).vertical_scale(NOW_S) == 0.0
    relieved = dataclasses.replace(P.initial_state().touchdown, relief=0.3)
    assert replace(in_plan(), touchdown=relieved).vertical_scale(NOW_S) == pytest.approx(0.3)


@pytest.mark.parametrize(("spooled_s", "share"), [(0.05, 0.03), (0.6, 0.35), (1.19, 0.69)])
def test_rotors_that_are_called_off_spool_down_from_the_thrust_that_they_had(spooled_s: float, share: float) -> None:
    state, _ = after(in_stage(Stage.SPOOL, spooled_s), "operator_land", SafetyAction.LAND)
    assert state.stage is Stage.TOUCHDOWN and state.outcome is Outcome.ABORTED
    assert state.vertical_scale(NOW_S) == pytest.approx(share, abs=0.01)
    assert state.vertical_scale(NOW_S + 0.2) == pytest.approx(0.5 * share, abs=0.01)


@pytest.mark.parametrize(
    ("stage", "kind", "begun", "progress"),
    [
        (Stage.WAIT, PhaseKind.GROUND, False, 0.0),
        (Stage.ARM, PhaseKind.GROUND, False, 0.0),
        (Stage.TOUCHDOWN, PhaseKind.LANDING, True, 1.0),
        (Stage.AUTOPILOT_LAND, PhaseKind.LANDING, True, 1.0),
        (Stage.AUTOPILOT_LAND, PhaseKind.LANDING, False, 0.0),
        (Stage.DISARM, PhaseKind.DONE, True, 1.0),
        (Stage.DONE, PhaseKind.DONE, True, 1.0),
        (Stage.STAND_DOWN, PhaseKind.DONE, False, 0.0),
    ],
)
def test_the_phase_that_the_operator_sees(stage: Stage, kind: PhaseKind, begun: bool, progress: float) -> None:
    state = in_stage(stage, 1.0, mission_start_s=NOW_S - 1.0 if begun else None)
    assert state.phase(NOW_S) == (stage.value, kind, progress)


def test_the_phase_in_the_plan_is_its_segment_and_an_abort_is_named() -> None:
    name, kind, progress = in_plan(6.0).phase(NOW_S)
    assert kind is PhaseKind.FLIGHT and 0.0 < progress < 1.0
    assert replace(in_plan(6.0), aborting=True).phase(NOW_S)[0] == f"abort: {name}"


def test_every_device_that_sent_nothing_is_named() -> None:
    nothing = replace(healthy(), vehicle=None, status=None, mocap=None, arm=None, force=None)
    assert missing_inputs(nothing, CONFIG.vehicle) == ["PX4 state", "PX4", "motion capture", "arm", "force sensor"]
    assert missing_inputs(healthy(), CONFIG.vehicle) == []
    external = ["PX4 state", "PX4", "PX4's ESTIMATOR_STATUS", "arm", "force sensor"]
    assert missing_inputs(nothing, EXTERNAL) == external
    assert missing_inputs(fed_by_another(healthy()), EXTERNAL) == []


def test_the_other_vehicle_of_a_team_must_be_heard_now() -> None:
    i, devices = with_partner(healthy()), CONFIG.vehicle.devices
    vehicle = CONFIG.vehicle.model_copy(update={"devices": devices.model_copy(update={"team": TeamDevice()})})
    assert i.partner is not None
    for age_s, missing in ((0.0, []), (0.29, []), (0.31, ["other vehicle"])):
        heard = replace(i, partner=replace(i.partner, stamp_s=i.t_s - age_s))
        assert missing_inputs(heard, vehicle) == missing
    assert missing_inputs(replace(i, partner=None), vehicle) == ["other vehicle"]


@pytest.mark.parametrize(("elapsed_s", "refused"), [(14.9, False), (15.1, True)])
def test_missing_inputs_refuse_the_flight_after_15_s_and_a_flight_that_was_ready_waits_on(
    elapsed_s: float, refused: bool
) -> None:
    lost = replace(healthy(), arm=None)
    state, request = tick(in_stage(Stage.WAIT, elapsed_s), inputs=lost, airborne=False)
    assert ids(request) == (["inputs_missing"] if refused else [])
    assert state.stage is (Stage.STAND_DOWN if refused else Stage.WAIT)
    assert state.waiting.unready == "no data from: arm"
    waiting = replace(P.initial_state().waiting, was_ready=True)
    assert tick(in_stage(Stage.WAIT, 1e3, waiting=waiting), inputs=lost, airborne=False)[0].stage is Stage.WAIT
    apart = put("mocap", position_world_m=(0.2, 0.0, 1.0))(healthy())
    _, request = tick(in_stage(Stage.WAIT, elapsed_s), inputs=apart, airborne=False)
    assert ids(request) == (["vision_not_fused"] if refused else [])


def ready(i: Inputs, *, looked_s: float = 0.05, tared_s: float = 0.5) -> FlightState:
    """Ready, looked at the position and began the tare this long ago; PX4 has followed motion capture for 1.2 s."""
    settled = SettledEstimate()
    for k in range(1, 121):
        assert i.vehicle is not None
        settled = settled.take(NOW_S - 0.01 * k, i.vehicle, i.mocap)
    settled = dataclasses.replace(settled, since_s=NOW_S - 1.2)
    waiting = replace(
        P.initial_state().waiting, was_ready=True, looked_s=NOW_S - looked_s, tare_start_s=NOW_S - tared_s
    )
    return in_stage(Stage.READY, 5.0, waiting=replace(waiting, settled=settled), plan=None, course=None)


START = Event(t_s=NOW_S, id="operator_start", severity=Severity.INFO, action=SafetyAction.NOMINAL, text="")


@pytest.mark.parametrize(
    ("x_m", "looked_s", "events", "next_", "reported"),
    [
        (-1.0, 0.15, [], Stage.READY, []),
        (-1.0, 0.05, [START], Stage.OFFBOARD, ["operator_start"]),
        (-0.7, 0.05, [], Stage.READY, []),  # it is looked at ten times a second
        (-0.7, 0.15, [], Stage.WAIT, ["not_ready"]),
        (-0.7, 0.05, [START], Stage.WAIT, ["operator_start", "not_ready", "start_declined"]),
    ],
)
def test_a_ready_flight_takes_off_on_command_and_waits_again_when_it_is_moved(
    x_m: float, looked_s: float, events: list[Event], next_: Stage, reported: list[str]
) -> None:
    i = at_start(x_m)
    waits = dataclasses.replace(P, waits_for_start=True)
    state, request = tick(ready(i, looked_s=looked_s), *events, parameters=waits, inputs=i, airborne=False)
    assert (state.stage, ids(request)) == (next_, reported)
    assert all(isinstance(event.severity, Severity) for event in request.events)
    assert (state.plan is not None) is (next_ is Stage.OFFBOARD)


def test_a_ready_flight_with_an_unsettled_estimate_or_a_lost_input_waits_again() -> None:
    i = at_start()
    begun = ready(i, looked_s=0.15)
    waiting = replace(begun.waiting, settled=SettledEstimate())
    for state, inputs in ((replace(begun, waiting=waiting), i), (begun, replace(i, force=None))):
        after, request = tick(state, inputs=inputs, airborne=False)
        assert (after.stage, ids(request)) == (Stage.WAIT, ["not_ready"])
        assert after.waiting.tare_start_s is None


@pytest.mark.parametrize("moved_m", [0.0, 0.1])
def test_a_tare_during_which_the_vehicle_was_moved_begins_anew(moved_m: float) -> None:
    begun, settled = ready(at_start(), tared_s=1.01), SettledEstimate()
    for k in range(120, 0, -1):
        there = at_start(-1.0 + (moved_m if k > 60 else 0.0))
        assert there.vehicle is not None
        settled = settled.take(NOW_S - 0.01 * k, there.vehicle, there.mocap)
    waiting = in_stage(Stage.WAIT, 5.0, waiting=replace(begun.waiting, settled=settled), plan=None, course=None)
    state, request = tick(waiting, inputs=at_start(), airborne=False)
    assert list(request.tare) == [Tare.COLLECT, Tare.BEGIN if moved_m else Tare.FINISH]
    assert state.stage is (Stage.WAIT if moved_m else Stage.OFFBOARD)
    assert state.waiting.unready.startswith("the vehicle does not stand still") is (moved_m > 0.0)
    assert state.waiting.tare_start_s == (NOW_S if moved_m else NOW_S - 1.01)


@pytest.mark.parametrize(
    ("tared_s", "steps"), [(0.99, [Tare.COLLECT]), (1.01, [Tare.COLLECT, Tare.FINISH, Tare.BEGIN])]
)
def test_the_tare_of_a_ready_flight_is_renewed_every_second(tared_s: float, steps: list[Tare]) -> None:
    i = at_start()
    state, request = tick(ready(i, tared_s=tared_s), inputs=i, airborne=False)
    assert list(request.tare) == steps
    assert state.waiting.tare_start_s == (NOW_S if Tare.BEGIN in steps else NOW_S - tared_s)


def in_landing(outcome: Outcome = Outcome.ABORTED, **begun: Any) -> FlightState:
    landing = AutopilotLanding.begin(
        NOW_S - 2.0, P.clearance_m, P.tilt_max_rad, **{"pilot": False, "pose_s": NOW_S, **begun}
    )
    return in_stage(Stage.AUTOPILOT_LAND, 2.0, landing=landing, outcome=outcome)


@pytest.mark.parametrize(("event_id", "goes_on"), [("mocap_lost", True), ("pilot_took_over", False)])
def test_a_landing_by_px4_that_began_without_a_rule_does_not_begin_anew(event_id: str, goes_on: bool) -> None:
    """Neither `no_touchdown` nor `disarm_refused` escalates the supervisor."""
    state = in_landing()
    assert state.landing is not None and state.supervisor.action is SafetyAction.NOMINAL
    state = replace(state, landing=dataclasses.replace(state.landing, touched_s=NOW_S - 1.0))
    state, _ = after(state, event_id, SafetyAction.AUTOPILOT_LAND)
    assert state.landing is not None and state.supervisor.action is SafetyAction.AUTOPILOT_LAND
    assert (state.landing.touched_s is not None, state.pilot_flies) == (goes_on, not goes_on)
    assert state.entered_s == (NOW_S - 2.0 if goes_on else NOW_S)


@pytest.mark.parametrize(("height_m", "outcome"), [(0.46, Outcome.CRASHED), (0.44, Outcome.ABORTED)])
def test_a_kill_in_the_air_is_a_crash(height_m: float, outcome: Outcome) -> None:
    there = {"position_world_m": (0.0, 0.0, height_m)}
    killed = put("status", system_status=8)(put("mocap", **there)(put("vehicle", **there)(healthy())))
    assert tick(in_landing(), inputs=killed)[0].outcome is outcome


@pytest.mark.parametrize(
    ("px4_m", "mocap_m", "age_s", "pilot", "outcome"),
    [
        (1.0, 1.0, 0.0, False, Outcome.CRASHED),
        (1.0, 0.3, 0.0, False, Outcome.ABORTED),
        (0.3, 1.0, 0.0, False, Outcome.ABORTED),
        (1.0, 1.0, 0.4, False, Outcome.ABORTED),  # on the floor an estimate without poses may show any height
        (1.0, 1.0, 0.0, True, Outcome.ABORTED),
    ],
)
def test_a_disarm_in_the_air_is_a_crash(
    px4_m: float, mocap_m: float, age_s: float, pilot: bool, outcome: Outcome
) -> None:
    seen = put("mocap", position_world_m=(0.0, 0.0, mocap_m), stamp_s=NOW_S - age_s)(px4(armed=False))
    disarmed = put("vehicle", position_world_m=(0.0, 0.0, px4_m))(seen)
    assert tick(in_landing(pilot=pilot), inputs=disarmed)[0].outcome is outcome


def test_px4_that_disarms_during_the_mission_has_crashed_the_vehicle() -> None:
    state, _ = after(in_plan(), "px4_disarmed", SafetyAction.AUTOPILOT_LAND, inputs=px4(armed=False))
    assert (state.stage, state.outcome) == (Stage.AUTOPILOT_LAND, Outcome.CRASHED)


@pytest.mark.parametrize(("before", "reported"), [(Outcome.ABORTED, "crashed"), (Outcome.CRASHED, "autopilot_landing")])
def test_a_flipped_vehicle_is_reported_as_a_crash_once(before: Outcome, reported: str) -> None:
    over = {"attitude_wxyz": (0.0, 1.0, 0.0, 0.0)}
    state, request = tick(
        in_landing(before, flipped=True), inputs=put("mocap", **over)(put("vehicle", **over)(healthy()))
    )
    assert (request.autopilot, state.outcome, ids(request)) == (FORCE_DISARM, Outcome.CRASHED, [reported])
    assert request.events[0].severity is Severity.CRITICAL


def test_a_touchdown_under_px4_is_no_critical_event() -> None:
    state = in_landing()
    assert state.landing is not None
    landing = dataclasses.replace(state.landing, landing_since_s=NOW_S - 2.0)
    low = dataclasses.replace(landing.height, since_s=NOW_S - 1.0)
    sinking = Sinking()
    for k in range(40):
        sinking = sinking.update(NOW_S - 0.2 + 0.005 * k, on_floor(NOW_S - 0.2 + 0.005 * k).mocap)
    landing = dataclasses.replace(landing, height=low, sinking=sinking)
    i = put("status", mode=FlightMode.LAND)(on_floor(NOW_S))
    state, request = tick(replace(state, landing=landing), inputs=i)
    assert [(event.id, event.severity) for event in request.events] == [("autopilot_landing", Severity.INFO)]
    assert state.zero_thrust


def test_a_pilot_flies_only_while_px4_lands_or_is_flown() -> None:
    flown = in_landing(pilot=True)
    assert flown.pilot_flies and not replace(flown, stage=Stage.DONE).pilot_flies
    assert flown.phase(NOW_S)[0] == PILOT_FLIES


@pytest.mark.parametrize("before", [Outcome.ABORTED, Outcome.CRASHED])
def test_a_vehicle_that_px4_could_not_land_is_lost_unless_it_has_crashed(before: Outcome) -> None:
    landing = AutopilotLanding.begin(NOW_S - 31.0, P.clearance_m, P.tilt_max_rad, pilot=False, pose_s=-math.inf)
    state, _ = tick(in_stage(Stage.AUTOPILOT_LAND, 31.0, landing=landing, outcome=before))
    assert state.stage is Stage.DONE
    assert state.outcome is (Outcome.CRASHED if before is Outcome.CRASHED else Outcome.LOST)
