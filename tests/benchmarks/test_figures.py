"""Ratios, verdicts and late ticks are computed from figures correctly."""

from __future__ import annotations

import numpy as np
import pytest

from benchmarks.measuring.figures import MET, NOT_MEASURED, NOT_MET, Row, Target
from benchmarks.measuring.hover import late_alone
from benchmarks.measuring.latency import Latency


def row(p50: float, p99: float, target: Target | None, beside: dict[str, float] | None = None) -> Row:
    return Row(
        what="loop",
        beside="bare",
        figures={"p50": p50, "p99": p99},
        beside_figures={"p50": 1.0, "p99": 2.0} if beside is None else beside,
        target=target,
    )


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
def test_a_target_is_met_if_every_percentile_that_it_names_meets_it(
    p50: float, p99: float, target: Target | None, verdict: str
) -> None:
    assert row(p50, p99, target).verdict == verdict


@pytest.mark.parametrize(
    ("late_at_s", "beside_at_s", "alone"),
    [
        ([9.91, 10.09, 20.0], [10.0, 20.0, 30.0], 0),
        ([9.8, 10.2, 25.0, 31.0], [10.0, 20.0, 30.0], 4),
        ([1.0], [], 1),
        ([], [10.0], 0),
    ],
)
def test_a_late_tick_counts_unless_the_comparison_loop_was_late_at_about_the_same_time(
    late_at_s: list[float], beside_at_s: list[float], alone: int
) -> None:
    late, beside = (np.full(len(times_s), 0.02) for times_s in (late_at_s, beside_at_s))
    assert late_alone(np.array(late_at_s), late, np.array(beside_at_s), beside) == [0.02] * alone


def test_a_tick_late_by_two_periods_counts_unless_the_comparison_loop_was_late_by_one() -> None:
    start_s = np.array([1.0, 2.0, 3.0, 4.0])
    late_s = np.array([0.0101, 0.0099, 0.03, 0.02])
    beside_s = np.array([0.95, 3.02, 4.05])
    beside_late_s = np.array([0.0049, 0.0051, 0.004])
    assert late_alone(start_s, late_s, beside_s, beside_late_s) == [0.0101, 0.02]


def test_percentiles_are_values_of_the_samples() -> None:
    found = Latency.of(number * 1e-3 for number in range(1001))
    assert (found.p50, found.p99, found.p999, found.max) == pytest.approx((500.0, 990.0, 999.0, 1000.0))
    with pytest.raises(ValueError, match="no samples"):
        Latency.of([])
