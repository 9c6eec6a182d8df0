"""A known weight on the net tells how the sensor lies and what its scale is; drift with its error."""

from __future__ import annotations

import math

import numpy as np
import pytest

from companion.commissioning.force_torque import fit as ft_fit
from companion.commissioning.force_torque.fit import WeightFit
from companion.config.loader import load_vehicle
from companion.model.frames import quat_conjugate, quat_from_euler_zyx, quat_multiply, quat_rotate
from companion.model.types import ForceSample, Joints, Quat, Vec3
from companion.preflight import force as preflight
from companion.preflight.axes import IDENTITY, ROTATIONS, AxisMap
from tests.machines import overrides_with_joints
from tests.support import ROOT

VEHICLE = load_vehicle(ROOT / "configs/vehicles/tarot650_2r.yaml")
WEIGHT_KG = 0.5
FOLDED: Joints = (math.radians(165.0), math.radians(140.0))
HANGING: Joints = (math.radians(90.0), 0.0)
TURNS = sorted(ROTATIONS, key=lambda turn: turn.names)


def quat_of(rpy_deg: Vec3) -> Quat:
    roll, pitch, yaw = (math.radians(angle) for angle in rpy_deg)
    return quat_from_euler_zyx(roll, pitch, yaw)


def fitted(
    truth: Quat,
    sensor_rpy_deg: Vec3 = (0.0, 0.0, 0.0),
    *,
    arm_rad: Joints = FOLDED,
    scale: float = 1.0,
    off_n: Vec3 = (0.0, 0.0, 0.0),
) -> WeightFit:
    """Fit the readings of a sensor that has a bias and is mounted as `truth`; the vehicle file says `sensor_rpy_deg`."""
    x, y, z = quat_rotate(quat_conjugate(truth), ft_fit.down_at_tip(VEHICLE, arm_rad))
    n = scale * 9.81 * WEIGHT_KG
    loaded_n = (1.0 + n * x + off_n[0], -2.0 + n * y + off_n[1], 30.0 + n * z + off_n[2])
    return ft_fit.fit_weight(
        (1.0, -2.0, 30.0), loaded_n, ft_fit.down_at_tip(VEHICLE, arm_rad), WEIGHT_KG, sensor_rpy_deg
    )


@pytest.mark.parametrize("rpy_deg", [[0, 0, 0], [90, 0, -30]])
@pytest.mark.parametrize("arm_rad", [(1.9,), (1.3, -0.1), (1.3, -0.1, 0.4, 0.9)])
def test_down_at_the_tip_is_along_the_last_link_as_far_as_that_points_down(
    arm_rad: Joints, rpy_deg: list[float]
) -> None:
    """The elevation of the last link is the joint angles' sum, of which all but the first turn up."""
    overrides = [*overrides_with_joints(len(arm_rad)), f"vehicle.tool.sensor_rpy_deg={rpy_deg}"]
    below_rad = arm_rad[0] - sum(arm_rad[1:])
    down = ft_fit.down_at_tip(load_vehicle("tarot650_2r", overrides), arm_rad)
    assert down == pytest.approx((math.sin(below_rad), 0.0, -math.cos(below_rad)), abs=1e-12)


@pytest.mark.parametrize("mounted_deg", [(0.0, 0.0, 0.0), (180.0, 0.0, 45.0)])
@pytest.mark.parametrize("turn", TURNS, ids=lambda turn: ",".join(turn.names))
def test_every_right_angle_turn_is_found(turn: AxisMap, mounted_deg: Vec3) -> None:
    truth = quat_multiply(quat_of(mounted_deg), turn.inverse.quat)
    fit = fitted(truth, mounted_deg, off_n=(0.05, -0.05, 0.05))
    assert fit.rest_deg < 3.0
    assert fit.scale == pytest.approx(1.0, abs=0.03)
    if fit.others:
        assert ft_fit.changes(fit) == {}
        return
    assert fit.turn == turn
    assert abs(sum(a * b for a, b in zip(quat_of(fit.rpy_deg), truth, strict=True))) == pytest.approx(1.0, abs=1e-6)


def test_most_turns_are_certain_in_the_folded_pose() -> None:
    assert all(not fitted(turn.inverse.quat).others for turn in TURNS)


def test_a_turned_sensor_is_a_patch_and_a_right_one_none() -> None:
    turned = fitted(quat_of((0.0, 0.0, 90.0)))
    assert ft_fit.changes(turned) == {("tool", "sensor_rpy_deg"): [0.0, 0.0, 90.0]}
    right = fitted(quat_of((0.0, 0.0, 90.0)), (0.0, 0.0, 90.0))
    assert ft_fit.changes(right) == {}
    assert right.turn == IDENTITY
    assert all(row.ok for row in ft_fit.rows(right))


def test_with_the_arm_straight_down_the_turn_about_the_link_is_reported_as_unknown() -> None:
    """A turn about the link is invisible there: the configured one is kept, with a warning."""
    seen = fitted(quat_of((90.0, 0.0, 0.0)), arm_rad=HANGING)
    assert len(seen.others) == 3
    assert [row.id for row in ft_fit.rows(seen) if not row.ok] == ["ft.pose"]
    hidden = fitted(quat_of((0.0, 90.0, 0.0)), arm_rad=HANGING)
    assert ft_fit.changes(hidden) == {}
    assert {row.id for row in ft_fit.rows(hidden) if not row.ok} == {"ft.pose", "ft.direction"}


@pytest.mark.parametrize("scale", [0.9, 2.0])
def test_a_wrong_scale_is_reported_as_such_and_not_as_a_turned_sensor(scale: float) -> None:
    fit = fitted(quat_of((0.0, 0.0, 0.0)), scale=scale)
    assert fit.scale == pytest.approx(scale)
    assert [row.id for row in ft_fit.rows(fit) if not row.ok] == ["ft.scale"]
    assert ft_fit.changes(fit) == {}


def test_a_weight_that_touches_something_is_not_reported_as_a_turned_sensor() -> None:
    fit = fitted(quat_of((0.0, 0.0, 0.0)), off_n=(3.0, 3.0, 0.0))
    assert ft_fit.changes(fit) == {}
    assert "ft.direction" in [row.id for row in ft_fit.rows(fit) if not row.ok]


def stream(force_n: np.ndarray, rate_hz: float = 200.0) -> list[ForceSample]:
    return [
        ForceSample(
            stamp_s=5.0 + k / rate_hz,
            force_sensor_n=(float(x), float(y), float(z)),
            torque_sensor_nm=(0.0, 0.0, 0.0),
            overload=False,
        )
        for k, (x, y, z) in enumerate(force_n)
    ]


def test_drift_is_reported_with_its_error() -> None:
    rng = np.random.default_rng(4)
    t = np.arange(0.0, 60.0, 0.005)
    force = rng.normal(0.0, 0.05, (len(t), 3)) + np.outer(t, (0.5 / 60.0, 0.0, -1.0 / 60.0))
    x, y, z = ft_fit.drift(stream(force))
    for axis, truth in ((x, 0.5), (y, 0.0), (z, -1.0)):
        assert abs(axis.per_minute_n - truth) < 5.0 * axis.standard_error_n
        assert 0.0 < axis.standard_error_n < 0.01
        assert axis.noise_n == pytest.approx(0.05, rel=0.05)


def test_a_sensor_that_repeats_itself_is_stuck() -> None:
    rng = np.random.default_rng(4)
    alive = rng.normal(0.0, 0.05, (600, 3))
    assert preflight.stuck_row(stream(alive), VEHICLE).ok
    alive[200:320] = alive[200]
    row = preflight.stuck_row(stream(alive), VEHICLE)
    assert not row.ok
    assert "0.59 s" in row.read or "0.60 s" in row.read


def test_drift_is_computed_from_samples_that_arrive_in_one_burst() -> None:
    """A computer that was held up delivers most samples of a second at once; the line is defined all the same."""
    t = np.arange(0.0, 1.21, 0.01)
    samples = stream(np.column_stack((30.0 + t, 0.0 * t, 0.0 * t)), rate_hz=100.0)
    x, y, _ = ft_fit.drift([*samples[:30], samples[120]])
    assert x.per_minute_n == pytest.approx(60.0, rel=1e-6)
    assert y.per_minute_n == 0.0 and math.isfinite(x.standard_error_n)
