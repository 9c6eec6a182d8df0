"""The fit tells what was put in, within the errors that it claims, and says when the data cannot tell."""

from __future__ import annotations

import math
from collections.abc import Iterator
from dataclasses import replace

import numpy as np
import pytest

from companion.commissioning.arm.friction import FrictionFit, JointFit, fit
from companion.commissioning.arm.sweep import REACH_DEG, SPEEDS_DEG_S, Sample
from companion.config.loader import load_vehicle
from companion.config.vehicle import Vehicle
from companion.control.arm_model import manipulator_of
from companion.model.types import IDENTITY_QUAT, Joints
from tests.commissioning.arm_rig import SHIPPED

RATE_HZ = 200.0
HANGING_DEG = (90.0, 0.0)


@pytest.fixture(scope="module")
def vehicle() -> Vehicle:
    return load_vehicle(SHIPPED)


def swept(
    vehicle: Vehicle,
    seed: int = 1,
    *,
    k: tuple[float, float] = (1.3, 1.3),
    dry_nm: float = 0.04,
    viscous_nms: float = 0.02,
    off_deg: float = 0.0,
    noise_a: float = 0.01,
    reach: float = 1.0,
) -> list[Sample]:
    """What the sweeps of an arm with these properties give; noise that wanders, as a control loop's does."""
    rng = np.random.default_rng(seed)
    manipulator = manipulator_of(vehicle)

    def leg(number: int, joint: int, begin_deg: float, end_deg: float, speed_deg_s: float) -> Iterator[Sample]:
        way = math.copysign(1.0, end_deg - begin_deg)
        rate, wander = math.radians(way * speed_deg_s), 0.0
        for tick in range(int(abs(end_deg - begin_deg) / speed_deg_s * RATE_HZ)):
            angle = [math.radians(deg) for deg in HANGING_DEG]
            angle[joint] = math.radians(begin_deg) + rate * tick / RATE_HZ
            true: Joints = (angle[0] + math.radians(off_deg), angle[1])
            gravity = manipulator.gravity_torque_nm(true, IDENTITY_QUAT)[joint]
            wander = 0.97 * wander + math.sqrt(1.0 - 0.97**2) * noise_a * rng.standard_normal()
            current = (gravity + way * dry_nm + viscous_nms * rate) / k[joint] + wander
            yield Sample(
                leg=number,
                joint=joint,
                direction=int(way),
                t_s=100.0 * number + tick / RATE_HZ,
                angle_rad=(angle[0], angle[1]),
                velocity_rad_s=rate,
                current_a=round(current / 2.69e-3) * 2.69e-3,
            )

    samples: list[Sample] = []
    for joint in (0, 1):
        low, high = (HANGING_DEG[joint] + reach * deg for deg in REACH_DEG[joint])
        for speed in SPEEDS_DEG_S:
            for begin, end in ((low, high), (high, low)):
                samples += leg(len({one.leg for one in samples}), joint, begin, end, speed)
    return samples


def both(found: FrictionFit) -> list[JointFit]:
    fits = [one for one in found.joints if one is not None]
    assert len(fits) == 2
    return fits


@pytest.mark.parametrize("off_deg", [0.0, 1.5])
def test_the_true_values_are_found_within_the_errors_claimed(vehicle: Vehicle, off_deg: float) -> None:
    beyond = 0
    for seed in range(4):
        found = fit(swept(vehicle, seed, k=(1.15, 1.15), dry_nm=0.08, viscous_nms=0.05, off_deg=off_deg), vehicle)
        assert found.torque_per_amp_nm_a is not None and found.joint_friction_nm is not None
        assert found.torque_per_amp_nm_a.value == pytest.approx(1.15, rel=0.03)
        assert found.joint_friction_nm.value == pytest.approx(0.08, abs=0.01)
        for one in both(found):
            for estimate, truth in ((one.torque_per_amp_nm_a, 1.15), (one.dry_nm, 0.08), (one.viscous_nms, 0.05)):
                beyond += abs(estimate.value - truth) > 2.0 * estimate.standard_error
        changes = found.changes(vehicle)
        assert changes.keys() == {("arm", "torque_per_amp_nm_a"), ("arm", "joint_friction_nm")}
    assert beyond <= 0.15 * 24, "two standard errors hold 95 % of what is reported; the noise wanders"


def test_an_arm_that_is_touched_now_and_then_is_measured_all_the_same(vehicle: Vehicle) -> None:
    """A push of 0.65 N m for 0.4 s in every sweep; without robust weights the fit does not determine the friction."""
    samples = swept(vehicle, dry_nm=0.08)
    begins = {one.leg: one.t_s for one in reversed(samples)}
    touched = [
        replace(one, current_a=one.current_a + 0.5) if 0.5 < one.t_s - begins[one.leg] < 0.9 else one for one in samples
    ]
    found = fit(touched, vehicle)
    assert found.torque_per_amp_nm_a is not None and found.joint_friction_nm is not None, found.notes
    assert found.torque_per_amp_nm_a.value == pytest.approx(1.3, rel=0.03)
    assert found.joint_friction_nm.value == pytest.approx(0.08, abs=0.01)


def test_an_arm_as_in_the_file_needs_no_change(vehicle: Vehicle) -> None:
    for seed in range(3):
        found = fit(swept(vehicle, seed), vehicle)
        assert found.changes(vehicle) == {} and found.notes == ()


def test_a_sweep_without_change_of_gravity_does_not_determine_the_constant(vehicle: Vehicle) -> None:
    found = fit(swept(vehicle, reach=0.1, noise_a=0.03), vehicle)
    assert found.torque_per_amp_nm_a is None
    assert ("arm", "torque_per_amp_nm_a") not in found.changes(vehicle)
    assert any("do not determine the torque constant" in note for note in found.notes)


def test_noise_that_hides_the_friction_is_reported(vehicle: Vehicle) -> None:
    found = fit(swept(vehicle, noise_a=0.3), vehicle)
    assert found.joint_friction_nm is None and found.changes(vehicle) == {}
    assert sum("do not determine the dry friction" in note for note in found.notes) == 2


def test_too_few_samples_determine_nothing(vehicle: Vehicle) -> None:
    found = fit(swept(vehicle)[:50], vehicle)
    assert found.joints == (None, None)
    assert (found.torque_per_amp_nm_a, found.joint_friction_nm) == (None, None)
    assert len(found.notes) == 2 and found.changes(vehicle) == {}


def test_constants_that_differ_point_at_the_masses(vehicle: Vehicle) -> None:
    found = fit(swept(vehicle, k=(1.3, 1.0)), vehicle)
    assert any("torque constants differ" in note for note in found.notes)


def test_a_constant_of_no_such_servo_is_not_proposed(vehicle: Vehicle) -> None:
    found = fit(swept(vehicle, k=(3.0, 3.0)), vehicle)
    assert found.torque_per_amp_nm_a is None
    assert any("implausible for an XM430-W210" in note for note in found.notes)


def test_each_model_of_servo_has_a_constant_of_its_own() -> None:
    names = [f"vehicle.arm.joints[0].{key}" for key in ("servo=XM540-W270", "velocity_max_deg_s=180")]
    mixed = load_vehicle(SHIPPED, [*names, "vehicle.arm.torque_per_amp_nm_a=null"])
    found = fit(swept(mixed, k=(2.2, 1.3)), mixed)
    first, second = found.torque_constants_nm_a
    assert first is not None and second is not None and found.torque_per_amp_nm_a is None
    assert (first.value, second.value) == pytest.approx((2.2, 1.3), rel=0.03)
    assert found.changes(mixed).keys() == {("arm", "joints", 0, "torque_per_amp_nm_a")} and found.notes == ()


def test_a_machine_that_is_not_level_is_reported(vehicle: Vehicle) -> None:
    found = fit(swept(vehicle, off_deg=6.0, noise_a=0.003), vehicle)
    assert any("gravity acts as if the arm were turned" in note for note in found.notes)
