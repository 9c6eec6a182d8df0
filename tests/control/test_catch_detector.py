"""The catch, and that its payload has left the net: told apart from bumps, falls and a sensor that says nothing."""

from __future__ import annotations

import math
from collections.abc import Callable

import pytest
from msgspec.structs import replace

from companion.control.sensing import CatchDetector, ObservedCatchDetector
from companion.control.vehicle_control import VehicleControl
from companion.mission.plan import Plan
from companion.model.types import Inputs, Vec3
from companion.sitl_config.loader import load_sitl
from tests.safety.healthy import control as log_of
from tests.safety.healthy import healthy, put

DT_S = 0.005
G_M_S2 = 9.81


class Net:
    """Drives a detector tick by tick; remembers when it said what."""

    def __init__(self, payload_kg: float = 0.2) -> None:
        self.detector = CatchDetector()
        self.payload_kg = payload_kg
        self.t_s = 0.0
        self.caught: list[float] = []
        self.left: list[float] = []

    def feel(
        self, seconds: float, force: Callable[[float], Vec3 | None] | Vec3 | None, acceleration_z_m_s2: float = 0.0
    ) -> None:
        """As the core does: a catch is looked for first."""
        begin_s = self.t_s
        for _ in range(round(seconds / DT_S)):
            self.t_s += DT_S
            now = force(self.t_s - begin_s) if callable(force) else force
            if self.detector.update(self.t_s, now):
                self.caught.append(self.t_s)
            elif self.detector.left(self.t_s, now, acceleration_z_m_s2):
                self.left.append(self.t_s)

    def hang(self, acceleration_z_m_s2: float = 0.0) -> Vec3:
        return (0.0, 0.0, -self.payload_kg * (G_M_S2 + acceleration_z_m_s2))

    def catch(self) -> None:
        """A blow of 40 ms, then the weight for 1 s."""
        self.feel(0.04, (-6.0, 0.5, -9.0))
        self.feel(1.0, self.hang())
        assert self.detector.caught_s is not None


EMPTY: Vec3 = (0.05, -0.03, 0.04)


@pytest.mark.parametrize("swings", [False, True])
def test_an_arm_that_swings_confirms_no_catch(swings: bool) -> None:
    config = load_sitl("configs/missions/catch.yaml", overrides=["vehicle.airframe.hover_thrust=0.5"])
    control, caught = VehicleControl(config.flight), []
    for tick in range(600):
        force = EMPTY if tick < 200 else (-6.0, 0.5, -9.0) if tick < 208 else (0.0, 0.0, -1.96)
        caught.append(control.catch_s(tick * DT_S, log_of(force_ext_world_n=force), swings))
    assert [caught_s for caught_s in caught if caught_s is not None] == ([] if swings else [200 * DT_S])


def test_a_force_is_unknown_before_the_tare_and_once_it_is_old() -> None:
    """0.25 s is `safety.force_timeout_s`. Unknown is not 0: a bar would seem lost, a surface not touched."""
    config = load_sitl("configs/missions/catch.yaml", overrides=["vehicle.airframe.hover_thrust=0.5"])
    control, now = VehicleControl(config.flight), healthy()
    reference = Plan.build(config.mission, config.vehicle).reference(0.0)

    def known(i: Inputs) -> bool:
        control.fly(i, DT_S, reference, 1.0)
        assert (control.force_n is None) is (control.force_on_tool_n(i) is None)
        return control.force_n is not None

    assert not known(now)
    control.collect_tare(now)
    control.finish_tare()
    assert known(now)
    assert known(put("force", stamp_s=now.t_s - 0.24)(now))
    assert not known(put("force", stamp_s=now.t_s - 0.26)(now))
    assert not known(replace(now, force=None))


@pytest.mark.parametrize("payload_kg", [0.05, 0.1, 0.2, 0.3, 0.6])
def test_catch_after_catch(payload_kg: float) -> None:
    net = Net(payload_kg)
    for number in range(1, 4):
        net.feel(2.0, EMPTY)
        net.catch()
        blow_s = net.t_s - 1.04
        assert net.detector.caught_s == pytest.approx(blow_s + DT_S)
        net.feel(5.0, net.hang())
        assert (len(net.caught), len(net.left)) == (number, number - 1)
        gone_s = net.t_s
        net.feel(2.0, EMPTY)
        assert net.detector.caught_s is None
        assert len(net.left) == number
        assert 0.5 <= net.left[-1] - gone_s < 0.8
    assert len(net.caught) == 3


def test_a_ball_that_hits_the_rim_and_falls_is_no_catch() -> None:
    net = Net()
    net.feel(2.0, EMPTY)
    net.feel(0.03, (-12.0, 0.5, -15.0))
    net.feel(0.12, (-1.5, 0.1, -2.0))
    assert net.detector.unconfirmed_s == pytest.approx(2.0 + DT_S), "until then it may be one"
    net.feel(3.0, EMPTY)
    assert (net.caught, net.left, net.detector.unconfirmed_s) == ([], [], None)


WAKE: Vec3 = (0.1, -0.05, -0.35)
"""Drift of the sensor and the rotors' wake on the net."""


def test_a_force_that_was_there_before_the_blow_is_no_weight() -> None:
    net = Net()
    net.feel(3.0, WAKE)
    net.feel(0.04, (-12.0, 0.5, -15.0))
    net.feel(2.0, WAKE)
    assert net.caught == []


def test_a_light_payload_leaves_a_net_on_which_the_wake_pulls() -> None:
    net = Net(0.05)
    net.feel(3.0, WAKE)
    net.feel(0.04, (-6.0, 0.5, -6.0))
    net.feel(3.0, (WAKE[0], WAKE[1], WAKE[2] + net.hang()[2]))
    assert (len(net.caught), net.left) == (1, [])
    net.feel(1.0, WAKE)
    assert len(net.left) == 1


@pytest.mark.parametrize("payload_kg", [0.05, 0.2, 0.5])
@pytest.mark.parametrize("before_s", [0.6, 0.8, 0.95, 1.05])
def test_a_bump_before_the_ball_hides_no_catch_and_does_not_date_it(before_s: float, payload_kg: float) -> None:
    net = Net(payload_kg)
    net.feel(2.0, EMPTY)
    net.feel(0.04, (3.0, 0.0, 1.0))
    net.feel(before_s - 0.04, EMPTY)
    net.catch()
    assert len(net.caught) == 1
    assert net.detector.caught_s == pytest.approx(2.0 + before_s + DT_S)


def test_a_payload_that_bounces_in_the_net_is_caught_where_it_first_touched() -> None:
    net = Net(0.1)
    net.feel(2.0, EMPTY)
    for _ in range(3):
        net.feel(0.04, (-6.0, 0.5, -9.0))
        net.feel(0.11, EMPTY)
    net.feel(1.0, net.hang())
    assert net.detector.caught_s == pytest.approx(2.0 + DT_S)


def test_a_bump_from_below_is_no_leaving() -> None:
    net = Net()
    net.catch()
    net.feel(0.3, (0.0, 0.0, 0.1))
    net.feel(1.0, net.hang())
    net.feel(0.1, (0.0, 0.0, 8.0))
    net.feel(1.0, net.hang())
    assert net.left == []


def test_a_push_that_lasts_is_no_leaving() -> None:
    net = Net()
    net.catch()
    net.feel(3.0, (0.0, 0.0, 4.0))
    assert net.left == []


def test_a_falling_machine_has_not_lost_its_payload() -> None:
    net = Net()
    net.catch()
    net.feel(0.8, net.hang(-9.5), acceleration_z_m_s2=-9.5)
    net.feel(0.8, net.hang(-6.0), acceleration_z_m_s2=-6.0)
    net.feel(1.0, net.hang(-2.0), acceleration_z_m_s2=-2.0)
    assert net.left == []


def test_a_swinging_payload_is_not_lost() -> None:
    net = Net()
    net.catch()
    net.feel(4.0, lambda t_s: (0.5, 0.0, -net.payload_kg * G_M_S2 * (1.0 if t_s % 0.8 < 0.4 else 0.1)))
    assert net.left == []


def test_without_force_samples_the_payload_has_not_left() -> None:
    net = Net()
    net.catch()
    net.feel(3.0, None)
    assert net.detector.caught_s is not None
    net.feel(0.4, EMPTY)
    net.feel(0.1, None)
    net.feel(0.4, EMPTY)
    assert net.left == [], "half a second without a gap was asked for"
    net.feel(0.4, EMPTY)
    assert len(net.left) == 1


def test_no_catch_no_leaving() -> None:
    net = Net()
    net.feel(2.0, EMPTY)
    net.feel(0.05, (5.0, 0.0, 1.0))
    net.feel(2.0, EMPTY)
    assert (net.caught, net.left) == ([], [])


class ObservedNet(Net):
    """Drives the detector of the momentum observer's force."""

    def __init__(self, payload_kg: float = 0.2) -> None:
        super().__init__(payload_kg)
        self.detector = ObservedCatchDetector()


@pytest.mark.parametrize("payload_kg", [0.1, 0.2, 0.3])
def test_the_observed_impact_and_weight_are_a_catch(payload_kg: float) -> None:
    net = ObservedNet(payload_kg)
    net.feel(2.0, (0.4, -0.3, -0.4))
    net.feel(0.1, (-2.0, 0.2, -0.5))
    assert net.detector.carries(net.t_s), "the weight is held from the impact on"
    net.feel(1.0, net.hang())
    assert net.caught == pytest.approx([2.005 + net.detector.PULL_TIME_S], abs=1.5 * DT_S)
    assert net.detector.carries(net.t_s + 100.0)
    net.feel(1.5, (0.3, 0.2, -0.1 * payload_kg))
    assert len(net.left) == 1
    assert not net.detector.carries(net.t_s)


@pytest.mark.parametrize("gust", [(1.5, 0.8, -0.4), (-1.3, 2.5, 0.3), (0.0, 0.0, -1.7)])
def test_a_gust_is_no_catch_and_ends(gust: Vec3) -> None:
    net = ObservedNet()
    net.feel(0.3, gust)
    net.feel(2.0, (0.1, 0.0, -0.3))
    assert not net.caught
    assert not net.detector.carries(net.t_s)


def test_a_rejected_catch_is_not_carried_and_the_next_one_is_found() -> None:
    net = ObservedNet()
    net.feel(0.1, (0.0, -3.0, -2.5))
    net.feel(0.8, (0.0, -2.0, -2.5))
    net.detector.reject()
    assert not net.detector.carries(net.t_s)
    net.feel(2.0, EMPTY)
    net.feel(0.1, (-2.0, 0.2, -0.5))
    net.feel(1.0, net.hang())
    assert len(net.caught) == 2


@pytest.mark.parametrize("net", [Net(), ObservedNet()])
def test_vibration_is_not_a_fall(net: Net) -> None:
    """80 Hz, sampled at 200 Hz: single samples show less specific force than a fall."""
    net.catch()
    for n in range(400):
        net.feel(DT_S, EMPTY, 6.0 * math.sin(2.0 * math.pi * 80.0 * n * DT_S))
    assert len(net.left) == 1
