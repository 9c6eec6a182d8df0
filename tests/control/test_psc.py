"""Partitioned compliance: arm and vehicle each by itself, the payload's estimated mass, and whole missions in the fast loop."""

from __future__ import annotations

from functools import cache
from pathlib import Path

import numpy as np
import pytest
from msgspec.structs import replace

from companion.analysis.log import FlightLog
from companion.analysis.replay import flight_core, replay
from companion.config.controller import PscConfig
from companion.control.payload_mass import PayloadEstimator
from companion.control.psc import PscController
from companion.control.types import PlantState, Wrench
from companion.model.types import PhaseKind
from companion.sitl_config.loader import SitlConfig, load_sitl
from sitl.campaigns.flights import log_of
from sitl.fast.loop import FastFlight
from sitl.fast.result import FastResult
from tests.analysis.recorded import record
from tests.control.states import POSE, at, at_rest
from tests.flights.test_fast_flights import error_after_catch_m, event_ids

pytestmark = pytest.mark.usefixtures("short_start")


MISSION = "configs/missions/catch.yaml"
MASS_KG, G = 3.0, 9.81


def configured(*overrides: str) -> SitlConfig:
    return load_sitl(MISSION, controller_law="psc", overrides=overrides)


def law(config: SitlConfig) -> PscConfig:
    assert isinstance(config.controller, PscConfig)
    return config.controller


def controller(config: SitlConfig) -> PscController:
    return PscController(law(config), config.vehicle, 0.49)


@cache
def flown() -> tuple[FastFlight, FastResult]:
    """The mission with 0.3 kg up to 3.5 s after the catch."""
    flight = FastFlight(configured("world.payload_kg=0.3"))
    return flight, flight.run(until_mission_s=10.0)


REFERENCE = replace(
    at_rest((0.0, 0.0, 1.0), 0.0, POSE), acceleration_world_m_s2=(0.2, 0.0, 0.1), arm_acceleration_rad_s2=(0.3, -0.2)
)


def stepped(config: SitlConfig, state: PlantState) -> Wrench:
    return controller(config).step(0.005, state, REFERENCE, 1.0)


def test_the_vehicle_follows_its_own_law_and_ignores_the_arm() -> None:
    config = configured()
    c = law(config)
    wanted = [
        MASS_KG * (feed - kd * v - kp * e)
        for feed, kd, v, kp, e in zip(
            (0.2, 0.0, 0.1), c.position_kd_xyz, (0.1, 0.0, -0.1), c.position_kp_xyz, (0.02, -0.03, 0.01), strict=True
        )
    ]
    for state in (
        at((0.02, -0.03, 1.01), (0.1, 0.0, -0.1)),
        at((0.02, -0.03, 1.01), (0.1, 0.0, -0.1), (1.2, 0.3), (2.0, -2.0), (3.0, 0.0, -3.0)),
    ):
        force = stepped(config, state).log.tau[0:3]
        assert force == pytest.approx((wanted[0], wanted[1], wanted[2] + MASS_KG * G), abs=1e-9)


def test_the_integral_part_ends_a_lasting_error_and_is_bounded() -> None:
    config = configured("controller.payload_max_kg=0")
    c = law(config)
    one = controller(config)
    low = at(position=(0.0, 0.0, 0.99))
    before = one.step(0.005, low, REFERENCE, 1.0).collective_n
    for _ in range(2000):
        after = one.step(0.005, low, REFERENCE, 1.0).collective_n
    gained = MASS_KG * min(c.integral_max_m_s2, 0.01 * c.position_ki_xyz[2] * 10.0)
    assert after - before == pytest.approx(gained, rel=1e-3, abs=1e-6)
    grounded = controller(config)
    for _ in range(400):
        grounded.step(0.005, replace(low, airborne=False), REFERENCE, 1.0)
    assert grounded.step(0.005, low, REFERENCE, 1.0).collective_n == pytest.approx(before, abs=1e-9)


@pytest.mark.parametrize("climb_m_s2", [0.0, 1.0, -1.0])
def test_the_estimate_is_thrust_over_specific_force_whatever_the_machine_does(climb_m_s2: float) -> None:
    estimator = PayloadEstimator(law(configured()), MASS_KG)
    for _ in range(2000):
        estimator.step(0.005, (MASS_KG + 0.25) * (G + climb_m_s2), G + climb_m_s2, True)
    assert estimator.payload_kg == pytest.approx(0.25, abs=1e-6)


@pytest.mark.parametrize(
    ("thrust_n", "specific", "airborne", "wanted_kg"),
    [
        (40.0, G, False, 0.0),  # on the ground
        (15.0, G, True, 0.0),  # the ground may carry a part
        (28.0, G, True, 0.0),  # lighter than itself: bounded
        (58.0, G, True, 1.0),  # bounded above
        (40.0, 0.0, True, 0.0),  # falling: nothing to divide by
    ],
)
def test_the_estimate_is_gated_and_bounded(thrust_n: float, specific: float, airborne: bool, wanted_kg: float) -> None:
    estimator = PayloadEstimator(law(configured()), MASS_KG)
    for _ in range(4000):
        estimator.step(0.005, thrust_n, specific, airborne)
    assert estimator.payload_kg == pytest.approx(wanted_kg, abs=1e-6)


def test_no_estimate_without_its_switch() -> None:
    estimator = PayloadEstimator(law(configured("controller.payload_max_kg=0")), MASS_KG)
    assert estimator.step(0.005, 40.0, G, True) == 0.0


def test_it_carries_the_payload_and_its_mass_estimate_converges() -> None:
    """Within 20 %, from thrust and IMU alone, with their noise; from 2 s after the catch on."""
    _, result = flown()
    assert event_ids(result) == ["takeoff", "catch"]
    assert error_after_catch_m(result) <= 0.03
    catch_s = next(event.t_s for outputs in result.outputs for event in outputs.events if event.id == "catch")
    flight = [o for o in result.outputs if o.phase_kind is PhaseKind.FLIGHT]
    estimates = [(o.t_s, o.control.payload_estimate_kg) for o in flight if o.control is not None]
    assert len(estimates) == len(flight)
    carried = [kg for t_s, kg in estimates if kg is not None and t_s > catch_s + 2.0]
    before = [kg for t_s, kg in estimates if kg is not None and t_s < catch_s]
    assert np.mean(carried) == pytest.approx(0.3, rel=0.2)
    assert np.mean(before) < 0.05


def test_the_estimate_is_in_the_log_and_comes_out_of_a_replay_bit_for_bit(tmp_path: Path) -> None:
    flight, result = flown()
    log = FlightLog.read(record(log_of(flight.config.flight, result, None), tmp_path / "flight.mcap"))
    estimates = [o.control.payload_estimate_kg for o in log.outputs if o.control is not None]
    assert None not in estimates
    assert len(set(estimates)) > 400
    assert replay(log, flight_core).first_difference is None


def test_without_force_sensor_it_flies_as_without_a_force() -> None:
    assert stepped(configured(), at(force=None)).log == stepped(configured(), at()).log
