"""The chain of any joints against an independent library (Pinocchio) and against the closed form of the planar 2R arm."""

from __future__ import annotations

import numpy as np
import pytest
from numpy.typing import NDArray

from companion.config.arm_chain import chain_of
from companion.config.base import JOINTS_MAX
from companion.config.loader import load_vehicle
from companion.control.arm_model import dynamics_of
from companion.control.arm_model.chain_dynamics import ChainDynamics
from companion.control.arm_model.chain_manipulator import ChainManipulator
from companion.control.arm_model.planar_dynamics import PlanarDynamics
from companion.control.arm_model.planar_manipulator import PlanarManipulator, is_planar_2r
from companion.control.dynamics import Dynamics, chi_rate_from_body_rate
from companion.control.manipulator import Manipulator
from companion.model.arm_chain import ArmChain, ChainLink
from companion.model.frames import quat_from_euler_zyx, quat_rotate, rotation_matrix
from companion.model.types import Chi, Joints, Mat3, Quat, Vec3
from tests.pinocchio_or_skip import pin

Array = NDArray[np.float64]
MASS_KG = 9.0
BASE_INERTIA_KG_M2 = (0.05, 0.07, 0.09)


def vec3(values: Array) -> Vec3:
    x, y, z = values.tolist()
    return (x, y, z)


def random_quat(rng: np.random.Generator) -> Quat:
    w, x, y, z = (lambda q: q / np.linalg.norm(q))(rng.standard_normal(4)).tolist()
    return (w, x, y, z)


def random_inertia(rng: np.random.Generator) -> Mat3:
    """Inertia of four random points, so that it is one of a rigid body."""
    points = rng.uniform(-0.06, 0.06, (4, 3))
    a, b, c = (sum(0.05 * (p @ p * np.eye(3) - np.outer(p, p)) for p in points)).tolist()
    return (tuple(a), tuple(b), tuple(c))


def random_chain(rng: np.random.Generator, joints: int) -> ArmChain:
    def link() -> ChainLink:
        axis = rng.standard_normal(3)
        return ChainLink(
            position_m=vec3(rng.uniform(-0.2, 0.2, 3)),
            attitude_wxyz=random_quat(rng),
            axis=vec3(axis / np.linalg.norm(axis)),
            mass_kg=float(rng.uniform(0.05, 0.3)),
            com_m=vec3(rng.uniform(-0.1, 0.1, 3)),
            inertia_kg_m2=random_inertia(rng),
            armature_kg_m2=float(rng.uniform(0.0, 0.01)),
        )

    return ArmChain(
        links=tuple(link() for _ in range(joints)),
        tip_m=vec3(rng.uniform(-0.2, 0.2, 3)),
        sensor_wxyz=random_quat(rng),
        tool_mass_kg=0.2 if joints else 0.0,
        tool_inertia_kg_m2=2e-4 if joints else 0.0,
    )


def se3(position: Vec3, attitude: Quat) -> pin.SE3:
    w, x, y, z = attitude
    return pin.SE3(pin.Quaternion(w, x, y, z).matrix(), np.array(position))


def oracle(chain: ArmChain) -> pin.Model:
    """The same machine in Pinocchio; the base carries the mass that the arm does not have."""
    model = pin.Model()
    last = model.addJoint(0, pin.JointModelFreeFlyer(), pin.SE3.Identity(), "base")
    base_kg = MASS_KG - sum(link.mass_kg for link in chain.links) - chain.tool_mass_kg
    model.appendBodyToJoint(last, pin.Inertia(base_kg, np.zeros(3), np.diag(BASE_INERTIA_KG_M2)), pin.SE3.Identity())
    for number, link in enumerate(chain.links):
        joint = pin.JointModelRevoluteUnaligned(np.array(link.axis))
        last = model.addJoint(last, joint, se3(link.position_m, link.attitude_wxyz), f"joint{number}")
        inertia = pin.Inertia(link.mass_kg, np.array(link.com_m), np.array(link.inertia_kg_m2))
        model.appendBodyToJoint(last, inertia, pin.SE3.Identity())
    tip = se3(chain.tip_m, chain.sensor_wxyz)
    if chain.links:
        ball = pin.Inertia(chain.tool_mass_kg, np.zeros(3), chain.tool_inertia_kg_m2 * np.eye(3))
        model.appendBodyToJoint(last, ball, tip)
    model.addFrame(pin.Frame("tip", last, tip, pin.FrameType.OP_FRAME))
    model.armature = np.array([0.0] * 6 + [link.armature_kg_m2 for link in chain.links])
    return model


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


def symmetric(upper: Array) -> Array:
    upper = np.triu(upper)
    full: Array = upper + upper.T - np.diag(np.diag(upper))
    return full


@pytest.mark.parametrize("joints", range(JOINTS_MAX + 1))
def test_any_chain_agrees_with_pinocchio(joints: int) -> None:
    rng = np.random.default_rng(joints)
    for _ in range(3):
        chain = random_chain(rng, joints)
        manipulator = ChainManipulator(chain)
        dynamics = ChainDynamics(chain, MASS_KG, BASE_INERTIA_KG_M2, 1.0)
        model = oracle(chain)
        data, tip = model.createData(), model.getFrameId("tip")
        rpy = vec3(rng.uniform(-1.2, 1.2, 3))
        angle: Joints = tuple(rng.uniform(-3, 3, joints).tolist())
        rate: Joints = tuple(rng.uniform(-2, 2, 6 + joints).tolist())
        attitude = quat_from_euler_zyx(*rpy)
        rotation = rotation_matrix(attitude)
        up_body = vec3(9.81 * np.array(rotation)[2])
        w, x, y, z = attitude
        q = np.array([0.3, -0.2, 1.1, x, y, z, w, *angle])
        transform, transform_rate = to_twist(rpy, joints), to_twist_rate(rpy, rate)

        at_rest = np.array([0.0] * 6 + [1.0] + list(angle))
        jacobian = pin.computeFrameJacobian(model, data, at_rest, tip, pin.ReferenceFrame.LOCAL_WORLD_ALIGNED)
        pin.framesForwardKinematics(model, data, at_rest)
        np.testing.assert_allclose(manipulator.net_body_m(angle), data.oMf[tip].translation, atol=1e-12)
        np.testing.assert_allclose(
            np.reshape(manipulator.joints_body_m(angle), (joints, 3)),
            np.reshape([data.oMi[2 + number].translation for number in range(joints)], (joints, 3)),
            atol=1e-12,
        )
        sensor = rotation_matrix(manipulator.sensor_attitude_body(angle))
        np.testing.assert_allclose(sensor, data.oMf[tip].rotation, atol=1e-12)
        found, gravity_nm = manipulator.joint_terms(angle, up_body)
        np.testing.assert_allclose(found, jacobian[:3, 6:], atol=1e-12)
        np.testing.assert_allclose(manipulator.jacobian_body_m(angle), jacobian[:3, 6:], atol=1e-12)
        force_n = vec3(rng.uniform(-2, 2, 3))
        torques = manipulator.joint_torque_from_force(angle, force_n)
        np.testing.assert_allclose(torques, jacobian[:3, 6:].T @ force_n, atol=1e-12)

        terms = dynamics.terms(rotation, rpy, angle, rate)
        pin.crba(model, data, q)
        np.testing.assert_allclose(terms.mass, transform.T @ symmetric(data.M) @ transform, atol=1e-10)
        gravity = transform.T @ pin.computeGeneralizedGravity(model, data, q)
        np.testing.assert_allclose(terms.gravity, gravity, atol=1e-10)
        np.testing.assert_allclose(gravity_nm, gravity[6:], atol=1e-10)
        np.testing.assert_allclose(manipulator.gravity_torque_nm(angle, attitude), gravity[6:], atol=1e-10)
        bias = transform.T @ pin.rnea(model, data, q, transform @ np.array(rate), transform_rate @ np.array(rate))
        np.testing.assert_allclose(np.add(terms.coriolis, terms.gravity), bias, atol=1e-8)

        # A fixed base without gravity.
        model.gravity.linear = np.zeros(3)
        acceleration: Joints = tuple(rng.uniform(-5, 5, joints).tolist())
        still = np.zeros(6)
        torque = pin.rnea(model, data, at_rest, np.array([*still, *rate[6:]]), np.array([*still, *acceleration]))[6:]
        np.testing.assert_allclose(dynamics.arm_torque_nm(angle, rate[6:], acceleration), torque, atol=1e-12)
        arm = dynamics.arm_terms(angle, rate[6:])
        mass = np.reshape(arm.mass, (joints, joints))
        np.testing.assert_allclose(mass @ np.array(acceleration) + np.array(arm.coriolis), torque, atol=1e-12)


def implementations() -> tuple[tuple[Manipulator, Dynamics], tuple[Manipulator, Dynamics]]:
    vehicle = load_vehicle("tarot650_2r")
    arm = vehicle.arm.model_copy(update={"shoulder_body_m": (0.03, 0.02, -0.05)})
    chain = chain_of(vehicle.model_copy(update={"arm": arm}))
    assert is_planar_2r(chain)
    rest = (MASS_KG, BASE_INERTIA_KG_M2, 0.9)
    return (
        (PlanarManipulator(chain), PlanarDynamics(chain, *rest)),
        (ChainManipulator(chain), ChainDynamics(chain, *rest)),
    )


def test_the_chain_of_the_planar_arm_equals_its_closed_form() -> None:
    (planar, planar_dynamics), (chain, chain_dynamics) = implementations()
    rng = np.random.default_rng(4)
    for _ in range(50):
        angle: Joints = tuple(rng.uniform(-3, 3, 2).tolist())
        rate: Joints = tuple(rng.uniform(-2, 2, 8).tolist())
        values: Joints = tuple(rng.uniform(-2, 2, 2).tolist())
        rpy = vec3(rng.uniform(-1.2, 1.2, 3))
        attitude = quat_from_euler_zyx(*rpy)
        up_body = quat_rotate((attitude[0], -attitude[1], -attitude[2], -attitude[3]), (0.0, 0.0, 9.81))

        def close(found: object, expected: object) -> None:
            np.testing.assert_allclose(np.array(found), np.array(expected), atol=1e-12)

        close(chain.net_body_m(angle), planar.net_body_m(angle))
        close(chain.joints_body_m(angle), planar.joints_body_m(angle))
        close(chain.sensor_attitude_body(angle), planar.sensor_attitude_body(angle))
        for found, expected in zip(chain.joint_terms(angle, up_body), planar.joint_terms(angle, up_body), strict=True):
            close(found, expected)
        close(chain.jacobian_body_m(angle), planar.jacobian_body_m(angle))
        close(chain.joint_torque_from_force(angle, up_body), planar.joint_torque_from_force(angle, up_body))
        levers = planar.gravity_levers_m_s2(angle, up_body)
        close(chain.gravity_levers_m_s2(angle, up_body), levers)
        close(chain.moment_torque_nm(levers, values), planar.moment_torque_nm(levers, values))
        close(chain.projected_on_moments(levers, values), planar.projected_on_moments(levers, values))
        terms = chain_dynamics.terms(rotation_matrix(attitude), rpy, angle, rate)
        planar_terms = planar_dynamics.terms(rotation_matrix(attitude), rpy, angle, rate)
        close(terms.mass, planar_terms.mass)
        close(terms.coriolis, planar_terms.coriolis)
        close(terms.gravity, planar_terms.gravity)
        arm, planar_arm = (one.arm_terms(angle, rate[6:]) for one in (chain_dynamics, planar_dynamics))
        close(arm.mass, planar_arm.mass)
        close(arm.coriolis, planar_arm.coriolis)
        torque, planar_torque = (
            one.arm_torque_nm(angle, rate[6:], values) for one in (chain_dynamics, planar_dynamics)
        )
        close(torque, planar_torque)


def test_gravity_levers_times_first_moments_are_the_gravity_torque_of_links_whose_mass_lies_on_their_lines() -> None:
    """The mass of a link on the line to the next joint is that link's moment; mass at joints is added to the links before."""
    rng = np.random.default_rng(2)
    bare = random_chain(rng, 4)
    ends = [*(link.position_m for link in bare.links[1:]), bare.tip_m]
    masses, shares = rng.uniform(0.1, 0.3, 4), rng.uniform(0.2, 0.9, 4)
    links = tuple(
        ChainLink(
            position_m=link.position_m,
            attitude_wxyz=link.attitude_wxyz,
            axis=link.axis,
            mass_kg=float(mass),
            com_m=vec3(share * np.array(end)),
            inertia_kg_m2=link.inertia_kg_m2,
            armature_kg_m2=0.0,
        )
        for link, end, mass, share in zip(bare.links, ends, masses, shares, strict=True)
    )
    manipulator = ChainManipulator(ArmChain(links, tip_m=bare.tip_m))
    beyond = [float(masses[number + 1 :].sum()) for number in range(4)]
    lengths = np.linalg.norm(ends, axis=1)
    moments = (masses * shares + beyond) * lengths
    angle, up_body = (0.3, -1.1, 0.7, 2.0), (1.0, -2.0, 9.0)
    levers = manipulator.gravity_levers_m_s2(angle, up_body)
    expected = manipulator.joint_terms(angle, up_body)[1]
    np.testing.assert_allclose(manipulator.moment_torque_nm(levers, tuple(moments.tolist())), expected, atol=1e-12)


def test_a_pose_with_too_few_angles_is_refused() -> None:
    with pytest.raises(ValueError):
        ChainManipulator(random_chain(np.random.default_rng(0), 3)).net_body_m((0.1, 0.2))


def test_euler_rates_undo_the_body_rate() -> None:
    rng = np.random.default_rng(9)
    for _ in range(20):
        rpy, rate = vec3(rng.uniform(-1.2, 1.2, 3)), rng.uniform(-2, 2, 3)
        back = chi_rate_from_body_rate(rpy, vec3(to_twist(rpy, 0)[3:6, 3:6] @ rate))
        np.testing.assert_allclose(back, rate, atol=1e-12)


def test_a_scaled_model_is_scaled_throughout() -> None:
    rpy, angle, rate = (0.3, -0.2, 0.5), (1.0, -0.4), (0.1, 0.2, -0.3, 0.4, -0.5, 0.6, 0.7, -0.8)
    vehicle, rotation = load_vehicle("tarot650_2r"), rotation_matrix(quat_from_euler_zyx(0.3, -0.2, 0.5))
    one, scaled = (dynamics_of(vehicle, scale).terms(rotation, rpy, angle, rate) for scale in (1.0, 0.85))
    for name in ("mass", "coriolis", "gravity"):
        np.testing.assert_allclose(getattr(scaled, name), 0.85 * np.array(getattr(one, name)), rtol=1e-12, atol=1e-15)
