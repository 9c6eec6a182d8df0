"""Touch-down with one wrong source: no rotor stops in the air, none turns on the floor for ever."""

from __future__ import annotations

from collections.abc import Callable

import msgspec
import pytest

from companion.model.types import (
    AutopilotRequest,
    FlightMode,
    Inputs,
    LandedState,
    Outcome,
    PhaseKind,
    SafetyAction,
    Vec3,
)
from companion.sitl_config.loader import SitlConfig, load_sitl
from sitl.fast.loop import FastFlight
from sitl.fast.result import FastResult
from sitl.mocap import MocapFrame
from tests.core.walk import Deaf
from tests.flights.ends import Changed
from tests.safety.healthy import put
from tests.support import HOVER, SHORT_CATCH

pytestmark = pytest.mark.usefixtures("short_start")

replace = msgspec.structs.replace
Change = Callable[[Inputs], Inputs]
STANDS_M = load_sitl("configs/missions/catch.yaml").vehicle.airframe.ground_clearance_m


SHORT_HOVER = ("mission.phases[1].duration_s=3.0",)


class Spoiled(Changed):
    """Motion capture that has the floor elsewhere, and what else the companion is reported wrong."""

    def __init__(self, config: SitlConfig, change: Change, lift_m: float) -> None:
        super().__init__(config, change)
        plant, take = self.plant, self.plant.mocap.take

        def lifted() -> list[MocapFrame]:
            """The error comes in slowly, as a shifting volume would bring it; PX4 is reported the same."""
            by_m = lift_m * min(1.0, max(0.0, (plant.t_s - 2.0) / 8.0))
            frames = [(frame, *frame.position_world_m) for frame in take()]
            return [frame._replace(position_world_m=(x, y, z + by_m)) for frame, x, y, z in frames]

        plant.mocap.take = lifted  # type: ignore[method-assign]


def flown(change: Change = lambda i: i, lift_m: float = 0.0, *, deaf: bool = False) -> tuple[FastFlight, FastResult]:
    # The error of the height takes 8 s to come.
    config = load_sitl(HOVER, overrides=SHORT_HOVER) if lift_m else load_sitl(SHORT_CATCH)
    flight = Spoiled(config, change, lift_m)
    if deaf:
        flight.px4.land = Deaf()  # type: ignore[assignment]
    return flight, flight.run()


def ids(result: FastResult) -> list[str]:
    return [event.id for o in result.outputs for event in o.events]


def rotors_stopped_at_m(result: FastResult) -> float:
    """How high the machine truly was when the thrust was first taken away in the landing."""
    first = next(
        o for o in result.outputs if o.phase_kind is PhaseKind.LANDING and o.attitude and o.attitude.thrust < 0.02
    )
    return next(truth.position_world_m[2] for truth in result.truth if truth.t_s >= first.t_s)


def assert_landed(flight: FastFlight, result: FastResult, outcome: Outcome) -> None:
    assert result.outputs[-1].outcome is outcome, ids(result)
    assert not result.crashed
    assert not flight.px4.armed, "the rotors turn on the floor"
    assert result.truth[-1].position_world_m[2] < STANDS_M + 0.02


def test_with_all_sources_it_touches_down() -> None:
    flight, result = flown()
    assert_landed(flight, result, Outcome.COMPLETED)
    assert rotors_stopped_at_m(result) < STANDS_M + 0.02
    inputs, outputs = result.inputs, result.outputs
    landed = next(o for o in outputs if any(event.id == "touchdown" for event in o.events))
    status = inputs[landed.tick].status
    assert status is not None and status.landed is not LandedState.ON_GROUND, "before PX4 would say so"
    assert status.mode is FlightMode.OFFBOARD
    assert outputs[-1].action is SafetyAction.NOMINAL


def test_a_floor_that_reads_too_high_is_found_by_thrust_and_px4() -> None:
    flight, result = flown(lift_m=0.3)
    assert_landed(flight, result, Outcome.COMPLETED)
    touchdown = next(event for o in result.outputs for event in o.events if event.id == "touchdown")
    assert touchdown.t_s < result.outputs[-1].t_s < touchdown.t_s + 5.0
    assert rotors_stopped_at_m(result) < STANDS_M + 0.02


def test_a_floor_that_reads_too_low_stops_no_rotor_in_the_air() -> None:
    flight, result = flown(lift_m=-0.2)
    assert result.outputs[-1].outcome in (Outcome.COMPLETED, Outcome.ABORTED)
    assert_landed(flight, result, result.outputs[-1].outcome)
    assert rotors_stopped_at_m(result) < STANDS_M + 0.03


def test_a_land_detector_that_never_fires_is_overruled_on_the_floor() -> None:
    flight, result = flown(deaf=True)
    assert_landed(flight, result, Outcome.COMPLETED)
    forced = [o.t_s for o in result.outputs if o.request is AutopilotRequest.FORCE_DISARM]
    zero = next(o.t_s for o in result.outputs if o.phase == "disarm")
    assert forced and forced[0] - zero > 3.9


def test_a_land_detector_that_always_fires_stops_no_rotor_in_the_air() -> None:
    def change(i: Inputs) -> Inputs:
        return put("status", landed=LandedState.ON_GROUND)(i) if i.t_s > 3.0 else i

    flight, result = flown(change)
    assert_landed(flight, result, Outcome.COMPLETED)
    assert rotors_stopped_at_m(result) < STANDS_M + 0.02


def test_in_px4s_own_landing_its_detector_may_be_deaf() -> None:
    """Motion capture lags behind what PX4 says of itself: the ladder lets PX4 land, which never finds the floor."""
    flight, result = flown(
        lambda i: put("vehicle", attitude_wxyz=(0.8, 0.6, 0.0, 0.0))(i) if 4.5 < i.t_s < 4.65 else i, deaf=True
    )
    assert "tilt" in ids(result)
    assert_landed(flight, result, Outcome.ABORTED)
    assert AutopilotRequest.FORCE_DISARM in {o.request for o in result.outputs}


def test_estimate_frozen_just_above_the_floor_is_no_touchdown() -> None:
    """Low and still by PX4's estimate, and the law presses; motion capture sees the vehicle sink on."""

    def change(i: Inputs) -> Inputs:
        vehicle = i.vehicle
        if vehicle is None or vehicle.position_world_m[2] > STANDS_M + 0.11 or i.t_s < 5.0:
            return i
        held: Vec3 = (*vehicle.position_world_m[:2], STANDS_M + 0.1)
        return replace(i, vehicle=replace(vehicle, position_world_m=held, velocity_world_m_s=(0.0, 0.0, 0.001)))

    flight, result = flown(change)
    assert rotors_stopped_at_m(result) < STANDS_M + 0.02
    assert not flight.px4.armed and not result.crashed
