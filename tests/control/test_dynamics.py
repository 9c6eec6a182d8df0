"""The nominal model against an independent library (Pinocchio), and against what any mechanical system obeys."""

from __future__ import annotations

import math

import numpy as np
import pytest
from numpy.typing import NDArray

from companion.config.loader import load_vehicle
from companion.config.vehicle import Vehicle
from companion.control.arm_model import dynamics_of
from companion.control.dynamics import Dynamics, DynamicsTerms, chi_rate_from_body_rate
from companion.model.frames import quat_from_euler_zyx, rotation_matrix
from companion.model.types import Chi, Joints, Vec3
from companion.sitl_config.world import World
from sitl.world.model import base_mass_kg
from tests.pinocchio_or_skip import pin
from tests.support import tool_of

Array = NDArray[np.float64]


@pytest.fixture(scope="module")
def vehicle() -> Vehicle:
    """Shoulder off the middle, so that no term is zero by symmetry."""
    loaded = load_vehicle("configs/vehicles/tarot650_2r.yaml")
    return loaded.model_copy(
        update={"arm": loaded.arm.model_copy(update={"shoulder_body_m": (0.03, 0.02, -0.05)})},
    )


def oracle(vehicle: Vehicle) -> pin.Model:
    """The same machine in Pinocchio, from the vehicle file and nothing of MuJoCo's."""
    arm, tool = vehicle.arm, tool_of(vehicle)
    model = pin.Model()
    base = model.addJoint(0, pin.JointModelFreeFlyer(), pin.SE3.Identity(), "base")
    base_mass = base_mass_kg(vehicle, World())
    model.appendBodyToJoint(
        base, pin.Inertia(base_mass, np.zeros(3), np.diag(vehicle.airframe.inertia_kg_m2)), pin.SE3.Identity()
    )

    def rod(mass: float, com: float, length: float) -> pin.Inertia:
        across = mass * length**2 / 12
        return pin.Inertia(mass, np.array([com, 0, 0]), np.diag([0.1 * across + 1e-5, across, across]))

    (l1, l2), (m1, m2), (c1, c2) = arm.link_lengths_m, arm.link_masses_kg, arm.link_com_m
    shoulder = pin.SE3(np.eye(3), np.array(arm.shoulder_body_m))
    link1 = model.addJoint(base, pin.JointModelRY(), shoulder, "alpha1")
    model.appendBodyToJoint(link1, rod(m1, c1, l1), pin.SE3.Identity())
    elbow = pin.SE3(np.eye(3), np.array([l1, 0, 0]))
    link2 = model.addJoint(link1, pin.JointModelRevoluteUnaligned(np.array([0.0, -1.0, 0.0])), elbow, "alpha2")
    model.appendBodyToJoint(link2, rod(m2, c2, l2), pin.SE3.Identity())
    end = pin.SE3(np.eye(3), np.array([l2, 0, 0]))
    for mass in (tool.sensor_mass_kg, tool.beyond_sensor_kg):
        model.appendBodyToJoint(link2, pin.Inertia(mass, np.zeros(3), np.eye(3) * 1e-4), end)
    model.addFrame(pin.Frame("net", link2, end, pin.FrameType.OP_FRAME))
    model.armature = np.array([0.0] * 6 + [arm.joint_armature_kg_m2] * 2)
    return model


def random_state(rng: np.random.Generator) -> tuple[Vec3, Joints, Chi]:
    """Roll, pitch, yaw; joints; chi'."""
    roll, pitch, yaw = rng.uniform(-1.2, 1.2, 3).tolist()
    a1, a2 = rng.uniform(-3, 3, 2).tolist()
    a, b, c, d, e, f, g, h = rng.uniform(-2, 2, 8).tolist()
    return (roll, pitch, yaw), (a1, a2), (a, b, c, d, e, f, g, h)


def terms(dynamics: Dynamics, rpy: Vec3, arm: Joints, rate: Chi) -> DynamicsTerms:
    return dynamics.terms(rotation_matrix(quat_from_euler_zyx(*rpy)), rpy, arm, rate)


def axis_rotation(axis: int, angle: float) -> Array:
    unit = np.zeros(3)
    unit[axis] = angle
    return np.array(pin.exp3(unit))


def rotation_of(rpy: Array) -> Array:
    return axis_rotation(2, rpy[2]) @ axis_rotation(1, rpy[1]) @ axis_rotation(0, rpy[0])


def to_twist(rpy: Vec3, joints: int = 2) -> Array:
    """chi' to Pinocchio's velocity (origin velocity in body axes, body rate, joints), from the axes that the angles turn about."""
    yaw_pitch = axis_rotation(2, rpy[2]) @ axis_rotation(1, rpy[1])
    axes = np.column_stack([yaw_pitch[:, 0], axis_rotation(2, rpy[2])[:, 1], [0.0, 0.0, 1.0]])
    rotation = rotation_of(np.array(rpy))
    out = np.eye(6 + joints)
    out[:3, :3] = rotation.T
    out[3:6, 3:6] = rotation.T @ axes
    return out


def to_twist_rate(rpy: Vec3, rate: Chi) -> Array:
    """d/dt of `to_twist`, by a complex-free fourth-order difference."""

    def at(h: float) -> Array:
        return to_twist((rpy[0] + h * rate[3], rpy[1] + h * rate[4], rpy[2] + h * rate[5]), len(rate) - 6)

    h = 1e-3
    return (8.0 * (at(h) - at(-h)) - (at(2 * h) - at(-2 * h))) / (12.0 * h)


def test_mass_coriolis_and_gravity_agree_with_pinocchio(vehicle: Vehicle) -> None:
    dynamics, model = dynamics_of(vehicle), oracle(vehicle)
    data = model.createData()
    rng = np.random.default_rng(11)
    for _ in range(200):
        rpy, arm, rate = random_state(rng)
        x, y, z, w = pin.Quaternion(rotation_of(np.array(rpy))).coeffs()
        q = np.array([0.3, -0.2, 1.1, x, y, z, w, *arm])
        transform, transform_rate = to_twist(rpy), to_twist_rate(rpy, rate)
        v = transform @ np.array(rate)
        found = terms(dynamics, rpy, arm, rate)

        pin.crba(model, data, q)
        upper = np.triu(data.M)
        mass_pin = upper + upper.T - np.diag(np.diag(data.M))
        np.testing.assert_allclose(np.array(found.mass), transform.T @ mass_pin @ transform, atol=1e-8)
        gravity = transform.T @ pin.computeGeneralizedGravity(model, data, q)
        np.testing.assert_allclose(np.array(found.gravity), gravity, atol=1e-8)
        # chi'' = 0: the twist changes by the transform alone.
        bias = transform.T @ pin.rnea(model, data, q, v, transform_rate @ np.array(rate))
        np.testing.assert_allclose(np.array(found.coriolis) + np.array(found.gravity), bias, atol=1e-8)


def test_mass_is_symmetric_and_positive_and_changes_as_twice_coriolis_power(vehicle: Vehicle) -> None:
    """chi' (M' - 2 C) chi' = 0 (passivity), with M' by differences."""
    dynamics = dynamics_of(vehicle)
    rng = np.random.default_rng(5)
    h = 1e-4
    for _ in range(50):
        rpy, arm, rate = random_state(rng)
        mass = np.array(terms(dynamics, rpy, arm, rate).mass)
        np.testing.assert_allclose(mass, mass.T, atol=1e-14)
        assert np.linalg.eigvalsh(mass).min() > 0

        def power(step: float, rpy: Vec3 = rpy, arm: Joints = arm, rate: Chi = rate) -> float:
            moved = (rpy[0] + step * rate[3], rpy[1] + step * rate[4], rpy[2] + step * rate[5])
            joints = (arm[0] + step * rate[6], arm[1] + step * rate[7])
            return float(np.array(rate) @ np.array(terms(dynamics, moved, joints, rate).mass) @ np.array(rate))

        mass_power = (power(h) - power(-h)) / (2 * h)
        coriolis_power = float(np.array(rate) @ np.array(terms(dynamics, rpy, arm, rate).coriolis))
        assert mass_power == pytest.approx(2.0 * coriolis_power, abs=1e-5)


def test_a_scaled_model_is_scaled_throughout(vehicle: Vehicle) -> None:
    rpy, arm, rate = random_state(np.random.default_rng(8))
    one, scaled = terms(dynamics_of(vehicle), rpy, arm, rate), terms(dynamics_of(vehicle, 0.85), rpy, arm, rate)
    np.testing.assert_allclose(np.array(scaled.mass), 0.85 * np.array(one.mass), rtol=1e-12, atol=1e-15)
    np.testing.assert_allclose(scaled.coriolis, 0.85 * np.array(one.coriolis), rtol=1e-12, atol=1e-15)
    np.testing.assert_allclose(scaled.gravity, 0.85 * np.array(one.gravity), rtol=1e-12, atol=1e-15)


def test_euler_rates_undo_the_body_rate(vehicle: Vehicle) -> None:
    rng = np.random.default_rng(9)
    for _ in range(20):
        rpy, _, rate = random_state(rng)
        body = to_twist(rpy)[3:6, 3:6] @ np.array(rate[3:6])
        back = chi_rate_from_body_rate(rpy, (float(body[0]), float(body[1]), float(body[2])))
        np.testing.assert_allclose(back, rate[3:6], atol=1e-12)
        assert math.isfinite(sum(back))
