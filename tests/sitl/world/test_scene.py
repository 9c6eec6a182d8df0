"""A scene with two machines: each flies by its own commands, as it would alone."""

from __future__ import annotations

import math
from collections.abc import Sequence

import numpy as np
import pytest

from companion.config.vehicle import Vehicle
from companion.model.constants import GRAVITY_M_S2
from companion.model.frames import euler_zyx_from_quat
from companion.sitl_config.effects.air import Air
from companion.sitl_config.effects.downwash import Downwash
from companion.sitl_config.effects.tether_line import TetherLine
from companion.sitl_config.loader import load_sitl
from companion.sitl_config.world import World
from sitl.world.machine import Machine
from sitl.world.scene import Scene
from sitl.world.start import MachineSpec, Start
from sitl.world.state import PHYSICS_DT_S, Truth
from tests.machines import vehicle_with_joints
from tests.support import CATCH

VEHICLE = load_sitl(CATCH).vehicle
OTHER = vehicle_with_joints(3)
"""A second machine that differs from the first in its arm."""
LOADED = World(seed=3, air=Air(on=True), downwash=Downwash(on=True), tether_line=TetherLine(on=True))
HEIGHT_M = 1.0
AGREE = 1e-9
"""Largest difference of any state in SI units between a machine alone and with another one far away. It is 0 with the pinned MuJoCo,
which solves the constraints of machines that do not touch separately.
"""


def spec(vehicle: Vehicle, config: World, x_m: float, yaw_rad: float = 0.0) -> MachineSpec:
    """A machine on the floor, the anchor of its tether beside it."""
    assert vehicle.tether is not None
    anchored = vehicle.tether.model_copy(update={"anchor_world_m": (x_m, -1.2, 0.0)})
    vehicle = vehicle.model_copy(update={"tether": anchored})
    arm_rad = tuple(1.7 if joint == 0 else 0.6 for joint in range(len(vehicle.arm.joints)))
    return MachineSpec(vehicle, config, Start((x_m, 0.0), yaw_rad, arm_rad))


class Hover:
    """A pilot with the true state who holds a machine `HEIGHT_M` above its start; nothing drives its joints."""

    def __init__(self, machine: Machine, spec: MachineSpec) -> None:
        self._machine, airframe = machine, spec.vehicle.airframe
        layout, turn = airframe.rotor_layout, airframe.yaw_torque_per_thrust_m
        rows = [(1.0, y, -x, -s * turn) for (x, y, _), s in zip(layout.positions_body_m, layout.spins, strict=True)]
        self._mix = np.linalg.pinv(np.array(rows).T) * layout.count / airframe.thrust_max_n
        self._goal = np.array([*spec.start.position_m, HEIGHT_M])
        self._missing, self._yaw_rad, self._joints = np.zeros(3), spec.start.yaw_rad, len(spec.start.arm_rad)

    def command(self, armed: bool) -> None:
        truth, weight_n = self._machine.truth(), self._machine.weight_n
        away = self._goal - truth.position_world_m
        self._missing += away * (PHYSICS_DT_S, PHYSICS_DT_S, 0.0)
        forward, left, up = (2.0 * away + 0.4 * self._missing - 3.0 * np.array(truth.velocity_world_m_s)) / GRAVITY_M_S2
        cos, sin = math.cos(self._yaw_rad), math.sin(self._yaw_rad)
        tilt = np.clip((sin * forward - cos * left, cos * forward + sin * left), -0.2, 0.2)
        turned = np.array(euler_zyx_from_quat(truth.attitude_wxyz)) - (*tilt, self._yaw_rad)
        wanted_nm = -6.0 * turned - 1.0 * np.array(truth.angular_rate_body_rad_s)
        commands = np.clip(self._mix @ np.array([weight_n * (1.0 + up), *wanted_nm]), 0.0, 1.0) * armed
        self._machine.command(tuple(commands.tolist()), (0.0,) * self._joints)


def fly(specs: Sequence[MachineSpec], time_s: float, armed: Sequence[bool] = (True, True)) -> list[list[Truth]]:
    """Let the armed machines hover and return the states of each."""
    scene = Scene(specs)
    pilots = [Hover(machine, each) for machine, each in zip(scene.machines, specs, strict=True)]
    states: list[list[Truth]] = [[] for _ in specs]
    for _ in range(round(time_s / PHYSICS_DT_S)):
        for pilot, on in zip(pilots, armed, strict=False):
            pilot.command(on)
        scene.step(False)
        for machine, own in zip(scene.machines, states, strict=True):
            own.append(machine.truth())
    assert not any(machine.crashed for machine in scene.machines) and scene.take_events() == []
    return states


def difference(one: Truth, other: Truth) -> float:
    fields = ("position_world_m", "velocity_world_m_s", "attitude_wxyz", "joint_angle_rad", "force_sensor_n")
    return max(math.dist(getattr(one, name), getattr(other, name)) for name in fields)


def test_two_machines_hover_each_by_its_own_rotors() -> None:
    specs = [spec(VEHICLE, World(), -1.0), spec(OTHER, World(), 1.0, 0.5)]
    for own, each in zip(fly(specs, 10.0), specs, strict=True):
        assert own[-1].position_world_m == pytest.approx((*each.start.position_m, HEIGHT_M), abs=0.05)
        assert euler_zyx_from_quat(own[-1].attitude_wxyz)[2] == pytest.approx(each.start.yaw_rad, abs=0.05)
        assert own[-1].joint_angle_rad == pytest.approx(each.start.arm_rad, abs=0.05)


@pytest.mark.parametrize("number", [0, 1], ids=["first", "second"])
def test_a_machine_flies_beside_a_distant_one_as_it_does_alone(number: int) -> None:
    mine, away = spec(VEHICLE, LOADED, 0.0), spec(OTHER, LOADED.model_copy(update={"seed": 4}), 15.0)
    (alone,) = fly([mine], 2.5)
    both = fly([away, mine] if number else [mine, away], 2.5)[number]
    apart = list(map(difference, alone, both))
    assert max(apart) < AGREE


def test_an_unstable_world_ends_with_an_error_and_does_not_begin_again() -> None:
    scene = Scene([spec(VEHICLE, World(), 0.0)])
    scene.step()
    scene.data.qvel[0] = math.inf
    with pytest.raises(FloatingPointError, match=r"^the simulated world became unstable at 0\.002 s"):
        scene.step()
