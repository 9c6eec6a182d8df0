"""Every rule raised by its own fault and by nothing else, in the air and on the ground; and none by a machine in good health."""

from __future__ import annotations

import re
from collections.abc import Callable
from typing import Any

import pytest

from companion.config.vehicle import Vehicle
from companion.model.types import Inputs, SafetyAction, Severity
from companion.safety.flight_context import FlightContext
from companion.safety.monitors import Monitors
from companion.safety.rule import Lamp, Rule
from companion.safety.rules import RULES
from tests.safety.faults import EXTERNAL, FAULTS, FOUND, RULE, VEHICLE, Fault, replace, seen_by, turned
from tests.safety.healthy import START_S, TICK_S, after_a_moment, fed_by_another, flying, healthy, standing, watched

NOMINAL, WARN, HOLD, RETRACT = SafetyAction.NOMINAL, SafetyAction.WARN, SafetyAction.HOLD, SafetyAction.RETRACT
LAND, PX4_LANDS, TERMINATE = SafetyAction.LAND, SafetyAction.AUTOPILOT_LAND, SafetyAction.TERMINATE


REQUIRED: dict[str, tuple[SafetyAction | None, SafetyAction | None, float]] = {
    "vehicle_not_finite": (WARN, WARN, 0.015),  # a single bad record costs nothing; its loss has a rule of its own
    "mocap_not_finite": (WARN, WARN, 0.015),
    "arm_not_finite": (WARN, WARN, 0.015),
    "force_not_finite": (WARN, WARN, 0.015),
    "status_not_finite": (WARN, WARN, 0.015),
    "operator_hold": (None, HOLD, 0.015),
    "operator_resume": (None, NOMINAL, 0.015),  # on the ground there is no hold to end
    "operator_start": (NOMINAL, NOMINAL, 0.015),
    "operator_land": (LAND, LAND, 0.015),
    "operator_abort": (LAND, LAND, 0.015),
    "killed": (PX4_LANDS, PX4_LANDS, 0.015),  # whatever is sent after it would act when the switch is released
    "armed_externally": (LAND, PX4_LANDS, 0.000),  # on the ground it is disarmed; in the air nobody else lands it
    "mocap_lost": (PX4_LANDS, PX4_LANDS, 0.220),  # PX4's estimate holds for 1.4 s, the companion has none
    "mocap_invalid": (PX4_LANDS, PX4_LANDS, 0.210),
    "mocap_swapped": (PX4_LANDS, PX4_LANDS, 0.210),
    "mocap_jump": (WARN, WARN, 0.500),
    "mocap_two_streams": (PX4_LANDS, PX4_LANDS, 0.040),
    "mocap_dragged": (None, PX4_LANDS, 3.050),  # on the ground the body may be carried about
    "mocap_frozen": (None, PX4_LANDS, 0.125),
    "mocap_slow": (WARN, WARN, 1.000),  # it still flies, less well
    "mocap_late": (WARN, WARN, 0.220),
    "mocap_too_late": (PX4_LANDS, PX4_LANDS, 0.120),
    "estimate_disagrees": (None, PX4_LANDS, 1.705),  # one of the two is wrong, and the control law flies on PX4's
    "yaw_disagrees": (None, PX4_LANDS, 2.000),
    "estimator_silent": (PX4_LANDS, PX4_LANDS, 0.270),
    "vision_lost": (PX4_LANDS, PX4_LANDS, 0.015),
    "vision_rejected": (None, WARN, 0.220),  # vision_lost follows if it lasts
    "px4_rebooted": (PX4_LANDS, PX4_LANDS, 0.015),
    "link_slow": (WARN, WARN, 0.170),  # the law still has a margin
    "link_late": (PX4_LANDS, PX4_LANDS, 0.170),
    "estimate_frozen": (None, PX4_LANDS, 0.270),
    "vehicle_state_lost": (PX4_LANDS, PX4_LANDS, 0.270),
    "heartbeat_lost": (PX4_LANDS, PX4_LANDS, 2.520),
    "pilot_took_over": (PX4_LANDS, PX4_LANDS, 0.015),  # PX4 obeys the pilot; the landing is only watched
    "offboard_left": (PX4_LANDS, PX4_LANDS, 0.015),
    "px4_disarmed": (None, PX4_LANDS, 0.015),  # on the ground PX4 may disarm
    "battery_warn": (WARN, WARN, 1.015),
    "battery_low": (LAND, LAND, 1.015),
    "battery_silent": (LAND, LAND, 0.015),  # its charge may be anything
    "battery_voltage": (LAND, LAND, 2.015),
    "arm_lost": (LAND, LAND, 0.120),  # a limp or unknown arm swings; the vehicle still flies
    "arm_read_failures": (WARN, WARN, 0.015),
    "joint_states_late": (WARN, WARN, 0.095),  # the law predicts what has happened since
    "joint_swings": (WARN, WARN, 0.195),
    "joint_swings_on": (LAND, LAND, 1.695),
    "torque_refused": (LAND, PX4_LANDS, 0.105),  # the law itself computes nonsense: not even its landing can be trusted
    "servo_error": (LAND, LAND, 0.015),
    "clamp_error": (LAND, LAND, 0.015),  # the bar may fall at any time: set it down
    "servo_watchdog_tripped": (WARN, WARN, 0.015),  # its torque is on again
    "joint_jump": (LAND, LAND, 0.015),
    "servo_warm": (WARN, WARN, 0.515),
    "servo_hot": (LAND, LAND, 0.515),
    "servo_overload": (LAND, LAND, 1.015),
    "joint_rate": (LAND, LAND, 0.070),
    "joint_beyond_limit": (WARN, WARN, 0.105),
    "joint_far_beyond_limit": (LAND, LAND, 0.300),
    "force_lost": (LAND, WARN, 0.265),  # in the air the law flies on without it; a flight does not begin without it
    "force_overload": (WARN, WARN, 0.015),
    "force_stuck": (None, WARN, 0.525),
    "force_drift": (None, WARN, 2.850),
    "force_disagrees": (None, WARN, 0.545),  # the law flies on without it
    "loop_late": (WARN, WARN, 0.215),
    "loop_stalled": (LAND, LAND, 1.015),  # the next stall may be longer
    "recorder_drops": (WARN, WARN, 0.015),
    "guardian_lost": (LAND, WARN, 0.015),  # in the air it is no reason to land; a flight does not begin without it
    "tilt": (None, PX4_LANDS, 0.105),  # the law has lost control; on the ground a vehicle may stand on a slope
    "oscillates": (None, PX4_LANDS, 0.985),  # the law is unstable: its hold and its landing would swing too
    "crashed": (None, TERMINATE, 0.300),  # the rotors must stop
    "too_fast": (None, HOLD, 0.105),  # stopping is enough
    "climbs_too_fast": (None, LAND, 0.105),
    "sinks_too_fast": (None, LAND, 0.105),
    "geofence_left": (None, LAND, 0.050),  # a hold outside would not end it
    "geofence_near": (None, HOLD, 0.050),
    "tracking_warn": (None, WARN, 0.205),
    "tracking_hold": (None, HOLD, 0.205),
    "tracking_error": (None, LAND, 0.205),
    "thrust_saturated": (None, LAND, 1.005),
    "contact_force_high": (None, HOLD, 0.105),  # the hold moves it back from the surface first
    "tether_short": (None, HOLD, 0.050),
    "tether_taut": (None, RETRACT, 0.050),  # only the way back slackens it
    "tether_snagged": (None, LAND, 0.105),  # the way back may tighten it
    "tether_near": (None, WARN, 0.205),
    "tether_wound": (None, HOLD, 0.205),
    "tether_separated": (None, LAND, 0.105),
    "partner_quiet": (WARN, WARN, 0.305),  # nothing connects the two yet
    "partner_silent": (None, LAND, 0.305),
    "partner_late": (None, LAND, 0.105),  # a step of the server's clock is seen by both within a frame
    "partner_holds": (None, HOLD, 0.015),
    "partner_lands": (None, LAND, 0.015),
    "partner_let_go": (None, LAND, 0.115),
    "partner_near": (None, LAND, 0.065),
    "bar_force_high": (None, LAND, 0.300),
    "bar_tilted": (None, HOLD, 0.220),
    "bar_unseen": (None, WARN, 0.515),
}
"""What each rule must request on the ground and in the air (None: it is not reported), and how long after the start of the stream,
in s, its event must come. Written from the hazards, not from the table of the rules: a change of a row must be made here as well.
"""


READS = """
    armed_externally 1.00; mocap_lost 0.20; mocap_invalid 0.20; mocap_swapped 0.30 0; mocap_jump 0.40 0;
    mocap_dragged 91 40; mocap_slow 31 50; mocap_late 80 50; mocap_too_late 200 120; estimate_disagrees 0.34 0.30;
    yaw_disagrees 20 15; estimator_silent 0.25; vision_rejected 1.2 1; px4_rebooted 2.0; link_slow 30 20; link_late 100 35;
    vehicle_state_lost 0.25; heartbeat_lost 2.5; px4_disarmed 1.00; battery_warn 25 30; battery_low 10 20;
    battery_silent 10; battery_voltage 13.0 13.2; arm_lost 0.10; arm_read_failures 5; joint_states_late 8 5 12 8;
    joint_swings 1 16 86; joint_swings_on 1 16 86; torque_refused 0.0; servo_error 70 2; clamp_error 70;
    joint_jump 2 29; servo_warm 68 65; servo_hot 76 75; servo_overload -2.5 0.1; joint_rate 0 745 700;
    joint_beyond_limit 180 57 5; joint_far_beyond_limit 115 -25 15; force_lost 0.25; force_overload 1 -1 0;
    force_drift 3.3 0.0 0.0 2.0; force_disagrees 0.0 0.0 0.8 0.0 0.0 -0.8;
    oscillates 0.10 18; loop_late 205 50; loop_stalled 1005 300; tilt 45 40; crashed 120;
    too_fast 2.1 2.0; climbs_too_fast 1.6 1.5; sinks_too_fast 1.6 1.5; geofence_left -1.90 0.00 1.00;
    geofence_near 2.29 0.00 1.00; tracking_warn 0.50 0.45; tracking_hold 0.70 0.60; tracking_error 1.20 0.80;
    thrust_saturated 54 1.0; contact_force_high 15.0 12.0; tether_short 0.05 0.10; tether_taut 1.20 0;
    tether_snagged 0 1.20; tether_near 0.00 0.01; tether_wound 1.6 1.5; tether_separated 1.80; partner_quiet 0.3;
    partner_silent 0.3; partner_late 0.6 0.3; partner_near 1.00 1.03; bar_force_high 12.0 10.0;
    bar_tilted 14 10; bar_unseen 0.5
"""
"""The numbers that the operator reads in a rule's text, in its units: what was found, then the limit."""


NUMBERS = {id_: numbers for id_, *numbers in (row.split() for row in READS.split(";"))}


def severity_of(rule_id: str, action: SafetyAction, *, airborne: bool) -> Severity:
    if rule_id.startswith("operator_"):
        return Severity.INFO
    ends_the_mission = airborne and action in (RETRACT, LAND, PX4_LANDS, TERMINATE)
    return Severity.CRITICAL if ends_the_mission or rule_id in ("killed", "armed_externally") else Severity.WARNING


def until_told(rule: Rule) -> tuple[Vehicle, list[Inputs]]:
    """The machine to which the rule belongs, and what it sees until half a second after the last event is due."""
    machine, inputs = seen_by(rule)
    end_s = START_S + 0.5 + max(REQUIRED[id_][2] for id_ in (rule.id, *FAULTS[rule.id].also))
    return machine, [i for i in inputs if i.t_s <= end_s]


def test_every_rule_has_its_fault() -> None:
    assert set(FAULTS) == set(RULE) == set(REQUIRED)
    assert len(RULES) == len(RULE), "an id twice"


def test_a_rule_is_shown_on_the_lamp_of_its_subject_or_its_own() -> None:
    found = [RULE[id_].lamp for id_ in ("arm_lost", "mocap_lost", "vision_lost", "recorder_drops", "battery_low")]
    assert found == [Lamp.ARM, Lamp.MOCAP, Lamp.ESTIMATE, Lamp.RECORDER, Lamp.BATTERY]


@pytest.mark.parametrize("rule", RULES, ids=lambda rule: rule.id)
def test_each_fault_is_reported_once_by_name_in_time_and_requests_its_action(rule: Rule) -> None:
    fault = FAULTS[rule.id]
    events = watched(*until_told(rule), fault.context())
    assert {event.id for event in events} == {rule.id, *fault.also}
    assert len(events) == 1 + len(fault.also), "told again"
    for event in events:
        assert event.action is REQUIRED[event.id][1]
        assert event.severity is severity_of(event.id, event.action, airborne=True)
        assert event.text and "{" not in event.text
    first = next(event for event in events if event.id == rule.id)
    assert first.t_s - START_S == pytest.approx(REQUIRED[rule.id][2], abs=1.1 * TICK_S)
    if "{" in rule.message and not rule.id.endswith("_not_finite"):
        assert re.findall(r"-?\d+(?:\.\d+)?", first.text.replace("PX4", "")) == NUMBERS.get(rule.id, [])


@pytest.mark.parametrize("rule", RULES, ids=lambda rule: rule.id)
def test_on_the_ground_only_what_matters_there_is_reported(rule: Rule) -> None:
    fault = FAULTS[rule.id]
    context = standing(
        grip=fault.context().grip,
        offboard_expected=rule.id in ("pilot_took_over", "offboard_left"),
        found_armed=FOUND if rule.id == "armed_externally" else None,
        torque_refused="joint torque (nan, 0.0) is not finite" if rule.id == "torque_refused" else None,
    )
    events = watched(*until_told(rule), context)
    assert {event.id for event in events} == {id_ for id_ in (rule.id, *fault.also) if REQUIRED[id_][0] is not None}
    for event in events:
        assert event.action is REQUIRED[event.id][0]
        assert event.severity is severity_of(event.id, event.action, airborne=False)


@pytest.mark.parametrize("context", [flying, standing])
def test_a_healthy_machine_raises_no_event(context: Callable[[], FlightContext]) -> None:
    assert watched(VEHICLE, [healthy(k) for k in range(4000)], context()) == []


@pytest.mark.parametrize("context", [flying, standing])
def test_a_machine_that_another_program_feeds_misses_no_motion_capture(context: Callable[[], FlightContext]) -> None:
    assert watched(EXTERNAL, [fed_by_another(healthy(k)) for k in range(700)], context()) == []


def scaled(key: str, factor: float, machine: Vehicle = VEHICLE) -> Vehicle:
    """The vehicle with one threshold multiplied."""
    section, _, name = ("safety." + key if "." not in key else key).rpartition(".")
    part: Any = machine
    for step in section.split("."):
        part = getattr(part, step)
    value = getattr(part, name)
    changed = part.model_copy(update={name: type(value)(value * factor)})
    for step in reversed(section.split(".")[1:]):
        changed = machine.devices.model_copy(update={step: changed})
    return machine.model_copy(update={section.partition(".")[0]: changed})


def test_a_vehicle_state_that_is_missing_shows_no_motion() -> None:
    machine = scaled("climb_max_m_s", 1e-3, scaled("sink_max_m_s", 1e-3))
    events = watched(machine, [replace(healthy(k), vehicle=None) for k in range(200)], flying())
    assert [event.id for event in events] == ["vehicle_state_lost"]


ELSEWHERE = {
    *("tether.taut_slack_m", "tether.pull_min_n", "tether.separation_m"),  # TetherWatch: test_tether.py
    *("react_time_s", "stop_deceleration_m_s2"),  # StopModel: test_stop.py
    "arm.joints.torque_max_nm",
    "arm.joints.angle_deg",
}
"""Keys that have no effect on the faults above."""


TURNED = {"mocap_jump_deg": Fault(turned("mocap", 30.0))}


@pytest.mark.parametrize("rule", RULES, ids=lambda rule: rule.id)
def test_every_threshold_of_the_table_is_one_that_runs(rule: Rule) -> None:
    hold_time = [rule.hold_time] if isinstance(rule.hold_time, str) else []
    for key in [*rule.thresholds, *rule.tracked_by, *hold_time]:
        if key in ELSEWHERE:
            continue
        fault = TURNED.get(key, FAULTS[rule.id])
        machine, inputs = seen_by(rule)
        if fault is not FAULTS[rule.id]:
            inputs = after_a_moment(fault.change)

        def reported(vehicle: Vehicle, inputs: list[Inputs], fault: Fault = fault) -> int | None:
            """Return the number of the tick in which the rule's event is first reported."""
            monitors, context = Monitors(vehicle), fault.context()
            return next(
                (k for k, i in enumerate(inputs) if any(e.id == rule.id for e in monitors.check(i, context))), None
            )

        expected = reported(machine, inputs)
        assert expected is not None
        until = inputs[: expected + 1]
        assert any(reported(scaled(key, factor, machine), until) != expected for factor in (1e-3, 1e3, -1e3)), key
