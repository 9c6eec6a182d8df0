"""Surfaces in the simulated world: stiffness, friction, place, and the rotors' distance."""

from __future__ import annotations

import math

import mujoco
import numpy as np
import pytest

from companion.config.loader import load_vehicle
from companion.config.vehicle import Vehicle
from companion.control.arm_model import manipulator_of
from companion.model.frames import quat_rotate
from companion.model.types import Vec3
from companion.sitl_config.surfaces import Surface
from companion.sitl_config.world import World as WorldConfig
from sitl.world.handling import Wrench
from sitl.world.state import PHYSICS_DT_S
from sitl.world.surfaces import Placed
from sitl.world.tool_contact import ToolContact
from tests.sitl.plants import OneMachine, run

SHIPPED = load_vehicle("configs/vehicles/tarot650_2r_rod.yaml")
assert SHIPPED.tool is not None
ROD = SHIPPED.model_copy(update={"tool": SHIPPED.tool.model_copy(update={"stiffness_n_m": None})})
"""With a hard ball: the surface's stiffness alone counts."""
PRESS = tuple(map(math.radians, ROD.poses_deg["press"]))
TIP_M = manipulator_of(ROD).net_body_m(PRESS)
MU = 0.4


def in_front(gap_m: float = 0.0, vehicle: Vehicle = ROD, **surface: object) -> OneMachine:
    """Return a weightless vehicle at rest with its tip at this distance from a wall ahead."""
    height_m = vehicle.airframe.ground_clearance_m + TIP_M[2]
    wall = {"point_m": (TIP_M[0] + vehicle.tip_radius_m + gap_m, 0.0, height_m), "normal": (-1.0, 0.0, 0.0)}
    config = WorldConfig.model_validate({"surfaces": ({**wall, "friction": MU, **surface},)})
    world = OneMachine(vehicle, config, (0.0, 0.0), 0.0, PRESS)
    world.model.opt.gravity[:] = 0.0
    return world


def contact(world: OneMachine) -> tuple[Vec3, Vec3]:
    return world.machine.layout.contact(world.machine.sensors())


def touch(world: OneMachine) -> ToolContact:
    assert world.machine.contact is not None
    return world.machine.contact


def pushed(world: OneMachine, force_n: Vec3, time_s: float) -> list[Vec3]:
    """Push the tip and return the force of the surface after each step."""
    forces = []
    for _ in range(round(time_s / PHYSICS_DT_S)):
        world.machine.push(force_n)
        world.fly((0.0,) * 4, (0.0, 0.0), False, drag=False)
        forces.append(contact(world)[1])
    return forces


@pytest.mark.parametrize("stiffness_n_m", [1e3, 1e6])
def test_the_tip_sinks_in_by_force_over_stiffness_and_rests(stiffness_n_m: float) -> None:
    world = in_front(stiffness_n_m=stiffness_n_m, damping_ratio=1.0)
    forces = [-x for x, _, _ in pushed(world, (5.0, 0.0, 0.0), 4.0)]
    depth_m = ROD.tip_radius_m - touch(world).surfaces.placed[0].local_m(contact(world)[0])[2]
    assert forces[-1] == pytest.approx(5.0, rel=0.01)
    assert depth_m == pytest.approx(5.0 / stiffness_n_m, rel=0.05)
    assert np.ptp(forces[-250:]) < 0.05, "the contact chatters"
    assert touch(world).touches == 1


@pytest.mark.parametrize(("kind", "stiffness_n_m"), [("brush", 1e3), ("rod", 1e5)])
def test_a_tip_yields_in_addition_to_the_surface(kind: str, stiffness_n_m: float) -> None:
    assert ROD.tool is not None
    soft = ROD.tool.model_copy(update={"kind": kind, "stiffness_n_m": 1000.0})
    world = in_front(vehicle=ROD.model_copy(update={"tool": soft}), stiffness_n_m=stiffness_n_m, damping_ratio=1.0)
    pushed(world, (5.0, 0.0, 0.0), 4.0)
    depth_m = ROD.tip_radius_m - touch(world).surfaces.placed[0].local_m(contact(world)[0])[2]
    assert depth_m == pytest.approx(5.0 / 1000.0 + 5.0 / stiffness_n_m, rel=0.05)


@pytest.mark.parametrize(("stiffness_n_m", "damping_ratio"), [(1e3, 0.0), (1e6, 0.0)])
def test_an_impact_adds_no_energy(stiffness_n_m: float, damping_ratio: float) -> None:
    world = in_front(0.01, stiffness_n_m=stiffness_n_m, damping_ratio=damping_ratio)
    energy_j = []
    world.data.qvel[0] = 0.2
    for _ in range(1000):
        run(world, PHYSICS_DT_S, drag=False)
        mass = np.zeros((world.model.nv, world.model.nv))
        mujoco.mj_fullM(world.model, world.data, mass)
        energy_j.append(0.5 * float(world.data.qvel @ mass @ world.data.qvel))
    assert touch(world).force_max_n > 2.0
    assert max(energy_j) <= energy_j[0] * (1.0 + 1e-3)
    assert energy_j[-1] < energy_j[0]


@pytest.mark.parametrize("stiffness_n_m", [1e3, 1e5])
def test_the_tip_sticks_below_the_friction_cone_and_slides_above_it(stiffness_n_m: float) -> None:
    stuck = in_front(stiffness_n_m=stiffness_n_m, damping_ratio=1.0)
    pushed(stuck, (5.0, 0.0, 0.0), 2.0)
    from_m = contact(stuck)[0]
    x, y, z = pushed(stuck, (5.0, 0.8 * MU * 5.0 * math.sqrt(0.5), 0.8 * MU * 5.0 * math.sqrt(0.5)), 0.2)[-1]
    assert math.dist(from_m, contact(stuck)[0]) < 2e-3
    assert math.hypot(y, z) < MU * -x
    slides = in_front(stiffness_n_m=stiffness_n_m, damping_ratio=1.0)
    pushed(slides, (5.0, 0.0, 0.0), 2.0)
    x, y, z = pushed(slides, (5.0, 1.4 * MU * 5.0, 0.0), 0.06)[-1]
    assert x == pytest.approx(-5.0, rel=0.1)
    assert math.hypot(y, z) == pytest.approx(MU * -x, rel=0.01)
    assert y < 0.0
    assert contact(slides)[0][1] > 0.003
    touch(stuck).surfaces.set_friction(0, 0.1)
    x, y, z = pushed(stuck, (5.0, 0.8 * MU * 5.0, 0.0), 0.06)[-1]
    assert math.hypot(y, z) == pytest.approx(-0.1 * x, rel=0.01)


def test_the_force_sensor_feels_the_contact_and_the_lever_of_the_rod() -> None:
    world = in_front(stiffness_n_m=1e4, damping_ratio=1.0)
    pushed(world, (0.0, 0.0, 0.0), 0.5)
    world.machine.hold(Wrench((6.0, 0.0, 2.0), (0.0, 0.0, 0.0)))
    run(world, 0.2, drag=False)
    truth, (_, force_n) = world.machine.truth(), contact(world)
    assert math.hypot(*force_n) > 1.0
    assert ROD.tool is not None
    acceleration = world.data.sensordata[world.machine.layout.accel : world.machine.layout.accel + 3]
    inertial_n = ROD.tool.beyond_sensor_kg * float(np.linalg.norm(acceleration))
    down_m = math.degrees(PRESS[0] - PRESS[1])
    assert down_m == pytest.approx(0.0)
    np.testing.assert_allclose(
        quat_rotate(truth.attitude_wxyz, truth.force_sensor_n), force_n, atol=3.0 * inertial_n + 0.05
    )
    lever_nm = -ROD.tool.beyond_sensor_m * force_n[2]
    assert truth.torque_sensor_nm[1] == pytest.approx(lever_nm, abs=0.1 + 1.5 * inertial_n)


def test_the_surface_is_moved_and_tilted_by_its_errors() -> None:
    config = Surface(point_m=(1.0, 0.0, 1.0), normal=(-2.0, 0.0, 0.0), place_error_m=0.05, tilt_error_deg=(10.0, 0.0))
    placed = Placed.of(config)
    assert placed.point_m == pytest.approx((0.95, 0.0, 1.0))
    yawed = Placed.of(config.model_copy(update={"tilt_error_deg": (0.0, 12.0)}))
    assert math.degrees(math.acos(-placed.normal[0])) == pytest.approx(10.0)
    assert placed.normal[2] == pytest.approx(0.0)
    assert math.degrees(math.acos(-yawed.normal[0])) == pytest.approx(12.0)
    assert yawed.normal[1] == pytest.approx(0.0)
    np.testing.assert_allclose(np.array(yawed.axes) @ np.array(yawed.axes).T, np.eye(3), atol=1e-12)
    assert np.linalg.det(np.array(yawed.axes)) == pytest.approx(1.0)


def test_a_panel_gives_way_above_its_force() -> None:
    world = in_front(stiffness_n_m=1e4, damping_ratio=1.0, gives_way_n=8.0)
    pushed(world, (5.0, 0.0, 0.0), 1.0)
    assert touch(world).surfaces.gone == [False]
    pushed(world, (12.0, 0.0, 0.0), 0.3)
    assert touch(world).surfaces.gone == [True]
    assert contact(world)[1] == pytest.approx((0.0, 0.0, 0.0), abs=1e-9)
    assert [event.kind for event in world.take_events()] == ["touched", "gave_way"]


def test_a_rotor_that_touches_a_wall_is_a_crash() -> None:
    reach_m = max(x for x, _, _ in ROD.airframe.rotor_layout.positions_body_m) + ROD.airframe.disk_radius_m
    height_m = ROD.airframe.ground_clearance_m
    wall = {"normal": (-1.0, 0.0, 0.0), "size_m": (4.0, 0.2)}  # above the arm
    config = WorldConfig.model_validate({"surfaces": ({**wall, "point_m": (reach_m + 0.1, 0.0, height_m + 0.1)},)})
    folded = tuple(map(math.radians, ROD.poses_deg["folded"]))
    world = OneMachine(ROD, config, (0.0, 0.0), 0.0, folded)
    world.model.opt.gravity[:] = 0.0
    world.data.qvel[0] = 0.5
    world.fly((0.0,) * 4, (0.0, 0.0), False, drag=False)
    assert touch(world).rotor_distance_m == pytest.approx(0.1, abs=0.003)
    run(world, 0.26, drag=False)
    assert world.machine.crashed
    assert touch(world).report()["rotor_distance_min_m"] <= 0.0
    assert [event.kind for event in world.take_events()] == ["rotor_touched", "crashed"]
