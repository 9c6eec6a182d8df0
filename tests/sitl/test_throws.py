"""Repeated throws: the world's behaviour, and a repeating flight that catches each of them."""

from __future__ import annotations

from functools import cache
from pathlib import Path

import pytest

from companion.model.types import Outcome
from companion.sitl_config.loader import SitlConfig, load_sitl
from sitl.fast.loop import FastFlight, FastResult
from sitl.world.payload import Payload
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


def flown(config: SitlConfig) -> tuple[FastResult, Payload]:
    flight = FastFlight(config)
    return flight.run(limit_s=200.0), flight.plant.scene.payload


@cache
def repeated(*overrides: str) -> tuple[FastResult, Payload]:
    return flown(load_sitl(SHORT_CATCH, overrides=(*TO_AND_FRO, *overrides)))


def events(result: FastResult) -> list[tuple[str, float]]:
    """Ids with mission times."""
    begun_s = next(event.t_s for output in result.outputs for event in output.events if event.id == "takeoff")
    return [(event.id, event.t_s - begun_s) for output in result.outputs for event in output.events]


def test_each_pass_catches_a_throw_until_all_are_thrown() -> None:
    result, payload = repeated("mission.repeat=3", "world.throws=2")
    assert result.outputs[-1].outcome is Outcome.COMPLETED
    assert (payload.throws, payload.catches, payload.missed) == (2, 2, False)
    (names, times_s) = zip(*events(result), strict=True)
    assert names == ("takeoff", "catch", "payload_left", "catch", "touchdown"), "the last one stays in the net"
    assert (times_s[1], times_s[3]) == pytest.approx((CATCH_S, CATCH_S + PERIOD_S), abs=0.15)
    assert times_s[1] + KEEP_S + 0.5 <= times_s[2] < times_s[1] + KEEP_S + 1.0, "keep_s after the catch it is taken out"
    assert payload.caught_t_s is not None
    assert result.outputs[-1].mission_t_s > CATCH_S + 2 * PERIOD_S


def test_the_committed_soak_mission_catches_in_the_fast_loop() -> None:
    flight = FastFlight(configured("mission.repeat=1", mission="soak"))
    result, payload = flight.run(until_mission_s=12.0), flight.plant.scene.payload
    assert not result.crashed
    assert (payload.throws, payload.catches) == (1, 1)
