"""Gate, rules and tether clearance for arms of any number of joints, and for a vehicle without an arm."""

from __future__ import annotations

import math
import random

import msgspec
import pytest

from companion.config.loader import load_vehicle
from companion.config.vehicle import Vehicle
from companion.control.arm_model import manipulator_of
from companion.model.types import ArmState, Inputs
from companion.safety.gate import Gate
from companion.safety.tether_shape import Clearance
from tests.machines import overrides_with_joints, vehicle_with_joints
from tests.safety.healthy import flying, healthy, standing, watched
from tests.support import tether_of

COUNTS = (1, 2, 4)


def in_the_middle(vehicle: Vehicle) -> tuple[float, ...]:
    return tuple(math.radians(sum(joint.angle_deg) / 2.0) for joint in vehicle.arm.joints)


def ticks(vehicle: Vehicle, **last: float) -> list[Inputs]:
    """Healthy ticks with the arm of the vehicle; `last` changes a field of the last joint."""
    found = []
    for tick in range(700):
        inputs = healthy(tick)
        assert inputs.arm is not None
        zeros, joints = (0.0,) * len(vehicle.arm.joints), len(vehicle.arm.joints)
        arm = ArmState(
            stamp_s=inputs.arm.stamp_s,
            angle_rad=in_the_middle(vehicle),
            velocity_rad_s=zeros,
            torque_nm=zeros,
            hardware_error=(0,) * joints,
            temperature_c=(35.0,) * joints,
            read_failures=0,
        )
        for key, value in last.items():
            arm = msgspec.structs.replace(arm, **{key: (*getattr(arm, key)[:-1], value)})
        found.append(msgspec.structs.replace(inputs, arm=arm if joints else None))
    return found


@pytest.mark.parametrize("count", COUNTS)
@pytest.mark.parametrize(
    ("rule", "field", "value", "text"),
    [
        ("servo_error", "hardware_error", 32, "servo {}: overload"),
        ("servo_hot", "temperature_c", 79.0, "79 degC"),
        ("servo_overload", "torque_nm", 2.49, "2.5 N m are at the limit"),
        ("joint_rate", "velocity_rad_s", 13.0, "745 deg/s"),
        ("joint_far_beyond_limit", "angle_rad", math.radians(189.0), "189 deg: "),
        ("arm_not_finite", "angle_rad", math.nan, "ignored"),
    ],
)
def test_every_rule_of_the_arm_covers_the_last_joint(
    count: int, rule: str, field: str, value: float, text: str
) -> None:
    vehicle = vehicle_with_joints(count)
    assert watched(vehicle, ticks(vehicle), flying()) == []
    events = watched(vehicle, ticks(vehicle, **{field: value}), flying())
    told = [event.text for event in events if event.id == rule]
    assert told and text.format(count) in told[0]


def test_without_an_arm_its_absence_is_no_event() -> None:
    vehicle = vehicle_with_joints(0)
    for situation in (flying(), standing()):
        assert [event for event in watched(vehicle, ticks(vehicle), situation) if "force" not in event.id] == []


@pytest.mark.parametrize("count", COUNTS)
def test_the_gate_limits_every_joint(count: int) -> None:
    vehicle = vehicle_with_joints(count)
    gate, middle, still = Gate(vehicle), in_the_middle(vehicle), (0.0,) * count
    torque = gate.check(None, (9.0,) * count, middle, True, arm_rate_rad_s=still).arm_torque_nm
    assert torque == (2.5,) * count
    for joint in range(count):
        beyond = tuple(
            math.radians(vehicle.arm.joints[joint].angle_deg[1] + 1.0) if k == joint else angle
            for k, angle in enumerate(middle)
        )
        torque = gate.check(None, (1.0,) * count, beyond, True, arm_rate_rad_s=still).arm_torque_nm
        assert torque == tuple(0.0 if k == joint else 1.0 for k in range(count))


def test_without_an_arm_no_torque_is_no_refusal() -> None:
    assert Gate(vehicle_with_joints(0)).check(None, (), None, False).refused == ()


@pytest.mark.parametrize("count", COUNTS)
def test_no_point_of_the_arm_is_nearer_to_the_line_than_the_clearance_says(count: int) -> None:
    """The line runs aside, straight out through the middle of the arm's plane: its distance from the shoulder is the arm's reach."""
    vehicle = vehicle_with_joints(count)
    tether = tether_of(vehicle).model_copy(update={"attachment_body_m": (1.0, 0.6, -0.05)})
    clearance, manipulator, chance = Clearance(vehicle, tether), manipulator_of(vehicle), random.Random(count)
    assert clearance.judges_arm
    for _ in range(50):
        angles = tuple(chance.uniform(-3.0, 3.0) for _ in range(count))
        shoulder, *others = (*manipulator.joints_body_m(angles), manipulator.net_body_m(angles))
        reach_m = max(math.dist(shoulder, point) for point in others)
        assert clearance.least_m((0.0, -1.0, 0.0), None, angles) <= 1.0 - reach_m + 1e-9


def test_an_arm_that_leaves_the_plane_is_a_ball_about_its_shoulder() -> None:
    yaw = ["vehicle.arm.joints[0].axis=[0, 0, 1]"]
    vehicle = load_vehicle("tarot650_2r", [*overrides_with_joints(2), *yaw])
    shoulder, reach_m = vehicle.arm.shoulder_body_m, vehicle.arm.reach_m + vehicle.tip_radius_m
    away = (0.0, reach_m + 0.2, shoulder[2])
    outside = Clearance(vehicle, tether_of(vehicle).model_copy(update={"attachment_body_m": away}))
    assert outside.judges_arm
    assert outside.least_m((0.0, -1.0, 0.0), None, (1.0, 0.5)) == pytest.approx(-reach_m)
    inside = tether_of(vehicle).model_copy(update={"attachment_body_m": (0.0, 0.9 * reach_m, shoulder[2])})
    assert not Clearance(vehicle, inside).judges_arm


def test_without_an_arm_the_tether_is_judged_by_the_rotors_alone() -> None:
    vehicle = vehicle_with_joints(0)
    tether = tether_of(vehicle).model_copy(update={"attachment_body_m": (1.0, 0.6, -0.05)})
    assert not Clearance(vehicle, tether).judges_arm
