"""The sum of the IMU's samples: each counts once, for its own interval."""

from __future__ import annotations

import math
import random

import pytest

from companion.io.px4.delta_velocity import GAP_MAX_S, DeltaVelocity

INTERVAL_S = 0.004
AMPLITUDE_M_S2 = 10.0


def mean_m_s2(k: int, hz: float) -> float:
    """Mean of a vibration over the interval that ends at sample k, as PX4's HIGHRES_IMU has it."""
    turns = math.tau * hz
    since, until = turns * INTERVAL_S * (k - 1), turns * INTERVAL_S * k
    return AMPLITUDE_M_S2 * (math.cos(since) - math.cos(until)) / (turns * INTERVAL_S)


@pytest.mark.parametrize("hz", [80.0, 100.2, 125.0, 149.7, 200.0])
def test_vibration_adds_no_more_velocity_than_it_has(hz: float) -> None:
    """10 m/s2 at 80 Hz are 20 mm/s of true motion; one sample in 5 ms, as they were used before, drift by m/s."""
    total = DeltaVelocity()
    for k in range(5000):
        total.add(100.0 + k * INTERVAL_S, (mean_m_s2(k, hz), 0.0, -9.81))
        assert abs(total.sum_m_s[0]) <= 2.0 * AMPLITUDE_M_S2 / (math.tau * hz) + 1e-9
    assert total.sum_m_s[2] == pytest.approx(-9.81 * 4999 * INTERVAL_S)


def test_a_repeated_or_late_sample_changes_nothing() -> None:
    total = DeltaVelocity()
    for k in (0, 1, 1, 3, 2, 4):
        total.add(5.0 + k * INTERVAL_S, (1.0, 0.0, 0.0))
    assert total.sum_m_s == pytest.approx((4 * INTERVAL_S, 0.0, 0.0))
    assert total.boot_s == 5.0 + 4 * INTERVAL_S


@pytest.mark.parametrize("jump_s", [GAP_MAX_S + 0.01, -100.0], ids=["gap", "restart of PX4"])
def test_what_was_not_measured_adds_nothing(jump_s: float) -> None:
    total = DeltaVelocity()
    total.add(200.0, (1.0, 0.0, 0.0))
    total.add(200.0 + jump_s, (1.0, 0.0, 0.0))
    assert (total.boot_s, total.sum_m_s, total.gaps) == (200.0 + jump_s, (0.0, 0.0, 0.0), 1)
    total.add(200.0 + jump_s + INTERVAL_S, (1.0, 0.0, 0.0))
    assert total.sum_m_s == pytest.approx((INTERVAL_S, 0.0, 0.0))


def test_a_sample_that_is_not_finite_does_not_corrupt_the_sum() -> None:
    total = DeltaVelocity()
    for k, force in enumerate((1.0, 1.0, math.nan, math.inf, 1.0)):
        total.add(k * INTERVAL_S, (force, 0.0, 0.0))
    assert total.sum_m_s == pytest.approx((4 * INTERVAL_S, 0.0, 0.0))


@pytest.mark.parametrize("hz", [80.0, 125.3])
def test_a_lost_sample_is_not_replaced_by_the_next_one(hz: float) -> None:
    """One sample in 28 is lost, at random: each leaves no more than the vibration's own share of its interval."""
    draw = random.Random(1)
    total, lost = DeltaVelocity(), 0
    for k in range(28_000):
        if k > 100 and draw.random() < 1.0 / 28.0:
            lost += 1
        else:
            total.add(k * INTERVAL_S, (mean_m_s2(k, hz), 0.0, -9.81))
    # The sum of independent errors of at most the amplitude of the means; the next sample in its place would add as much again.
    error_m_s = AMPLITUDE_M_S2 * math.sin(math.pi * hz * INTERVAL_S) / (math.pi * hz * INTERVAL_S) * INTERVAL_S
    assert abs(total.sum_m_s[0]) < 2.5 * error_m_s * math.sqrt(0.5 * lost)
    assert total.sum_m_s[2] == pytest.approx(-9.81 * 27_999 * INTERVAL_S, rel=1e-4)
