"""Ladder, gate and monitors, each as a table."""

from __future__ import annotations

import dataclasses
import itertools
import math

import pytest

from companion.config.loader import load_vehicle
from companion.config.vehicle import Vehicle
from companion.frames import quat_from_euler_zyx
from companion.safety.gate import Gate
from companion.safety.monitors import Monitors, Situation, unfused
from companion.safety.supervisor import SupervisorState, update
from companion.types import (
    ArmState,
    AttitudeSetpoint,
    AutopilotStatus,
    Event,
    FlightMode,
    ForceSample,
    Inputs,
    LandedState,
    MocapPose,
    OperatorCommand,
    SafetyAction,
    Severity,
    Vec2,
    VehicleState,
)

NAN = math.nan
LEVEL = quat_from_euler_zyx(0, 0, 0.4)
ZERO = (0.0, 0.0, 0.0)


@pytest.fixture(scope="module")
def vehicle() -> Vehicle:
    return load_vehicle("configs/vehicles/tarot650_2r.yaml")


@pytest.mark.parametrize(("now", "asked"), list(itertools.product(SafetyAction, SafetyAction)))
def test_the_ladder_goes_up_only(now: SafetyAction, asked: SafetyAction) -> None:
    state = SupervisorState(now, "before", 1.0)
    after = update(state, [Event(2.0, "new", Severity.CRITICAL, asked, "")])
    if asked.rank > now.rank:
        assert after == SupervisorState(asked, "new", 2.0)
    else:
        assert after == state


BAD_ATTITUDES = {
    "nan": AttitudeSetpoint((NAN, 0.0, 0.0, 1.0), 0.5),
    "infinite thrust": AttitudeSetpoint(LEVEL, math.inf),
    "not unit": AttitudeSetpoint((0.9, 0.0, 0.0, 0.0), 0.5),
    "zero": AttitudeSetpoint((0.0, 0.0, 0.0, 0.0), 0.5),
    "thrust above 1": AttitudeSetpoint(LEVEL, 1.0001),
    "thrust below 0": AttitudeSetpoint(LEVEL, -0.0001),
    "upside down": AttitudeSetpoint((0.0, 1.0, 0.0, 0.0), 0.5),
    "leaning too far": AttitudeSetpoint(quat_from_euler_zyx(0.0, math.radians(25), 0.0), 0.5),
}


@pytest.mark.parametrize("name", BAD_ATTITUDES)
def test_a_bad_attitude_setpoint_never_leaves(vehicle: Vehicle, name: str) -> None:
    verdict = Gate(vehicle).check(BAD_ATTITUDES[name], None, None, False)
    assert verdict.attitude is None
    assert len(verdict.refused) == 1


def test_a_good_setpoint_leaves_as_it_is(vehicle: Vehicle) -> None:
    good = AttitudeSetpoint(quat_from_euler_zyx(0.1, -0.1, 2.0), 0.5)
    verdict = Gate(vehicle).check(good, (0.3, -0.2), (2.0, 1.0), True)
    assert verdict.attitude == good
    assert verdict.arm_torque_nm == (0.3, -0.2)
    assert not verdict.refused


@pytest.mark.parametrize(
    ("torque", "angle", "fresh", "leaves"),
    [
        ((NAN, 0.0), (2.0, 1.0), True, None),
        ((0.0, math.inf), (2.0, 1.0), True, None),
        ((0.5, 0.5), None, True, None),
        ((0.5, 0.5), (2.0, 1.0), False, None),
        ((99.0, -99.0), (2.0, 1.0), True, (2.5, -2.5)),
        ((1.0, 1.0), (math.radians(176), 1.0), True, (0.0, 1.0)),  # past the upper wall of joint 1
        ((-1.0, 1.0), (math.radians(176), 1.0), True, (-1.0, 1.0)),
        ((0.2, -1.0), (2.0, math.radians(-11)), True, (0.2, 0.0)),  # past the lower wall of joint 2
    ],
)
def test_joint_torques(vehicle: Vehicle, torque: Vec2, angle: Vec2 | None, fresh: bool, leaves: Vec2 | None) -> None:
    assert Gate(vehicle).check(None, torque, angle, fresh).arm_torque_nm == leaves


def healthy(t_s: float = 10.0) -> Inputs:
    return Inputs(
        tick=0,
        t_s=t_s,
        vehicle=VehicleState(t_s, t_s, t_s, (0.0, 0.0, 1.0), ZERO, LEVEL, ZERO, (0.0, 0.0, 9.81)),
        status=AutopilotStatus(t_s, True, FlightMode.OFFBOARD, LandedState.IN_AIR, 15.8, 0.9),
        mocap=MocapPose(t_s, 0.005, 1, (0.0, 0.0, 1.0), LEVEL, True, 0.0002),
        arm=ArmState(t_s, (2.0, 1.0), (0.0, 0.0), (0.0, 0.0), (0, 0), (35.0, 35.0), 0),
        force=ForceSample(t_s, ZERO, ZERO, False),
        command=OperatorCommand.NONE,
        recorder_dropped=0,
    )


FLYING = Situation(airborne=True, offboard_expected=True, tracking_error_m=0.02)
replace = dataclasses.replace


def broken(name: str) -> Inputs:
    i = healthy()
    assert i.vehicle and i.status and i.mocap and i.arm and i.force
    tilted = quat_from_euler_zyx(math.radians(45), 0, 0)
    silent = dict.fromkeys(FROZEN, i)
    return {
        **silent,
        "mocap_invalid": replace(i, mocap=replace(i.mocap, tracking_valid=False)),
        "force_lost": replace(i, force=None),
        "force_overload": replace(i, force=replace(i.force, overload=True)),
        "arm_let_go": replace(i, arm=replace(i.arm, hardware_error=(0x80, 0))),
        "recorder_drops": replace(i, recorder_dropped=3),
        "servo_error": replace(i, arm=replace(i.arm, hardware_error=(0, 32))),
        "battery_low": replace(i, status=replace(i.status, battery_remaining=0.1)),
        "operator_land": replace(i, command=OperatorCommand.LAND),
        "pilot_took_over": replace(i, status=replace(i.status, mode=FlightMode.MANUAL)),
        "offboard_left": replace(i, status=replace(i.status, mode=FlightMode.LAND)),
        "tilt": replace(i, vehicle=replace(i.vehicle, attitude_wxyz=tilted)),
        "estimate_disagrees": replace(i, mocap=replace(i.mocap, position_world_m=(0.5, 0.0, 1.0))),
    }[name]


@pytest.mark.parametrize(
    ("name", "action"),
    [
        ("mocap_lost", SafetyAction.AUTOPILOT_LAND),
        ("mocap_invalid", SafetyAction.AUTOPILOT_LAND),
        ("vehicle_state_lost", SafetyAction.AUTOPILOT_LAND),
        ("heartbeat_lost", SafetyAction.AUTOPILOT_LAND),
        ("arm_lost", SafetyAction.LAND),
        ("force_lost", SafetyAction.WARN),
        ("force_overload", SafetyAction.WARN),
        ("arm_let_go", SafetyAction.WARN),
        ("recorder_drops", SafetyAction.WARN),
        ("servo_error", SafetyAction.LAND),
        ("battery_low", SafetyAction.LAND),
        ("operator_land", SafetyAction.LAND),
        ("pilot_took_over", SafetyAction.AUTOPILOT_LAND),
        ("offboard_left", SafetyAction.AUTOPILOT_LAND),
        ("tilt", SafetyAction.AUTOPILOT_LAND),
        ("estimate_disagrees", SafetyAction.AUTOPILOT_LAND),
    ],
)
def test_each_monitor_speaks_once_and_asks_for_its_rung(vehicle: Vehicle, name: str, action: SafetyAction) -> None:
    monitors = Monitors(vehicle.safety)
    assert monitors.check(healthy(), FLYING) == ()
    spoken: list[Event] = []
    for k in range(1, 600):
        spoken += monitors.check(_later(broken(name), k * 0.005, frozen=FROZEN.get(name)), FLYING)
    assert [(event.id, event.action) for event in spoken] == [(name, action)]


FROZEN = {
    "mocap_lost": "mocap",
    "vehicle_state_lost": "vehicle",
    "heartbeat_lost": "status",
    "arm_lost": "arm",
}


def _later(i: Inputs, by_s: float, frozen: str | None = None) -> Inputs:
    """The same inputs later, every stamp with them but those of the device that fell silent."""
    assert i.vehicle
    assert i.status
    assert i.mocap
    assert i.arm
    v = i.vehicle
    moved = {
        "vehicle": replace(
            v,
            position_stamp_s=v.position_stamp_s + by_s,
            attitude_stamp_s=v.attitude_stamp_s + by_s,
            imu_stamp_s=v.imu_stamp_s + by_s,
        ),
        "status": replace(i.status, heartbeat_stamp_s=i.status.heartbeat_stamp_s + by_s),
        "mocap": replace(i.mocap, stamp_s=i.mocap.stamp_s + by_s),
        "arm": replace(i.arm, stamp_s=i.arm.stamp_s + by_s),
        "force": replace(i.force, stamp_s=i.force.stamp_s + by_s) if i.force else None,
    }
    if frozen is not None:
        del moved[frozen]
    return replace(i, t_s=i.t_s + by_s, **moved)


@pytest.mark.parametrize(
    ("gap_s", "spoken"),
    [(0.04, []), (0.2, [("loop_late", SafetyAction.WARN)]), (1.0, [("loop_stalled", SafetyAction.LAND)])],
)
def test_a_held_up_process_blames_itself_and_no_device(
    vehicle: Vehicle, gap_s: float, spoken: list[tuple[str, SafetyAction]]
) -> None:
    """The first tick after a hold-up sees old stamps of everything; a moment later all is fresh."""
    monitors = Monitors(vehicle.safety)
    monitors.check(healthy(), FLYING)
    events = [*monitors.check(replace(healthy(), t_s=10.0 + gap_s), FLYING)]
    events += monitors.check(_later(healthy(), gap_s + 0.005), FLYING)
    assert [(event.id, event.action) for event in events] == spoken


def test_a_mocap_that_stays_away_after_a_hold_up_is_lost(vehicle: Vehicle) -> None:
    monitors = Monitors(vehicle.safety)
    monitors.check(healthy(), FLYING)
    events: list[Event] = []
    for k in range(40):
        events += monitors.check(_later(healthy(), 0.2 + k * 0.005, frozen="mocap"), FLYING)
    assert [event.id for event in events] == ["loop_late", "mocap_lost"]


def _after(monitors: Monitors, i: Inputs, situation: Situation) -> list[Event]:
    """Events of the next half second."""
    return [event for k in range(1, 100) for event in monitors.check(_later(i, k * 0.005), situation)]


def test_being_lost_from_the_reference_lands(vehicle: Vehicle) -> None:
    monitors = Monitors(vehicle.safety)
    lost = replace(FLYING, tracking_error_m=1.2)
    events = [*monitors.check(healthy(), lost), *_after(monitors, healthy(), lost)]
    assert [(event.id, event.action) for event in events] == [("tracking_error", SafetyAction.LAND)]


def test_upside_down_terminates(vehicle: Vehicle) -> None:
    monitors = Monitors(vehicle.safety)
    i = healthy()
    assert i.vehicle
    flipped = replace(i, vehicle=replace(i.vehicle, attitude_wxyz=quat_from_euler_zyx(math.radians(120), 0, 0)))
    events = [*monitors.check(flipped, FLYING), *_after(monitors, flipped, FLYING)]
    assert ("crashed", SafetyAction.TERMINATE) in [(event.id, event.action) for event in events]


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
    i = healthy()
    assert i.mocap
    pose = replace(i.mocap, position_world_m=position, attitude_wxyz=quat_from_euler_zyx(0, 0, yaw))
    assert (unfused(replace(i, mocap=pose)) is None) == fused
