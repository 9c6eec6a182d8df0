"""The worlds in which `adaptive/recommended` had the hardest time are flown again: `companion robustness --keep` writes them."""

from __future__ import annotations

from functools import cache
from pathlib import Path

import pytest

from companion.campaigns.robustness.cases import Case, Cases, read_cases, worse_than
from companion.campaigns.robustness.draws import SAFE, WORST
from companion.sitl_config.loader import SitlConfig, load_sitl
from sitl.campaigns import robustness
from tests.support import ROOT

FILE = Path(__file__).with_name("robustness.yaml")
KEPT: Cases = read_cases(FILE)
FLOWN = 1
"""The worst; `companion robustness --cases tests/regressions/robustness.yaml` flies all."""


@cache
def config() -> SitlConfig:
    return load_sitl(ROOT / KEPT.mission, None, KEPT.controller, KEPT.preset)


def test_ten_are_kept_of_the_law_that_users_get() -> None:
    assert len(KEPT.cases) == WORST
    assert (KEPT.controller, KEPT.preset) == ("adaptive", "recommended")
    assert all(case.kept.outcome.value in SAFE for case in KEPT.cases), "a crash is to be mended, not kept"


@pytest.mark.parametrize("case", KEPT.cases[:FLOWN], ids=lambda case: case.name)
def test_no_worse_than_when_it_was_kept(case: Case) -> None:
    flight = {"name": case.name, "number": None, "world": case.knobs()}
    row = robustness.fly(config(), flight)["row"]
    assert worse_than(row, case.kept) is None, row
