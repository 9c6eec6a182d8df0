"""A flight that ends just after the catch, in the fast closed loop: the log has what was felt at the net, and the summary says so."""

from __future__ import annotations

import io
from functools import cache
from pathlib import Path
from typing import Any

import pytest
from rich.console import Console

from companion.analysis.summary import summarise
from companion.model.types import Event
from companion.runtime.console import print_result
from companion.sitl_config.loader import load_sitl
from sitl.campaigns.flights import log_of
from sitl.fast.loop import FastFlight
from tests.flights.ends import after
from tests.flights.test_fast_flights import event_ids
from tests.support import SHORT_CATCH

CONFIRMED_S = 1.0
"""After the catch."""


@cache
def usual() -> Event:
    """The catch of a flight without a fault."""
    outputs = FastFlight(load_sitl(SHORT_CATCH)).run(until=after("catch")).outputs
    return next(event for o in outputs for event in o.events if event.id == "catch")


def summary_of(fault: str) -> tuple[dict[str, Any], list[str]]:
    """Summary of a flight with a fault, and the ids of its events."""
    config = load_sitl(SHORT_CATCH, overrides=[f"world.faults=[{fault}]"])
    result = FastFlight(config).run(limit_s=9.5)
    log = log_of(config, result, None)
    return summarise(log, outcome="aborted", controller="adaptive", preset="recommended"), event_ids(result)


def test_a_catch_that_the_flight_could_not_confirm_is_in_the_summary() -> None:
    summary, ids = summary_of("{kind: kill_flight, after: catch, t_s: 0.2}")
    assert "catch" not in ids
    assert usual().text == f"payload caught at t = {summary['catch_t_s']:.2f} s"
    assert summary["catch_confirmed"] is False
    out = io.StringIO()
    print_result(Console(file=out, width=200), summary, Path(), None)
    assert (
        f"t = {summary['catch_t_s']:.2f} s, not confirmed: the flight ended too soon after the impact" in out.getvalue()
    )


@pytest.mark.parametrize("after_s", [0.8, 1.2])
def test_a_catch_is_confirmed_by_its_event_alone(after_s: float) -> None:
    summary, ids = summary_of(f"{{kind: kill_flight, after: catch, t_s: {after_s}}}")
    assert summary["catch_confirmed"] is ("catch" in ids) is (after_s > CONFIRMED_S)


def test_before_the_catch_nothing_was_felt() -> None:
    summary, _ = summary_of("{kind: kill_flight, t_s: 3.4}")
    assert (summary["catch_t_s"], summary["catch_confirmed"]) == (None, None)
