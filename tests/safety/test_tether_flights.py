"""The tether watch in flights of the fast loop: what it must notice, and what must not alarm it."""

from __future__ import annotations

import math
from collections.abc import Callable

import pytest

from companion.model.outputs import Outputs
from companion.model.types import Outcome, PhaseKind, SafetyAction, Vec3
from sitl.fast.loop import FastFlight
from sitl.fast.result import FastResult
from sitl.world.state import Truth
from tests.safety.test_tether import ANCHOR, config, vehicle
from tests.support import tether_of

pytestmark = pytest.mark.usefixtures("short_start")


def event_ids(result: FastResult) -> list[str]:
    return [event.id for outputs in result.outputs for event in outputs.events]


@pytest.mark.parametrize(
    "overrides",
    [("world.payload_kg=0.1", "world.wind_m_s=[3, 0, 0]"), ("world.payload_kg=0.4", "world.hover_thrust_error=-0.1")],
)
def test_an_ordinary_flight_raises_no_alarm(overrides: tuple[str, ...]) -> None:
    result = FastFlight(config(*overrides)).run(until_mission_s=9.0)
    assert event_ids(result) == ["takeoff", "catch"]
    assert all(o.action is SafetyAction.NOMINAL and not o.limited_by and o.mocap_trusted for o in result.outputs)
    states = [o.tether for o in result.outputs if o.tether is not None and o.phase_kind is PhaseKind.FLIGHT]
    assert len(states) > 1000
    assert not any(state.taut or state.snagged or state.separated for state in states)
    assert max(state.pull_n for state in states) < 2.3
    assert min(state.clearance_m for state in states) > tether_of(vehicle()).clearance_min_m
    assert max(abs(state.turns) for state in states) < 0.5


def test_wind_of_5_m_s_from_ahead_is_no_tether_that_pulls() -> None:
    """It presses with 4 to 6 N, mostly by the rotors' drag. The tilt against it brings the rotors nearer to the line."""
    result = FastFlight(config("world.rotors={on: true, drag_s_m: 0.03}", "world.wind_m_s=[-5, 0, 0]")).run(
        until_mission_s=9.0
    )
    assert set(event_ids(result)) - {"tether_near"} == {"takeoff", "catch"}
    assert all(o.action.rank <= SafetyAction.WARN.rank for o in result.outputs)


def snag(flight: FastFlight, at_s: float, anchor: Vec3, extra_m: float) -> None:
    """From `at_s` after arming on the line is held at `anchor`, and is that much longer than it is away."""
    act, plant = flight.plant.act, flight.plant
    done = False

    def hooked(armed: bool) -> None:
        nonlocal done
        now_s = plant.mission_t_s()
        if not done and now_s is not None and now_s >= at_s:
            done = True
            scene = plant.scene
            scene.model.site_pos[scene.model.site("anchor").id] = anchor
            scene.model.tendon_range[0, 1] = math.dist(anchor, plant.truth.position_world_m) + extra_m
        act(armed)

    flight.plant.act = hooked  # type: ignore[method-assign]


def gives_way(o: Outputs) -> bool:
    """Whether it goes back along the line, or lands."""
    return o.action in (SafetyAction.RETRACT, SafetyAction.LAND)


def first_s(result: FastResult, is_so: Callable[[Outputs, Truth], bool]) -> float:
    return next(truth.t_s for outputs, truth in zip(result.outputs, result.truth, strict=True) if is_so(outputs, truth))


@pytest.mark.parametrize(("at_s", "anchor", "whole"), [(9.0, ANCHOR, True), (14.0, (1.5, 1.5, 0.0), False)])
def test_a_snagged_line_is_noticed_and_the_machine_lands(at_s: float, anchor: Vec3, whole: bool) -> None:
    """One flight is followed to the floor."""
    flight = FastFlight(config("world.payload_kg=0.2"))
    snag(flight, at_s, anchor, 0.02)
    result = flight.run(60.0, until=None if whole else gives_way)
    tight_s = first_s(result, lambda _, truth: truth.tether_tension_n > 1.0)
    seen_s = first_s(
        result, lambda outputs, _: bool(outputs.tether and (outputs.tether.snagged or outputs.tether.taut))
    )
    assert 0.0 < seen_s - tight_s < 2.0
    assert not result.crashed and gives_way(result.outputs[-1])
    assert not whole or result.outputs[-1].outcome is Outcome.ABORTED
    assert set(event_ids(result)) & {"tether_taut", "tether_snagged"}
