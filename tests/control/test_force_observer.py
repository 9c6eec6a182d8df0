"""The momentum observer: a known momentum gives a known force; no arm motion, gap or NaN does."""

from __future__ import annotations

import math
from collections.abc import Callable

import pytest

from companion.config.loader import load_vehicle
from companion.control.force_observer import MEAN_S, USED_MAX_N, ForceObserver
from companion.control.types import PlantState
from companion.model.constants import GRAVITY_M_S2
from companion.model.types import Joints, Vec3
from tests.control.states import POSE, ZERO, at
from tests.machines import ARMS, vehicle_with_joints

DT_S = 0.005
WEIGHT_N = 3.0 * GRAVITY_M_S2
HOVER: Vec3 = (0.0, 0.0, 0.0)
"""Rotor force and weight cancel."""


def state(acceleration: Vec3 = ZERO, arm: Joints = POSE) -> PlantState:
    return at(acceleration=acceleration, arm=arm, arm_rate=(0.0,) * len(arm), force=None)


class Run:
    """Steps an observer tick by tick."""

    def __init__(self, observer: ForceObserver | None = None) -> None:
        self.observer = observer or ForceObserver(load_vehicle("tarot650_2r", []))
        self.t_s = 0.0

    def step(self, found: PlantState, known_n: Vec3 = HOVER, contact: bool = False, later_s: float = DT_S) -> Vec3:
        self.t_s += later_s
        return self.observer.step(DT_S, known_n, found, (self.t_s, self.t_s), contact)

    def still(self, seconds: float, found: PlantState, known_n: Vec3 = HOVER, contact: bool = False) -> Vec3:
        for _ in range(round(seconds / DT_S)):
            force = self.step(found, known_n, contact)
        return force


def test_a_payload_that_the_rotors_carry_is_its_weight() -> None:
    run = Run()
    run.still(2.0, state())
    assert run.still(1.0, state(), known_n=(0.0, 0.0, 1.96), contact=True)[2] == pytest.approx(-1.96, abs=0.01)
    assert run.still(20.0, state(), known_n=(0.0, 0.0, 1.96), contact=True)[2] == pytest.approx(-1.96, abs=0.01), (
        "drift"
    )


def test_a_payload_that_pulls_the_vehicle_down_is_its_weight() -> None:
    run = Run()
    run.still(2.0, state())
    force = run.still(0.6, state((0.0, 0.0, -1.0)), contact=True)
    assert force[2] == pytest.approx(-3.0, abs=0.01)


def test_a_step_of_force_arrives_without_overshoot() -> None:
    run = Run()
    run.still(2.0, state())
    found = [run.step(state((0.0, 0.0, -1.0)), contact=True)[2] for _ in range(200)]
    assert found == sorted(found, reverse=True)
    assert -1.0 < found[4] < 0.0
    assert found[59] < -2.9, "95 % after 0.24 s"


def test_what_lasts_without_contact_is_removed() -> None:
    run = Run()
    force = run.still(8.0 * MEAN_S, state(), known_n=(0.5, -0.3, 1.5))
    assert force == pytest.approx(ZERO, abs=0.01)


def test_a_lasting_horizontal_force_is_removed_during_contact_too() -> None:
    run = Run()
    run.still(2.0, state())
    x, y, z = run.still(8.0 * MEAN_S, state(), known_n=(0.5, -0.3, 1.0), contact=True)
    assert (x, y) == pytest.approx((0.0, 0.0), abs=0.01)
    assert z == pytest.approx(-1.0, abs=0.01)


@pytest.mark.parametrize("joints", [1, 2, 3, 4])
def test_the_force_that_accelerates_the_arm_is_not_external(joints: int) -> None:
    """The base moves against the arm: total momentum is constant."""
    vehicle = vehicle_with_joints(joints)
    observer = ForceObserver(vehicle)
    moment = observer.first_moment_body_kg_m
    pose = [math.radians(angle) for angle in ARMS[joints][1]]

    def arm(t_s: float) -> Joints:
        return (pose[0] + 0.3 * math.sin(6.0 * t_s), *pose[1:])

    def reaction(t_s: float) -> Vec3:
        h = 1e-4
        x, y, z = (
            -(after - 2.0 * now + before) / h**2 / vehicle.airframe.mass_kg
            for after, now, before in zip(moment(arm(t_s + h)), moment(arm(t_s)), moment(arm(t_s - h)), strict=True)
        )
        return (x, y, z)

    moved = Run(observer)
    found = [math.hypot(*moved.step(state(reaction(k * DT_S), arm(k * DT_S)))) for k in range(600)]
    largest = max(found[200:])
    size_n = max(3.0 * math.hypot(*reaction(k * DT_S)) for k in range(600))
    assert size_n > 0.4, "there is a reaction"
    assert largest < 0.2 * size_n


def test_without_an_arm_the_force_on_the_base_is_observed() -> None:
    run = Run(ForceObserver(vehicle_with_joints(0)))
    run.still(2.0, state(arm=()))
    assert run.still(0.6, state((0.0, 0.0, -1.0), arm=()), contact=True)[2] == pytest.approx(-3.0, abs=0.01)


def test_joints_that_moved_during_a_gap_in_the_reads_are_not_taken_for_a_force() -> None:
    run = Run()
    run.still(2.0, state())
    moved = state(arm=(POSE[0] + 0.2, POSE[1]))
    assert math.hypot(*run.step(moved, later_s=0.1)) < 1e-6
    jumped = Run()
    jumped.still(2.0, state())
    assert math.hypot(*jumped.step(moved)) > 1.0, "a jump without a gap is"


@pytest.mark.parametrize(
    "broken",
    [
        lambda run: run.step(state((math.nan, 0.0, 0.0))),
        lambda run: run.step(state((0.0, 0.0, math.inf))),
        lambda run: run.step(state(arm=(math.nan, POSE[1]))),
        lambda run: run.step(state(), known_n=(0.0, math.nan, 0.0)),
    ],
)
def test_values_that_are_not_finite_leave_the_estimate_unchanged(broken: Callable[[Run], Vec3]) -> None:
    run = Run()
    run.still(2.0, state())
    before = run.still(0.2, state((0.0, 0.0, -1.0)), contact=True)
    assert broken(run) == before
    assert run.still(1.0, state((0.0, 0.0, -1.0)), contact=True)[2] == pytest.approx(-3.0, abs=0.01)


def test_the_law_gets_a_bounded_estimate() -> None:
    run = Run()
    run.still(2.0, state())
    run.still(1.0, state((0.0, 0.0, -10.0)), contact=True)
    assert run.observer.force_n[2] == pytest.approx(-30.0, abs=0.1)
    assert run.observer.used_n()[2] == -USED_MAX_N


def test_on_the_ground_the_estimate_is_discarded() -> None:
    run = Run()
    run.still(2.0, state((0.0, 0.0, 1.0)), contact=True)
    run.observer.reset()
    assert run.observer.force_n == ZERO
    assert math.hypot(*run.step(state())) < 1e-9
