"""What `benchmarks.model_errors` makes wrong, and what it makes of its flights."""

from __future__ import annotations

from math import inf, nan

import pytest

from benchmarks.effects import MISSION
from benchmarks.model_errors import ALL, ERRORS, NONE, cell, with_error
from companion.sitl_config.loader import SitlConfig, load_sitl


@pytest.fixture(scope="module")
def laboratory() -> SitlConfig:
    return load_sitl(MISSION, world="lab")


@pytest.mark.parametrize("error", ERRORS)
def test_an_error_takes_the_place_of_one_figure_and_is_among_all_of_them(laboratory: SitlConfig, error: str) -> None:
    plain, wrong, everything = (with_error(laboratory, 7, which) for which in (NONE, error, ALL))
    before, after, whole = (one.model_dump(mode="json") for one in (plain, wrong, everything))
    changed = [
        (section, key)
        for section in ("world", "vehicle")
        for key in before[section]
        if before[section][key] != after[section][key]
    ]
    assert 1 <= len(changed) <= 2
    section, key = next(one for one in changed if one != ("world", "hover_thrust_error") or len(changed) == 1)
    assert whole[section][key] != before[section][key]


def test_an_error_that_ends_a_flight_early_is_counted_and_a_missed_ball_is_left_out() -> None:
    plain = [0.010] * 6 + [nan, 0.010]
    assert cell(plain, [0.012] * 6 + [0.020, nan]) == "+2.0 (+2.0 to +2.0)"
    assert cell(plain, [0.012] * 5 + [inf, 0.020, nan]) == "+2.0 (+2.0 to +inf); 1 ended early"
    assert cell([nan] * 8, [nan] * 8) == "–"
