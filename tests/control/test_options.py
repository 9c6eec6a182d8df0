"""The options beyond the paper: each adds what its formula says, and nothing where it is off."""

from __future__ import annotations

import math
from typing import Any

import pytest
from msgspec.structs import replace

from companion.config.controller import AdaptiveConfig
from companion.config.loader import FlightConfig, load_flight
from companion.control.adaptive import AdaptiveController
from companion.control.common import Actuation
from companion.control.disturbance import DisturbanceObserver
from companion.model.types import Joints, Reference, Vec3
from tests.control.states import at, at_rest

POSE: Joints = (math.radians(100), math.radians(60))
ZERO: Vec3 = (0.0, 0.0, 0.0)
OFF: dict[str, Any] = {
    "disturbance_time_xyz_s": ZERO,
    "feedforward_lead_s": 0.0,
    "arm_inertia_nominal": False,
    "arm_friction_share": 0.0,
}


@pytest.fixture(scope="module")
def config() -> FlightConfig:
    return load_flight("configs/missions/catch.yaml", preset="recommended")


def tau(config: FlightConfig, option: dict[str, Any], reference: Reference, rate: Joints = (0.0, 0.0)) -> list[float]:
    assert isinstance(config.controller, AdaptiveConfig)
    controller = AdaptiveController(config.controller.model_copy(update=OFF | option), config.vehicle, 0.49)
    state = at(arm_rate=rate)
    return list(controller.step(0.005, state, reference, 1.0).log.tau)


def difference(
    config: FlightConfig, option: dict[str, Any], reference: Reference, rate: Joints = (0.0, 0.0)
) -> list[float]:
    with_it, without = tau(config, option, reference, rate), tau(config, {}, reference, rate)
    return [a - b for a, b in zip(with_it, without, strict=True)]


def test_the_lead_adds_mass_times_jerk_times_lead_and_only_sideways(config: FlightConfig) -> None:
    reference = replace(at_rest((0.0, 0.0, 1.0), 0.0, POSE), jerk_world_m_s3=(2.0, -1.0, 3.0))
    added = difference(config, {"feedforward_lead_s": 0.15}, reference)
    assert added[:3] == pytest.approx([3.0 * 0.15 * 2.0, -3.0 * 0.15 * 1.0, 0.0])
    assert added[6:] == [0.0, 0.0]


def test_friction_follows_the_rate_that_is_wanted_not_the_one_that_is_measured(config: FlightConfig) -> None:
    option = {"arm_friction_share": 1.0}
    friction_nm = config.vehicle.arm.joint_friction_nm
    moving = replace(at_rest((0.0, 0.0, 1.0), 0.0, POSE), arm_rate_rad_s=(1.0, -1.0))
    added = difference(config, option, moving)
    assert added[6:] == pytest.approx([friction_nm, -friction_nm], rel=1e-3)
    resting = at_rest((0.0, 0.0, 1.0), 0.0, POSE)
    assert difference(config, option, resting, rate=(1.0, -1.0))[6:] == pytest.approx([0.0, 0.0], abs=1e-12)


def test_the_observer_finds_a_steady_force_whatever_is_asked_for() -> None:
    observer = DisturbanceObserver(3.0, (0.5, 0.5, 0.0), 0.1, 6.0)
    push, lagged = 1.5, 0.0
    for tick in range(1200):
        asked = 4.0 * math.sin(0.01 * tick)
        found = observer.step(0.005, (asked, 0.0, 0.0), ((lagged + push) / 3.0, 0.0, 5.0), learn=True)
        lagged += (1.0 - math.exp(-0.005 / 0.1)) * (asked - lagged)
    assert found == pytest.approx((push, 0.0, 0.0), abs=0.15)
    observer.reset()
    assert observer.force_n == ZERO


def test_the_observer_is_bounded_and_freezes_on_request() -> None:
    observer = DisturbanceObserver(3.0, (0.1, 0.1, 0.1), 0.0, 2.0)
    for _ in range(500):
        observer.step(0.005, ZERO, (10.0, -10.0, 0.1), learn=True)
    assert observer.force_n == pytest.approx((2.0, -2.0, 0.3), abs=1e-3)
    before = observer.force_n
    observer.step(0.005, ZERO, (-50.0, 50.0, 9.0), learn=False)
    assert observer.force_n == before


@pytest.mark.parametrize(
    ("known_n", "acceleration"),
    [((math.nan, 0.0, 0.0), ZERO), (ZERO, (0.0, math.nan, 0.0)), (ZERO, (0.0, 0.0, math.inf))],
)
def test_values_that_are_not_finite_leave_the_observer_unchanged(known_n: Vec3, acceleration: Vec3) -> None:
    observer = DisturbanceObserver(3.0, (0.1, 0.1, 0.1), 0.05, 100.0)
    before = [observer.step(0.005, ZERO, (1.0, 0.0, 0.0), learn=True) for _ in range(200)][-1]
    assert observer.step(0.005, known_n, acceleration, learn=True) == before
    assert observer.step(0.005, ZERO, (1.0, 0.0, 0.0), learn=True) == pytest.approx(before, abs=1e-3)


def test_a_force_that_the_base_gives_way_to_is_not_observed_away(config: FlightConfig) -> None:
    """With base rows on, a pushed base that moves as its impedance says is not disturbed; without them the same push is."""
    assert isinstance(config.controller, AdaptiveConfig)
    found = []
    for compliance in ((0.0, 0.0, 0.0), (1.0, 1.0, 1.0)):
        law = config.controller.model_copy(
            update={"base_compliance_xyz": compliance, "disturbance_time_xyz_s": (0.65, 0.65, 0.8)}
        )
        controller = AdaptiveController(law, config.vehicle, 0.49)
        for _ in range(400):
            state = at(acceleration=(2.0 / 3.0, 0.0, 0.0), force=(2.0, 0.0, 0.0))
            reference = at_rest((0.0, 0.0, 1.0), 0.0, POSE)
            controller.step(0.005, state, reference, 1.0)
        found.append(controller._compensation._observer.force_n[0])
    without, with_rows = found
    assert without - with_rows > 1.0


@pytest.mark.parametrize(("torque_nm", "sent_nm"), [(9.0, 2.5), (-9.0, -2.5), (math.nan, math.nan)])
def test_a_torque_that_is_not_a_number_does_not_become_the_largest_one(
    config: FlightConfig, torque_nm: float, sent_nm: float
) -> None:
    assert isinstance(config.controller, AdaptiveConfig)
    actuation = Actuation(config.controller, config.vehicle, 0.49)
    actuation.step(0.005, (0.0, 0.0, 29.4), (0.1, torque_nm), (0.0, 0.0, 1.0), 0.0, 1.0)
    assert actuation.arm_torque_nm == pytest.approx((0.1, sent_nm), nan_ok=True)
