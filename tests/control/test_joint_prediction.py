"""Joint states that are late: what the commanded torques have changed since is added."""

from __future__ import annotations

import msgspec
import pytest

from companion.config.loader import load_vehicle
from companion.control.joint_prediction import AGE_MAX_S, JointPrediction
from companion.model.types import ArmState

VEHICLE = load_vehicle("configs/vehicles/tarot650_2r.yaml")
ARM = ArmState(
    stamp_s=0.0, angle_rad=(2.0, 1.0), velocity_rad_s=(0.1, -0.2), torque_nm=(0.5, 0.2), hardware_error=(0, 0),
    temperature_c=(35.0, 35.0), read_failures=0,
)  # fmt: skip
J = VEHICLE.arm.armatures_kg_m2[0]


def commanded(*torques_nm: tuple[float, float]) -> JointPrediction:
    """A command every 5 ms, the newest 5 ms before `NOW_S`."""
    prediction = JointPrediction(VEHICLE)
    for number, torque_nm in enumerate(torques_nm):
        prediction.sent(NOW_S - 0.005 * (len(torques_nm) - number), torque_nm)
    return prediction


NOW_S = 20.0
STEP = [(0.5, 0.0)] * 100 + [(0.7, 0.0), (0.7, 0.0)]


def measured(age_s: float) -> ArmState:
    return msgspec.structs.replace(ARM, stamp_s=NOW_S, asked_s=NOW_S - age_s)


def test_a_joint_state_of_this_moment_is_passed_on_unchanged() -> None:
    assert commanded(*STEP).now(NOW_S, measured(0.0)) == (ARM.angle_rad, ARM.velocity_rad_s)
    assert JointPrediction(VEHICLE).now(NOW_S, measured(0.01)) == (ARM.angle_rad, ARM.velocity_rad_s), "no command yet"


@pytest.mark.parametrize("age_s", [0.002, 0.005, 0.01])
def test_a_change_of_torque_since_the_measurement_turns_the_joint(age_s: float) -> None:
    angles, rates = commanded(*STEP).now(NOW_S, measured(age_s))
    turned = rates[0] - ARM.velocity_rad_s[0]
    # The mean follows the step within 50 ms, so that a little less than 0.2 N m counts.
    assert 0.8 * 0.2 * age_s / J < turned < 0.2 * age_s / J
    assert angles[0] - ARM.angle_rad[0] == pytest.approx((ARM.velocity_rad_s[0] + 0.5 * turned) * age_s)
    assert rates[1] == ARM.velocity_rad_s[1]


def test_a_lasting_load_turns_nothing() -> None:
    _, rates = commanded(*[(0.5, -0.3)] * 100).now(NOW_S, measured(0.01))
    assert rates == pytest.approx(ARM.velocity_rad_s, abs=1e-9)


def test_a_lost_arm_is_predicted_no_further_and_an_arm_without_torque_not_at_all() -> None:
    prediction = commanded(*STEP)
    _, longest = prediction.now(NOW_S, measured(AGE_MAX_S))
    assert prediction.now(NOW_S, measured(1.0))[1] == longest
    prediction.sent(NOW_S, None)
    assert prediction.now(NOW_S, measured(0.01))[1] == ARM.velocity_rad_s
