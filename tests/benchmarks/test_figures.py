"""Ratios, verdicts and late ticks are computed from figures correctly."""

from __future__ import annotations

import numpy as np
import pytest

from benchmarks.measuring.figures import MET, NOT_MEASURED, NOT_MET, Row, Section, Target, problems
from benchmarks.measuring.hover import late_alone
from benchmarks.measuring.late import alone_late
from benchmarks.measuring.latency import Latency


def row(p50: float, p99: float, target: Target | None, beside: dict[str, float] | None = None) -> Row:
    return Row(
        what="loop",
        beside="bare",
        figures={"p50": p50, "p99": p99},
        beside_figures={"p50": 1.0, "p99": 2.0} if beside is None else beside,
        target=target,
    )


def test_ratios_are_of_each_statistic_to_the_same_of_what_ran_beside() -> None:
    assert row(1.5, 5.0, None).ratios == {"p50": 1.5, "p99": 2.5}
    assert row(1.5, 5.0, None, {"p99": 10.0}).ratios == {"p99": 0.5}
    assert row(1.5, 5.0, None, {"p50": 0.0, "p99": 10.0}).ratios == {"p99": 0.5}, "nothing is a multiple of 0"


@pytest.mark.parametrize(
    ("p50", "p99", "target", "verdict"),
    [
        (1.5, 3.0, Target(1.5), MET),
        (1.5, 3.01, Target(1.5), NOT_MET),
        (1.51, 3.0, Target(1.5), NOT_MET),
        (1.51, 3.0, Target(1.5, ("p99",)), MET),
        (100.0, 900.0, Target(100.0, ("p50",), ratio=False), MET),
        (100.1, 900.0, Target(100.0, ("p50",), ratio=False), NOT_MET),
        (1.0, 1.0, Target(1.0, ("p99.9",)), NOT_MEASURED),
        (9.0, 9.0, None, ""),
    ],
)
def test_every_figure_that_a_target_names_must_meet_it(
    p50: float, p99: float, target: Target | None, verdict: str
) -> None:
    assert row(p50, p99, target).verdict == verdict


def test_problems_name_what_is_not_met_or_not_measured_and_why() -> None:
    missing = Row(
        what="core", beside="", figures={}, beside_figures={}, target=Target(1.0), why_not="the bus did not start"
    )
    told = problems(
        [Section("", (), (), [row(1.0, 1.0, Target(1.5)), row(9.0, 9.0, Target(1.5)), row(9.0, 9.0, None), missing])]
    )
    assert told == ["loop beside bare: not met", "core: not measured: the bus did not start"]


def test_a_tick_is_alone_late_unless_the_loop_beside_was_late_close_to_it() -> None:
    beside = [10.0, 20.0, 30.0]
    assert alone_late([9.91, 10.09, 20.0], beside) == []
    assert alone_late([9.8, 10.2, 25.0, 31.0], beside) == [9.8, 10.2, 25.0, 31.0]
    assert alone_late([10.2], beside, within_s=0.3) == []
    assert alone_late([1.0], []) == [1.0]
    assert alone_late([], beside) == []


def test_late_by_two_periods_counts_unless_the_loop_beside_was_late_by_one() -> None:
    start_s = np.array([1.0, 2.0, 3.0, 4.0])
    late_s = np.array([0.0101, 0.0099, 0.03, 0.02])
    beside_s = np.array([0.95, 3.02, 4.05])
    beside_late_s = np.array([0.0049, 0.0051, 0.004])
    assert late_alone(start_s, late_s, beside_s, beside_late_s) == [0.0101, 0.02]


def test_percentiles_are_samples() -> None:
    found = Latency.of(number * 1e-3 for number in range(1001))
    assert (found.p50, found.p99, found.p999, found.max) == pytest.approx((500.0, 990.0, 999.0, 1000.0))
    with pytest.raises(ValueError, match="no samples"):
        Latency.of([])
