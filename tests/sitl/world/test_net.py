"""The net: a hoop with a bag, against closed-form mechanics and conservation laws."""

from __future__ import annotations

import math
from dataclasses import dataclass

import mujoco
import numpy as np
import pytest
from numpy.typing import NDArray

from companion.config.loader import load_vehicle
from companion.model.constants import GRAVITY_M_S2
from companion.model.types import Vec2, Vec3
from companion.sitl_config.effects.net import Net
from companion.sitl_config.world import World as WorldConfig
from sitl.world.effects.net import Bag
from sitl.world.payload import Ball
from sitl.world.state import PHYSICS_DT_S
from tests.sitl.plants import OneMachine, run
from tests.support import tool_of

Array = NDArray[np.float64]
HOOP_M, PAYLOAD_RADIUS_M = 0.09, 0.035
CATCH_POSE = (math.radians(100), math.radians(60))


VEHICLE = load_vehicle("configs/vehicles/tarot650_2r.yaml")
LEVEL = (0.0, 0.0)


def world_with(config: WorldConfig, arm_rad: Vec2 = LEVEL) -> OneMachine:
    return OneMachine(VEHICLE, config, (0.0, 0.0), 0.0, arm_rad)


def ball_of(world: OneMachine) -> Ball:
    ball = world.payload.ball
    assert ball is not None
    return ball


@dataclass
class Point:
    """A payload at a net that is held still, upright, integrated as MuJoCo does."""

    bag: Bag
    mass_kg: float
    position: Vec3
    velocity: Vec3
    gravity: float = GRAVITY_M_S2
    t_s: float = 0.0
    force: Vec3 | None = None

    def step(self) -> None:
        self.force = self.bag.force_n(self.position, self.velocity, self.t_s)
        fx, fy, fz = self.force or (0.0, 0.0, 0.0)
        k = PHYSICS_DT_S / self.mass_kg
        vx, vy, vz = self.velocity
        self.velocity = (vx + k * fx, vy + k * fy, vz + k * fz - self.gravity * PHYSICS_DT_S)
        x, y, z = (p + PHYSICS_DT_S * v for p, v in zip(self.position, self.velocity, strict=True))
        self.position = (x, y, z)
        self.t_s += PHYSICS_DT_S

    def run(self, duration_s: float) -> None:
        for _ in range(round(duration_s / PHYSICS_DT_S)):
            self.step()


def falling(
    speed_m_s: float,
    mass_kg: float = 0.2,
    at: Vec2 = (0.0, 0.0),
    gravity: float = GRAVITY_M_S2,
    z_m: float = 0.05,
    **net: float,
) -> Point:
    bag = Bag(Net(on=True, **net), HOOP_M, PAYLOAD_RADIUS_M)
    return Point(bag, mass_kg, (*at, z_m), (0.0, 0.0, -speed_m_s), gravity)


@pytest.mark.parametrize("mass_kg", [0.1, 0.3])
def test_the_bag_stops_the_payload_in_a_quarter_period_of_its_spring(mass_kg: float) -> None:
    payload = falling(2.7, mass_kg, gravity=0.0)
    forces = []
    while payload.t_s < 0.15:
        payload.step()
        forces.append(math.hypot(*payload.force) if payload.force else 0.0)
    duration_s = sum(force > 0.1 * max(forces) for force in forces) * PHYSICS_DT_S
    assert duration_s == pytest.approx(0.5 * math.pi * math.sqrt(mass_kg / 500.0), abs=3 * PHYSICS_DT_S)
    assert 0.018 <= duration_s <= 0.08
    assert max(forces) == pytest.approx(2.7 * math.sqrt(mass_kg * 500.0), rel=0.06)


@pytest.mark.parametrize("restitution", [0.0, 0.6])
def test_the_bag_returns_the_restitution_of_the_speed(restitution: float) -> None:
    payload = falling(2.0, gravity=0.0, restitution=restitution)
    payload.run(0.5)
    assert payload.velocity[2] == pytest.approx(2.0 * restitution, abs=0.12)


@pytest.mark.parametrize(("mass_kg", "at"), [(0.02, (0.05, 0.03)), (0.1, (0.0, 0.085)), (1.0, (0.0, 0.0))])
def test_settling_adds_no_energy(mass_kg: float, at: Vec2) -> None:
    payload = falling(2.0, mass_kg, at)
    before = energy = mass_kg * (0.5 * 2.0**2 + GRAVITY_M_S2 * payload.position[2])
    while payload.t_s < 6.0:
        payload.step()
        if payload.force is None:
            now = mass_kg * (0.5 * math.hypot(*payload.velocity) ** 2 + GRAVITY_M_S2 * payload.position[2])
            assert now <= energy + 0.01 * mass_kg, "energy in free flight: never more than before"
            energy = min(energy, now)
    assert energy < before
    assert math.hypot(*payload.velocity) < 0.02
    assert payload.bag.side == 1


def thrown_at(world: OneMachine, ball: Ball, ball_from_net_m: Vec3, velocity_m_s: Vec3) -> None:
    """Place a payload in the frame of the hoop and let the net act on it."""
    m, d = world.model, world.data
    mujoco.mj_forward(m, d)
    axes = d.xmat[m.body("sensor").id].reshape(3, 3)
    d.qpos[ball.q : ball.q + 3] = d.xpos[m.body("net").id] + axes @ np.array(ball_from_net_m)
    d.qvel[ball.v : ball.v + 3] = axes @ np.array(velocity_m_s)
    mujoco.mj_forward(m, d)
    world.machine.read()
    assert world.payload.bag is not None
    world.payload.bag.watch(*ball[0:3])
    world.payload.throws, world.payload._flies_since_s = 1, world.t_s


@pytest.mark.parametrize("payload_kg", [0.1, 0.3])
def test_an_off_centre_catch_conserves_both_momenta(payload_kg: float) -> None:
    """In weightlessness, without air: the vehicle takes up the payload's change of momentum."""
    config = WorldConfig(payload_kg=payload_kg, joint_friction_nm=0.0, joint_damping_nms=0.0, net=Net(on=True))
    world = world_with(config, CATCH_POSE)
    world.machine.release_arm()
    m, d = world.model, world.data
    m.opt.gravity[:] = 0
    d.qpos[2] = 1.5
    thrown_at(world, ball_of(world), (0.05, -0.03, 0.1), (0.3, 0.1, -2.7))

    def momenta() -> tuple[Array, Array]:
        mujoco.mj_forward(m, d)
        mujoco.mj_subtreeVel(m, d)
        return np.array(m.body_subtreemass[0] * d.subtree_linvel[0]), np.array(d.subtree_angmom[0])

    linear, angular = momenta()
    payload_before = payload_kg * d.qvel[ball_of(world).v : ball_of(world).v + 3]
    run(world, 0.2, drag=False)
    linear_after, angular_after = momenta()
    payload_after = payload_kg * d.qvel[ball_of(world).v : ball_of(world).v + 3]
    assert np.linalg.norm(payload_after - payload_before) > 0.5 * np.linalg.norm(payload_before), "an impact"
    assert np.linalg.norm(linear_after - linear) <= 0.01 * np.linalg.norm(linear)
    assert np.linalg.norm(angular_after - angular) <= 0.01 * np.linalg.norm(angular)


def test_a_payload_that_settles_off_centre_turns_the_force_sensor() -> None:
    """On the floor, the arm held out level: the sensor reads the weight, and the weight times its lever."""
    config = WorldConfig(payload_kg=0.2, net=Net(on=True, pocket=1.0))
    world = world_with(config)
    thrown_at(world, ball_of(world), (-0.02, 0.06, 0.05), (0.0, 0.0, -1.0))
    run(world, 4.0)
    assert [event.kind for event in world.take_events()] == ["caught"]
    truth = world.machine.truth()
    net_weight_n = tool_of(VEHICLE).beyond_sensor_kg * GRAVITY_M_S2
    weight_n = 0.2 * GRAVITY_M_S2
    assert truth.force_sensor_n[2] == pytest.approx(-weight_n - net_weight_n, rel=0.01)
    lever_x_m, lever_y_m = world.data.xpos[ball_of(world).body][0:2] - world.data.xpos[world.machine._tip][0:2]
    assert lever_y_m == pytest.approx(0.06, abs=0.01)
    assert truth.torque_sensor_nm[0] == pytest.approx(-weight_n * lever_y_m, rel=0.02)
    assert truth.torque_sensor_nm[1] == pytest.approx(weight_n * lever_x_m, rel=0.05)


def test_a_payload_that_comes_near_behind_the_hoop_is_not_in_the_bag() -> None:
    bag = Bag(Net(on=True), HOOP_M, PAYLOAD_RADIUS_M)
    assert [bag.force_n((0.02, 0.0, z), (0.0, 0.0, 2.0), 0.0) for z in (-0.99, -0.5, -0.11)] == [None] * 3
    assert bag.side == 0
    bag.force_n((0.02, 0.0, 0.001), (0.0, 0.0, 2.0), 0.0)
    assert bag.side == -1, "it lifts the mesh from below"


def test_what_bounces_out_is_an_event_and_no_catch() -> None:
    config = WorldConfig(payload_kg=0.1, net=Net(on=True))
    world = world_with(config)
    thrown_at(world, ball_of(world), (0.0, 0.0, 0.1), (0.0, 0.0, -9.0))
    run(world, 0.6)
    assert [event.kind for event in world.take_events()] == ["bounced_out"]
    assert world.payload.caught_t_s is None
