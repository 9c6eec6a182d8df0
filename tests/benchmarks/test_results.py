"""`python -m benchmarks`: every part, its files, and the page."""

from __future__ import annotations

import copy
import json
import re
import signal
import subprocess
import sys
from pathlib import Path
from typing import Any

import pytest

from benchmarks import __main__ as command
from benchmarks.measuring.figures import problems
from benchmarks.measuring.hover_log import read_hover
from benchmarks.measuring.page import markdown
from benchmarks.measuring.pi import PI5_S
from benchmarks.measuring.rows import sections
from companion.analysis.log import FlightLog
from tests.analysis.synthetic_flight import record_flight
from tests.support import DEADLINE_S, ROOT


def spread(p50: float, p99: float) -> dict[str, float]:
    return {"p50": p50, "p99": p99, "p999": 2 * p99, "max": 3 * p99, "samples": 1000}


def process(cpu_percent: float, rss_mb: float) -> dict[str, float]:
    return {"cpu_percent": cpu_percent, "cpu_percent_worst": 2 * cpu_percent, "rss_mb": rss_mb, "minor_faults_s": 1.0}


GOOD: dict[str, Any] = {
    "core": {"core_ms": spread(0.08, 0.2), "law_us": 12.0, "law_without_loads_us": 10.0, "tick_us": 200.0, "raw_tick_us": 20.0,
             "catches_min": 40.0},
    "compiled": {"core_ms": spread(0.02, 0.04), "tick_us": 62.5, "catches_min": 30.0},
    "pi": {"here_s": {name: time_s / 1.5 for name, time_s in PI5_S.items()}},
    "joints": {
        "alone": {"cycle_ms": spread(0.4, 0.6), "command_ms": spread(0.02, 0.03), "wire_ms": 0.26, "request_bytes": 16,
                  "answer_bytes": 42, "write_bytes": 20, "baud_bps": 3_000_000},
        "in_world": {"cycle_ms": spread(1.0, 2.0), "command_ms": spread(0.02, 0.03)},
    },
    "setpoint": {name: {"inside": spread(0.1, 0.2), "wire": spread(wire, 2 * wire)}
                 for name, wire in (("native", 0.15), ("edge", 0.2), ("pymavlink", 0.1))},
    "hover": {
        "exit_code": 0, "outcome": "completed", "recorder_dropped": 0, "warnings": ["no more than a hint"], "hover_s": 594.0,
        "viewer": "headless Chromium", "realtime": "SCHED_FIFO 50", "limits": {"vehicle.safety.preflight_s": 2.0},
        "flight": {"lateness_ms": spread(0.1, 0.3), "later_than_one": 1, "later_than_two": 0, "ticks": 118800, "skipped": 0},
        "plain": {"lateness_ms": spread(0.5, 1.0), "later_than_one": 1, "later_than_two": 0, "ticks": 118800, "skipped": 0},
        "empty": {"lateness_ms": spread(0.1, 0.2), "later_than_one": 1, "later_than_two": 0, "ticks": 118800, "skipped": 0},
        "late_alone": [], "setpoint_ms": spread(0.12, 0.3), "start_to_setpoint_ms": spread(0.1, 0.2),
        "core_ms": spread(0.08, 0.2), "bus_cycle_ms": spread(1.3, 2.6), "read_to_write_ms": spread(0.4, 0.8),
        "bare": {"inside": spread(0.08, 0.2), "wire": spread(0.1, 0.3)},
        "processes": {role: process(14.0, 70.0) for role in ("flight", "empty loop", "recorder", "guardian", "bare loop")},
        "threads": {name: {"user": 4.0, "system": system} for name, system in (("main", 2.0), ("arm-bus", 1.0), ("native", 0.0))},
        "machine": {"busy_percent": 60.0, "stolen_percent": 0.1},
    },
}  # fmt: skip


def results(parts: dict[str, Any], **failed: str) -> dict[str, Any]:
    entries = {name: {"quick": False, "failed": None, "figures": figures} for name, figures in parts.items()}
    return {
        "parts": {**entries, **{name: {"quick": False, "failed": why, "figures": {}} for name, why in failed.items()}}
    }


def changed(*keys: str, to: Any) -> dict[str, Any]:
    parts: dict[str, Any] = copy.deepcopy(GOOD)
    inner = parts
    for key in keys[:-1]:
        inner = inner[key]
    inner[keys[-1]] = to
    return parts


def test_every_target_can_be_met() -> None:
    tables = sections(GOOD)
    assert problems(tables) == []
    assert sum(row.target is not None for table in tables for row in table.rows) == 18


@pytest.mark.parametrize(
    ("keys", "bad", "words"),
    [
        (("hover", "flight", "lateness_ms"), spread(0.1, 1.51), "lateness of a tick"),
        (("hover", "late_alone"), [0.012], "later than two periods while"),
        (("hover", "setpoint_ms"), spread(0.161, 0.3), "beside bare loop on native MAVSDK"),
        (("hover", "bus_cycle_ms"), spread(1.51, 2.0), "joint read begun"),
        (("core", "core_ms"), spread(0.101, 0.2), "FlightCore.step, us"),
        (("hover", "core_ms"), spread(0.081, 0.2), "FlightCore.step in the flight"),
        (("compiled", "core_ms"), spread(0.021, 0.04), "FlightCore.step, compiled build"),
        (("compiled", "core_ms"), spread(0.02, 0.041), "FlightCore.step, compiled build"),
        (("compiled", "tick_us"), 62.6, "80 x real time"),
        (("compiled", "catches_min"), 30.1, "10,000 catches"),
        (("hover", "threads", "main"), {"user": 5.0, "system": 1.1}, "CPU time of its main thread"),
        (("hover", "threads", "arm-bus"), {"user": 0.0, "system": 5.1}, "system time of the flight process"),
        (("pi", "here_s"), {name: time_s / 1.95 for name, time_s in PI5_S.items()}, "Pi 4, 1.8 GHz: flight process"),
        (("hover", "processes", "flight"), process(14.1, 70.0), "CPU time of the flight"),
        (("hover", "processes", "flight"), process(14.0, 151.0), "memory of the flight"),
    ],
)
def test_each_target_can_be_missed(keys: tuple[str, ...], bad: Any, words: str) -> None:
    [problem] = problems(sections(changed(*keys, to=bad)))
    assert words in problem
    assert problem.endswith("not met")
    assert markdown(results(changed(*keys, to=bad)), sections(changed(*keys, to=bad))).count("**not met**") == 1


def test_what_was_not_measured_says_why_and_is_a_problem() -> None:
    failed = results(GOOD, hover="no broker")
    told = problems(command.tables_of(failed))
    assert len(told) == 13
    assert all(line.endswith(": not measured: no broker") for line in told)
    assert "* **hover was not measured: no broker**" in markdown(failed, command.tables_of(failed))
    assert len(problems(command.tables_of(results({})))) == 18
    without_bare = changed("hover", "bare", to={"not_measured": "it had not ended"})
    assert problems(sections(without_bare))[0].endswith("in the same minutes: not measured: it had not ended")


def test_the_page_says_what_kind_of_run_it_was() -> None:
    text = markdown(results(GOOD), sections(GOOD))
    assert "1.3 / 1 = 1.30" in text
    assert "the flight said: no more than a hint" in text
    assert "quick" not in text
    quick = results(GOOD)
    quick["parts"]["hover"]["quick"] = True
    assert "one minute instead of ten" in markdown(quick, sections(GOOD))
    landed = changed("hover", "outcome", to="aborted")
    assert "the flight did not complete: aborted" in markdown(results(landed), sections(landed))
    for line in text.splitlines():
        assert line.count("|") in (0, 6, 7, 8, 9), line


def test_the_committed_page_has_the_tables_of_the_program() -> None:
    text = (ROOT / "docs/internals/benchmarks.md").read_text(encoding="utf-8")
    assert re.findall(r"^## (.+)$", text, flags=re.M) == [table.title for table in sections(GOOD)]


def test_one_phase_of_a_log_is_read(tmp_path: Path) -> None:
    path = tmp_path / "flight.mcap"
    record_flight(path, rate_hz=50.0)
    log = FlightLog.read(path)
    name = max({outputs.phase for outputs in log.outputs}, key=lambda phase: sum(o.phase == phase for o in log.outputs))
    begin_s = next(outputs.t_s for outputs in log.outputs if outputs.phase == name)
    kept = [s for _, o, s in log.rows() if o.phase == name and s.start_s >= begin_s + 1.0]
    found = read_hover(path, name, 1.0)
    assert found.start_s.tolist() == [sent.start_s for sent in kept]
    assert found.timing.lateness_s.tolist() == [sent.lateness_s for sent in kept]
    assert len(kept) < len(log.sent)
    assert found.epoch_offset_s == 1_700_000_000.0
    with pytest.raises(ValueError, match="'nowhere'"):
        read_hover(path, "nowhere", 1.0)


STAND_IN = """#!/bin/sh
# As `python -P -m benchmarks --part NAME --out DIR`: one part is measured, one fails, one crashes, one lands on Ctrl-C.
case "$5" in
core) printf '%s' '{"law_us": 7.5}' > "$7/core/figures.json" ;;
joints) echo "the bus did not start" >&2; exit 1 ;;
setpoint) kill -SEGV $$ ;;
hover) trap 'echo landed > "$7/hover/landed"; exit 130' INT; echo hovering; while :; do sleep 0.05; done ;;
esac
"""


@pytest.fixture
def stand_in(tmp_path: Path) -> Path:
    path = tmp_path / "python"
    path.write_text(STAND_IN, encoding="utf-8")
    path.chmod(0o755)
    return path


def test_a_part_that_fails_ends_no_other(
    tmp_path: Path, stand_in: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setattr(sys, "executable", str(stand_in))
    monkeypatch.setattr(command, "PAGE", tmp_path / "page.md")
    out = tmp_path / "out"
    assert command.main(["--out", str(out), "--only", "joints", "--only", "setpoint", "--only", "core"]) == 1
    found = json.loads((out / "results.json").read_text())
    assert found["parts"]["joints"]["failed"] == "the bus did not start"
    assert found["parts"]["setpoint"]["failed"].startswith("the part ended with exit code")
    assert found["parts"]["core"]["figures"] == {"law_us": 7.5}
    assert {row["what"]: row["figures"] for row in found["rows"]}["the law alone, us"] == {"p50": 7.5}
    assert "joints was not measured: the bus did not start" in (out / "results.md").read_text()
    assert "the bus did not start" in capsys.readouterr().out
    monkeypatch.setattr(sys, "executable", "/bin/false")
    assert command.main(["--out", str(out), "--only", "core"]) == 1
    kept = json.loads((out / "results.json").read_text())["parts"]
    assert kept["core"]["failed"], "measured anew"
    assert kept["joints"] == found["parts"]["joints"], "the others stay as they were"
    assert command.main(["--page", "--out", str(out)]) == 0
    assert (tmp_path / "page.md").read_text() == (out / "results.md").read_text()


def test_ctrl_c_lands_and_keeps_what_was_measured(tmp_path: Path, stand_in: Path) -> None:
    out = tmp_path / "out"
    code = f"""
import sys
from benchmarks import __main__ as command
sys.executable = {str(stand_in)!r}
sys.exit(command.main(["--out", {str(out)!r}, "--only", "core", "--only", "hover"]))
"""
    with subprocess.Popen(
        [sys.executable, "-c", code], cwd=ROOT, stdout=subprocess.PIPE, text=True, start_new_session=True
    ) as started:
        assert started.stdout is not None
        assert any(line == "hovering\n" for line in started.stdout)
        started.send_signal(signal.SIGINT)
        rest = started.stdout.read()
        assert started.wait(DEADLINE_S) == 130, rest
    assert (out / "hover/landed").exists()
    assert list(json.loads((out / "results.json").read_text())["parts"]) == ["core"]
