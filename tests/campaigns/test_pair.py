"""`companion robustness` of a team file: the rows that outside scripts read."""

from __future__ import annotations

import csv
import json
from pathlib import Path

import pytest

from tests.campaigns.made_up import fly_here
from tests.short_carry import SHORT_CARRY
from tests.support import run_here


@pytest.mark.usefixtures("undrawn")
def test_a_team_is_flown_in_drawn_laboratories_and_its_rows_carry_the_figures_of_the_bar(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    fly_here(monkeypatch)
    ended = run_here(
        *("robustness", "carry", "--draws", "1", "--seed", "3", "--jobs", "1"),
        *(word for override in SHORT_CARRY for word in ("--set", override)),
        *("--json", "--out", tmp_path),
    )
    assert ended.code == 0, ended.err
    found = json.loads(ended.out)
    (row,) = found["rows"]
    assert row["outcome"] == "completed"
    assert row["outcomes"] == ["completed", "completed"]
    assert 0.0 < row["bar_p_rms_m"] < 0.1
    assert 0.0 < row["bar_tilt_rms_deg"] < 3.0
    assert 0.0 < row["internal_force_rms_n"] < 3.0
    assert 0.3 < row["share"] < 0.7
    assert abs(row["let_go"]) < 0.05
    assert row["share_wanted"] == pytest.approx(0.562, abs=1e-3), "its centre of mass is 7.5 cm from the middle"
    assert row["share"] == pytest.approx(row["share_wanted"], abs=0.06)
    assert (row["dropped"], row["rotors_touched"], row["down_s"]) == (False, False, None)
    assert found["summary"]["bar_p_rms_m"]["p50"] == row["bar_p_rms_m"]
    (line,) = csv.DictReader((tmp_path / "draws.csv").read_text(encoding="utf-8").splitlines())
    assert line["left_events"].split()[:2] == ["takeoff", "gripped"]


def test_a_team_takes_no_cases_and_no_vehicle() -> None:
    ended = run_here("robustness", "carry", "--vehicle", "tarot650_2r")
    assert ended.code == 2
    assert ended.err_lines == ["companion robustness: a team file takes no --cases, --keep and --vehicle"]
