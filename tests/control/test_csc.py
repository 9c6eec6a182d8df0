"""Complete-system compliance: the impedance on every row, and whole missions in the fast loop."""

from __future__ import annotations

import math

import numpy as np
import pytest
from msgspec.structs import replace

from companion.config.controller import CscConfig
from companion.config.loader import FlightConfig
from companion.control.arm_model import dynamics_of
from companion.control.csc import CscController
from companion.control.types import PlantState, Wrench
from companion.core.flight_core import FlightCore
from companion.model.frames import rotation_matrix
from companion.model.types import IDENTITY_QUAT, PhaseKind, Vec3
from companion.sitl_config.loader import SitlConfig, load_sitl
from sitl.fast.loop import FastFlight
from sitl.fast.result import FastResult
from tests.control.states import POSE, ZERO, at, at_rest
from tests.flights.test_fast_flights import error_after_catch_m, event_ids

pytestmark = pytest.mark.usefixtures("short_start")

MISSION = "configs/missions/catch.yaml"
WEIGHT_N = 3.0 * 9.81


def configured(*overrides: str) -> SitlConfig:
    return load_sitl(MISSION, controller_law="csc", overrides=overrides)


def law(config: SitlConfig) -> CscConfig:
    assert isinstance(config.controller, CscConfig)
    return config.controller


def flown(*overrides: str) -> FastResult:
    """The mission up to 3 s after the catch."""
    return FastFlight(configured(*overrides)).run(until_mission_s=9.5)


def stepped(config: SitlConfig, state: PlantState, acceleration: Vec3 = ZERO, vertical_scale: float = 1.0) -> Wrench:
    """The first tick: level, and nothing filtered yet."""
    reference = replace(at_rest((0.0, 0.0, 1.0), 0.0, POSE), acceleration_world_m_s2=acceleration)
    return CscController(law(config), config.vehicle, 0.49).step(0.005, state, reference, vertical_scale)


def acceleration(config: SitlConfig, state: PlantState, wrench: Wrench) -> np.ndarray:
    """chi'' of position and joints that the nominal machine has under the wrench, the attitude being held level."""
    terms = dynamics_of(config.vehicle).terms(
        rotation_matrix(IDENTITY_QUAT),
        ZERO,
        state.arm_rad,
        (*state.velocity_world_m_s, 0.0, 0.0, 0.0, *state.arm_rate_rad_s),
    )
    force = state.force_ext_world_n or ZERO
    c = CscController(law(config), config.vehicle, 0.49)
    external = [*force, *c._manipulator.joint_torque_from_force(state.arm_rad, force)]
    rows = [0, 1, 2, 6, 7]
    mass = np.array(terms.mass)[np.ix_(rows, rows)]
    bias = (np.array(terms.coriolis) + np.array(terms.gravity))[rows]
    applied = np.array([*wrench.log.tau[0:3], *wrench.arm_torque_nm])
    out: np.ndarray = np.linalg.solve(mass, applied + np.array(external) - bias)
    return out


def test_at_rest_it_asks_for_hover_and_arm_gravity() -> None:
    config = configured()
    wrench = stepped(config, at())
    assert wrench.collective_n == pytest.approx(WEIGHT_N, abs=1e-9)
    assert wrench.attitude_wxyz == pytest.approx(IDENTITY_QUAT, abs=1e-12)
    np.testing.assert_allclose(acceleration(config, at(), wrench), 0.0, atol=1e-9)


@pytest.mark.parametrize(
    "state",
    [
        at(position=(0.02, -0.01, 1.02)),
        at(velocity=(0.1, -0.1, 0.05), arm_rate=(0.3, -0.4)),
        at(arm=(POSE[0] + 0.1, POSE[1] - 0.1)),
        at(force=(0.5, -0.3, -1.0)),
        at((0.01, 0.02, 0.99), (0.05, 0.0, -0.05), (POSE[0] - 0.05, POSE[1]), (0.2, 0.2), (0.2, 0.1, -0.5)),
    ],
)
def test_the_nominal_machine_moves_as_the_target_impedance(state: PlantState) -> None:
    """M_d e'' + K_d e' + K_p e = tau_ext on position and joint rows, coupling included."""
    config = configured("controller.desired_force_time_s=1000")
    c = law(config)
    wrench = stepped(config, state, acceleration=(0.1, 0.0, -0.1))
    assert wrench.log.saturated == (False, False, False)
    e, e_rate = np.array(wrench.log.error), np.array(wrench.log.error_rate)
    wanted = [0.1, 0.0, -0.1, 0, 0, 0, 0, 0] - (
        np.array(c.damping_kd) * e_rate + np.array(c.stiffness_kp) * e - np.array(wrench.log.e_tau)
    ) / np.array(c.inertia_md)
    np.testing.assert_allclose(acceleration(config, state, wrench), wanted[[0, 1, 2, 6, 7]], atol=1e-9)


def test_without_force_sensor_it_flies_on() -> None:
    wrench = stepped(configured(), at(force=None))
    assert wrench.log.force_ext_world_n == ZERO
    assert wrench.collective_n == pytest.approx(WEIGHT_N, abs=1e-9)


def test_spooling_scales_the_vertical_force_alone() -> None:
    wrench = stepped(configured(), at(position=(0.1, 0.0, 1.0)), vertical_scale=0.4)
    assert wrench.log.tau[0:2] == (0.0, 0.0)
    assert wrench.collective_n == pytest.approx(0.4 * WEIGHT_N, rel=0.05)


def test_saturation_is_logged() -> None:
    config = configured()
    wrench = stepped(config, at(position=(9.0, 0.0, -9.0), arm=(POSE[0] + 3.0, POSE[1] - 3.0)))
    assert wrench.log.saturated == (True, True, True)
    limits = [joint.torque_max_nm for joint in config.vehicle.arm.joints]
    assert all(abs(torque) <= limit for torque, limit in zip(wrench.arm_torque_nm, limits, strict=True))
    force = np.array(wrench.log.tau[0:3])
    assert math.atan2(math.hypot(force[0], force[1]), force[2]) <= math.radians(20) + 1e-9


def height_error_before_catch_m(result: FastResult) -> float:
    """Mean over the phases of flight; negative: it hangs low."""
    catch_s = next(event.t_s for outputs in result.outputs for event in outputs.events if event.id == "catch")
    errors = [
        inputs.mocap.position_world_m[2] - outputs.reference.position_world_m[2]
        for inputs, outputs in zip(result.inputs, result.outputs, strict=True)
        if outputs.phase_kind is PhaseKind.FLIGHT and outputs.t_s < catch_s and inputs.mocap and outputs.reference
    ]
    return sum(errors) / len(errors)


def test_it_carries_the_payload_replays_and_with_too_little_mass_in_its_model_flies_low() -> None:
    """15 % in every mass: below its height by the missing weight over the stiffness."""
    right = flown("world.payload_kg=0.2")
    wrong = flown("world.payload_kg=0.2", "controller.model_mass_scale=0.85")
    assert event_ids(right) == ["takeoff", "catch"]
    assert error_after_catch_m(right) <= 0.06
    flight = FastFlight(configured("world.payload_kg=0.2"))
    again = FlightCore(FlightConfig.model_validate_json(flight.config.flight.model_dump_json()))
    assert [again.step(inputs) for inputs in right.inputs[:1500]] == right.outputs[:1500]
    assert abs(height_error_before_catch_m(right)) < 0.003
    assert height_error_before_catch_m(wrong) < -0.006
    assert error_after_catch_m(wrong) > 1.25 * error_after_catch_m(right)
