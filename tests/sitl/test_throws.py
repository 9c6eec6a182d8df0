"""Repeated throws: the world's behaviour, and a repeating flight that catches each of them."""

from __future__ import annotations

import math
from functools import cache
from pathlib import Path

import pytest

from companion.config.vehicle import Vehicle
from companion.model.types import Outcome, Outputs
from companion.sitl_config.loader import SitlConfig, load_sitl
from sitl.fast.loop import FastFlight, FastResult
from sitl.server import Ports, Sitl, start_of
from sitl.world.plant import Plant
from sitl.world.world import World
from tests.support import SHORT_CATCH

ROOT = Path(__file__).parents[2]
CATCH_S, PERIOD_S, KEEP_S = 2.45, 6.0, 1.0
"""Time of the first catch of `TO_AND_FRO`, time between two catches, and time in the net."""
TO_AND_FRO = (
    'mission.phases=[{"type": "takeoff", "height_m": 0.5, "duration_s": 1.5},'
    ' {"type": "line", "name": "catch", "to_m": [0.4, 0, 0.5], "duration_s": 2}, {"type": "hold", "duration_s": 1},'
    ' {"type": "line", "to_m": [-0.2, 0, 0.5], "duration_s": 2}, {"type": "hold", "duration_s": 1},'
    ' {"type": "land", "speed_m_s": 0.35}]',
    f"world.keep_s={KEEP_S}",
)
"""The short catch, flown there and back: it may be repeated."""
FIRST_MISSED = "world.faults=[{kind: payload_missed, t_s: 0, duration_s: 8.2, size: 0.5}]"
"""The first of its throws goes beside the net."""


def configured(*overrides: str, mission: str = "catch") -> SitlConfig:
    return load_sitl(ROOT / f"configs/missions/{mission}.yaml", overrides=overrides)


def flown(config: SitlConfig) -> tuple[FastResult, World]:
    flight = FastFlight(config)
    return flight.run(limit_s=200.0), flight.plant.world


@cache
def repeated(*overrides: str) -> tuple[FastResult, World]:
    return flown(load_sitl(SHORT_CATCH, overrides=(*TO_AND_FRO, *overrides)))


def events(result: FastResult) -> list[tuple[str, float]]:
    """Ids with mission times."""
    begun_s = next(event.t_s for output in result.outputs for event in output.events if event.id == "takeoff")
    return [(event.id, event.t_s - begun_s) for output in result.outputs for event in output.events]


def at(result: FastResult, mission_t_s: float) -> Outputs:
    return next(output for output in result.outputs if output.mission_t_s >= mission_t_s)


def test_three_repetitions_catch_three_throws() -> None:
    result, world = repeated("mission.repeat=3", "world.throws=3")
    assert result.outputs[-1].outcome is Outcome.COMPLETED
    assert (world.payload.throws, world.payload.catches, world.payload.missed) == (3, 3, False)
    said = events(result)
    assert [name for name, _ in said] == [
        "takeoff", "catch", "payload_left", "catch", "payload_left", "catch", "touchdown"
    ]  # fmt: skip
    caught = [t_s for name, t_s in said if name == "catch"]
    assert caught == pytest.approx([CATCH_S + number * PERIOD_S for number in range(3)], abs=0.15)
    left = [t_s for name, t_s in said if name == "payload_left"]
    for before_s, left_s in zip(caught, left, strict=False):
        assert before_s + KEEP_S + 0.5 <= left_s < before_s + KEEP_S + 1.0, "keep_s after the catch it is taken out"
    assert world.payload.caught_t_s is not None
    assert result.outputs[-1].mission_t_s > CATCH_S + 2 * PERIOD_S


def test_each_catch_is_flown_as_well_as_the_first() -> None:
    result, _ = repeated("mission.repeat=3", "world.throws=3")
    worst = []
    for number in range(3):
        since_s = CATCH_S + number * PERIOD_S
        worst.append(
            max(
                math.dist(inputs.mocap.position_world_m, outputs.reference.position_world_m)
                for inputs, outputs in zip(result.inputs, result.outputs, strict=True)
                if inputs.mocap and outputs.reference and since_s <= outputs.mission_t_s < since_s + 2.0
            )
        )
    assert max(worst[1:]) < 1.5 * worst[0]


def test_the_phase_says_which_repetition_it_is() -> None:
    result, _ = repeated("mission.repeat=3", "world.throws=3")
    assert at(result, 1.0).phase == "take-off"
    assert at(result, CATCH_S).phase == "catch (1 of 3)"
    assert at(result, CATCH_S + 2 * PERIOD_S).phase == "catch (3 of 3)"
    assert "land" in {output.phase for output in result.outputs}


def test_one_throw_is_one_throw_however_often_it_passes() -> None:
    result, world = repeated("mission.repeat=2")
    assert (world.payload.throws, world.payload.catches) == (1, 1)
    assert [name for name, _ in events(result)] == ["takeoff", "catch", "touchdown"], "it stays in the net"


def test_after_a_miss_the_next_pass_is_thrown_at() -> None:
    """The first throw goes beside the net; `missed` and `caught_t_s` are about that one."""
    result, world = repeated("mission.repeat=2", "world.throws=2", FIRST_MISSED)
    assert result.outputs[-1].outcome is Outcome.COMPLETED
    assert (world.payload.throws, world.payload.catches, world.payload.missed, world.payload.caught_t_s) == (
        2,
        1,
        True,
        None,
    )
    assert [name for name, _ in events(result)].count("catch") == 1


def test_a_dropped_payload_is_thrown_again() -> None:
    dropped = "world.faults=[{kind: payload_dropped, t_s: 0.5, after: catch}]"
    _, world = repeated("mission.repeat=2", "world.throws=2", dropped)
    assert (world.payload.throws, world.payload.catches) == (2, 2)


def test_the_committed_soak_mission_catches_in_the_fast_loop() -> None:
    flight = FastFlight(configured("mission.repeat=1", mission="soak"))
    result, payload = flight.run(until_mission_s=12.0), flight.plant.world.payload
    assert not result.crashed
    assert (payload.throws, payload.catches) == (1, 1)


def test_the_battery_lasts_as_long_as_configured() -> None:
    config = configured("world.battery_life_s=50", "world.battery_start=0.9")
    flight = FastFlight(config)
    plant: Plant = flight.plant
    plant.armed_t_s = 0.0
    plant.world.t_s = 20.0
    assert plant.battery().remaining == pytest.approx(0.9 - 20.0 / 50.0)
    plant.world.t_s = 60.0
    assert plant.battery().remaining == 0.0


def test_the_final_word_counts_throws_and_catches() -> None:
    config = configured("world.throws=4")
    start = config.mission.start
    sitl = Sitl(
        config.vehicle,
        config.world,
        start_of(start.position_m, start.yaw_deg, start.arm_deg),
        Ports(),
        lambda message: None,
    )
    sitl.plant.world.payload.throws, sitl.plant.world.payload.catches = 3, 2
    final = sitl.final()
    assert (final["throws"], final["catches"]) == (3, 2)
    assert (final["thrown"], final["caught"], final["missed"]) == (False, False, False)


def test_what_is_taken_out_of_the_net_lies_where_it_lay_before() -> None:
    config = configured("world.throws=2", "world.keep_s=0.2")
    vehicle: Vehicle = config.vehicle
    world = World(vehicle, config.world, (-1.0, 0.0), 0.0, (2.0, 1.5))
    ball = world.model.body("payload").id
    lay = world.data.xpos[ball].copy()
    at_net = world.data.xpos[world.model.body("net").id]
    q = int(world.model.jnt_qposadr[world.model.joint("payload").id])
    world.data.qpos[q : q + 3] = at_net
    world.payload.throws, world.payload._flies_since_s = 1, world.t_s
    seen = []
    for _ in range(200):
        world.step((0, 0, 0, 0), (0, 0), False)
        seen += [event.kind for event in world.take_events()]
    assert seen == ["caught", "taken"]
    assert world.data.xpos[ball] == pytest.approx(lay, abs=0.01)
    assert not world.data.eq_active[world.model.equality("catch").id]
