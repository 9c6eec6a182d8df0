"""The rotors' wakes on arm, net and payload, against momentum theory and the drag equation."""

from __future__ import annotations

import math
from typing import Any

import mujoco
import numpy as np
import pytest

from companion.config.vehicle import Vehicle
from companion.model.rotors import standard_layout
from companion.sitl_config.effects.downwash import Downwash as DownwashConfig
from companion.sitl_config.loader import load_sitl
from companion.sitl_config.world import World as WorldConfig
from sitl.world.effects.downwash import Wakes
from tests.sitl.plants import OneMachine, act, load
from tests.support import CATCH

VEHICLE = load_sitl(CATCH).vehicle
LAYOUT = VEHICLE.airframe.rotor_layout
ROTOR_HEIGHT_M = LAYOUT.positions_body_m[2][2]
RADIUS_M = 0.165
DISK_M2 = math.pi * RADIUS_M**2
THRUST_N = 7.5
FOUR_N = (THRUST_N,) * 4
SHARP = 1e-4
"""A spread that leaves the wake's edge sharp."""


def developed(depth_m: float) -> float:
    """Velocity over that far below the disk: 0.5 in the disk, 1 far below."""
    return 0.5 + 0.5 * depth_m / math.hypot(RADIUS_M, depth_m)


def test_every_wake_of_an_octocopter_is_below_its_own_rotor() -> None:
    layout = standard_layout("octa_x", 0.5, 0.0)
    wakes = Wakes(layout, 0.1, SHARP)
    for number in range(8):
        thrust_n = tuple(float(i == number) for i in range(8))
        found = [wakes.pressure_pa(thrust_n, (x, y, -0.05)) > 0.0 for x, y, _ in layout.positions_body_m]
        assert found == [i == number for i in range(8)]


def under_rotor(arm_rad: tuple[float, float], **settings: Any) -> OneMachine:
    """A level world at 2 m whose arm is mounted below the front right rotor, with a sharp and steady wake."""
    x, y, _ = LAYOUT.positions_body_m[0]
    arm = VEHICLE.arm.model_copy(update={"shoulder_body_m": (x - 0.1, y, -0.07)})
    return hovering(VEHICLE.model_copy(update={"arm": arm}), arm_rad, **{"spread": SHARP, **settings})


def hovering(vehicle: Vehicle, arm_rad: tuple[float, float], height_m: float = 2.0, **settings: Any) -> OneMachine:
    """A world with these settings whose effect has acted once, all thrusts `THRUST_N`."""
    effect = DownwashConfig(on=True, **{"turbulence_intensity": 0.0, **settings})
    world = OneMachine(vehicle, WorldConfig(downwash=effect), (0.0, 0.0), 0.0, arm_rad)
    world.data.qpos[2] = height_m
    mujoco.mj_forward(world.model, world.data)
    world.data.ctrl[0:4] = FOUR_N
    act(world)
    return world


def test_a_level_link_below_a_rotor_feels_the_drag_of_its_area() -> None:
    config = DownwashConfig()
    world = under_rotor((0.0, math.radians(90.0)))
    length_m, com_m = VEHICLE.arm.link_lengths_m[0], VEHICLE.arm.link_com_m[0]
    pressure_pa = THRUST_N / DISK_M2 * developed(0.07 + ROTOR_HEIGHT_M) ** 2
    drag_n = config.link_drag_coefficient * config.link_width_m * length_m * pressure_pa
    # At its middle, behind the centre of mass: the torque about y is +x times -z forwards.
    torque_nm = (0.5 * length_m - com_m) * drag_n
    assert load(world, "link1") == pytest.approx([0.0, 0.0, -drag_n, 0.0, torque_nm, 0.0], rel=1e-6, abs=1e-12)
    assert 0.1 < drag_n < 1.0


def test_the_force_sensor_reads_the_wake_on_net_and_payload() -> None:
    readings = []
    for thrust_n in (0.0, THRUST_N):
        world = hovering(VEHICLE, (math.radians(90.0), 0.0), spread=0.4)
        m, d = world.model, world.data
        d.ctrl[0:4] = thrust_n
        act(world)
        d.qacc[:] = 0.0
        mujoco.mj_rnePostConstraint(m, d)
        mujoco.mj_sensorAcc(m, d)
        readings.append(np.array(world.machine.truth().force_sensor_n))
    rotation = world.data.site_xmat[world.model.site("net").id].reshape(3, 3)
    read_n = rotation @ (readings[1] - readings[0])
    np.testing.assert_allclose(read_n, load(world, "net")[:3], atol=1e-9)
    assert read_n[2] < -0.05


def test_there_is_no_wake_while_no_rotor_turns() -> None:
    world = hovering(VEHICLE, (math.radians(90.0), 0.0), turbulence_intensity=0.25)
    world.data.ctrl[0:4] = 0.0
    act(world)
    assert not world.data.xfrc_applied.any()
