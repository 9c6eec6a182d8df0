"""A flight that ends just after the catch, in the fast closed loop: the log has what was felt at the net, and the summary says so."""

from __future__ import annotations

import io
from functools import cache
from pathlib import Path
from typing import Any

import pytest
from rich.console import Console

from companion.analysis.summary import summarise
from companion.runtime.console import print_result
from companion.sitl_config.loader import load_sitl
from sitl.campaigns.flights import log_of
from sitl.fast.loop import FastFlight
from sitl.fast.result import FastResult
from tests.flights.ends import after
from tests.flights.test_fast_flights import event_ids
from tests.support import SHORT_CATCH

pytestmark = pytest.mark.usefixtures("short_start")

CONFIRMED_S = 1.0
"""After the catch."""


@cache
def usual() -> tuple[FastFlight, FastResult]:
    """A flight without a fault, until its catch is confirmed and a little longer."""
    flight = FastFlight(load_sitl(SHORT_CATCH))
    return flight, flight.run(until=after("catch", 0.3))


def summary_until(after_catch_s: float) -> tuple[dict[str, Any], list[str]]:
    """Summary of the flight if its process is killed this long after the impact, and the ids of its events."""
    flight, whole = usual()
    caught_s = flight.plant.scene.payload.caught_t_s
    assert caught_s is not None
    ticks = sum(o.t_s <= caught_s + after_catch_s for o in whole.outputs)
    result = FastResult(inputs=whole.inputs[:ticks], outputs=whole.outputs[:ticks])
    log = log_of(flight.config, result, None)
    return summarise(log, outcome="aborted", controller="adaptive", preset="recommended"), event_ids(result)


def test_a_catch_that_the_flight_could_not_confirm_is_in_the_summary() -> None:
    summary, ids = summary_until(0.2)
    assert "catch" not in ids
    (event,) = [event for o in usual()[1].outputs for event in o.events if event.id == "catch"]
    assert event.text == f"payload caught at t = {summary['catch_t_s']:.2f} s"
    assert summary["catch_confirmed"] is False
    out = io.StringIO()
    print_result(Console(file=out, width=200), summary, Path(), None)
    assert (
        f"t = {summary['catch_t_s']:.2f} s, not confirmed: the flight ended too soon after the impact" in out.getvalue()
    )


@pytest.mark.parametrize("after_s", [0.8, 1.2])
def test_a_catch_is_confirmed_by_its_event_alone(after_s: float) -> None:
    summary, ids = summary_until(after_s)
    assert summary["catch_confirmed"] is ("catch" in ids) is (after_s > CONFIRMED_S)


def test_before_the_catch_nothing_was_felt() -> None:
    summary, _ = summary_until(-0.2)
    assert (summary["catch_t_s"], summary["catch_confirmed"]) == (None, None)
