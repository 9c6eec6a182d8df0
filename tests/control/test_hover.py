"""Hover thrust: learnt in the air, not on the ground, not from a payload, never beyond its bounds."""

from __future__ import annotations

import math
from functools import cache
from pathlib import Path

import pytest

from companion.control.hover_thrust import SHARE_MAX, HoverThrust
from companion.control.types import PlantState
from companion.model.constants import GRAVITY_M_S2
from companion.model.frames import quat_from_euler_zyx
from companion.model.types import IDENTITY_QUAT, PhaseKind, Quat, Vec3
from companion.sitl_config.loader import SitlConfig, load_sitl
from sitl.fast.loop import FastFlight
from sitl.fast.result import FastResult
from tests.control.states import at
from tests.flights.ends import flown_until
from tests.support import CATCH, SHORT_CATCH

pytestmark = pytest.mark.usefixtures("short_start")


MASS_KG = 3.0
START, TRUE = 0.5, 0.45
DT_S = 0.005


def state(
    acceleration: Vec3 = (0.0, 0.0, 0.0), attitude: Quat = IDENTITY_QUAT, force: Vec3 | None = (0.0, 0.0, 0.0)
) -> PlantState:
    return at(acceleration=acceleration, attitude=attitude, arm=(1.7, 1.0), force=force)


def learnt(
    thrust: float, plant: PlantState, *, seconds: float = 30.0, airborne: bool = True, carrying: bool = False
) -> float:
    hover = HoverThrust(START, MASS_KG)
    for _ in range(round(seconds / DT_S)):
        hover.step(DT_S, thrust, plant, airborne, carrying)
    return hover.value


def test_it_finds_the_thrust_that_hovers() -> None:
    assert learnt(TRUE, state()) == pytest.approx(TRUE, rel=1e-3)


def test_it_is_quick_in_take_off_and_slow_later() -> None:
    """Two thirds of an error are gone after 3 s of flight; a change after a minute takes as long for its first third."""
    assert abs(learnt(TRUE, state(), seconds=3.0) - TRUE) < 0.2 * (START - TRUE)
    hover = HoverThrust(START, MASS_KG)
    for _ in range(12_000):
        hover.step(DT_S, START, state(), True, False)
    for _ in range(200):
        hover.step(DT_S, TRUE, state(), True, False)
    assert START - hover.value < 0.25 * (START - TRUE)


def test_steady_climb_and_acceleration_are_no_change() -> None:
    """Accelerating upwards at 1 m/s^2 takes more thrust; the IMU feels as much."""
    assert learnt(TRUE * (1.0 + 1.0 / GRAVITY_M_S2), state((0.0, 0.0, 1.0))) == pytest.approx(TRUE, rel=1e-3)


def test_tilting_into_a_turn_is_no_change() -> None:
    pitch = math.radians(10.0)
    plant = state((GRAVITY_M_S2 * math.tan(pitch), 0.0, 0.0), quat_from_euler_zyx(0.0, pitch, 0.0))
    assert learnt(TRUE / math.cos(pitch), plant) == pytest.approx(TRUE, rel=1e-3)


@pytest.mark.parametrize("carrying", [False, True])
def test_a_payload_is_no_change(carrying: bool) -> None:
    payload_kg = 0.3
    plant = state(force=(0.0, 0.0, -payload_kg * GRAVITY_M_S2))
    assert learnt(TRUE * (1.0 + payload_kg / MASS_KG), plant, carrying=carrying) == pytest.approx(TRUE, rel=1e-3)


LEANING = quat_from_euler_zyx(math.radians(18.0), 0.0, 0.0)


@pytest.mark.parametrize(
    ("thrust", "plant", "airborne", "carrying"),
    [
        pytest.param(TRUE, state(), False, False, id="on the ground"),
        pytest.param(1.0, state(), True, False, id="thrust at its upper limit"),
        pytest.param(0.0, state(), True, False, id="no thrust"),
        pytest.param(TRUE, state(force=None), True, True, id="carrying without force sensor"),
        pytest.param(TRUE, state(attitude=LEANING), True, False, id="leaning far"),
    ],
)
def test_it_stands_still(thrust: float, plant: PlantState, airborne: bool, carrying: bool) -> None:
    assert learnt(thrust, plant, airborne=airborne, carrying=carrying) == START


def test_it_stands_still_while_jerked() -> None:
    hover = HoverThrust(START, MASS_KG)
    for _ in range(100):  # until the acceleration's filter has seen it
        hover.step(DT_S, TRUE, state((0.0, 0.0, 4.0)), True, False)
    before = hover.value
    for _ in range(400):
        hover.step(DT_S, TRUE, state((0.0, 0.0, 4.0)), True, False)
    assert hover.value == before


@pytest.mark.parametrize(("thrust", "bound"), [(0.99, 1.0 + SHARE_MAX), (0.05, 1.0 - SHARE_MAX)])
def test_the_hover_thrust_is_bounded(thrust: float, bound: float) -> None:
    assert learnt(thrust, state(), seconds=60.0) == pytest.approx(START * bound)


# -- whole flights in the fast loop ----------------------------------------------------------------------------------------------


def flown(
    error: float, until_mission_s: float, adapt: bool = True, faults: str = "[]", mission: Path = CATCH
) -> FastResult:
    flight = FastFlight(configured(error, adapt, faults, mission))
    result = flown_until(flight, lambda o: o.mission_t_s >= until_mission_s)
    assert result.caught and not result.crashed and result.outputs[-1].outcome is None
    return result


def configured(error: float, adapt: bool, faults: str = "[]", mission: Path = CATCH) -> SitlConfig:
    """Without the law's own adaptive force, which would make good for a wrong hover thrust by itself."""
    overrides = (
        "controller.load_rate_xyz=[0, 0, 0]",
        f"world.hover_thrust_error={error}",
        f"vehicle.airframe.hover_thrust_adapt={str(adapt).lower()}",
        f"world.faults={faults}",
    )
    return load_sitl(mission, preset="recommended", overrides=overrides)


@cache
def true_hover_thrust() -> float:
    return FastFlight(configured(0.0, True)).plant.machine.hover_command


def height_errors_m(result: FastResult, from_s: float) -> list[float]:
    """True height against the reference, FLIGHT phases from so long after take-off."""
    return [
        truth.position_world_m[2] - outputs.reference.position_world_m[2]
        for outputs, truth in zip(result.outputs, result.truth, strict=True)
        if outputs.reference and outputs.phase_kind is PhaseKind.FLIGHT and outputs.mission_t_s >= from_s
    ]


def test_a_wrong_parameter_is_flown_out() -> None:
    """10 % would be 5 cm of height for ever; from 4 s on it is below 2 cm, catch and payload included."""
    error = -0.1
    result = flown(error, 8.5)
    assert max(abs(e) for e in height_errors_m(result, 4.0)) < 0.02
    used = [outputs.control.hover_thrust for outputs in result.outputs if outputs.control]
    assert used[0] == pytest.approx(true_hover_thrust() * (1.0 + error))
    assert used[-1] == pytest.approx(true_hover_thrust(), rel=0.01)


def test_switched_off_it_stays_at_the_parameter() -> None:
    result = flown(0.1, 4.4, adapt=False, mission=SHORT_CATCH)
    assert {o.control.hover_thrust for o in result.outputs if o.control} == {true_hover_thrust() * 1.1}
    assert max(abs(e) for e in height_errors_m(result, 3.0)) > 0.035


def test_a_catch_without_force_sensor_does_not_move_it() -> None:
    """The sensor dies after the catch: what hangs there can no longer be told from a weak motor."""
    result = flown(0.0, 5.0, faults="[{kind: force_loss, t_s: 5.7}]", mission=SHORT_CATCH)
    lost_s = next(e.t_s for o in result.outputs for e in o.events if e.id == "force_lost")
    later = {o.control.hover_thrust for o in result.outputs if o.control and o.t_s > lost_s + 0.1}
    assert len(later) == 1
