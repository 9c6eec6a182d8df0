"""The gate: what never leaves, and what leaves cut."""

from __future__ import annotations

import math

import pytest
from hypothesis import given
from hypothesis import strategies as st

from companion.config.loader import load_vehicle
from companion.config.vehicle import Vehicle
from companion.model.frames import quat_from_euler_zyx, tilt_rad
from companion.model.types import AttitudeSetpoint, Joints
from companion.safety.gate import Gate

NAN = math.nan
LEVEL = quat_from_euler_zyx(0, 0, 0.4)
VEHICLE = load_vehicle("configs/vehicles/tarot650_2r.yaml")


@pytest.fixture
def vehicle() -> Vehicle:
    return VEHICLE


@pytest.mark.parametrize(
    ("bad", "kind"),
    [
        (AttitudeSetpoint((NAN, 0.0, 0.0, 1.0), 0.5), "setpoint not finite"),
        (AttitudeSetpoint(LEVEL, math.inf), "setpoint not finite"),
        (AttitudeSetpoint((0.9, 0.0, 0.0, 0.0), 0.5), "no rotation"),
        (AttitudeSetpoint((1.01, 0.0, 0.0, 0.0), 0.5), "no rotation"),
        (AttitudeSetpoint((0.0, 0.0, 0.0, 0.0), 0.5), "no rotation"),
        (AttitudeSetpoint(LEVEL, 1.0001), "thrust"),
        (AttitudeSetpoint(LEVEL, -0.0001), "thrust"),
        (AttitudeSetpoint((0.0, 1.0, 0.0, 0.0), 0.5), "tilt"),
        (AttitudeSetpoint(quat_from_euler_zyx(0.0, math.radians(25.1), 0.0), 0.5), "tilt"),
        (AttitudeSetpoint(quat_from_euler_zyx(math.radians(-20.1), 0.0, 1.0), 0.5), "tilt"),
    ],
)
def test_a_bad_attitude_setpoint_never_leaves_and_is_named(vehicle: Vehicle, bad: AttitudeSetpoint, kind: str) -> None:
    verdict = Gate(vehicle).check(bad, None, None, False)
    assert verdict.attitude is None
    assert [refusal.kind for refusal in verdict.refused] == [kind]


def test_a_good_setpoint_leaves_as_it_is(vehicle: Vehicle) -> None:
    good = AttitudeSetpoint(quat_from_euler_zyx(0.1, -0.1, 2.0), 0.5)
    verdict = Gate(vehicle).check(good, (0.3, -0.2), (2.0, 1.0), True)
    assert verdict.attitude == good
    assert verdict.arm_torque_nm == (0.3, -0.2)
    assert not verdict.refused


@pytest.mark.parametrize(
    ("torque", "angle", "fresh", "limp"),
    [
        ((NAN, 0.0), (2.0, 1.0), True, True),
        ((0.0, math.inf), (2.0, 1.0), True, True),
        ((0.5,), (2.0, 1.0), True, True),
        ((0.5, 0.5), None, True, False),
        ((0.5, 0.5), (2.0, 1.0), False, False),
    ],
)
def test_unusable_torques_leave_the_arm_limp_and_a_stale_joint_state_does_not(
    torque: Joints, angle: Joints | None, fresh: bool, limp: bool
) -> None:
    verdict = Gate(VEHICLE).check(None, torque, angle, fresh)
    assert verdict.arm_torque_nm is None
    assert [refusal.limp for refusal in verdict.refused] == [limp]


@pytest.mark.parametrize(
    ("torque", "angle", "leaves"),
    [
        ((99.0, -99.0), (2.0, 1.0), (2.5, -2.5)),
        ((1.0, 1.0), (math.radians(176), 1.0), (0.0, 1.0)),  # past the upper wall of joint 1
        ((-1.0, 1.0), (math.radians(176), 1.0), (-1.0, 1.0)),
        ((0.2, -1.0), (2.0, math.radians(-11)), (0.2, 0.0)),  # past the lower wall of joint 2
    ],
)
def test_joint_torques(vehicle: Vehicle, torque: Joints, angle: Joints, leaves: Joints) -> None:
    assert Gate(vehicle).check(None, torque, angle, True).arm_torque_nm == leaves


@pytest.mark.parametrize(
    ("torque", "rate_deg_s", "leaves"),
    [
        ((1.0, 1.0), (301.0, 0.0), (0.0, 1.0)),
        ((-1.0, 1.0), (301.0, 0.0), (-1.0, 1.0)),
        ((1.0, -1.0), (0.0, -301.0), (1.0, 0.0)),
        ((1.0, 1.0), (299.0, -299.0), (1.0, 1.0)),
    ],
)
def test_a_joint_that_is_too_fast_is_only_braked(
    vehicle: Vehicle, torque: Joints, rate_deg_s: Joints, leaves: Joints
) -> None:
    rate: Joints = (math.radians(rate_deg_s[0]), math.radians(rate_deg_s[1]))
    assert Gate(vehicle).check(None, torque, (2.0, 1.0), True, arm_rate_rad_s=rate).arm_torque_nm == leaves


def test_no_torque_asks_for_more_than_the_current_limit() -> None:
    safety = VEHICLE.safety.model_copy(update={"servo_current_max_a": 1.0})
    gate = Gate(VEHICLE.model_copy(update={"safety": safety}))
    assert gate.check(None, (2.0, -2.0), (2.0, 1.0), True).arm_torque_nm == (1.3, -1.3)  # 1.3 N m/A


def test_a_setpoint_from_an_old_state_does_not_leave(vehicle: Vehicle) -> None:
    good = AttitudeSetpoint(LEVEL, 0.5)
    assert Gate(vehicle).check(good, None, None, False, state_age_s=0.1).attitude == good
    old = Gate(vehicle).check(good, None, None, False, state_age_s=0.101)
    assert old.attitude is None
    assert [refusal.kind for refusal in old.refused] == ["stale state"]
    assert Gate(vehicle).check(good, None, None, False, state_age_s=NAN).attitude is None


@pytest.mark.parametrize(("before", "asked", "sent"), [(0.1, 0.9, 0.6), (0.9, 0.1, 0.4)])
def test_thrust_changes_no_faster_than_it_may(before: float, asked: float, sent: float) -> None:
    gate = Gate(VEHICLE)
    gate.check(AttitudeSetpoint(LEVEL, before), None, None, False, t_s=1.0)
    cut = gate.check(AttitudeSetpoint(LEVEL, asked), None, None, False, t_s=1.005)
    assert cut.attitude is not None
    assert cut.attitude.thrust == pytest.approx(sent)  # 100 /s
    assert [refusal.kind for refusal in cut.refused] == ["thrust slew"]
    free = gate.check(AttitudeSetpoint(LEVEL, asked), None, None, False, t_s=1.01)
    assert free.attitude is not None and free.attitude.thrust == asked
    assert not free.refused


def test_after_a_silence_the_first_thrust_may_be_any() -> None:
    gate = Gate(VEHICLE)
    gate.check(AttitudeSetpoint(LEVEL, 0.9), None, None, False, t_s=1.0)
    free = gate.check(AttitudeSetpoint(LEVEL, 0.0), None, None, False, t_s=1.2)
    assert free.attitude is not None and free.attitude.thrust == 0.0


number = st.floats(allow_nan=True, allow_infinity=True, width=32)


@given(
    st.lists(
        st.tuples(number, number, number, number, number, number, number, number, number, st.floats(0.0, 0.3)),
        max_size=6,
    )
)
def test_the_gate_passes_only_commands_within_limits(rows: list[tuple[float, ...]]) -> None:
    gate, t_s, last = Gate(VEHICLE), 1.0, None
    for w, x, y, z, thrust, first, second, angle, rate, pause_s in rows:
        t_s += pause_s
        verdict = gate.check(
            AttitudeSetpoint((w, x, y, z), thrust),
            (first, second),
            (angle, angle),
            True,
            t_s=t_s,
            arm_rate_rad_s=(rate, rate),
        )
        if verdict.attitude is not None:
            sent = verdict.attitude
            assert all(map(math.isfinite, (*sent.attitude_wxyz, sent.thrust)))
            assert 0.0 <= sent.thrust <= 1.0
            assert tilt_rad(sent.attitude_wxyz) <= math.radians(VEHICLE.airframe.tilt_max_deg) + 1e-3
            if last is not None and t_s - last[0] <= 0.1:
                assert abs(sent.thrust - last[1]) <= 100.0 * (t_s - last[0]) + 1e-9
            last = (t_s, sent.thrust)
        if verdict.arm_torque_nm is not None:
            assert all(math.isfinite(torque) and abs(torque) <= 2.5 for torque in verdict.arm_torque_nm)
