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
from tests.machines import vehicle_with_joints
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
    events = watched(vehicle, ticks(vehicle, **{field: value}), flying())
    texts = [event.text for event in events if event.id == rule]
    assert texts and text.format(count) in texts[0]


@pytest.mark.parametrize("count", [0, *COUNTS])
def test_a_healthy_arm_and_the_absence_of_one_raise_no_event(count: int) -> None:
    vehicle = vehicle_with_joints(count)
    for context in (flying(), standing()):
        assert [event for event in watched(vehicle, ticks(vehicle), context) if "force" not in event.id] == []


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


@pytest.mark.parametrize("torque", [(), (9.0,), (0.1,), (0.1, 0.1, 0.1), (9.0, 0.1, 0.1)])
def test_another_number_of_torques_than_joints_does_not_leave(torque: tuple[float, ...]) -> None:
    vehicle = vehicle_with_joints(2)
    verdict = Gate(vehicle).check(None, torque, in_the_middle(vehicle), True, arm_rate_rad_s=(0.0, 0.0))
    assert verdict.arm_torque_nm is None
    assert [refusal.text for refusal in verdict.refused] == [f"{len(torque)} joint torques for 2 joints"]


def test_a_joint_whose_current_is_limited_is_overloaded_at_the_torque_of_that_current() -> None:
    vehicle = load_vehicle("tarot650_2r", ["vehicle.safety.servo_current_max_a=1.0"])  # 1.3 N m/A
    for torque_nm, overloaded in ((1.25, False), (1.29, True)):
        events = watched(vehicle, ticks(vehicle, torque_nm=torque_nm), flying())
        assert ("servo_overload" in {event.id for event in events}) is overloaded


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


def test_the_reach_of_links_that_lie_on_each_other_at_angle_0_is_not_underestimated() -> None:
    """Link 2 points back to the shoulder at angle 0, so that the arm is stretched at 180 deg."""
    inertia = "mass_kg: 0.1, com_m: [0, 0, 0], inertia_kg_m2: [1.0e-4, 1.0e-4, 1.0e-4, 0, 0, 0]"
    links = (
        f"[{{origin_m: [0, 0, 0], axis: [0, 1, 0], {inertia}}}, {{origin_m: [0.2, 0, 0], axis: [0, 1, 0], {inertia}}}]"
    )
    rods = [f"vehicle.arm.{key}=[]" for key in ("link_lengths_m", "link_masses_kg", "link_com_m")]
    vehicle = load_vehicle("tarot650_2r", [*rods, f"vehicle.arm.links={links}", "vehicle.arm.tip_m=[-0.2, 0, 0]"])
    clearance = Clearance(vehicle, tether_of(vehicle).model_copy(update={"attachment_body_m": (1.0, 0.6, 0.0)}))
    net_m = manipulator_of(vehicle).net_body_m((0.0, math.pi))
    assert math.dist((0.0, 0.0, 0.0), net_m) == pytest.approx(0.4)
    assert clearance.least_m((0.0, -1.0, 0.0), None, (0.0, math.pi)) <= 1.0 - 0.4 - vehicle.tip_radius_m + 1e-9


def test_without_an_arm_the_tether_is_judged_by_the_rotors_alone() -> None:
    vehicle = vehicle_with_joints(0)
    tether = tether_of(vehicle).model_copy(update={"attachment_body_m": (1.0, 0.6, -0.05)})
    assert not Clearance(vehicle, tether).judges_arm
