"""A ball that hits the rim of the net and falls to the floor is no catch: neither in the events nor in the summary."""

from __future__ import annotations

import io
from pathlib import Path

import pytest
from rich.console import Console

from companion.analysis.summary import summarise
from companion.runtime.console import print_result
from companion.sitl_config.loader import load_sitl
from sitl.campaigns.flights import log_of
from sitl.fast.loop import FastFlight
from tests.flights.ends import after
from tests.flights.test_fast_flights import event_ids
from tests.support import CATCH, SHORT_CATCH

pytestmark = pytest.mark.usefixtures("short_start")

UNTIL_S = 9.0
"""Mission time, 2.5 s after the expected catch."""


def test_a_ball_that_fell_off_the_rim_is_not_reported_as_caught() -> None:
    flight = FastFlight(load_sitl(CATCH, overrides=["world.seed=2002"], world="lab"))
    result = flight.run(until_mission_s=UNTIL_S)
    payload = flight.plant.scene.payload
    assert payload.missed and not result.caught
    assert {"catch", "payload_left"}.isdisjoint(event_ids(result))
    log = log_of(flight.config.flight, result, None)
    summary = summarise(log, outcome="completed", controller="adaptive", preset="recommended")
    assert (summary["catch_t_s"], summary["catch_confirmed"]) == (None, None)
    out = io.StringIO()
    print_result(Console(file=out, width=200), summary, Path(), None)
    (line,) = [line for line in out.getvalue().splitlines() if line.startswith("catch")]
    assert line.split() == ["catch", "none"]


@pytest.mark.parametrize("payload_kg", [0.05, 0.5])
def test_the_lightest_and_the_heaviest_payload_are_reported(payload_kg: float) -> None:
    changes = ["world.seed=2003", f"world.payload_kg={payload_kg}"]
    flight = FastFlight(load_sitl(SHORT_CATCH, overrides=changes, world="lab"))
    result = flight.run(until=after("catch"))
    (event,) = [event for o in result.outputs for event in o.events if event.id == "catch"]
    assert event.t_s == pytest.approx(flight.plant.scene.payload.caught_t_s, abs=0.05)
