"""benchmarks/fast_loop.py runs and says what it measured; how fast is not for a test to say."""

from __future__ import annotations

import json
import subprocess
import sys
from pathlib import Path

import pytest

from benchmarks.fast_loop import BenchmarkError, rotorpy_s

ROOT = Path(__file__).parents[2]


def run(*arguments: str) -> subprocess.CompletedProcess[str]:
    command = [sys.executable, str(ROOT / "benchmarks" / "fast_loop.py"), *arguments]
    return subprocess.run(command, cwd=ROOT, capture_output=True, text=True, timeout=150, check=False)


def test_the_table_and_its_figures(tmp_path: Path) -> None:
    figures = tmp_path / "rows.json"
    mission = str(ROOT / "configs" / "missions" / "hover.yaml")
    done = run(
        "--flights",
        "1",
        "--no-workers",
        "--mission",
        mission,
        "--rotorpy-python",
        sys.executable,
        "--json",
        str(figures),
    )
    assert done.returncode == 0, done.stderr
    rows = {row["key"]: row for row in json.loads(figures.read_text())}
    for key in ("raw_step_us", "tick_us", "real_time", "core_p50_us", "law_us", "reference_us"):
        assert rows[key]["value"] > 0
    # One is part of the other.
    assert rows["tick_us"]["value"] > 2.5 * rows["raw_step_us"]["value"]
    assert rows["tick_us"]["value"] > rows["law_us"]["value"]
    assert rows["real_time"]["value"] * rows["tick_us"]["value"] == pytest.approx(5000.0)
    assert "FastFlight" in done.stdout


def test_bad_input_is_one_line() -> None:
    done = run("--mission", "nowhere.yaml")
    assert done.returncode == 2
    assert "nowhere.yaml" in done.stderr
    assert "Traceback" not in done.stderr


def test_a_python_that_is_not_there_is_told() -> None:
    with pytest.raises(BenchmarkError, match="/nowhere/python"):
        rotorpy_s("/nowhere/python")
