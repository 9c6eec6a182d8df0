"""Every rule raised by its own fault and by nothing else, in the air and on the ground; and none by a machine in good health."""

from __future__ import annotations

import math
import re
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from typing import Any

import msgspec
import pytest

from companion.config.loader import load_vehicle
from companion.config.vehicle import Vehicle
from companion.model.frames import quat_from_euler_zyx, quat_multiply, quat_rotate
from companion.model.types import (
    ControlLog,
    Event,
    FlightMode,
    Inputs,
    MocapPose,
    OperatorCommand,
    SafetyAction,
    Severity,
)
from companion.safety.arm import error_text
from companion.safety.flight_context import FlightContext
from companion.safety.mocap import unfused
from companion.safety.monitors import Monitors
from companion.safety.oscillation import Oscillation
from companion.safety.rule import Rule, Subject
from companion.safety.rules import RULES
from tests.safety.healthy import (
    SLOW,
    START_S,
    TICK_S,
    ZERO8,
    Change,
    after_a_moment,
    control,
    fed_by_another,
    flying,
    healthy,
    put,
    standing,
    stopped,
    watched,
)

VEHICLE = load_vehicle("configs/vehicles/tarot650_2r.yaml")
EXTERNAL = load_vehicle("configs/vehicles/tarot650_2r.yaml", overrides=["vehicle.devices.mocap.type=external"])
NO_INERTIAL = load_vehicle(
    "configs/vehicles/tarot650_2r.yaml",
    overrides=["vehicle.safety.mocap_inertial_m=9", "vehicle.safety.mocap_jump_m=1"],
)
"""For positions that move although the IMU rests."""
replace = msgspec.structs.replace
NAN = math.nan
RULE = {rule.id: rule for rule in RULES}


def tethered(**fields: object) -> FlightContext:
    return flying(tether=replace(SLOW, **fields))


def moved(part: str, by_m: tuple[float, float, float]) -> Change:
    def change(i: Inputs) -> Inputs:
        x, y, z = getattr(i, part).position_world_m
        return put(part, position_world_m=(x + by_m[0], y + by_m[1], z + by_m[2]))(i)

    return change


def turned(part: str, by_deg: float) -> Change:
    turn = quat_from_euler_zyx(0.0, 0.0, math.radians(by_deg))
    return lambda i: put(part, attitude_wxyz=quat_multiply(turn, getattr(i, part).attitude_wxyz))(i)


def leaning(by_deg: float) -> Change:
    lean = quat_from_euler_zyx(math.radians(by_deg), 0.0, 0.0)
    return lambda i: put("vehicle", attitude_wxyz=lean)(put("mocap", attitude_wxyz=lean)(i))


def both(*changes: Change) -> Change:
    def change(i: Inputs) -> Inputs:
        for one in changes:
            i = one(i)
        return i

    return change


def drifting(i: Inputs) -> Inputs:
    """PX4's estimate slides away from where the vehicle is, by 0.2 m/s."""
    return moved("vehicle", (0.2 * (i.t_s - START_S), 0.0, 0.0))(i)


def turning(i: Inputs) -> Inputs:
    return turned("vehicle", 10.0 * (i.t_s - START_S))(i)


def frozen_values(part: str, *names: str) -> Change:
    """Values stay, stamps and frame numbers go on."""
    first = getattr(healthy(), part)
    return put(part, **{name: getattr(first, name) for name in names})


def at(x: float, y: float, z: float, vx: float = 0.05, vy: float = 0.0, vz: float = 0.0) -> Change:
    """Somewhere else from the start on; PX4 and motion capture agree."""
    p = (x, y, z)

    def change(i: Inputs) -> Inputs:
        d = 1e-4 * (i.tick % 7)
        here = (p[0] + d, p[1], p[2])
        vehicle = put("vehicle", position_world_m=here, velocity_world_m_s=(vx, vy, vz))
        return put("mocap", position_world_m=here)(vehicle(i))

    return change


FOUND = "PX4 is armed (height 1.00 m, mode OFFBOARD), but not by the companion"


@dataclass(frozen=True)
class Fault:
    """How a rule's finding is made, and what else is found with it."""

    change: Change = lambda i: i
    context: Callable[[], FlightContext] = flying
    sound: int = 3
    """Healthy ticks before it."""
    also: frozenset[str] = field(default_factory=frozenset)


def every_35_ms(i: Inputs) -> Inputs:
    """30 poses in a second."""
    k = i.tick - i.tick % 7
    return replace(i, mocap=healthy(k).mocap)


def slow_link(i: Inputs) -> Inputs:
    """From one tick to the next, what arrives was said 100 ms ago."""
    assert i.vehicle is not None and i.vehicle.boot_s is not None
    return put("vehicle", boot_s=i.vehicle.boot_s - 0.1)(i)


def jumping(i: Inputs) -> Inputs:
    return moved("mocap", (0.4, 0.0, 0.0))(i) if i.tick == 100 else i


def two_streams(i: Inputs) -> Inputs:
    """Every other frame is another server's; its numbers are its own."""
    assert i.mocap is not None
    return put("mocap", frame_number=i.mocap.frame_number + 1_000_000)(i) if i.tick % 2 else i


def dragged(i: Inputs) -> Inputs:
    """From 2.8 s on the poses are dragged by 1.2 m/s, and PX4's position follows them; its IMU measures no motion."""
    by_m = 1.2 * max(0.0, i.t_s - START_S - 2.8)
    return both(moved("mocap", (by_m, 0.0, 0.0)), moved("vehicle", (by_m, 0.0, 0.0)))(i)


def estimator(**fields: float) -> Change:
    return lambda i: put("estimator", **fields)(fed_by_another(i))


class Swinging(FlightContext):
    """The position error swings by 0.24 m to and fro, twice a second: it is read twice in each tick."""

    _reads = 0

    @property
    def control(self) -> ControlLog:
        self._reads += 1
        error_m = 0.12 * math.sin(2.0 * math.tau * self._reads * 0.5 * TICK_S)
        return control(error=(error_m, *ZERO8[1:]))

    @control.setter
    def control(self, _: ControlLog) -> None: ...


def swinging() -> FlightContext:
    return Swinging(**{name: getattr(flying(), name) for name in ("airborne", "offboard_expected", "tracking_error_m")})


def swinging_joint(i: Inputs) -> Inputs:
    return put("arm", velocity_rad_s=(0.7 + 1.5 * math.sin(math.tau * 16.0 * (i.t_s - START_S)), 0.0))(i)


FAULTS: dict[str, Fault] = {
    "estimator_silent": Fault(lambda i: replace(i, estimator=fed_by_another(healthy()).estimator)),
    "vision_lost": Fault(estimator(flags=0b1111)),
    "vision_rejected": Fault(estimator(position_horizontal_ratio=1.2)),
    "mocap_not_finite": Fault(put("mocap", position_world_m=(NAN, 0.0, 1.0)), also=frozenset({"mocap_lost"})),
    "vehicle_not_finite": Fault(
        put("vehicle", velocity_world_m_s=(0.0, math.inf, 0.0)), also=frozenset({"vehicle_state_lost"})
    ),
    "status_not_finite": Fault(put("status", battery_voltage_v=NAN), also=frozenset({"heartbeat_lost"})),
    "arm_not_finite": Fault(put("arm", torque_nm=(0.0, NAN)), also=frozenset({"arm_lost"})),
    "force_not_finite": Fault(put("force", force_sensor_n=(0.0, 0.0, -math.inf)), also=frozenset({"force_lost"})),
    "mocap_lost": Fault(stopped("mocap")),
    "mocap_invalid": Fault(put("mocap", tracking_valid=False)),
    "mocap_slow": Fault(every_35_ms),
    "mocap_late": Fault(put("mocap", latency_s=0.08)),
    "mocap_too_late": Fault(put("mocap", latency_s=0.2)),
    "mocap_jump": Fault(jumping),
    "mocap_swapped": Fault(moved("mocap", (0.0, 0.3, 0.0)), also=frozenset({"mocap_jump"})),
    "mocap_frozen": Fault(frozen_values("mocap", "position_world_m", "attitude_wxyz")),
    "mocap_two_streams": Fault(two_streams),
    "mocap_dragged": Fault(dragged),
    "estimate_disagrees": Fault(drifting),
    "yaw_disagrees": Fault(turning),
    "vehicle_state_lost": Fault(stopped("vehicle")),
    "estimate_frozen": Fault(frozen_values("vehicle", "position_world_m", "velocity_world_m_s")),
    "heartbeat_lost": Fault(stopped("status")),
    "px4_rebooted": Fault(put("vehicle", boot_s=2.0), also=frozenset({"link_late"})),
    "link_slow": Fault(lambda i: put("vehicle", boot_s=i.t_s - 0.03)(i)),
    "link_late": Fault(slow_link),
    "killed": Fault(put("status", system_status=8)),
    "armed_externally": Fault(context=lambda: flying(found_armed=FOUND)),
    "px4_disarmed": Fault(put("status", armed=False)),
    "pilot_took_over": Fault(put("status", mode=FlightMode.MANUAL)),
    "offboard_left": Fault(put("status", mode=FlightMode.LAND)),
    "battery_warn": Fault(put("status", battery_remaining=0.25)),
    "battery_low": Fault(put("status", battery_remaining=0.1), also=frozenset({"battery_warn"})),
    "battery_silent": Fault(lambda i: put("status", battery_stamp_s=i.t_s - 10.1)(i)),
    "battery_voltage": Fault(put("status", battery_voltage_v=13.0)),
    "arm_lost": Fault(stopped("arm")),
    "arm_read_failures": Fault(put("arm", read_failures=5)),
    "joint_states_late": Fault(lambda i: put("arm", stamp_s=i.t_s - 0.012)(i)),
    "joint_swings": Fault(swinging_joint, also=frozenset({"joint_swings_on"})),
    "joint_swings_on": Fault(swinging_joint, also=frozenset({"joint_swings"})),
    "torque_refused": Fault(context=lambda: flying(torque_refused="joint torque (nan, 0.0) is not finite")),
    "servo_error": Fault(put("arm", hardware_error=(0, 32))),
    "servo_watchdog_tripped": Fault(put("arm", hardware_error=(0x80, 0))),
    "servo_warm": Fault(put("arm", temperature_c=(35.0, 68.0))),
    "servo_hot": Fault(put("arm", temperature_c=(76.0, 35.0))),
    "servo_overload": Fault(put("arm", torque_nm=(-2.5, 0.1))),
    "joint_jump": Fault(put("arm", angle_rad=(2.0, 1.5))),
    "joint_rate": Fault(put("arm", velocity_rad_s=(0.0, 13.0))),
    "joint_beyond_limit": Fault(put("arm", angle_rad=(math.radians(180.0), 1.0)), sound=0),
    "joint_far_beyond_limit": Fault(
        put("arm", angle_rad=(2.0, math.radians(-25.0))), sound=0, also=frozenset({"joint_beyond_limit"})
    ),
    "force_lost": Fault(lambda i: replace(i, force=None)),
    "force_overload": Fault(put("force", overload=True)),
    "force_stuck": Fault(frozen_values("force", "force_sensor_n", "torque_sensor_nm")),
    "force_drift": Fault(context=lambda: flying(control=control(force_ext_world_n=(3.5, 0.0, 0.0)))),
    "force_disagrees": Fault(
        context=lambda: flying(control=control(force_ext_world_n=(0.0, 0.0, 1.5)), disturbance_world_n=(0.0, 0.0, -1.5))
    ),
    "loop_late": Fault(),
    "loop_stalled": Fault(),
    "recorder_drops": Fault(lambda i: replace(i, recorder_dropped=3)),
    "guardian_lost": Fault(lambda i: replace(i, guardian_ready=False)),
    "tilt": Fault(leaning(45.0), sound=0),
    "oscillates": Fault(put("vehicle", angular_rate_body_rad_s=(0.0, 0.4, 0.0)), context=swinging),
    "crashed": Fault(leaning(120.0), sound=0, also=frozenset({"tilt"})),
    "tracking_warn": Fault(context=lambda: flying(tracking_error_m=0.5)),
    "tracking_hold": Fault(context=lambda: flying(tracking_error_m=0.7), also=frozenset({"tracking_warn"})),
    "tracking_error": Fault(
        context=lambda: flying(tracking_error_m=1.2), also=frozenset({"tracking_warn", "tracking_hold"})
    ),
    "contact_force_high": Fault(context=lambda: flying(contact_n=15.0)),
    "thrust_saturated": Fault(
        context=lambda: flying(
            control=control(saturated=(True, False, False), tau=(0.0, 0.0, 54.0, 0.0, 0.0, 0.0, 0.0, 0.0))
        )
    ),
    "too_fast": Fault(at(0.0, 0.0, 1.0, vx=0.0, vy=2.1), sound=0, also=frozenset({"geofence_near"})),
    "climbs_too_fast": Fault(at(0.0, 0.0, 0.6, vz=1.6), sound=0),
    "sinks_too_fast": Fault(at(0.0, 0.0, 1.5, vz=-1.6), sound=0),
    "geofence_near": Fault(at(1.6, 0.0, 1.0, vx=0.8), sound=0),
    "geofence_left": Fault(at(-1.9, 0.0, 1.0), sound=0, also=frozenset({"geofence_near"})),
    "tether_short": Fault(context=lambda: tethered(stop_slack_m=0.05)),
    "tether_taut": Fault(context=lambda: tethered(taut=True)),
    "tether_snagged": Fault(context=lambda: tethered(snagged=True)),
    "tether_near": Fault(context=lambda: tethered(clearance_m=0.0)),
    "tether_wound": Fault(context=lambda: tethered(turns=-1.6)),
    "tether_separated": Fault(context=lambda: tethered(separated=True)),
    "operator_hold": Fault(lambda i: replace(i, command=OperatorCommand.HOLD)),
    "operator_resume": Fault(lambda i: replace(i, command=OperatorCommand.RESUME)),
    "operator_start": Fault(lambda i: replace(i, command=OperatorCommand.START)),
    "operator_land": Fault(lambda i: replace(i, command=OperatorCommand.LAND)),
    "operator_abort": Fault(lambda i: replace(i, command=OperatorCommand.ABORT)),
}


def stream(rule_id: str) -> list[Inputs]:
    if rule_id in ("loop_late", "loop_stalled"):
        gap_s = 0.2 if rule_id == "loop_late" else 1.0
        return [healthy(k, START_S + k * TICK_S + (gap_s if k > 2 else 0.0)) for k in range(700)]
    fault = FAULTS[rule_id]
    return after_a_moment(fault.change, sound=fault.sound)


def seen_by(rule: Rule) -> tuple[Vehicle, list[Inputs]]:
    """The machine to which the rule belongs, and what it sees."""
    if rule.subject is not Subject.VISION:
        return VEHICLE, stream(rule.id)
    return EXTERNAL, [fed_by_another(i) for i in stream(rule.id)]


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
    "killed": (
        PX4_LANDS,
        PX4_LANDS,
        0.015,
    ),  # nothing is sent after it: what would be, would act when the switch is released
    "armed_externally": (LAND, PX4_LANDS, 0.000),  # on the ground it is disarmed; in the air nobody else lands it
    "mocap_lost": (PX4_LANDS, PX4_LANDS, 0.220),  # PX4's estimate holds for 4.5 s, the companion has none
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
    "force_stuck": (None, WARN, 0.275),
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
    joint_swings 1 16 86; joint_swings_on 1 16 86; torque_refused 0.0; servo_error 70 2;
    joint_jump 2 29; servo_warm 68 65; servo_hot 76 75; servo_overload -2.5 0.1; joint_rate 0 745 700;
    joint_beyond_limit 180 57 5; joint_far_beyond_limit 115 -25 15; force_lost 0.25; force_overload 1 -1 0;
    force_drift 3.3 0.0 0.0 2.0; force_disagrees 0.0 0.0 0.8 0.0 0.0 -0.8;
    oscillates 0.10 18; loop_late 205 50; loop_stalled 1005 300; tilt 45 40; crashed 120;
    too_fast 2.1 2.0; climbs_too_fast 1.6 1.5; sinks_too_fast 1.6 1.5; geofence_left -1.90 0.00 1.00;
    geofence_near 2.29 0.00 1.00; tracking_warn 0.50 0.45; tracking_hold 0.70 0.60; tracking_error 1.20 0.80;
    thrust_saturated 54 1.0; contact_force_high 15.0 12.0; tether_short 0.05 0.10; tether_taut 1.20 0;
    tether_snagged 0 1.20; tether_near 0.00 0.01; tether_wound 1.6 1.5; tether_separated 1.80
"""
"""The numbers that the operator reads in a rule's text, in its units: what was found, then the limit."""
NUMBERS = {id_: numbers for id_, *numbers in (row.split() for row in READS.split(";"))}


def severity_of(rule_id: str, action: SafetyAction, *, airborne: bool) -> Severity:
    if rule_id.startswith("operator_"):
        return Severity.INFO
    ends_the_mission = airborne and action in (RETRACT, LAND, PX4_LANDS, TERMINATE)
    return Severity.CRITICAL if ends_the_mission or rule_id in ("killed", "armed_externally") else Severity.WARNING


def test_every_rule_has_its_fault() -> None:
    assert set(FAULTS) == set(RULE) == set(REQUIRED)
    assert len(RULES) == len(RULE), "an id twice"


@pytest.mark.parametrize("rule", RULES, ids=lambda rule: rule.id)
def test_each_fault_is_reported_once_by_name_in_time_and_requests_its_action(rule: Rule) -> None:
    fault = FAULTS[rule.id]
    events = watched(*seen_by(rule), fault.context())
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
        offboard_expected=rule.id in ("pilot_took_over", "offboard_left"),
        found_armed=FOUND if rule.id == "armed_externally" else None,
        torque_refused="joint torque (nan, 0.0) is not finite" if rule.id == "torque_refused" else None,
    )
    events = watched(*seen_by(rule), context)
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


def test_vision_that_has_never_been_fused_is_not_lost() -> None:
    assert watched(EXTERNAL, [estimator(flags=0b1111)(healthy(k)) for k in range(100)], standing()) == []


def test_the_estimators_last_report_counts_until_the_next_one_comes() -> None:
    rejected = estimator(position_horizontal_ratio=1.2)
    inputs = [rejected(healthy(k)) if k < 5 else replace(healthy(k), mocap=None, estimator=None) for k in range(70)]
    assert [event.id for event in watched(EXTERNAL, inputs, flying())] == ["vision_rejected", "estimator_silent"]


def test_what_was_a_warning_on_the_ground_is_judged_anew_in_the_air() -> None:
    monitors = Monitors(VEHICLE)
    no_force = [replace(healthy(k), force=None) for k in range(400)]
    on_ground = watched(VEHICLE, no_force[:200], standing(), monitors)
    in_air = watched(VEHICLE, no_force[200:], flying(), monitors)
    assert [(e.id, e.action) for e in on_ground] == [("force_lost", SafetyAction.LAND)]
    assert [(e.id, e.action) for e in in_air] == [("force_lost", SafetyAction.WARN)]


# -- values that are no numbers --------------------------------------------------------------------------------------


def broken_fields() -> list[tuple[str, str, int | None]]:
    """Part, field and component of every float of the inputs."""
    found: list[tuple[str, str, int | None]] = []
    for part in ("vehicle", "status", "mocap", "arm", "force"):
        record = getattr(healthy(), part)
        for name in record.__struct_fields__:
            value = getattr(record, name)
            if isinstance(value, float) and name not in ("marker_error_m", "written_s", "asked_s"):
                found.append((part, name, None))
            elif isinstance(value, tuple) and isinstance(value[0], float):
                found += [(part, name, index) for index in range(len(value))]
    return found


@pytest.mark.parametrize(("part", "name", "index"), broken_fields())
def test_a_value_that_is_not_finite_is_reported_and_its_record_counts_as_missing(
    part: str, name: str, index: int | None
) -> None:
    for bad in (NAN, math.inf, -math.inf, 1e300):
        monitors = Monitors(VEHICLE)
        assert watched(VEHICLE, [healthy(0), healthy(1)], flying(), monitors) == []
        value = getattr(getattr(healthy(2), part), name)
        value = bad if index is None else (*value[:index], bad, *value[index + 1 :])
        events = monitors.check(put(part, **{name: value})(healthy(2)), flying())
        assert [(event.id, event.action) for event in events] == [(f"{part}_not_finite", SafetyAction.WARN)]
        assert f"ignored: {name} = " in events[0].text and f"{bad:g}" in events[0].text and len(events[0].text) < 120
        assert monitors.trusted is not None and getattr(monitors.trusted, part) is None
        good = healthy(3)
        assert monitors.check(good, flying()) == ()
        assert monitors.trusted is good


# -- motion capture --------------------------------------------------------------------------------------------------


def test_a_rejected_pose_is_not_passed_on() -> None:
    monitors = Monitors(VEHICLE)
    watched(VEHICLE, [healthy(k) for k in range(3)], flying(), monitors)
    monitors.check(moved("mocap", (0.0, 0.3, 0.0))(healthy(3)), flying())
    assert not monitors.mocap_trusted
    assert monitors.trusted is not None and monitors.trusted.mocap == healthy(2).mocap, "as if it had not arrived"
    monitors.check(healthy(4), flying())
    assert monitors.mocap_trusted
    assert monitors.trusted.mocap is not None


def between_ticks(tick: int, change: Change = lambda i: i) -> MocapPose:
    """A pose that arrives 2 ms after the tick."""
    pose = change(healthy(tick)).mocap
    assert pose is not None
    return replace(pose, stamp_s=pose.stamp_s + 0.002, position_world_m=(*pose.position_world_m[:2], 0.99995))


BAD: dict[str, Change] = {
    "shifted": moved("mocap", (0.0, 0.3, 0.0)),
    "turned": turned("mocap", 180.0),
    "too late": put("mocap", latency_s=0.13),
    "not tracked": put("mocap", tracking_valid=False),
}


@pytest.mark.parametrize("kind", BAD)
def test_each_pose_is_judged_before_it_is_passed_on_and_not_by_the_one_before_it(kind: str) -> None:
    """Frames that start no tick arrive between two of them: the verdict of the tick is that of another pose."""
    bad, monitors = BAD[kind], Monitors(VEHICLE)
    watched(VEHICLE, [healthy(k) for k in range(3)], flying(), monitors)
    vehicle = healthy(2).vehicle
    assert monitors.forwards(between_ticks(2), vehicle)
    assert not monitors.forwards(between_ticks(2, bad), vehicle)
    monitors.check(bad(healthy(3)), flying())
    assert monitors.forwards(between_ticks(3), vehicle), "a good pose after a bad one"
    assert not monitors.forwards(between_ticks(3, bad), vehicle)
    evaluated = bad(healthy(3)).mocap
    assert evaluated is not None and not monitors.forwards(evaluated, vehicle)


@pytest.mark.parametrize("id_", ["mocap_frozen", "mocap_two_streams", "mocap_dragged"])
def test_of_a_stream_that_is_rejected_no_pose_is_passed_on_or_used(id_: str) -> None:
    monitors, inputs = Monitors(VEHICLE), stream(id_)
    until = next(k for k, i in enumerate(inputs) if any(e.id == id_ for e in monitors.check(i, flying())))
    last = inputs[until].mocap
    assert last is not None and monitors.pose_filter() is None
    x, y, z = last.position_world_m
    another = replace(last, stamp_s=last.stamp_s + 0.002, position_world_m=(x, y, z + 1e-4))
    assert not monitors.forwards(another, inputs[until].vehicle)
    assert monitors.trusted is not None and monitors.trusted.mocap is None


def test_a_pose_that_is_too_late_counts_as_not_received() -> None:
    """PX4 lands on its own estimate then, and what it does shows more than a pose that PX4 does not get."""
    monitors = Monitors(VEHICLE)
    watched(VEHICLE, [healthy(k) for k in range(3)], flying(), monitors)
    late = put("mocap", latency_s=0.13)
    monitors.check(late(healthy(3)), flying())
    assert not monitors.mocap_trusted
    assert monitors.trusted is not None and monitors.trusted.mocap == healthy(2).mocap
    watched(VEHICLE, [late(healthy(k)) for k in range(4, 50)], flying(), monitors)
    assert monitors.trusted.mocap is None
    monitors.check(healthy(50), flying())
    assert monitors.mocap_trusted and monitors.trusted.mocap is not None


def test_judging_a_pose_between_ticks_changes_nothing() -> None:
    """A replay has the inputs of the ticks only."""
    asked, unasked = Monitors(VEHICLE), Monitors(VEHICLE)
    for tick in range(40):
        i = turned("mocap", 180.0)(healthy(tick)) if tick % 3 == 2 else healthy(tick)
        assert asked.check(i, flying()) == unasked.check(i, flying())
        assert asked.mocap_trusted is unasked.mocap_trusted
        asked.forwards(between_ticks(tick, BAD[("shifted", "turned")[tick % 2]]), i.vehicle)


@pytest.mark.parametrize("id_", ["estimate_disagrees", "yaw_disagrees"])
def test_poses_that_are_rejected_in_between_do_not_restart_the_hold_time_of_a_disagreement(id_: str) -> None:
    apart = {"estimate_disagrees": moved("vehicle", (0.0, 0.4, 0.0)), "yaw_disagrees": turned("vehicle", 20.0)}[id_]

    def flickering(i: Inputs) -> Inputs:
        return apart(turned("mocap", 180.0)(i) if i.tick % 2 else i)

    events = watched(VEHICLE, after_a_moment(flickering), flying())
    reported = [event.t_s - START_S for event in events if event.id == id_]
    hold_s = next(rule.hold_time for rule in RULES if rule.id == id_)
    assert isinstance(hold_s, float)
    assert reported == [pytest.approx(3 * TICK_S + hold_s, abs=3 * TICK_S)]


@pytest.mark.parametrize(("late_s", "id_"), [(0.06, "mocap_late"), (0.15, "mocap_too_late")])
def test_a_delay_that_the_servers_stamps_do_not_contain_is_measured_against_the_least(late_s: float, id_: str) -> None:
    """A system that answers no echo requests: frames wait on the network from the 100th tick on."""

    def held(i: Inputs) -> Inputs:
        assert i.mocap is not None and i.mocap.exposure_server_s is not None
        wait_s = late_s if i.tick >= 100 else 0.0
        return put("mocap", exposure_server_s=i.mocap.exposure_server_s - wait_s)(i)

    events = watched(VEHICLE, (held(healthy(k)) for k in range(300)), flying())
    assert [event.id for event in events] == [id_]


def test_bad_poses_of_every_kind_in_turn_are_no_motion_capture() -> None:
    """None of the kinds lasts; but nothing to believe has come."""

    def mixed(i: Inputs) -> Inputs:
        kinds = (
            moved("mocap", (0.0, 0.3, 0.0)),
            put("mocap", tracking_valid=False),
            put("mocap", position_world_m=(NAN,) * 3),
        )
        return kinds[i.tick % 3](i)

    events = watched(VEHICLE, after_a_moment(mixed), flying())
    first = next(event for event in events if event.action is SafetyAction.AUTOPILOT_LAND)
    assert first.t_s - START_S <= VEHICLE.safety.mocap_timeout_s + 5 * TICK_S


@pytest.mark.parametrize("gone_s", [0.3, 2.5])
def test_motion_capture_that_comes_back_at_its_full_rate_is_not_reported_as_slow(gone_s: float) -> None:
    def lost_for_a_while(i: Inputs) -> Inputs:
        return stopped("mocap")(i) if 1.0 <= i.t_s - START_S < 1.0 + gone_s else i

    events = watched(VEHICLE, after_a_moment(lost_for_a_while, ticks=1200), flying())
    assert [event.id for event in events] == ["mocap_lost"]


@pytest.mark.parametrize(
    ("gap_s", "off_m", "trusted"),
    [
        (0.5, 0.22, True), (0.5, 0.28, False), (0.95, 0.32, False), (0.15, 0.12, True), (0.15, 0.17, False),
        (1.5, 0.45, True), (1.5, 0.49, False), (3.0, 1.12, True), (3.0, 1.16, False),
    ],
)  # fmt: skip
def test_after_a_gap_a_pose_far_from_px4s_position_is_not_passed_on(gap_s: float, off_m: float, trusted: bool) -> None:
    """0.1 m, and 0.3 m/s for the drift of PX4's position, up to 0.3 m; from 1 s on 0.2 m x t^1.5 / s^1.5 in its place."""
    monitors, ticks = after_a_gap(gap_s, flying())
    far = moved("mocap", (0.0, off_m, 0.0))(healthy(ticks))
    monitors.check(far, flying())
    assert monitors.trusted is not None and (monitors.trusted.mocap is far.mocap) is trusted


@pytest.mark.parametrize(("turn_deg", "trusted"), [(18.0, True), (-18.0, True), (22.0, False), (-90.0, False)])
def test_after_a_long_gap_a_pose_that_has_turned_is_not_passed_on(turn_deg: float, trusted: bool) -> None:
    monitors, ticks = after_a_gap(2.0, flying())
    monitors.check(turned("mocap", turn_deg)(healthy(ticks)), flying())
    assert monitors.mocap_trusted is trusted


def test_after_a_long_gap_another_bodys_poses_are_not_trusted_however_long_they_last() -> None:
    monitors, ticks = after_a_gap(1.5, flying())
    others = [moved("mocap", (1.0, 0.0, 0.0))(healthy(k)) for k in range(ticks, ticks + 2000)]
    events = watched(VEHICLE, others, flying(), monitors)
    assert not monitors.mocap_trusted
    assert [event.id for event in events if event.id == "mocap_swapped"]


@pytest.mark.parametrize("gone", [stopped("mocap"), put("mocap", tracking_valid=False)], ids=["lost", "not tracked"])
def test_the_first_pose_after_a_loss_is_evaluated_before_it_may_be_passed_on(gone: Change) -> None:
    """PX4 would reset its position to it."""
    monitors = Monitors(VEHICLE)
    watched(VEHICLE, after_a_moment(gone, ticks=201), flying(), monitors)
    sound = healthy(201)
    far = moved("mocap", (1.0, 0.0, 0.0))(sound)
    assert sound.mocap is not None and monitors.forwards(sound.mocap, sound.vehicle)
    assert far.mocap is not None and not monitors.forwards(far.mocap, far.vehicle)


@pytest.mark.parametrize(("gap_s", "trusted"), [(0.9, False), (1.1, True)])
def test_on_the_ground_the_vehicle_may_be_carried_while_it_is_not_seen_for_a_second(
    gap_s: float, trusted: bool
) -> None:
    monitors, ticks = after_a_gap(gap_s, standing())
    carried = moved("mocap", (1.5, 0.0, 0.0))(healthy(ticks))
    assert carried.mocap is not None and monitors.forwards(carried.mocap, carried.vehicle) is trusted
    monitors.check(carried, standing())
    assert monitors.mocap_trusted is trusted


def after_a_gap(gap_s: float, context: FlightContext) -> tuple[Monitors, int]:
    """Monitors that have seen no frame for a while, and the tick of the next one."""
    monitors = Monitors(VEHICLE)
    ticks = 20 + round(gap_s / TICK_S)
    gone = [replace(healthy(k), mocap=healthy(min(k, 19)).mocap) for k in range(ticks)]
    watched(VEHICLE, gone, context, monitors)
    return monitors, ticks


def test_motion_capture_that_comes_back_slowly_is_reported_with_its_own_rate() -> None:
    def lost_then_slow(i: Inputs) -> Inputs:
        since_s = i.t_s - START_S
        return stopped("mocap")(i) if 1.0 <= since_s < 3.0 else every_35_ms(i) if since_s >= 3.0 else i

    events = watched(VEHICLE, after_a_moment(lost_then_slow, ticks=1200), flying())
    assert [event.id for event in events] == ["mocap_lost", "mocap_slow"]
    assert events[1].text == "motion capture arrives at 29 Hz (limit 50 Hz)"


def test_a_pose_that_is_lost_disagrees_with_nothing() -> None:
    """PX4's estimate drifts on without it: one cause, one event."""
    events = watched(VEHICLE, after_a_moment(both(drifting, turning, stopped("mocap"))), flying())
    assert [event.id for event in events] == ["mocap_lost"]


@pytest.mark.parametrize("direction", [(0.0, 1.0, 0.0), (0.0, 0.0, -1.0), (-0.6, 0.8, 0.0)])
@pytest.mark.parametrize("flies", [True, False])
def test_poses_that_move_are_dragged_unless_the_imu_measures_the_motion(
    direction: tuple[float, float, float], flies: bool
) -> None:
    """From 3.2 s on the vehicle, or only its poses, accelerate by 4 m/s2 to 0.8 m/s; the IMU measures in the body's axes."""
    into_body = quat_from_euler_zyx(0.0, 0.0, -0.4)

    def change(i: Inputs) -> Inputs:
        since_s = max(0.0, i.t_s - START_S - 3.2)
        speed_m_s = min(0.8, 4.0 * since_s)
        way_m = 0.5 * speed_m_s * min(since_s, 0.2) + 0.8 * max(0.0, since_s - 0.2)
        x, y, z = direction
        i = both(
            moved("mocap", (way_m * x, way_m * y, way_m * z)), moved("vehicle", (way_m * x, way_m * y, way_m * z))
        )(i)
        if not flies:
            return i
        assert i.vehicle is not None and i.vehicle.delta_velocity_body_m_s is not None
        gained = quat_rotate(into_body, (speed_m_s * x, speed_m_s * y, speed_m_s * z))
        sensed = tuple(a + b for a, b in zip(i.vehicle.delta_velocity_body_m_s, gained, strict=True))
        return put("vehicle", delta_velocity_body_m_s=sensed)(i)

    events = watched(VEHICLE, after_a_moment(change, ticks=730, sound=0), flying())
    assert ("mocap_dragged" in [event.id for event in events]) is not flies


@pytest.mark.parametrize("direction", [(1, 0, 0), (0, 1, 0), (0, 0, 1), (-1, 0, 0), (0, -1, 0), (0, 0, -1)])
@pytest.mark.parametrize(("size_m", "trusted"), [(0.09, True), (0.11, False)])
def test_a_jump_is_one_from_ten_centimetres_on_in_every_direction(
    direction: tuple[int, int, int], size_m: float, trusted: bool
) -> None:
    monitors = Monitors(VEHICLE)
    watched(VEHICLE, [healthy(k) for k in range(3)], flying(), monitors)
    x, y, z = direction
    monitors.check(moved("mocap", (size_m * x, size_m * y, size_m * z))(healthy(3)), flying())
    assert monitors.mocap_trusted is trusted


@pytest.mark.parametrize("component", [0, 1, 2])
def test_a_pose_is_compared_with_where_px4s_velocity_has_carried_the_last_one(component: int) -> None:
    """80 ms without a frame at 1.5 m/s are 0.12 m, more than the jump limit."""
    velocity, there = [0.0, 0.0, 0.0], [0.0, 0.0, 0.0]
    velocity[component], there[component] = 1.5, 0.12
    monitors = Monitors(VEHICLE)
    fast = put("vehicle", velocity_world_m_s=tuple(velocity))
    gone = [fast(replace(healthy(k), mocap=healthy(min(k, 4)).mocap)) for k in range(20)]
    watched(VEHICLE, gone, flying(), monitors)
    monitors.check(fast(moved("mocap", (there[0], there[1], there[2]))(healthy(20))), flying())
    assert monitors.mocap_trusted


@pytest.mark.parametrize(
    ("height_m", "context", "reported"),
    [
        (0.46, flying(), True),
        (0.44, flying(), False),
        (1.0, flying(offboard_expected=False), False),
        (1.0, flying(airborne=False), False),
    ],
)
def test_disarmed_is_reported_only_high_in_the_air_and_while_the_companion_flies(
    height_m: float, context: FlightContext, reported: bool
) -> None:
    """It stands at 0.3 m; from 0.15 m above that it flies."""
    disarmed = both(at(0.0, 0.0, height_m), put("status", armed=False))
    found = [event.id for event in watched(VEHICLE, after_a_moment(disarmed, ticks=20, sound=0), context)]
    assert ("px4_disarmed" in found) is reported


# -- the room --------------------------------------------------------------------------------------------------------

WALLS = [(0, 1, 1.81), (0, -1, 1.81), (1, 1, 1.41), (1, -1, 1.41), (2, 1, 2.15)]
"""Axis, side, and the largest coordinate: the room of the vehicle file less 0.49 m for the rotors (0.15 m above), plus 0.1 m."""


@pytest.mark.parametrize(("axis", "side", "most_m"), WALLS)
def test_at_every_side_the_fence_is_where_the_rotors_leave_the_room(axis: int, side: int, most_m: float) -> None:
    def found(off_m: float, speed_m_s: float) -> list[str]:
        place, velocity = [0.0, 0.0, 1.0], [0.0, 0.0, 0.0]
        place[axis], velocity[axis] = side * (most_m + off_m), side * speed_m_s
        inputs = after_a_moment(at(*place, *velocity), ticks=60, sound=0)
        return [event.id for event in watched(VEHICLE, inputs, flying())]

    stop_m = 0.5 * (0.21 + 0.6 + 0.5 / 16.0)  # docs/internals/safety.md: 0.5 m/s; reaction, LAND's stop point, braking
    assert found(-0.01, 0.0) == []
    assert found(0.01, 0.0) == ["geofence_left", "geofence_near"]
    assert found(-stop_m - 0.01, 0.5) == []
    assert found(-stop_m + 0.01, 0.5) == ["geofence_near"]
    assert found(-0.01, -0.5) == [], "on its way back"


# -- a process that was held up --------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("gap_s", "spoken"),
    [(0.04, []), (0.2, [("loop_late", SafetyAction.WARN)]), (1.0, [("loop_stalled", SafetyAction.LAND)])],
)
def test_after_a_late_tick_the_loop_is_reported_and_no_device(
    gap_s: float, spoken: list[tuple[str, SafetyAction]]
) -> None:
    """The first tick after a hold-up sees old stamps of everything; a moment later all is fresh."""
    late_s = START_S + gap_s
    inputs = [healthy(), replace(healthy(), t_s=late_s), *[healthy(k, late_s + k * TICK_S) for k in range(1, 60)]]
    events = watched(VEHICLE, inputs, flying())
    assert [(event.id, event.action) for event in events] == spoken


def test_a_mocap_that_stays_away_after_a_hold_up_is_lost() -> None:
    inputs = [healthy(), *[stopped("mocap")(healthy(k, START_S + 0.2 + k * TICK_S)) for k in range(40)]]
    assert [event.id for event in watched(VEHICLE, inputs, flying())] == ["loop_late", "mocap_lost"]


# -- what comes and goes ---------------------------------------------------------------------------------------------


@pytest.mark.parametrize(("ticks", "reports"), [(range(5, 700, 20), 1), ((100, 500), 2)])
def test_a_finding_that_flickers_is_reported_once_and_one_that_returns_later_again(
    ticks: Sequence[int], reports: int
) -> None:
    def failing(i: Inputs) -> Inputs:
        return put("arm", read_failures=6)(i) if i.tick in ticks else i

    assert len(watched(VEHICLE, after_a_moment(failing), flying())) == reports


def test_a_finding_that_ends_before_its_hold_time_begins_it_anew() -> None:
    def low_twice(i: Inputs) -> Inputs:
        return put("status", battery_remaining=0.25)(i) if 100 <= i.tick < 280 or 300 <= i.tick < 480 else i

    assert watched(VEHICLE, after_a_moment(low_twice), flying()) == []


def test_a_finding_that_is_active_after_a_resume_is_reported_again() -> None:
    monitors = Monitors(VEHICLE)
    inputs = after_a_moment(at(1.6, 0.0, 1.0, vx=0.8), sound=0)
    before = watched(VEHICLE, inputs[:100], flying(), monitors)
    monitors.forget()
    after = watched(VEHICLE, inputs[100:200], flying(), monitors)
    assert [[event.id for event in events] for events in (before, after)] == [["geofence_near"], ["geofence_near"]]


def test_a_finding_is_active_until_it_was_gone_for_a_second() -> None:
    monitors = Monitors(VEHICLE)
    near = after_a_moment(at(1.6, 0.0, 1.0, vx=0.8), sound=0)[:100]
    watched(VEHICLE, near, flying(), monitors)
    assert "outside the room" in (monitors.standing() or "")
    watched(VEHICLE, [healthy(k) for k in range(100, 295)], flying(), monitors)
    assert "outside the room" in (monitors.standing() or "")
    watched(VEHICLE, [healthy(k) for k in range(295, 310)], flying(), monitors)
    assert monitors.standing() is None


@pytest.mark.parametrize("first_s", [0.0, 0.3])
def test_of_several_active_findings_the_most_severe_is_named(first_s: float) -> None:
    """The arm is lost before or after the vehicle comes near the wall."""
    monitors, near = Monitors(VEHICLE), at(1.6, 0.0, 1.0, vx=0.8)
    lost = [i if i.t_s - START_S < first_s else stopped("arm")(i) for i in map(healthy, range(120))]
    watched(VEHICLE, [i if i.t_s - START_S < 0.3 - first_s else near(i) for i in lost], flying(), monitors)
    assert "joint state" in (monitors.standing() or "")


def test_a_warning_and_an_operators_command_do_not_prevent_resuming() -> None:
    monitors = Monitors(VEHICLE)
    warm = put("arm", temperature_c=(70.0, 35.0))
    events = watched(VEHICLE, [warm(healthy(k)) for k in range(150)], flying(), monitors)
    asked = [replace(warm(healthy(150)), command=OperatorCommand.HOLD)]
    events += watched(VEHICLE, asked, flying(), monitors)
    assert [event.id for event in events] == ["servo_warm", "operator_hold"]
    assert monitors.standing() is None


def test_an_operator_may_repeat_a_command() -> None:
    asked = [
        OperatorCommand.HOLD,
        OperatorCommand.RESUME,
        OperatorCommand.HOLD,
        OperatorCommand.NONE,
        OperatorCommand.HOLD,
    ]
    inputs = [replace(healthy(k), command=command) for k, command in enumerate(asked)]
    told = [event.id for event in watched(VEHICLE, inputs, flying())]
    assert told == ["operator_hold", "operator_resume", "operator_hold", "operator_hold"]


def test_while_inputs_are_missing_only_commands_and_invalid_values_are_reported() -> None:
    nothing = replace(healthy(), vehicle=None, status=None, mocap=None, force=None)
    waiting = standing(waiting=True)
    inputs: list[Inputs] = [replace(nothing, tick=k, t_s=START_S + k) for k in range(10)]
    inputs.append(replace(nothing, t_s=START_S + 11.0, command=OperatorCommand.LAND))
    events: list[Event] = watched(VEHICLE, inputs, waiting)
    assert [(event.id, event.action) for event in events] == [("operator_land", SafetyAction.LAND)]


# -- words -----------------------------------------------------------------------------------------------------------


def test_hardware_errors_are_reported_by_name() -> None:
    assert error_text((0, 0b100100)) == "servo 2: overheating, overload"
    assert error_text((0b1, 0b1000000)) == "servo 1: input voltage; servo 2: fault of the motor"


@pytest.mark.parametrize(
    ("position", "yaw", "fused"),
    [
        ((0.0, 0.0, 1.0), 0.4, True),
        ((0.05, 0.0, 1.0), 0.45, True),
        ((0.2, 0.0, 1.0), 0.4, False),
        ((0.0, 0.0, 1.0), 0.9, False),
    ],
)
def test_fusion_is_proved_by_agreement(position: tuple[float, float, float], yaw: float, fused: bool) -> None:
    pose = put("mocap", position_world_m=position, attitude_wxyz=quat_from_euler_zyx(0, 0, yaw))
    assert (unfused(pose(healthy())) is None) == fused


def test_a_link_that_was_always_slow_is_the_clocks_difference() -> None:
    """What counts is how much later than at the best of times; and after a while the new difference is the clocks'."""
    monitors = Monitors(VEHICLE)
    told = watched(VEHICLE, (slow_link(healthy(k)) for k in range(400)), flying(), monitors)
    assert told == []
    later = watched(
        VEHICLE, (put("vehicle", boot_s=healthy(k).t_s - 0.16)(healthy(k)) for k in range(400, 420)), flying(), monitors
    )
    assert later == [], "60 ms more"


@pytest.mark.parametrize(
    ("growth", "told"),
    [(0.0005, []), (0.04, ["link_slow", "link_late"])],
    ids=["clocks that drift", "a queue that fills"],
)
def test_a_lag_that_grows_faster_than_clocks_drift_apart_is_reported(growth: float, told: list[str]) -> None:
    """At the former rate of forgetting, 50 ms/s, a link that queued 40 ms more each second was never late."""
    queue = (
        put("vehicle", boot_s=i.t_s - 0.01 - growth * k * TICK_S)(i) for k, i in enumerate(map(healthy, range(600)))
    )
    assert [event.id for event in watched(VEHICLE, queue, flying())] == told


@pytest.mark.parametrize(
    ("every", "told"), [(2, ["torque_refused"]), (20, [])], ids=["every other tick", "one in twenty"]
)
def test_torques_that_are_refused_again_and_again_land_although_some_are_sent(every: int, told: list[str]) -> None:
    monitors, ids = Monitors(VEHICLE), []
    for k in range(400):
        refused = None if k % every else "joint torque (nan, 0.0) is not finite"
        ids += [event.id for event in monitors.check(healthy(k), flying(torque_refused=refused))]
    assert ids == told


def test_in_the_air_a_repeated_pose_is_not_passed_on_at_once() -> None:
    """Long before it is a finding: PX4 would take it for standing still."""
    monitors, first = Monitors(VEHICLE), healthy()
    assert first.mocap is not None
    for k in range(5):
        monitors.check(healthy(k), flying())
        assert monitors.mocap_trusted
    pose = healthy(4).mocap
    assert pose is not None
    same = put("mocap", position_world_m=pose.position_world_m, attitude_wxyz=pose.attitude_wxyz)
    monitors.check(same(healthy(5)), flying())
    assert not monitors.mocap_trusted
    assert monitors.trusted is not None and monitors.trusted.mocap is not None, "it is no finding yet"
    monitors.check(healthy(6), flying())
    assert monitors.mocap_trusted
    monitors.check(same(healthy(7)), standing())
    monitors.check(same(healthy(8)), standing())
    assert monitors.mocap_trusted, "on the ground a pose may well repeat"


REPEATS = {
    "force_stuck": frozen_values("force", "force_sensor_n", "torque_sensor_nm"),
    "mocap_frozen": frozen_values("mocap", "position_world_m", "attitude_wxyz"),
    "estimate_frozen": frozen_values("vehicle", "position_world_m"),
}


@pytest.mark.parametrize(
    ("velocity", "rate", "moves"),
    [
        ((0.0, 0.0, 0.029), (0.0, 0.0, 0.049), False),
        ((0.0, 0.0, 0.031), (0.0, 0.0, 0.0), True),
        ((0.0, -0.031, 0.0), (0.0, 0.0, 0.0), True),
        ((0.0, 0.0, 0.0), (0.0, 0.0, 0.051), True),
        ((0.0, 0.0, 0.0), (0.0, -0.051, 0.0), True),
    ],
)
@pytest.mark.parametrize("found", REPEATS)
def test_values_that_repeat_are_a_fault_only_while_the_vehicle_moves(
    found: str, velocity: tuple[float, float, float], rate: tuple[float, float, float], moves: bool
) -> None:
    """It moved until they began to repeat: that proves nothing."""
    motion = put("vehicle", velocity_world_m_s=velocity, angular_rate_body_rad_s=rate)
    events = watched(VEHICLE, after_a_moment(both(motion, REPEATS[found]), ticks=300, sound=20), flying())
    assert [event.id for event in events] == ([found] if moves else [])


@pytest.mark.parametrize(("context", "trusted"), [(flying, False), (standing, True)])
def test_on_the_ground_a_force_that_repeats_itself_is_still_one(
    context: Callable[[], FlightContext], trusted: bool
) -> None:
    monitors = Monitors(VEHICLE)
    watched(VEHICLE, after_a_moment(REPEATS["force_stuck"], ticks=200), context(), monitors)
    assert monitors.trusted is not None and (monitors.trusted.force is not None) is trusted


def test_a_frame_without_the_body_does_not_end_a_freeze() -> None:
    """Otherwise the frozen pose is trusted again for `mocap_frozen_s`, and a landing by PX4 takes it for a new one."""
    monitors, same = Monitors(VEHICLE), frozen_values("mocap", "position_world_m", "attitude_wxyz")
    told = watched(VEHICLE, (same(healthy(k)) for k in range(60)), flying(), monitors)
    assert [event.id for event in told] == ["mocap_frozen"]
    monitors.check(put("mocap", tracking_valid=False)(same(healthy(60))), flying())
    for k in range(61, 80):
        monitors.check(same(healthy(k)), flying())
        assert monitors.trusted is not None and monitors.trusted.mocap is None
    monitors.check(healthy(80), flying())
    assert monitors.trusted is not None and monitors.trusted.mocap is not None, "the pose moves again"


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


SWING_M = VEHICLE.safety.oscillation_m


@pytest.mark.parametrize(
    ("error_m", "rate_rad_s", "oscillates"),
    [
        (lambda t_s: 0.55 * SWING_M * math.sin(3.0 * t_s), 0.4, True),
        (lambda t_s: 0.3 + 0.55 * SWING_M * math.sin(3.0 * t_s), 0.4, True),  # about another place, in wind
        (lambda t_s: 0.45 * SWING_M * math.sin(3.0 * t_s), 0.4, False),
        (lambda t_s: 0.55 * SWING_M * math.sin(3.0 * t_s), 0.2, False),  # the reference wanders, not the vehicle
        (lambda t_s: 3.0 * SWING_M * math.exp(-2.0 * t_s) * math.sin(3.0 * t_s), 0.4, False),  # a blow that dies out
        (lambda t_s: 0.55 * SWING_M * math.sin(0.9 * t_s), 0.4, False),  # drifting air
    ],
)
@pytest.mark.parametrize("axis", [0, 1])
def test_only_swings_that_last_are_an_oscillation(
    error_m: Callable[[float], float], rate_rad_s: float, oscillates: bool, axis: int
) -> None:
    watch = Oscillation(SWING_M)
    found = []
    for k in range(2000):
        error, rate = [0.0, 0.0], [0.0, 0.0]
        error[axis], rate[1 - axis] = error_m(k * TICK_S), rate_rad_s
        watch.update(k * TICK_S, TICK_S, (error[0], error[1]), (rate[0], rate[1]))
        found.append(watch.rate_rad_s is not None)
    assert any(found) is oscillates
    assert not any(found[:400]), "not before two periods, of 2.1 s each"


@pytest.mark.parametrize(("late_s", "id_"), [(0.01, None), (0.03, "link_slow"), (0.06, "link_late")])
@pytest.mark.parametrize("offset_m", [(0.0, 0.0, 0.0), (0.05, -0.03, 0.02)])
def test_a_link_that_was_always_slow_is_found_when_the_vehicle_moves(
    late_s: float, id_: str | None, offset_m: tuple[float, float, float]
) -> None:
    """PX4's position is where the vehicle was on the way there and back; a wrong pivot makes no difference."""

    def flies(i: Inputs) -> Inputs:
        now_s = i.t_s - START_S

        def at_m(t_s: float) -> float:
            return 0.3 * math.sin(1.5 * t_s)

        x, y, z = offset_m
        px4 = put("vehicle", position_world_m=(x + at_m(now_s - 2.0 * late_s), y, 1.0 + z))
        speed = put("vehicle", velocity_world_m_s=(0.45 * math.cos(1.5 * (now_s - 2.0 * late_s)), 0.0, 0.0))
        return put("mocap", position_world_m=(at_m(now_s), 0.0, 1.0))(speed(px4(i)))

    events = watched(NO_INERTIAL, [flies(healthy(k)) for k in range(1000)], flying())
    assert [event.id for event in events] == ([id_] if id_ else [])


def test_the_lag_is_not_measured_with_poses_that_are_not_trusted_or_repeat() -> None:
    """A pose that stays behind a moving vehicle looks like a lag that is negative or large."""

    def lost(i: Inputs) -> Inputs:
        t_s = i.t_s - START_S
        moving = put("vehicle", velocity_world_m_s=(0.4 * math.sin(2.0 * t_s), 0.0, 0.0))
        shift_m = 0.09 * math.sin(2.0 * t_s)
        return replace(moved("vehicle", (-shift_m, 0.0, 0.0))(moving(i)), mocap=healthy(3).mocap)

    events = watched(NO_INERTIAL, after_a_moment(lost), flying())
    assert {event.id for event in events} == {"mocap_lost"}
