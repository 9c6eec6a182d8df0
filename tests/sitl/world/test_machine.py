"""The built machine differs from its vehicle file as the section `machine` says."""

from __future__ import annotations

import math
from typing import Any

import mujoco
import numpy as np
import pytest
from numpy.typing import NDArray

from companion.config.vehicle import Vehicle
from companion.model.constants import GRAVITY_M_S2
from companion.sitl_config.effects.machine import Machine
from companion.sitl_config.loader import load_sitl
from companion.sitl_config.world import World as WorldConfig
from sitl.world.model import base_mass_kg
from tests.sitl.plants import OneMachine
from tests.support import CATCH, tool_of

Array = NDArray[np.float64]
VEHICLE = load_sitl(CATCH).vehicle
ARM_RAD = (math.radians(100.0), math.radians(40.0))
NOTHING = {
    "centre_of_mass_m": (0.0, 0.0, 0.0),
    "inertia_error": (0.0, 0.0, 0.0),
    "shoulder_offset_m": (0.0, 0.0, 0.0),
    "shoulder_rpy_deg": (0.0, 0.0, 0.0),
    "link_length_error_m": (0.0, 0.0),
    "link_com_error_m": (0.0, 0.0),
}


def built(vehicle: Vehicle = VEHICLE, **errors: Any) -> OneMachine:
    """A world with these errors and no others, arm held at `ARM_RAD`."""
    config = WorldConfig(payload_kg=0.0, machine=Machine(on=True, **{**NOTHING, **errors}))
    return OneMachine(vehicle, config, (0.0, 0.0), 0.0, ARM_RAD)


def rotation(rpy_deg: tuple[float, float, float]) -> Array:
    """Rotation matrix of ZYX roll, pitch, yaw."""
    roll, pitch, yaw = (math.radians(angle) for angle in rpy_deg)
    about_x = np.array([[1, 0, 0], [0, math.cos(roll), -math.sin(roll)], [0, math.sin(roll), math.cos(roll)]])
    about_y = np.array([[math.cos(pitch), 0, math.sin(pitch)], [0, 1, 0], [-math.sin(pitch), 0, math.cos(pitch)]])
    about_z = np.array([[math.cos(yaw), -math.sin(yaw), 0], [math.sin(yaw), math.cos(yaw), 0], [0, 0, 1]])
    return np.asarray(about_z @ about_y @ about_x)


def test_a_hover_with_a_shifted_centre_of_mass_needs_the_torque_of_that_shift_and_stays_level() -> None:
    shift_m = (0.010, -0.006, 0.008)
    world = built(centre_of_mass_m=shift_m)
    m, d = world.model, world.data
    world.machine.release_arm()
    d.qpos[2] = 2.0
    mujoco.mj_forward(m, d)

    shift_nm = GRAVITY_M_S2 * base_mass_kg(VEHICLE, WorldConfig()) * np.array([shift_m[1], -shift_m[0], 0.0])
    nominal = built()
    nominal.data.qpos[2] = 2.0
    mujoco.mj_forward(nominal.model, nominal.data)
    assert d.qfrc_bias[3:6] - nominal.data.qfrc_bias[3:6] == pytest.approx(shift_nm, abs=1e-9)

    # Rotor i at (x_i, y_i) a / sqrt 2 with thrust T_i: sum T = W, sum y T = W c_y, sum x T = W c_x, sum s T = 0, for the level vehicle.
    weight_n, centre_m = world.machine.weight_n, d.subtree_com[m.body("base").id] - d.qpos[:3]
    a = VEHICLE.airframe.rotor_arm_m / math.sqrt(2.0)
    places = np.array([(1, -1, -1), (-1, 1, -1), (1, 1, 1), (-1, -1, 1)])  # x, y, sign of the yaw torque
    equations = np.vstack([np.ones(4), a * places[:, 0], a * places[:, 1], places[:, 2]])
    d.ctrl[:4] = np.linalg.solve(equations, [weight_n, weight_n * centre_m[0], weight_n * centre_m[1], 0.0])
    d.ctrl[4:6] = d.qfrc_bias[6:8]
    mujoco.mj_forward(m, d)
    assert d.qacc == pytest.approx(np.zeros(8), abs=1e-6)
    assert min(d.ctrl[:4]) > 0.0


def test_the_sensor_frame_of_the_vehicle_file_is_turned_by_zyx_angles() -> None:
    rpy_deg = (10.0, 20.0, 30.0)
    tool = tool_of(VEHICLE).model_copy(update={"sensor_rpy_deg": rpy_deg})
    world = built(VEHICLE.model_copy(update={"tool": tool}))
    link, sensor = (world.data.xmat[world.model.body(name).id].reshape(3, 3) for name in ("link2", "net"))
    assert link.T @ sensor == pytest.approx(rotation(rpy_deg))


@pytest.mark.parametrize(
    ("beside_m", "turning", "hit"), [(0.0, True, True), (-0.01, True, True), (0.01, True, False), (0.0, False, False)]
)
def test_a_ball_in_the_disk_of_a_turning_rotor_is_a_crash(beside_m: float, turning: bool, hit: bool) -> None:
    """It falls through the middle of a rotor, or past the outermost edge of its disk, of a vehicle that is yawed and in the air."""
    config = WorldConfig(payload_kg=0.2)
    world, layout = OneMachine(VEHICLE, config, (1.0, 0.0), 0.7, ARM_RAD), VEHICLE.airframe.rotor_layout
    payload, d = world.payload, world.data
    assert payload.ball is not None
    rotor = np.array(layout.positions_body_m[0][:2])
    out = rotor / np.linalg.norm(rotor)
    edge_m = VEHICLE.airframe.disk_radius_m + config.payload_radius_m + beside_m
    x, y = rotor if beside_m == 0.0 else rotor + edge_m * out
    d.qpos[2] = 2.0
    at, yaw_rad = payload.ball.q, 0.7
    d.qpos[at : at + 3] = (
        1.0 + math.cos(yaw_rad) * x - math.sin(yaw_rad) * y,
        math.sin(yaw_rad) * x + math.cos(yaw_rad) * y,
        2.3,
    )
    d.qvel[payload.ball.v + 2] = -3.0
    payload.throws, payload._flies_since_s = 1, world.t_s
    mujoco.mj_forward(world.model, d)
    world.model.opt.gravity[:] = 0.0
    for _ in range(100):  # 0.2 s: past the rotors
        world.fly((0.05 if turning else 0.0,) * layout.count, (0.0, 0.0), False, drag=False)
    assert [event.kind for event in world.take_events()] == (["rotor_hit", "crashed"] if hit else [])
