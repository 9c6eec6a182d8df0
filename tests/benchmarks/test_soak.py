"""benchmarks.soak measures correctly and reports growth. The flight of an hour is not part of the tests."""

from __future__ import annotations

import os
import subprocess
import sys
from pathlib import Path

import pytest

from benchmarks.soak import problems_of
from benchmarks.soaking.lateness import Minute, Ticks, ticks_of_log
from benchmarks.soaking.processes import family, pss_mb, usage
from benchmarks.soaking.verdict import ROLES, Sample, airborne, lateness_problems, memory_growth, thirds
from companion.analysis.log import FlightLog
from tests.analysis.synthetic_flight import record_flight

PERIOD_S = 0.005
GOOD = {
    "outcome": "completed",
    "repetitions": 3,
    "throws": 3,
    "catches": 3,
    "catches_noticed": 3,
    "guardian_missed": 0,
    "recorder_dropped": 0,
}


def hour(growing: str | None = None, mb_per_hour: float = 0.0) -> list[Sample]:
    """One sample a second; before and after the flight only the launcher runs, and it grows."""
    samples = [Sample(float(t_s), {"launcher": 10.0}, {"launcher": 0.0}, {}) for t_s in range(10)]
    for t_s in range(10, 3610):
        rss_mb = {role: 50.0 + (mb_per_hour * (t_s - 10) / 3600.0 if role == growing else 0.0) for role in ROLES}
        cpu_s = dict.fromkeys(ROLES, 0.25 * t_s)
        samples.append(Sample(float(t_s), rss_mb, cpu_s, {"flight": 30.0} if t_s % 10 == 0 else {}))
    return [*samples, Sample(3610.0, {"launcher": 500.0}, {"launcher": 900.0}, {})]


def minutes(p99: list[float], p50: float = 0.5) -> list[Minute]:
    return [Minute(begin_s=60.0 * number, ticks=12000, p50=p50, p99=value, max=3.0) for number, value in enumerate(p99)]


def test_memory_is_compared_early_and_late_in_the_flight_alone() -> None:
    found = {row.role: row for row in memory_growth(airborne(hour("recorder", 4.0)))}
    assert set(found) == set(ROLES)
    assert found["flight"].ratio == pytest.approx(1.0)
    # Mean of the last ten minutes against minutes 5 to 15: 45 minutes apart.
    assert found["recorder"].late_mb - found["recorder"].early_mb == pytest.approx(3.0, abs=0.01)
    assert found["launcher"].late_mb == pytest.approx(50.0), "what it takes to grade the log is no growth of the flight"
    assert found["world"].early_cpu_percent == pytest.approx(25.0)
    assert found["flight"].late_pss_mb == 30.0
    assert found["world"].late_pss_mb is None


@pytest.mark.parametrize(("mb_per_hour", "told"), [(0.0, False), (2.5, False), (4.5, True)])
def test_a_process_that_grows_by_more_than_a_twentieth_is_named(mb_per_hour: float, told: bool) -> None:
    growth = memory_growth(airborne(hour("world", mb_per_hour)))
    flat = minutes([1.0] * 60)
    found = problems_of(GOOD, growth, Ticks(flat, 720000, 0, 0), flat)
    assert len(found) == told
    assert all(text.startswith("memory of the world process grew") for text in found)


def test_what_was_missed_is_a_problem() -> None:
    growth = memory_growth(airborne(hour()))
    flat = minutes([1.0] * 60)
    ticks = Ticks(flat, 720000, 0, 0)
    for key, bad, words in (
        ("outcome", "aborted", "outcome aborted"),
        ("catches", 2, "2 catches in 3 repetitions"),
        ("catches_noticed", 4, "4 catches noticed in 3 repetitions"),
        ("guardian_missed", 1, "guardian missed: 1"),
        ("guardian_missed", None, "guardian missed: None"),
        ("recorder_dropped", 7, "recorder dropped: 7"),
    ):
        assert problems_of({**GOOD, key: bad}, growth, ticks, flat) == [words]
    assert problems_of(GOOD, growth, ticks, flat) == []


def test_lateness_that_grows_is_reported_unless_the_machine_grew_as_late() -> None:
    growing, flat = minutes([1.0] * 20 + [1.2] * 20 + [1.5] * 20), minutes([1.0] * 60)
    assert thirds(growing, "p99") == (1.0, 1.5)
    assert lateness_problems(flat, flat) == []
    [told] = lateness_problems(growing, flat)
    assert told == "lateness p99 grew 1.50 times, 1.20 allowed"
    assert lateness_problems(growing, growing) == []
    spike = minutes([1.0] * 55 + [30.0] + [1.0] * 4)
    assert lateness_problems(spike, flat) == [], "one bad minute is no growth"
    assert lateness_problems(minutes([1.0, 1.0]), flat) == ["too short to show growth of lateness"]


def test_the_log_is_read_tick_by_tick(tmp_path: Path) -> None:
    path = tmp_path / "flight.mcap"
    record_flight(path, end_s=5.0)
    log = FlightLog.read(path)
    ticks = ticks_of_log(path)
    assert ticks.ticks == len(log.sent)
    assert ticks.skipped == 0
    assert ticks.missed == int((log.timing.lateness_s > PERIOD_S).sum())


def test_processes_are_found_by_what_they_run_and_measured() -> None:
    """A launcher that starts something that looks like a guardian, and something else."""
    code = (
        "import subprocess, sys\n"
        "arguments = (['companion.guardian'], ['something.else'])\n"
        "started = [subprocess.Popen([sys.executable, '-c', 'print(1, flush=True); input()', *more], stdin=subprocess.PIPE,"
        " stdout=subprocess.PIPE) for more in arguments]\n"
        "[child.stdout.readline() for child in started]\n"
        "print(started[0].pid, flush=True)\n"
        "input()\n"
        "[child.communicate(b'x') for child in started]\n"
    )
    with subprocess.Popen(
        [sys.executable, "-c", code], stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True
    ) as launcher:
        assert launcher.stdout is not None and launcher.stdin is not None
        guardian = int(launcher.stdout.readline())
        found = family(launcher.pid)
        assert found == {"launcher": launcher.pid, "guardian": guardian}
        used = usage(guardian)
        assert used is not None
        assert 3.0 < used.rss_mb < 200.0
        pss = pss_mb(guardian)
        assert pss is not None
        assert 0.0 < pss <= used.rss_mb
        launcher.communicate("\n")
    assert usage(guardian) is None
    own = usage(os.getpid())
    assert own is not None
    assert own.cpu_s > 0.0
