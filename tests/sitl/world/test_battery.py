"""Voltage, current and charge of the true battery against closed forms, and what PX4's power module reports of it."""

from __future__ import annotations

from typing import Any

import pytest

from companion.model.types import Vec4
from companion.sitl_config.effects.battery import Battery as BatteryConfig
from companion.sitl_config.loader import load_sitl
from companion.sitl_config.world import World as WorldConfig
from sitl.fast.loop import FastFlight
from sitl.world.effects.battery import BatteryPack, open_circuit_v
from sitl.world.state import PHYSICS_DT_S
from tests.sitl.plants import OneMachine
from tests.support import CATCH

VEHICLE = load_sitl(CATCH).vehicle
WEIGHT_N = 29.4
HOVER: Vec4 = (WEIGHT_N / 4.0,) * 4


def pack(start: float = 1.0, life_s: float = 900.0, **changes: Any) -> BatteryPack:
    return BatteryPack(BatteryConfig(on=True, **changes), start, life_s, WEIGHT_N, VEHICLE.airframe)


@pytest.mark.parametrize("each_n", [0.0, 7.35, 12.0])
def test_voltage_sags_by_the_resistance_times_the_current(each_n: float) -> None:
    battery = pack(resistance_ohm=0.03)
    battery.step(PHYSICS_DT_S, (each_n,) * 4)
    assert battery.voltage_v * battery.current_a == pytest.approx(15.0 + 4.0 * 3.9 * each_n**1.5)
    assert battery.voltage_v == pytest.approx(open_circuit_v(1.0, 4) - 0.03 * battery.current_a)


def test_hovering_empties_the_battery_in_its_life() -> None:
    battery = pack(life_s=100.0)
    battery.step(PHYSICS_DT_S, HOVER)
    assert battery.voltage_v == pytest.approx(battery.hover_v)
    for _ in range(round(50.0 / PHYSICS_DT_S) - 1):
        battery.step(PHYSICS_DT_S, HOVER)
    assert battery.remaining == pytest.approx(0.5, abs=0.02)  # the current grows as the voltage falls
    for _ in range(round(60.0 / PHYSICS_DT_S)):
        battery.step(PHYSICS_DT_S, HOVER)
    assert battery.remaining == 0.0


def test_thrust_goes_with_the_square_of_the_voltage() -> None:
    battery = pack(full_thrust_v=16.6)
    assert battery.thrust_ratio(16.6) == 1.0
    assert battery.thrust_ratio(14.0) == pytest.approx(0.711, abs=1e-3)
    config = {"on": True, "full_thrust_v": 16.0, "resistance_ohm": 0.0}
    for rotors, share in (({"on": False}, 0.5), ({"on": True, "thrust_error": (0.0, 0.0, 0.0, 0.0)}, 0.375)):
        for start in (1.0, 0.2):
            world = OneMachine(
                VEHICLE,
                WorldConfig.model_validate({"battery": config, "rotors": rotors, "battery_start": start}),
                (0.0, 0.0),
                0.0,
                (1.0, 1.0),
            )
            for _ in range(300):
                world.fly((0.5,) * 4, (0.0, 0.0))
            near = (
                1.0 if world.machine._rotors is None else world.machine._rotors.ground_effect(world.machine.q[2] + 0.03)
            )
            wanted = near * VEHICLE.airframe.thrust_max_n * share * (open_circuit_v(start, 4) / 16.0) ** 2
            assert sum(world.data.ctrl[0:4]) == pytest.approx(wanted, rel=2e-3)


def test_power_module_reports_the_pack_and_the_sag_of_a_fault() -> None:
    faults = '[{"kind": "battery_sag", "after": "arming", "t_s": 0.5, "size": 2.0}]'
    start = ("world.battery_start=0.8", "world.battery.on=true", f"world.faults={faults}")
    flight = FastFlight(load_sitl(CATCH, overrides=start))
    plant, battery = flight.plant, flight.plant.machine.battery
    assert battery is not None
    while plant.t_s < 0.2:
        plant.step(False)
    assert battery.drawn_as > 0.0
    plant.step(True)
    assert battery.drawn_as == pytest.approx(battery.current_a * PHYSICS_DT_S), "the charge counts from arming"
    while plant.t_s < 0.6:
        plant.step(True)
    assert plant.battery().voltage_v == battery.voltage_v
    assert plant.battery().remaining == battery.remaining == pytest.approx(0.8, abs=1e-3)
    assert plant.battery().current_a == battery.current_a
    assert plant.battery().consumed_mah == pytest.approx(battery.drawn_as / 3.6)
    while plant.t_s < 0.8:
        plant.step(True)
    assert plant.battery().voltage_v == pytest.approx(battery.voltage_v - 2.0)
    assert plant.machine.rotor_share is not None
