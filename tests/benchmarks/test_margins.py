"""What `benchmarks.margins` makes of its flights."""

from __future__ import annotations

from math import inf

import pytest

from benchmarks.effects import MISSION
from benchmarks.margins import Flown, fly, margin, table
from companion.sitl_config.loader import load_sitl

GOOD, SWINGS, LANDED = ("completed", 0.04, 0.018), ("completed", 0.3, 0.2), ("aborted", inf, inf)


@pytest.mark.parametrize(
    ("flown", "found"),
    [
        ({10: [GOOD], 20: [GOOD, GOOD, LANDED], 30: [GOOD, SWINGS, LANDED]}, (20, 30)),
        ({10: [GOOD], 20: [GOOD]}, (20, None)),
        ({10: [LANDED], 20: [GOOD]}, (None, 10)),
        ({10: [GOOD], 20: [SWINGS], 30: [GOOD]}, (10, 20)),
    ],
    ids=["two of three are not good", "always good", "never good", "good again by chance"],
)
def test_the_margin_ends_where_the_median_flight_swings_or_does_not_complete(
    flown: dict[int, list[Flown]], found: tuple[int | None, int | None]
) -> None:
    assert margin(flown) == found


def test_the_table_says_what_became_of_the_flights_beyond_the_margin() -> None:
    text = table({"a/b": {10: [GOOD, GOOD], 20: [SWINGS, LANDED]}, "c/d": {10: [GOOD]}})
    assert "| a/b | 18 | 10 | 0.30 | 1 aborted, 1 completed |" in text
    assert "| c/d | 18 | above 10 | – | – |" in text


def test_setpoints_that_are_late_enough_are_noticed() -> None:
    loaded = {"psc/tuned": load_sitl(MISSION, None, "psc", "tuned", world="lab")}
    outcome, peak_m, _ = fly(loaded, ("psc/tuned", 150, 1))
    assert outcome != "completed" and peak_m == inf
