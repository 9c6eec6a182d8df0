"""The simulated arm with any number of joints: its mechanics, its servos and their faults."""

from __future__ import annotations

import asyncio
import math
from typing import Any

import mujoco
import numpy as np
import pytest
from numpy.typing import NDArray

from companion.config.arm import Link, Tool
from companion.config.arm_chain import chain_of
from companion.config.loader import load_vehicle
from companion.config.vehicle import Vehicle
from companion.control.arm_model import dynamics_of, manipulator_of
from companion.control.dynamics import euler_rate_matrices
from companion.model.frames import quat_from_euler_zyx, quat_multiply, rotation_matrix
from companion.model.types import Joints, Outcome
from companion.sitl_config.effects.compliance import Compliance
from companion.sitl_config.effects.machine import Machine
from companion.sitl_config.effects.servo_mechanics import ServoMechanics
from companion.sitl_config.faults import Fault
from companion.sitl_config.loader import load_sitl
from companion.sitl_config.world import World as WorldConfig
from sitl.autopilot.backend import stub_of
from sitl.fast.bus import FastBus, scales_of
from sitl.fast.loop import FastFlight
from sitl.faults.injector import Faults
from sitl.plant import Plant
from sitl.server import Sitl
from sitl.servo.drive import ServoDrive
from sitl.servo.from_config import servos_of
from sitl.wires import MachineWires, Ports
from sitl.world.start import Start, start_of
from tests.machines import ARMS, overrides_with_joints, vehicle_with_joints
from tests.sitl.plants import FixedRotors, OneMachine
from tests.support import HOVER, LOW_HOVER, tool_of

Array = NDArray[np.float64]
NO_FRICTION = WorldConfig(payload_kg=0.0, joint_friction_nm=0.0, joint_damping_nms=0.0)


def folded_rad(joints: int) -> Joints:
    return tuple(map(math.radians, ARMS[joints][0])) if joints else ()


def with_random_links(joints: int, rng: np.random.Generator) -> Vehicle:
    """A vehicle whose links are any bodies with any axes."""

    def link() -> Link:
        points = rng.uniform(-0.05, 0.05, (4, 3))  # a body of four points of 50 g
        inertia = sum(0.05 * (p @ p * np.eye(3) - np.outer(p, p)) for p in points)
        return Link(
            origin_m=tuple(rng.uniform(-0.2, 0.2, 3)),
            origin_rpy_deg=tuple(rng.uniform(-80.0, 80.0, 3)),
            axis=tuple(rng.standard_normal(3)),
            mass_kg=0.2,
            com_m=tuple(rng.uniform(-0.1, 0.1, 3)),
            inertia_kg_m2=(*np.diag(inertia), inertia[0, 1], inertia[0, 2], inertia[1, 2]),
        )

    vehicle = vehicle_with_joints(joints)
    arm = vehicle.arm.model_copy(
        update={
            "link_lengths_m": (),
            "link_masses_kg": (),
            "link_com_m": (),
            "links": tuple(link() for _ in range(joints)),
            "tip_m": tuple(rng.uniform(-0.2, 0.2, 3)),
            "tip_rpy_deg": tuple(rng.uniform(-80.0, 80.0, 3)),
        }
    )
    tool = tool_of(vehicle).model_copy(update={"sensor_rpy_deg": (10.0, 20.0, 30.0)})
    return vehicle.model_copy(update={"arm": arm, "tool": tool})


def with_rod(vehicle: Vehicle) -> Vehicle:
    tool = Tool(
        kind="rod", sensor_mass_kg=0.15, mass_kg=0.2, length_m=0.3, tip_radius_m=0.01, sensor_rpy_deg=(10, 20, 30)
    )
    return vehicle.model_copy(update={"tool": tool})


def free(vehicle: Vehicle, config: WorldConfig = NO_FRICTION) -> OneMachine:
    """A world whose arm is not held."""
    world = OneMachine(vehicle, config, (0.0, 0.0), 0.0, (0.0,) * len(vehicle.arm.joints))
    world.machine.release_arm()
    return world


@pytest.mark.parametrize(
    "vehicle",
    [load_vehicle("tarot650_2r"), *(vehicle_with_joints(joints) for joints in (0, 1, 3, 4))]
    + [with_random_links(joints, np.random.default_rng(joints)) for joints in (1, 2, 3, 4)]
    + [with_rod(with_random_links(3, np.random.default_rng(7))), load_vehicle("configs/vehicles/tarot650_2r_rod.yaml")],
    ids=lambda vehicle: (
        f"{len(vehicle.arm.joints)} {'links' if vehicle.arm.links else 'rods'} {vehicle.tool.kind if vehicle.tool else ''}"
    ),
)
def test_mass_matrix_coriolis_and_gravity_are_those_of_the_laws_model(vehicle: Vehicle) -> None:
    joints = len(vehicle.arm.joints)
    world, model = free(vehicle), dynamics_of(vehicle)
    m, d, size = world.model, world.data, 6 + joints
    rng = np.random.default_rng(joints)
    for _ in range(5):
        roll, pitch, yaw = rpy = (*rng.uniform(-1.2, 1.2, 2).tolist(), float(rng.uniform(-3.0, 3.0)))
        angle_rad, chi_rate = rng.uniform(-3.0, 3.0, joints).tolist(), rng.uniform(-2.0, 2.0, size)
        attitude = quat_from_euler_zyx(roll, pitch, yaw)
        terms = model.terms(rotation_matrix(attitude), rpy, tuple(angle_rad), tuple(chi_rate.tolist()))
        turn, turn_rate = (np.array(matrix) for matrix in euler_rate_matrices(rpy, tuple(chi_rate.tolist())))
        to_mujoco, rate = np.eye(size), np.zeros((size, size))
        to_mujoco[3:6, 3:6], rate[3:6, 3:6] = turn, turn_rate
        d.qpos[:] = (*rng.uniform(-1.0, 1.0, 3), *attitude, *angle_rad)
        d.qvel[:] = to_mujoco @ chi_rate
        mujoco.mj_forward(m, d)
        mass = np.zeros((size, size))
        mujoco.mj_fullM(m, d, mass)
        np.testing.assert_allclose(to_mujoco.T @ mass @ to_mujoco, terms.mass, atol=1e-9)
        bias = to_mujoco.T @ (d.qfrc_bias + mass @ rate @ chi_rate)
        np.testing.assert_allclose(bias, np.add(terms.coriolis, terms.gravity), atol=1e-9)


def test_the_tip_of_a_rod_is_beyond_the_sensor_along_the_tips_axis() -> None:
    net = with_random_links(3, np.random.default_rng(5))
    vehicle = with_rod(net)
    world, chain = free(vehicle), chain_of(vehicle)
    m, d = world.model, world.data
    d.qpos[list(world.machine.layout.joint_q)] = alpha = (0.5, -1.0, 2.0)
    mujoco.mj_forward(m, d)
    link = m.body("link3").id
    last = d.xmat[link].reshape(3, 3)
    sensor = chain_of(net)
    np.testing.assert_allclose(d.site_xpos[m.site("net").id], d.xpos[link] + last @ sensor.tip_m, atol=1e-12)
    np.testing.assert_allclose(d.site_xpos[m.site("tip").id], d.xpos[link] + last @ chain.tip_m, atol=1e-12)
    outwards = np.array(rotation_matrix(chain.tip_wxyz)) @ (0.3, 0.0, 0.0)
    np.testing.assert_allclose(np.subtract(chain.tip_m, sensor.tip_m), outwards, atol=1e-12)
    tip_m = d.site_xpos[m.site("tip").id] - d.xpos[m.body("base").id]
    np.testing.assert_allclose(manipulator_of(vehicle).net_body_m(alpha), tip_m, atol=1e-12)
    assert m.body_subtreemass[m.body("base").id] == pytest.approx(vehicle.airframe.mass_kg)


def test_the_errors_of_the_machine_act_on_any_chain() -> None:
    vehicle = with_random_links(3, np.random.default_rng(6))
    machine = Machine(
        on=True,
        shoulder_offset_m=(0.003, -0.002, 0.001),
        shoulder_rpy_deg=(1.0, -0.8, 0.6),
        link_length_error_m=(0.001, -0.002),
        link_com_error_m=(0.01, 0.0, -0.01),
    )
    config = NO_FRICTION.model_copy(update={"machine": machine, "link_mass_error": (0.1, 0.0, -0.1)})
    nominal, built = free(vehicle).model, free(vehicle, config).model
    arm = vehicle.arm
    ends = [*(np.array(link.origin_m) for link in arm.links[1:]), np.array(arm.tip_m)]
    along = [end / np.linalg.norm(end) for end in ends]
    assert built.body("link1").pos == pytest.approx(np.add(arm.links[0].origin_m, machine.shoulder_offset_m))
    for number, (end, way, error_m) in enumerate(zip(ends, along, (0.001, -0.002, -0.002), strict=True), start=2):
        body = built.body(f"link{number}" if number < 4 else "sensor")
        assert body.pos == pytest.approx(end + error_m * way)
    for number, (link, way, error_m, mass) in enumerate(
        zip(arm.links, along, (0.01, 0.0, -0.01), (1.1, 1.0, 0.9), strict=True), start=1
    ):
        body, plain = built.body(f"link{number}"), nominal.body(f"link{number}")
        assert body.mass[0] == pytest.approx(mass * link.mass_kg)
        assert body.inertia == pytest.approx(mass * plain.inertia)
        assert body.ipos == pytest.approx(np.add(link.com_m, error_m * way))
    mount = quat_from_euler_zyx(math.radians(1.0), math.radians(-0.8), math.radians(0.6))
    own = quat_from_euler_zyx(*map(math.radians, arm.links[0].origin_rpy_deg))
    assert built.body("link1").quat == pytest.approx(quat_multiply(mount, own))


def plant_of(joints: int, **config: Any) -> tuple[Plant, FastBus, list[Any], Faults]:
    """A plant on the floor with the folded arm, and its servo bus."""
    vehicle = vehicle_with_joints(joints)
    world = WorldConfig(payload_kg=0.0, **config)
    servos = servos_of(vehicle, world)
    drives = [servo.drive for servo in servos]
    plant = Plant(vehicle, world, FixedRotors(), drives, Start((0.0, 0.0), 0.0, folded_rad(joints)))
    faults = Faults(world, plant.scene, plant.machine, stub_of(world, vehicle.airframe), drives, vehicle.tether)
    if world.faults:
        plant.inject(faults)
    return plant, FastBus(drives, scales_of(vehicle, servos), 0.1, plant.faults), drives, faults


@pytest.mark.parametrize("joints", [1, 3, 4])
def test_each_servo_reads_its_own_joint_and_turns_it_in_its_own_direction(joints: int) -> None:
    plant, bus, _, _ = plant_of(joints)
    plant.step(False)
    state = bus.read(0.0)
    assert state is not None
    assert state.angle_rad == pytest.approx(folded_rad(joints), abs=0.002)
    assert state.hardware_error == (0,) * joints and len(state.temperature_c) == joints
    wanted_nm = tuple(0.3 + 0.2 * joint for joint in range(joints))
    bus.write(0.0, wanted_nm)
    plant.step(False)
    plant.step(False)
    assert not plant.machine.parked
    torque_nm = plant.scene.data.ctrl[4:].tolist()
    assert torque_nm == pytest.approx(wanted_nm, abs=0.002)


def sprung(vehicle: Vehicle, config: WorldConfig) -> tuple[Plant, list[ServoDrive]]:
    """A plant with the folded arm, and its drives."""
    joints = len(vehicle.arm.joints)
    drives = [ServoDrive() for _ in range(joints)]
    return Plant(vehicle, config, FixedRotors(), drives, Start((0.0, 0.0), 0.0, folded_rad(joints))), drives


def hold(plant: Plant, drives: list[ServoDrive], until_s: float) -> None:
    """Let the drives hold the arm where it is."""
    plant.step(False)
    for drive in drives:
        drive.torque_on, (_, _, drive.goal_position_counts) = True, drive.present()
    plant.machine.release_arm()
    while plant.t_s < until_s:
        plant.step(False)


def test_every_joint_has_a_spring_of_its_own() -> None:
    """At rest each shaft is ahead of its link by the joint's torque times the compliance, of the mount or of the link before."""
    vehicle, flexible = vehicle_with_joints(3), Compliance(on=True, mount_deg_per_nm=1.0, link_deg_per_nm=2.0)
    plant, drives = sprung(vehicle, NO_FRICTION.model_copy(update={"compliance": flexible}))
    hold(plant, drives, 3.0)
    for joint, (drive, own, deg_per_nm) in enumerate(zip(drives, vehicle.arm.joints, (1.0, 2.0, 2.0), strict=True)):
        held_nm = float(plant.scene.data.qfrc_bias[6 + joint])
        shaft_rad = own.sign * (drive.angle_rad - own.zero_count / 4096.0 * math.tau)
        assert abs(held_nm) > 0.05
        ahead_rad = shaft_rad - plant.truth.joint_angle_rad[joint]
        assert ahead_rad == pytest.approx(math.radians(deg_per_nm) * held_nm, abs=5e-5)


def test_links_too_light_for_their_springs_get_the_inertia_that_the_physics_step_needs() -> None:
    geared = NO_FRICTION.model_copy(update={"servo_mechanics": ServoMechanics(on=True)})
    two, _ = sprung(load_vehicle("tarot650_2r"), geared)
    assert not two.scene.model.dof_armature.any()
    four, drives = sprung(vehicle_with_joints(4), NO_FRICTION.model_copy(update={"compliance": Compliance(on=True)}))
    added_kg_m2 = four.scene.model.dof_armature[6:10]
    assert 0.0 < added_kg_m2.min() == added_kg_m2.max() < 0.001
    hold(four, drives, 2.0)
    assert max(map(abs, four.truth.joint_velocity_rad_s)) < 0.01


def test_a_vehicle_without_an_arm_flies() -> None:
    low = [f"{key}={value}" for key, value in LOW_HOVER.items()]
    result = FastFlight(load_sitl(HOVER, overrides=[*overrides_with_joints(0), *low])).run()
    assert result.outputs[-1].outcome is Outcome.COMPLETED
    assert {event.id for output in result.outputs for event in output.events} == {"takeoff", "touchdown"}
    assert all(i.arm is None for i in result.inputs)


def test_without_an_arm_the_server_opens_no_servo_bus_and_no_force_sensor() -> None:
    config = WorldConfig(payload_kg=0.0, arm_handling=True, faults=(Fault(kind="gust", t_s=0.0, after="start"),))
    server = Sitl(
        [MachineWires(vehicle_with_joints(0), config, start_of((0.0, 0.0), 0.0, ()), Ports(), lambda _: None)]
    )

    async def served() -> set[str]:
        async with server.wires() as (devices,):
            for _ in range(5):
                server._step()
            return set(devices)

    assert asyncio.run(served()) == {"autopilot", "mocap"}
    assert server.machines[0].plant.t_s == pytest.approx(0.01)
