"""The transition is a function: what it is given it neither changes nor remembers."""

from __future__ import annotations

import dataclasses
import itertools

import msgspec
import pytest

from companion.core import flight_core
from companion.core.flight_state import FlightState, Request
from companion.core.state_machine import transition
from companion.core.transition import Parameters
from companion.mission.active_plan import ActiveTrajectory
from companion.mission.air import Observation
from companion.mission.plan import Plan
from companion.model.flight_stage import Stage
from companion.model.outputs import Outputs
from companion.model.types import Event, Outcome
from companion.sitl_config.loader import load_sitl
from sitl.fast.loop import FastFlight
from tests.flights.ends import flown_until
from tests.support import SHORT_CATCH

pytestmark = pytest.mark.usefixtures("short_start")


def plain(value: object) -> object:
    """A copy of a record as dictionaries, down to its last value; plans left out, because each is another object."""
    if isinstance(value, Plan):
        return None
    if isinstance(value, ActiveTrajectory):
        return (value.start_s, value.change)
    if isinstance(value, msgspec.Struct):
        return {name: plain(getattr(value, name)) for name in value.__struct_fields__}
    if dataclasses.is_dataclass(value) and not isinstance(value, type):
        return {field.name: plain(getattr(value, field.name)) for field in dataclasses.fields(value)}
    if isinstance(value, dict):
        return {key: plain(one) for key, one in value.items()}
    return [plain(one) for one in value] if isinstance(value, list | tuple) else value


def test_a_value_deep_in_the_state_is_compared() -> None:
    """The test below once compared the state with itself."""
    state = Parameters.of(load_sitl(SHORT_CATCH)).initial_state()
    before = plain(state)
    object.__setattr__(state.touchdown.height, "since_s", 1.0)
    assert plain(state) != before


def assert_observes_the_tick_before(outputs: list[Outputs], observations: list[Observation]) -> None:
    """What the control law and the governor made of the last tick is what the next transition reacts to."""
    for (before, _), (_, o) in itertools.pairwise(zip(outputs, observations, strict=False)):
        log = before.control
        if log is not None:
            assert (*o.position_error_m, o.yaw_error_rad) == (*log.error[:3], log.error[5])
            assert o.force_world_n == (log.force_observed_world_n or log.force_ext_world_n)
        if before.reference is not None:
            assert o.reference is before.reference
        assert o.dt_s == pytest.approx(o.inputs.t_s - before.t_s)


def test_a_transition_done_twice_gives_the_same_and_leaves_its_arguments_alone(monkeypatch: pytest.MonkeyPatch) -> None:
    stages, ticks, observations = set(), 0, []

    def twice(
        parameters: Parameters, state: FlightState, events: tuple[Event, ...], observation: Observation
    ) -> tuple[FlightState, Request]:
        nonlocal ticks
        ticks += 1
        stages.add(state.stage)
        observations.append(observation)
        before = plain(state) if ticks % 120 == 0 else None
        first = transition(parameters, state, events, observation)
        if before is not None:
            assert plain(transition(parameters, state, events, observation)[0]) == plain(first[0])
            assert plain(state) == before
        return first

    monkeypatch.setattr(flight_core, "transition", twice)
    landing = ("world.faults=[{kind: mocap_loss, phase: line}]",)
    outputs = [
        flown_until(FastFlight(load_sitl(SHORT_CATCH, overrides=overrides)), lambda o: o.outcome is not None).outputs
        for overrides in ((), landing)
    ]
    assert [flown[-1].outcome for flown in outputs] == [Outcome.COMPLETED, Outcome.ABORTED]
    assert "catch" in {event.id for o in outputs[0] for event in o.events}
    assert_observes_the_tick_before(outputs[0], observations)
    assert stages >= {
        Stage.WAIT,
        Stage.OFFBOARD,
        Stage.ARM,
        Stage.SPOOL,
        Stage.MISSION,
        Stage.TOUCHDOWN,
        Stage.AUTOPILOT_LAND,
    }
