"""The catch against conservation of momentum, and the taut tether. Mass, Coriolis and gravity: `world/test_arm_joints`."""

from __future__ import annotations

import math

import mujoco
import numpy as np
import pytest
from numpy.typing import NDArray

from companion.config.loader import load_vehicle
from companion.config.vehicle import Vehicle
from companion.sitl_config.world import World as WorldConfig
from tests.sitl.plants import OneMachine, run
from tests.support import tool_of

Array = NDArray[np.float64]
NO_PAYLOAD = WorldConfig(payload_kg=0.0, joint_friction_nm=0.0, joint_damping_nms=0.0)
ARM_START = (math.radians(100), math.radians(60))


@pytest.fixture(scope="module")
def vehicle() -> Vehicle:
    return load_vehicle("configs/vehicles/tarot650_2r.yaml")


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
