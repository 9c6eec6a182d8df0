"""The world's mechanics against an independent library (Pinocchio) and against conservation laws."""

from __future__ import annotations

import math

import mujoco
import numpy as np
import pytest
from numpy.typing import NDArray

from companion.config.loader import load_vehicle
from companion.config.vehicle import Vehicle
from companion.sitl_config.world import World as WorldConfig
from sitl.world.model import base_mass_kg
from sitl.world.state import PHYSICS_DT_S
from tests.pinocchio_or_skip import pin
from tests.sitl.plants import OneMachine, run
from tests.support import tether_of, tool_of

Array = NDArray[np.float64]
NO_PAYLOAD = WorldConfig(payload_kg=0.0, joint_friction_nm=0.0, joint_damping_nms=0.0)
ARM_START = (math.radians(100), math.radians(60))


@pytest.fixture(scope="module")
def vehicle() -> Vehicle:
    return load_vehicle("configs/vehicles/tarot650_2r.yaml")


def oracle(vehicle: Vehicle) -> pin.Model:
    """The same machine in Pinocchio, from the vehicle file and nothing of MuJoCo's."""
    arm, tool = vehicle.arm, tool_of(vehicle)
    model = pin.Model()
    base = model.addJoint(0, pin.JointModelFreeFlyer(), pin.SE3.Identity(), "base")
    base_mass = base_mass_kg(vehicle, NO_PAYLOAD)
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


def random_state(rng: np.random.Generator) -> tuple[Array, Array]:
    """qpos and qvel in MuJoCo's order: position, quaternion wxyz, joints; world linear, body angular, joints."""
    quaternion = rng.standard_normal(4)
    qpos = np.concatenate([rng.uniform(-2, 2, 3), quaternion / np.linalg.norm(quaternion), rng.uniform(-3, 3, 2)])
    return qpos, rng.uniform(-2, 2, 8)


def test_mass_coriolis_gravity_and_jacobian_agree_with_pinocchio(vehicle: Vehicle) -> None:
    world = OneMachine(vehicle, NO_PAYLOAD, (0.0, 0.0), 0.0, ARM_START)
    world.machine.release_arm()
    m, d = world.model, world.data
    model = oracle(vehicle)
    data = model.createData()
    net = model.getFrameId("net")
    rng = np.random.default_rng(7)
    for _ in range(30):
        qpos, qvel = random_state(rng)
        d.qpos[:], d.qvel[:] = qpos, qvel
        mujoco.mj_forward(m, d)
        q = np.concatenate([qpos[:3], qpos[4:7], qpos[3:4], qpos[7:]])
        rotation = pin.Quaternion(qpos[3], qpos[4], qpos[5], qpos[6]).matrix()
        # v_pinocchio = to_body v_mujoco; linear part from world to body axes.
        to_body = np.eye(8)
        to_body[:3, :3] = rotation.T
        v = to_body @ qvel

        mass = np.zeros((8, 8))
        mujoco.mj_fullM(m, d, mass)
        pin.crba(model, data, q)
        upper = np.triu(data.M)
        mass_pin = to_body.T @ (upper + upper.T - np.diag(np.diag(data.M))) @ to_body
        np.testing.assert_allclose(mass, mass_pin, atol=1e-8)

        # The rotating base makes a difference between the two accelerations: d/dt(R' v) = R' a - w x R' v.
        spin = np.zeros(8)
        spin[:3] = -np.cross(qvel[3:6], v[:3])
        bias_pin = to_body.T @ pin.rnea(model, data, q, v, spin)
        np.testing.assert_allclose(d.qfrc_bias, bias_pin, atol=1e-8)
        gravity_pin = to_body.T @ pin.computeGeneralizedGravity(model, data, q)
        d.qvel[:] = 0
        mujoco.mj_forward(m, d)
        np.testing.assert_allclose(d.qfrc_bias, gravity_pin, atol=1e-8)

        jacobian = np.zeros((3, 8))
        mujoco.mj_jacSite(m, d, jacobian, None, m.site("net").id)
        jac_pin = pin.computeFrameJacobian(model, data, q, net, pin.ReferenceFrame.LOCAL_WORLD_ALIGNED)[:3] @ to_body
        np.testing.assert_allclose(jacobian, jac_pin, atol=1e-8)


@pytest.mark.parametrize("payload_kg", [0.1, 0.3])
def test_the_catch_conserves_momentum(vehicle: Vehicle, payload_kg: float) -> None:
    """In weightlessness, without air: total linear momentum before and after the catch."""
    config = NO_PAYLOAD.model_copy(update={"payload_kg": payload_kg})
    world = OneMachine(vehicle, config, (0.0, 0.0), 0.0, ARM_START)
    world.machine.release_arm()
    m, d = world.model, world.data
    m.opt.gravity[:] = 0
    d.qpos[2] = 1.5
    mujoco.mj_forward(m, d)
    payload = m.body("payload").id
    address = m.jnt_qposadr[m.joint("payload").id]
    speed = np.array([-2.0, 0.15, -1.5])
    d.qpos[address : address + 3] = d.site_xpos[m.site("net").id] - speed * 0.1
    velocity = m.jnt_dofadr[m.joint("payload").id]
    d.qvel[velocity : velocity + 3] = speed
    mujoco.mj_forward(m, d)
    world.payload.throws, world.payload._flies_since_s = 1, world.t_s

    def momentum() -> Array:
        mujoco.mj_subtreeVel(m, d)
        return np.array(m.body_subtreemass[0] * d.subtree_linvel[0])

    before = momentum()
    np.testing.assert_allclose(before, payload_kg * speed, rtol=1e-9)
    run(world, 0.4, drag=False)
    assert world.payload.caught_t_s is not None
    away = d.xpos[payload] - d.xpos[m.body("net").id]
    assert np.linalg.norm(away) < 1.1 * tool_of(vehicle).radius_m, "the net did not keep the payload"
    assert np.linalg.norm(momentum() - before) <= 0.005 * np.linalg.norm(before)


def test_a_taut_tether_pulls_and_a_slack_one_does_not(vehicle: Vehicle) -> None:
    world = OneMachine(vehicle, NO_PAYLOAD, (0.0, 0.0), 0.0, ARM_START)
    hover = world.machine.hover_command * 1.3
    rotors = (hover, hover, hover, hover)
    tension = []
    for _ in range(int(2.5 / PHYSICS_DT_S)):
        world.fly(rotors, (0, 0), False)
        truth = world.machine.truth()
        tension.append(truth.tether_tension_n)
        away = math.dist(truth.position_world_m, tether_of(vehicle).anchor_world_m)
        assert away < tether_of(vehicle).length_m + 0.1
        if away < tether_of(vehicle).length_m - 0.05:
            assert truth.tether_tension_n == 0.0
    assert max(tension) > 1.0
