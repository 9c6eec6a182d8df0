"""The built machine differs from its vehicle file as the section `machine` says; and every part of it follows another vehicle file."""

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
from tests.sitl.plants import OneMachine, run
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


def net_body_m(world: OneMachine) -> Array:
    return np.array(world.data.site_xpos[world.model.site("net").id] - world.data.qpos[:3])


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


def test_the_shoulder_is_moved_and_turned_with_the_whole_arm() -> None:
    offset_m, rpy_deg = (0.003, -0.002, 0.001), (1.0, -0.8, 0.6)
    nominal = net_body_m(built())
    assert net_body_m(built(shoulder_offset_m=offset_m)) - nominal == pytest.approx(offset_m)
    shoulder = np.array(VEHICLE.arm.shoulder_body_m)
    turned = rotation(rpy_deg) @ (nominal - shoulder)
    assert net_body_m(built(shoulder_rpy_deg=rpy_deg)) - shoulder == pytest.approx(turned)


def test_the_sensor_frame_of_the_vehicle_file_is_turned_by_zyx_angles() -> None:
    rpy_deg = (10.0, 20.0, 30.0)
    tool = tool_of(VEHICLE).model_copy(update={"sensor_rpy_deg": rpy_deg})
    world = built(VEHICLE.model_copy(update={"tool": tool}))
    link, sensor = (world.data.xmat[world.model.body(name).id].reshape(3, 3) for name in ("link2", "net"))
    assert link.T @ sensor == pytest.approx(rotation(rpy_deg))


PHYSICAL = {
    "airframe": {
        "mass_kg": 2.4,
        "inertia_kg_m2": (0.03, 0.035, 0.05),
        "rotor_arm_m": 0.22,
        "yaw_torque_per_thrust_m": 0.016,
        "ground_clearance_m": 0.2,
    },
    "arm": {
        "shoulder_body_m": (0.05, 0.01, -0.08),
        "link_lengths_m": (0.15, 0.25),
        "link_masses_kg": (0.1, 0.12),
        "link_com_m": (0.1, 0.11),
        "joint_armature_kg_m2": 0.003,
    },
    "tool": {"sensor_mass_kg": 0.1, "net_mass_kg": 0.05, "sensor_rpy_deg": (0.0, 0.0, 90.0)},
    "tether": {"anchor_world_m": (0.5, -1.0, 0.1), "length_m": 2.0, "attachment_body_m": (0.0, 0.0, 0.1)},
}
"""Another machine; every value differs from the Tarot's."""


def test_another_vehicle_file_is_another_machine_in_all_its_parts() -> None:
    parts = {part: getattr(VEHICLE, part).model_copy(update=values) for part, values in PHYSICAL.items()}
    airframe = parts["airframe"].model_copy(update={"thrust_max_n": 40.0})
    other = VEHICLE.model_copy(update={**parts, "airframe": airframe})
    world = OneMachine(other, WorldConfig(payload_kg=0.0), (0.0, 0.0), 0.0, ARM_RAD)
    model, data = world.model, world.data
    assert world.machine.weight_n == pytest.approx(2.4 * GRAVITY_M_S2)
    assert world.machine.hover_command == pytest.approx(2.4 * GRAVITY_M_S2 / 40.0)
    assert data.qpos[2] == 0.2
    assert sorted(model.body("base").inertia) == [0.03, 0.035, 0.05]
    assert model.dof_armature[6:8].tolist() == [0.003, 0.003]
    rotors = np.array([model.site(f"rotor{k}").pos for k in range(4)])
    assert np.linalg.norm(rotors[:, :2], axis=1) == pytest.approx([0.22] * 4)
    assert np.abs(model.actuator_gear[:4, 5]) == pytest.approx([0.016] * 4)
    assert model.tendon_range[0, 1] == 2.0
    assert world.machine.tether.attachment_world_m == pytest.approx((0.0, 0.0, 0.3))
    # It stands on its feet at the clearance of its own file.
    run(world, 0.5)
    assert world.machine.q[2] == pytest.approx(0.2, abs=0.003)
    assert not world.machine.crashed
    # Full command lifts it with the thrust of its own file.
    for _ in range(500):
        world.fly((1.0, 1.0, 1.0, 1.0), (0.0, 0.0), False, drag=False)
    assert float(data.ctrl[:4].sum()) == pytest.approx(40.0)


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
