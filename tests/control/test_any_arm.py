"""The laws on arms of 0 to 7 joints with axes in all directions, against the formulas of docs/internals/control-law.md in matrices."""

from __future__ import annotations

import math
import random
from collections.abc import Iterator
from typing import Any, TypeVar

import numpy as np
import pytest
from msgspec.structs import replace
from numpy.typing import NDArray

from companion.config.controller import AdaptiveConfig, CscConfig, LawConfig, PscConfig
from companion.config.gains import fitted
from companion.config.loader import load_flight
from companion.config.vehicle import Vehicle
from companion.control.arm_model import dynamics_of, manipulator_of
from companion.control.dynamics import chi_rate_from_body_rate
from companion.control.scaled_gains import for_vehicle
from companion.control.trial import at_rest, build_law, hover
from companion.control.types import PlantState, Wrench
from companion.model.constants import GRAVITY_M_S2
from companion.model.frames import euler_zyx_from_quat, quat_from_euler_zyx, rotation_matrix
from companion.model.types import Joints, Reference, Vec3
from tests.support import CATCH

Array = NDArray[np.float64]
DT_S = 0.005
JOINTS = (1, 3, 4, 7)
AXES = ((0.0, 1.0, 0.0), (1.0, 0.0, 0.0), (0.0, 0.0, 1.0))
FORCE_FULL = {"force_lowpass_hz": 1e6}
"""The law uses the measured force as it is."""


def with_arm(count: int) -> Vehicle:
    """The shipped vehicle with an arm of rods that turn about y, x and z in turn."""
    given = load_flight(CATCH).vehicle.model_dump()
    joint = given["arm"]["joints"][0] | {"angle_deg": (-179.0, 179.0), "torque_max_nm": 3.0}
    arm = {
        "shoulder_body_m": (0.05, 0.01, -0.1),
        "link_lengths_m": [0.4 / max(1, count)] * count,
        "link_masses_kg": [0.2 / max(1, count)] * count,
        "link_com_m": [0.2 / max(1, count)] * count,
        "joints": [joint | {"servo_id": number, "axis": AXES[number % 3]} for number in range(count)],
    }
    given["safety"]["fold_arm_deg"] = [10.0] * count
    if count == 0:
        given |= {"tool": None}
        given["devices"] |= {"arm": None, "force": None}
    return Vehicle.model_validate(given | {"arm": arm})


Config = TypeVar("Config", bound=LawConfig)


def config_of(kind: type[Config], law: str, preset: str, **changes: Any) -> Config:
    controller = load_flight(CATCH, None, law, preset).controller
    return kind.model_validate(controller.model_dump() | FORCE_FULL | changes)


def ticks(count: int) -> Iterator[tuple[PlantState, Reference]]:
    """States near random references, with a force on the net."""
    draw = random.Random(count)

    def near(values: tuple[float, ...], spread: float) -> Any:
        return tuple(value + draw.uniform(-spread, spread) for value in values)

    nothing: Joints = (0.0,) * count
    for _ in range(6):
        reference = replace(
            hover(near(nothing, 2.0)),
            acceleration_world_m_s2=near((0.0, 0.0, 0.0), 0.5),
            arm_rate_rad_s=near(nothing, 0.3),
            arm_acceleration_rad_s2=near(nothing, 0.5),
        )
        roll, pitch, yaw = near((0.0, 0.0, 0.0), 0.2)
        state = replace(
            at_rest(near(reference.arm_rad, 0.05)),
            position_world_m=near(reference.position_world_m, 0.03),
            velocity_world_m_s=near((0.0, 0.0, 0.0), 0.1),
            acceleration_world_m_s2=near((0.0, 0.0, 0.0), 0.5),
            attitude_wxyz=quat_from_euler_zyx(roll, pitch, yaw),
            angular_rate_body_rad_s=near((0.0, 0.0, 0.0), 0.3),
            arm_rate_rad_s=near(reference.arm_rate_rad_s, 0.2),
            force_ext_world_n=near((0.0, 0.0, -1.0), 0.5),
        )
        yield state, reference


def rows_of(gains: tuple[float, ...], count: int) -> Array:
    return np.array(fitted(gains, count))


class Seen:
    """What every law is given in a tick, in arrays."""

    def __init__(self, vehicle: Vehicle, state: PlantState, reference: Reference) -> None:
        manipulator, attitude = manipulator_of(vehicle), state.attitude_wxyz
        self.rotation = np.array(rotation_matrix(attitude))
        up = tuple((self.rotation.T @ (0.0, 0.0, GRAVITY_M_S2)).tolist())
        jacobian = manipulator.jacobian_body_m(state.arm_rad)
        self.to_joints = np.array(jacobian).T @ self.rotation.T
        """J' R': joint torques per force on the net, world frame."""
        self.gravity_nm = np.array(manipulator.gravity_torque_nm(state.arm_rad, attitude))
        self.levers = np.array(manipulator.gravity_levers_m_s2(state.arm_rad, up))
        self.force_n = np.array(state.force_ext_world_n)
        self.rpy = euler_zyx_from_quat(attitude)
        self.e = np.subtract(state.arm_rad, reference.arm_rad)
        self.e_rate = np.subtract(state.arm_rate_rad_s, reference.arm_rate_rad_s)
        self.feed = np.array(reference.arm_acceleration_rad_s2)


def assert_torque(wrench: Wrench, expected_nm: Array, vehicle: Vehicle) -> None:
    most = np.array([joint.torque_max_nm for joint in vehicle.arm.joints])
    np.testing.assert_allclose(wrench.arm_torque_nm, np.clip(expected_nm, -most, most), atol=1e-9)
    np.testing.assert_array_equal(wrench.log.tau[6:], wrench.arm_torque_nm)


def held(dt_s: float, time_s: float | None) -> float:
    return 0.0 if time_s is None else min(1.0, dt_s / time_s)


@pytest.mark.parametrize("arm_inertia", [False, True])
@pytest.mark.parametrize("joints", JOINTS)
def test_adaptive(joints: int, arm_inertia: bool) -> None:
    vehicle = with_arm(joints)
    c = for_vehicle(vehicle, config_of(AdaptiveConfig, "adaptive", "recommended", arm_inertia_nominal=arm_inertia))
    assert len(set(c.robust_scale[6:])) == joints > 0
    law, dynamics, count = build_law(c, vehicle), dynamics_of(vehicle), 6 + joints
    m_d, phi, lam, weight = (rows_of(gains, count) for gains in (c.inertia_md, c.phi, c.lambda_gain, c.row_weights_s))
    d, robust = rows_of(c.damping_kd, count) - m_d * phi, rows_of(c.robust_scale, count) * weight**2
    gamma, desired_n, acceleration = np.zeros(count), np.zeros(3), np.zeros(3 + joints)
    moments, friction, rates_before = np.zeros(joints), np.zeros(joints), np.zeros(joints)
    h, zeta, learns = np.array(c.h_initial), c.zeta_initial, True
    for tick, (state, reference) in enumerate(ticks(joints)):
        wrench = law.step(DT_S, state, reference, 1.0)
        log, seen, rates = wrench.log, Seen(vehicle, state, reference), np.array(state.arm_rate_rad_s)
        e, v = np.array(log.error), np.array(log.error_rate)
        np.testing.assert_allclose(e[6:], seen.e, atol=1e-12)
        np.testing.assert_allclose(v[6:], seen.e_rate, atol=1e-12)
        tau_d = seen.to_joints @ desired_n
        e_tau = np.array(
            [*np.array(c.base_compliance_xyz) * seen.force_n, 0, 0, 0, *seen.to_joints @ seen.force_n - tau_d]
        )
        np.testing.assert_allclose(log.e_tau, e_tau, atol=1e-12)
        s = v + phi * e - gamma
        np.testing.assert_allclose(log.sliding, s, atol=1e-12)

        measured = np.array([*state.acceleration_world_m_s2, *(rates - (rates if tick == 0 else rates_before)) / DT_S])
        k = 1.0 if tick == 0 else 1.0 - math.exp(-2.0 * math.pi * c.acceleration_lowpass_hz * DT_S)
        acceleration, rates_before = acceleration + k * (measured - acceleration), rates
        norm, x = np.linalg.norm(weight * s), np.linalg.norm([weight * e, weight * v])
        norm_a = np.linalg.norm(np.delete(weight, (3, 4, 5)) * acceleration)
        regressor = np.array([1.0, x, x * x, min(norm_a, c.acceleration_cap)])
        rho = min(h @ regressor + zeta, c.rho_max)
        assert log.rho == pytest.approx(rho)

        tau = -(lam + rho * robust / max(norm, c.boundary_layer)) * s - m_d * phi * v - d * gamma
        wanted_rate = rates - s[6:]
        direction = np.tanh(wanted_rate / 0.1)
        torque = tau[6:] + m_d[6:] * seen.feed - tau_d + seen.gravity_nm + seen.levers @ moments + friction * direction
        if arm_inertia:
            wanted = seen.feed - phi[6:] * v[6:] + (e_tau - d * gamma)[6:] / m_d[6:]
            inertial = dynamics.arm_torque_nm(state.arm_rad, state.arm_rate_rad_s, tuple(wanted.tolist()))
            torque += inertial - m_d[6:] * wanted
        assert_torque(wrench, torque + c.arm_friction_share * vehicle.arm.joint_friction_nm * direction, vehicle)

        decay = np.exp(-d / m_d * DT_S)
        gamma = decay * gamma + (1.0 - decay) / d * e_tau
        np.testing.assert_allclose(log.gamma, gamma, atol=1e-12)
        desired_n += held(DT_S, c.desired_force_time_s) * (seen.force_n - desired_n)
        assert c.load_leakage == 0.0
        if learns:
            grown = moments - DT_S * np.asarray(c.moment_rate) * (seen.levers.T @ s[6:])
            moments = np.clip(grown, -c.moment_max_kg_m, c.moment_max_kg_m)
            turning = (rates * direction > 0.1 * abs(direction)) * np.asarray(c.friction_rate)
            friction = np.clip(friction - DT_S * turning * s[6:] * direction, 0.0, c.friction_max_nm)
        np.testing.assert_allclose(log.moment_estimate_kg_m or (), moments, atol=1e-12)
        np.testing.assert_allclose(log.friction_estimate_nm or (), friction, atol=1e-12)
        h, zeta, learns = np.array(log.h_hat), log.zeta, not any(log.saturated)


@pytest.mark.parametrize("joints", JOINTS)
def test_csc(joints: int) -> None:
    vehicle, c, count = with_arm(joints), config_of(CscConfig, "csc", "tuned"), 6 + joints
    law, dynamics = build_law(c, vehicle), dynamics_of(vehicle)
    m_d, k_d, k_p = (rows_of(gains, count) for gains in (c.inertia_md, c.damping_kd, c.stiffness_kp))
    desired_n, setpoint = np.zeros(3), (0.0, 0.0)
    for state, reference in ticks(joints):
        wrench = law.step(DT_S, state, reference, 1.0)
        log, seen = wrench.log, Seen(vehicle, state, reference)
        q_rate = chi_rate_from_body_rate(seen.rpy, state.angular_rate_body_rad_s)
        chi_rate = (*state.velocity_world_m_s, *q_rate, *state.arm_rate_rad_s)
        e, v = np.array(log.error), np.array(log.error_rate)
        e[3:5], v[3:6] = np.subtract(seen.rpy[:2], setpoint), np.subtract(q_rate, (0.0, 0.0, reference.yaw_rate_rad_s))
        share, share_d = np.array(c.external_xyz), np.array(c.desired_force_xyz)
        tau_ext = np.array([*share * seen.force_n, 0, 0, 0, *seen.to_joints @ seen.force_n])
        e_tau = tau_ext - [*share_d * desired_n, 0, 0, 0, *seen.to_joints @ desired_n]
        np.testing.assert_allclose(log.e_tau, e_tau, atol=1e-12)
        feed = np.array([*reference.acceleration_world_m_s2, 0.0, 0.0, 0.0, *seen.feed])
        command = feed - (k_d * v + k_p * e - e_tau) / m_d
        rotation = rotation_matrix(state.attitude_wxyz)
        terms = dynamics.terms(rotation, seen.rpy, state.arm_rad, chi_rate)
        tau = np.array(terms.mass) @ command + terms.coriolis + terms.gravity - tau_ext
        friction = (
            c.arm_friction_share * vehicle.arm.joint_friction_nm * np.tanh(np.array(reference.arm_rate_rad_s) / 0.1)
        )
        assert_torque(wrench, tau[6:] + friction, vehicle)
        desired_n += held(DT_S, c.desired_force_time_s) * (seen.force_n - desired_n)
        setpoint = log.attitude_desired_rad[:2]


@pytest.mark.parametrize("joints", JOINTS)
def test_psc(joints: int) -> None:
    vehicle, c = with_arm(joints), config_of(PscConfig, "psc", "tuned")
    law, dynamics = build_law(c, vehicle), dynamics_of(vehicle)
    m_d, k_d, k_p = (rows_of(gains, joints) for gains in (c.arm_inertia_md, c.arm_damping_kd, c.arm_stiffness_kp))
    desired_n = np.zeros(3)
    for state, reference in ticks(joints):
        wrench = law.step(DT_S, state, reference, 1.0)
        seen = Seen(vehicle, state, reference)
        tau_ext = seen.to_joints @ seen.force_n
        e_tau = tau_ext - seen.to_joints @ desired_n
        np.testing.assert_allclose(wrench.log.e_tau[6:], e_tau, atol=1e-12)
        terms = dynamics.arm_terms(state.arm_rad, state.arm_rate_rad_s)
        command = seen.feed - (k_d * seen.e_rate + k_p * seen.e - e_tau) / m_d
        torque = np.array(terms.mass) @ command + terms.coriolis + seen.gravity_nm - tau_ext
        friction = (
            c.arm_friction_share * vehicle.arm.joint_friction_nm * np.tanh(np.array(reference.arm_rate_rad_s) / 0.1)
        )
        assert_torque(wrench, torque + friction, vehicle)
        desired_n += held(DT_S, c.desired_force_time_s) * (seen.force_n - desired_n)


@pytest.mark.parametrize(
    ("kind", "law", "preset"),
    [(AdaptiveConfig, "adaptive", "recommended"), (CscConfig, "csc", "tuned"), (PscConfig, "psc", "tuned")],
)
def test_without_an_arm_it_hovers_with_the_weight_and_no_joint_torque(
    kind: type[LawConfig], law: str, preset: str
) -> None:
    vehicle = with_arm(0)
    state: PlantState = at_rest(())
    below: Vec3 = (0.1, 0.0, 0.9)
    flying = build_law(config_of(kind, law, preset), vehicle)
    wrench = flying.step(DT_S, state, hover(()), 1.0)
    assert wrench.arm_torque_nm == ()
    assert wrench.collective_n == pytest.approx(vehicle.airframe.mass_kg * GRAVITY_M_S2)
    for rows in (wrench.log.error, wrench.log.sliding, wrench.log.gamma, wrench.log.tau, wrench.log.e_tau):
        assert len(rows) == 6
    pushed = flying.step(DT_S, replace(state, position_world_m=below), hover(()), 1.0)
    assert pushed.collective_n > wrench.collective_n
    assert pushed.log.tau[0] < 0.0
