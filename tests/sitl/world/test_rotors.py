"""Thrust, lag, ground effect and drag of the true rotors against closed forms, and the hover thrust that follows from them."""

from __future__ import annotations

import math
from typing import Any

import pytest

from companion.model.rotors import motor_signal
from companion.model.types import Vec4
from companion.sitl_config.effects.rotors import Rotors as RotorsConfig
from companion.sitl_config.loader import load_sitl
from companion.sitl_config.world import World as WorldConfig
from sitl.autopilot.backend import stub_of
from sitl.fast.loop import FastFlight
from sitl.px4.parameters import parameters
from sitl.world.effects.rotors import Rotors
from sitl.world.state import PHYSICS_DT_S
from tests.sitl.plants import OneMachine
from tests.support import CATCH

VEHICLE = load_sitl(CATCH).vehicle
ARM_M = VEHICLE.airframe.rotor_arm_m
LAYOUT = VEHICLE.airframe.rotor_layout
FULL_N = 15.0
HALF: Vec4 = (0.5, 0.5, 0.5, 0.5)
ALIKE = {"thrust_error": (0.0, 0.0, 0.0, 0.0), "yaw_torque_error": (0.0, 0.0, 0.0, 0.0)}


def rotors(**changes: Any) -> Rotors:
    return Rotors(RotorsConfig(on=True, **changes), LAYOUT, PHYSICS_DT_S)


def run(effect: Rotors, signals: Vec4, time_s: float) -> tuple[float, ...]:
    """Thrusts after this time."""
    thrust: tuple[float, ...] = ()
    for _ in range(round(time_s / PHYSICS_DT_S)):
        thrust = effect.step(signals, FULL_N)
    return thrust


def standing(**sections: Any) -> OneMachine:
    return OneMachine(VEHICLE, WorldConfig(payload_kg=0.0, **sections), (0.0, 0.0), 0.0, (1.0, 1.0))


def test_settled_thrust_is_the_curve_times_each_rotors_own_gain() -> None:
    signals, errors = (0.2, 0.5, 0.8, 1.0), (0.03, -0.03, 0.01, 0.0)
    found = run(rotors(thrust_curve=0.6, thrust_error=errors), signals, 2.0)
    wanted = [FULL_N * (1.0 + e) * (0.6 * s * s + 0.4 * s) for s, e in zip(signals, errors, strict=True)]
    assert found == pytest.approx(wanted)


def test_rotor_speed_rises_and_falls_with_its_own_time_constant() -> None:
    """Rotor speed goes with the root of the thrust."""
    effect = rotors(lag_up_s=0.04, lag_down_s=0.08, **ALIKE)
    top = math.sqrt(FULL_N * (0.5 * 0.25 + 0.5 * 0.5))
    up = run(effect, HALF, 0.04)
    assert [math.sqrt(n) for n in up] == pytest.approx([top * (1.0 - math.exp(-1.0))] * 4)
    assert run(effect, HALF, 2.0) == pytest.approx((top * top,) * 4)
    down = run(effect, (0.0, 0.0, 0.0, 0.0), 0.08)
    assert [math.sqrt(n) for n in down] == pytest.approx([top * math.exp(-1.0)] * 4)


@pytest.mark.parametrize("height_m", [0.1, 1.0])
def test_ground_effect_of_four_rotors(height_m: float) -> None:
    r, z, across = 0.165, height_m, 2.0 * ARM_M
    beside = across / math.sqrt(2.0)
    one = (r / (4.0 * z)) ** 2
    neighbours = r**2 * z / (beside**2 + 4.0 * z**2) ** 1.5
    opposite = r**2 / 2.0 * z / (2.0 * beside**2 + 4.0 * z**2) ** 1.5
    body = 2.0 * r**2 * z / (across**2 + 4.0 * z**2) ** 1.5 * 2.0
    found = rotors(radius_m=r, ground_body_lift=2.0).ground_effect(height_m)
    assert found == pytest.approx(1.0 / (1.0 - one - neighbours - opposite - body))


def test_drag_opposes_the_airspeed_across_the_rotor_axis() -> None:
    effect = rotors(drag_s_m=0.02)
    level = (0.0, 0.0, 1.0, 1.0, 0.0, 0.0, 0.0)
    assert effect.drag_n(30.0, (2.0, -1.0, 5.0), level) == pytest.approx((1.2, -0.6, 0.0))
    quarter = math.sqrt(0.5)
    nose_down = (0.0, 0.0, 1.0, quarter, 0.0, quarter, 0.0)  # rotor axis along world x
    assert effect.drag_n(30.0, (2.0, -1.0, 5.0), nose_down) == pytest.approx((0.0, -0.6, 3.0))


def test_autopilot_assumes_its_own_curve_whether_it_is_the_stub_or_px4() -> None:
    config = WorldConfig.model_validate({"rotors": {"on": True, "thr_mdl_fac": 0.25}})
    for found in (
        stub_of(config, VEHICLE.airframe).params.real("THR_MDL_FAC"),
        parameters(VEHICLE.airframe, config, 0.5)["THR_MDL_FAC"],
    ):
        assert found == 0.25
    for command in (0.0, 0.3, 1.0):
        signal = motor_signal(command, 0.25)
        assert 0.25 * signal**2 + 0.75 * signal == pytest.approx(command)
        assert motor_signal(command, 0.0) == command


def test_vehicle_hovers_at_the_true_hover_thrust() -> None:
    """PX4's MPC_THR_HOVER is the setpoint of the hover: less the ground effect, plus what the battery loses in a few seconds."""
    config = load_sitl("configs/missions/hover.yaml", overrides=("world.rotors.on=true", "world.battery.on=true"))
    flight = FastFlight(config)
    result = flight.run(10.5)
    hover = [o.attitude.thrust for o in result.outputs if o.t_s >= 8.5 and o.attitude is not None]
    truth = flight.plant.machine.hover_command
    assert flight.px4.params.real("MPC_THR_HOVER") == pytest.approx(truth)
    assert result.snapshots[-1].q[2] > VEHICLE.airframe.ground_clearance_m + 0.5
    assert sum(hover) / len(hover) == pytest.approx(truth, rel=0.02)
