"""`--plan`: the duration of a campaign, from the measured cost of a sample."""

from __future__ import annotations

import json
import re
import time
from pathlib import Path
from typing import Any

import pytest

from companion.campaigns.plan import SAMPLE, Plan
from companion.campaigns.process import CampaignError
from companion.model.exit_codes import EXIT_BAD_INPUT, EXIT_OK
from companion.sitl_config.loader import SitlConfig, load_sitl
from sitl.campaigns.runner import fly_all
from tests.campaigns.made_up import compare_row, fly_made_up
from tests.support import CATCH, run_here

PLAN = (
    "compare",
    "--mission",
    str(CATCH),
    "--payloads",
    "0.2",
    "--controllers",
    "adaptive",
    "--presets",
    "paper",
    "--plan",
)


@pytest.fixture(autouse=True)
def _here(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)


def test_the_arithmetic_of_a_plan() -> None:
    found = Plan.of(1001, [{"cpu_s": cpu_s, "at_once": 4} for cpu_s in (1.0, 2.0, 3.0)])
    assert (found.cpu_s, found.sample) == (2.0, 3)
    assert found.cpu_error_s == pytest.approx(1.0 / 3.0**0.5)
    assert found.duration_s(1) == 2002.0
    assert found.duration_s(4) == 502.0, "251 flights one after the other on the busiest core"
    assert Plan.of(7, [{"cpu_s": 1.5, "at_once": 1}]).cpu_error_s == 1.5, "one flight says nothing about the others"


def test_a_plan_flies_a_sample_of_the_whole_campaign_and_writes_nothing(
    monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    seeds: list[int] = []

    def row(flight: dict[str, Any]) -> dict[str, Any]:
        seeds.append(flight["seed"])
        return compare_row(flight)

    fly_made_up(monkeypatch, row)
    ended = run_here(*PLAN, "--seeds", "10000", "--json")
    assert (ended.code, ended.err) == (EXIT_OK, "")
    assert seeds == [1 + 500 * number for number in range(SAMPLE)]
    found = json.loads(ended.out)
    assert (found["flights"], found["sample"], found["at_once"], found["cpu_s"]) == (10_000, SAMPLE, 4, 1.0)
    assert found["duration_s"] == 2500.0
    text = run_here(*PLAN, "--seeds", "10000").out
    assert re.search(r"10000 flights, 4 at a time on this computer: 42 min\n", text)
    assert re.search(r"10000 flights on 100 Dask workers, .*: 100 s\n", text)
    assert list(tmp_path.iterdir()) == []


def _nap(config: SitlConfig, flight: dict[str, Any]) -> dict[str, Any]:
    time.sleep(0.05)
    return {"row": {"seed": flight["seed"], "mission": config.mission.name}}


def test_a_flight_reports_its_processor_time_and_how_many_fly_at_once() -> None:
    [result] = fly_all(_nap, [load_sitl(CATCH)], [{"variant": 0, "seed": 7}], jobs=3, scheduler=None)
    assert (result["index"], result["row"]["seed"], result["at_once"]) == (0, 7, 3)
    assert 0.0 <= result["cpu_s"] <= result["wall_s"] - 0.04, "sleeping takes no processor time"


def test_a_plan_without_its_scheduler_is_refused(monkeypatch: pytest.MonkeyPatch) -> None:
    fly_made_up(monkeypatch, lambda flight: None, CampaignError("--scheduler tcp://x: no answer", bad_input=True))
    ended = run_here(*PLAN, "--scheduler", "tcp://x")
    assert (ended.code, ended.out) == (EXIT_BAD_INPUT, "")
    assert ended.err_lines == ["companion compare: --scheduler tcp://x: no answer"]
