"""Every wire survives some thousand damaged inputs, and every input on which it once failed. `benchmarks/fuzz.py` feeds a million."""

from __future__ import annotations

import logging
from collections.abc import Iterator

import pytest

from benchmarks.fuzz import REGRESSIONS
from benchmarks.fuzzing.campaign import feed_watched, run
from benchmarks.fuzzing.targets import NAMES, target_class

INPUTS = {
    "natnet": 2000,
    "dynamixel": 2000,
    "dynamixel-wire": 30,
    "force": 2000,
    "mavlink": 2000,
    "mavlink-wire": 30,
    "channels": 2000,
    "yaml": 1200,
}
SEED = 20
FOUND = sorted(REGRESSIONS.glob("*.bin"))


def target_of_file(stem: str) -> str:
    return stem.rsplit("-", 2)[0]


@pytest.fixture(autouse=True)
def quiet() -> Iterator[None]:
    """Silence the drivers, which log every rejected input."""
    logger = logging.getLogger("companion")
    before = logger.level
    logger.setLevel(logging.CRITICAL + 1)
    yield
    logger.setLevel(before)


def test_every_target_is_fed_here() -> None:
    assert set(INPUTS) == set(NAMES)


@pytest.mark.parametrize("name", NAMES)
def test_damaged_input_is_borne(name: str) -> None:
    with target_class(name)() as target:
        stretch = run(target, SEED, 0, INPUTS[name])
    assert stretch.inputs == INPUTS[name]
    # Memory is judged over a million inputs, where caches and the interpreter's arenas are filled.
    assert [str(finding) for finding in stretch.findings if finding.index is not None] == []


@pytest.mark.parametrize("stem", [path.stem for path in FOUND])
def test_what_was_found_once_is_borne(stem: str) -> None:
    with target_class(target_of_file(stem))() as target:
        assert feed_watched(target, (REGRESSIONS / f"{stem}.bin").read_bytes()) is None
