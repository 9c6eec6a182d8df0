"""A few random missions, short ones: what is accepted keeps its distance, what is refused says why. `make explore` flies many more."""

from __future__ import annotations

import pytest
from hypothesis import settings

from tests.mission.random_missions import Row, fly

pytestmark = pytest.mark.usefixtures("short_start")


COUNT = min(40, settings().max_examples // 9)
PHASES_MAX = 2


@pytest.fixture(scope="module")
def rows(pytestconfig: pytest.Config) -> list[Row]:
    """Missions that follow the seed of the property tests, which `make explore` draws."""
    first = int(pytestconfig.getoption("--hypothesis-seed") or 0)
    return [fly(number, PHASES_MAX) for number in range(first, first + COUNT)]


@pytest.mark.hypothesis
def test_what_is_accepted_stays_off_tether_and_walls_and_ends_well(rows: list[Row]) -> None:
    flown = [row for row in rows if not row.refused]
    assert len(flown) >= COUNT // 4, "too few to say anything"
    assert {row.number: row.failures for row in flown if row.failures} == {}


@pytest.mark.hypothesis
def test_the_governor_leaves_alone_what_was_accepted(rows: list[Row]) -> None:
    assert [row.number for row in rows if row.constrained] == []


@pytest.mark.hypothesis
def test_what_is_refused_says_what_where_and_how_to_change_it(rows: list[Row]) -> None:
    refused = [row for row in rows if row.refused]
    assert len(refused) >= COUNT // 5, "too few to say anything"
    for row in refused:
        for line in row.refused:
            assert line.startswith(f"mission 'random {row.number}', phase '")
            assert " at t = " in line
            assert line.count("\n") == 0
            assert "; " in line
    assert {row.number: row.failures for row in refused if row.failures} == {}


def test_a_mission_is_drawn_from_its_number_alone(rows: list[Row]) -> None:
    assert fly(rows[3].number, PHASES_MAX) == rows[3]
