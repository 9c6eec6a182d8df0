"""The servos of a vehicle file: limits of the model, and the torque constants of an arm with several models."""

from __future__ import annotations

import pytest

from companion.config.document import ConfigError
from companion.config.loader import load_vehicle
from companion.safety.gate import Gate
from tests.commissioning.arm_rig import SHIPPED

XM540 = ("vehicle.arm.joints[0].servo=XM540-W270", "vehicle.arm.joints[0].velocity_max_deg_s=180")
NO_CONSTANT = "vehicle.arm.torque_per_amp_nm_a=null"


@pytest.mark.parametrize(
    ("overrides", "text"),
    [
        (("vehicle.arm.joints[0].torque_max_nm=3.1",), "the XM430-W210 stalls at 3 N m, got 3.1 N m"),
        (
            ("vehicle.arm.joints[0].angle_deg=[-180, 180]",),
            "joints[0].angle_deg: expected less than 360 deg between the limits, got 360 deg: the servo loses its turns when it is "
            "switched off",
        ),
        (("vehicle.arm.joints[1].velocity_max_deg_s=571",), "the XM430-W210 turns at most at 570 deg/s, got 571 deg/s"),
        (
            ("vehicle.safety.joint_rate_max_deg_s=300",),
            "expected more than 300 deg/s, the largest planned speed of a joint",
        ),
        (XM540[:1], "the XM540-W270 turns at most at 222 deg/s, got 300 deg/s"),
        (XM540, "one torque constant cannot hold for XM540-W270 and XM430-W210"),
        (("vehicle.arm.joints[0].servo=XL430-W250",), "the XL430-W250 has no current control (operating mode 0)"),
        (("vehicle.arm.joints[0].servo=AX-12",), 'expected one of 14 names ("XM430-W210",'),
        (
            ("vehicle.safety.servo_max_c=80",),
            "expected less than 80 degC, at which the XM430-W210 switches its torque off",
        ),
    ],
)
def test_a_servo_that_does_not_suffice_is_refused_in_one_line(overrides: tuple[str, ...], text: str) -> None:
    with pytest.raises(ConfigError) as caught:
        load_vehicle(SHIPPED, overrides)
    (line,) = str(caught.value).splitlines()
    assert text in line


def test_the_torque_constant_is_that_of_the_joint_the_arm_or_the_model() -> None:
    assert load_vehicle(SHIPPED).arm.torque_constants_nm_a == (1.3, 1.3)
    two_models = load_vehicle(SHIPPED, [*XM540, NO_CONSTANT, "vehicle.arm.joints[1].torque_per_amp_nm_a=1.2"])
    assert two_models.arm.torque_constants_nm_a == pytest.approx((10.6 / 4.4, 1.2))


def test_without_a_speed_limit_the_speed_of_a_slow_servo_is_planned() -> None:
    joints = (
        "vehicle.arm.joints=[{servo: %s, servo_id: 1, sign: 1, zero_count: 0, angle_deg: [60, 175], torque_max_nm: 2}]"
    )
    rest = [f"vehicle.arm.link_{key}=[0.1]" for key in ("lengths_m", "masses_kg", "com_m")]
    one = [*rest, "vehicle.safety.fold_arm_deg=[165]", "vehicle.arm.poses={}", NO_CONSTANT]
    for servo, speed_deg_s in (("XM540-W270", 222.0), ("XM430-W210", 300.0)):
        (joint,) = load_vehicle(SHIPPED, [joints % servo, *one]).arm.joints
        assert joint.velocity_max_deg_s == pytest.approx(speed_deg_s)


def test_another_motor_without_a_speed_limit_is_refused_in_one_line() -> None:
    joint = "{servo: null, servo_id: 1, sign: 1, zero_count: 0, angle_deg: [60, 175], torque_max_nm: 2}"
    with pytest.raises(ConfigError, match=r"velocity_max_deg_s: missing; required if servo is null"):
        load_vehicle(SHIPPED, [f"vehicle.arm.joints[0]={joint}"])


def test_the_gate_limits_the_current_of_each_servo_to_its_stall_current() -> None:
    strong, weak = "vehicle.arm.joints[0].torque_max_nm=10", "vehicle.arm.joints[1].torque_per_amp_nm_a=0.5"
    vehicle = load_vehicle(SHIPPED, [*XM540, NO_CONSTANT, strong, weak])
    sent = Gate(vehicle).check(None, (99.0, 99.0), (1.6, 0.0), True).arm_torque_nm
    assert sent == pytest.approx((10.0, 0.5 * 2.3))
