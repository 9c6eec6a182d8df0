"""The simulated airframe is the one of the vehicle file."""

from __future__ import annotations

import math
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import mujoco
import pytest

from companion.config.airframe import Rotor
from companion.config.vehicle import Vehicle
from companion.model.rotors import LAYOUTS
from companion.model.types import Outcome, Vec3
from companion.sitl_config.loader import load_sitl
from companion.sitl_config.world import World as WorldConfig
from sitl.autopilot.mixer import Mixer
from sitl.fast.loop import FastFlight
from tests.sitl.plants import OneMachine
from tests.support import HOVER, LOW_HOVER, SHORT_CATCH

pytestmark = pytest.mark.usefixtures("short_start")

VEHICLE = load_sitl(HOVER).vehicle


def with_airframe(**changes: Any) -> Vehicle:
    return VEHICLE.model_copy(update={"airframe": VEHICLE.airframe.model_copy(update=changes)})


def torque_nm(vehicle: Vehicle, thrusts_n: Sequence[float], **settings: Any) -> Vec3:
    """Torque of the rotors on the base, body FLU."""
    world = OneMachine(vehicle, WorldConfig(payload_kg=0.0, **settings), (0.0, 0.0), 0.0, (1.5, 1.5))
    model, data = world.model, world.data
    data.ctrl[: len(thrusts_n)] = thrusts_n
    mujoco.mj_forward(model, data)
    x, y, z = data.qfrc_actuator[3:6].tolist()
    return (x, y, z)


@pytest.mark.parametrize(("arm_m", "yaw_m"), [(0.325, 0.025), (0.22, 0.016)])
def test_torque_follows_from_the_rotor_arm_and_the_yaw_torque_per_thrust(arm_m: float, yaw_m: float) -> None:
    vehicle = with_airframe(rotor_arm_m=arm_m, yaw_torque_per_thrust_m=yaw_m)
    offset_m = arm_m / math.sqrt(2.0)
    front_right, rear_left, front_left, rear_right = 8.0, 7.0, 6.0, 5.0
    roll_nm = offset_m * (rear_left + front_left - front_right - rear_right)
    pitch_nm = offset_m * (rear_left + rear_right - front_left - front_right)
    yaw_nm = yaw_m * (front_left + rear_right - front_right - rear_left)
    expected = pytest.approx((roll_nm, pitch_nm, yaw_nm), abs=1e-9)
    assert torque_nm(vehicle, (front_right, rear_left, front_left, rear_right)) == expected


PLACES = (
    (0.3, -0.15, "ccw"),
    (-0.2, 0.2, "ccw"),
    (0.3, 0.15, "cw"),
    (-0.2, -0.2, "cw"),
    (0.0, 0.3, "cw"),
    (0.0, -0.3, "ccw"),
)
SPREAD = tuple(Rotor.model_validate({"position_body_m": (x, y, 0.05), "spin": spin}) for x, y, spin in PLACES)


@pytest.mark.parametrize("layout", [*LAYOUTS, "listed"])
def test_the_mixer_controls_each_torque_of_the_simulated_rotors_by_itself(layout: str) -> None:
    """Torques in FRD; thrust alone turns nothing."""
    changes = {"rotors": SPREAD} if layout == "listed" else {"layout": layout}
    vehicle = with_airframe(**changes)
    mixer = Mixer(vehicle.airframe.rotor_layout)
    for axis, column in enumerate((mixer.roll, mixer.pitch, mixer.yaw, mixer.thrust)):
        x, y, z = torque_nm(vehicle, column)
        found = (x, -y, -z)
        for other in range(3):
            if other == axis:
                assert found[other] > 0.02
            else:
                assert found[other] == pytest.approx(0.0, abs=1e-9)
    assert sum(mixer.roll) == pytest.approx(0.0, abs=1e-9)
    assert sum(mixer.thrust) == pytest.approx(mixer.count)


def test_saturation_shrinks_the_torques_of_any_layout_but_keeps_their_direction() -> None:
    layout = with_airframe(rotors=SPREAD).airframe.rotor_layout
    mixer = Mixer(layout)
    for roll, pitch, yaw in ((0.9, -0.7, 0.8), (-2.0, 0.3, -1.0), (0.1, 0.2, 3.0)):
        for thrust in (0.1, 0.5, 1.0):
            commands = mixer.mix((roll, pitch, yaw), thrust)
            assert 0.0 <= min(commands) <= max(commands) <= 1.0
            x_nm, y_nm = (
                sum(place[axis] * k for place, k in zip(layout.positions_body_m, commands, strict=True))
                for axis in (1, 0)
            )
            assert x_nm * pitch == pytest.approx(y_nm * roll, abs=1e-6)
            assert x_nm * roll > 0.0
            assert yaw * sum(spin * k for spin, k in zip(layout.spins, commands, strict=True)) > -1e-6


@pytest.mark.parametrize("thrust", [0.0, 0.05])
def test_the_thrust_is_never_raised_for_a_torque(thrust: float) -> None:
    """MC_AIRMODE 0: zero thrust stops the rotors whatever the rates are."""
    layout = with_airframe(rotors=SPREAD).airframe.rotor_layout
    mixer = Mixer(layout)
    level, turned = mixer.mix((0.0, 0.0, 0.0), thrust), mixer.mix((0.2, -0.1, 0.1), thrust)
    assert sum(turned) <= sum(level) + 1e-9
    assert (max(turned) > max(level)) == (thrust > 0.0)


WEAK = [
    "world.faults=[{kind: motor_weak, t_s: 1.0, size: 0.2}]",
    *(f"{key}={value}" for key, value in LOW_HOVER.items()),
]


@pytest.mark.parametrize(("layout", "mission", "extra"), [("octa_plus", SHORT_CATCH, []), ("hexa_x", HOVER, WEAK)])
def test_other_layouts_hover_with_a_weak_rotor_and_catch(layout: str, mission: Path, extra: list[str]) -> None:
    flight = FastFlight(load_sitl(mission, overrides=[f"vehicle.airframe.layout={layout}", *extra]))
    result, machine = flight.run(), flight.plant.machine
    assert machine.rotor_count == {"hexa_x": 6, "octa_plus": 8}[layout]
    assert machine.rotor_share == ((0.8, *[1.0] * 5) if extra else None)
    assert result.caught is (mission == SHORT_CATCH)
    assert result.outputs[-1].outcome is Outcome.COMPLETED
    for truth, output in zip(result.truth, result.outputs, strict=True):
        if output.reference is not None and truth.position_world_m[2] > 0.4:
            assert math.dist(truth.position_world_m, output.reference.position_world_m) < 0.12
