"""Delays from taps that were made up: found within their own error, and refused where they cannot tell."""

from __future__ import annotations

import math
from dataclasses import replace
from functools import cache
from itertools import pairwise

import numpy as np
import pytest

from companion.commissioning.latency import fit as latency_fit
from companion.commissioning.latency.fit import Tap, TapDelay, agreeing, combine, find_taps, measure_tap, mocap_noise
from companion.commissioning.latency.tools import Measured, rows, text
from companion.model.types import Quat, Vec3
from companion.preflight.hand_test.motion import ImuAt, PoseAt

TAPS_AT_S = (2.0, 3.13, 4.21, 5.4, 6.52, 7.61)
TAP_S = 0.024
IMU_HZ = 226.0


def vector(values: np.ndarray) -> Vec3:
    return (float(values[0]), float(values[1]), float(values[2]))


@cache
def tapped(
    delay_s: float,
    *,
    strength_m_s2: float = 10.0,
    accel_noise: float = 0.15,
    mocap_noise_m: float = 0.0002,
    seed: int = 3,
) -> tuple[list[ImuAt], list[PoseAt]]:
    """A machine that is held by a spring and tapped along x and z: continuous truth at 10 kHz, sampled as IMU and motion capture do."""
    rng = np.random.default_rng(seed)
    dt = 1e-4
    t = np.arange(0.0, 9.0, dt)
    push = np.zeros(len(t))
    for at_s in TAPS_AT_S:
        inside = (t >= at_s) & (t < at_s + TAP_S)
        push[inside] = strength_m_s2 * np.sin(math.pi * (t[inside] - at_s) / TAP_S)
    sway = 0.02 * np.sin(2.0 * math.pi * 0.4 * t)
    x, v = np.zeros(len(t)), 0.0
    a = np.zeros(len(t))
    for k in range(1, len(t)):
        a[k] = push[k] - 300.0 * (x[k - 1] - sway[k]) - 30.0 * v
        v += a[k] * dt
        x[k] = x[k - 1] + v * dt
    way = np.array([0.8, 0.0, 0.6])
    total = np.concatenate([[0.0], np.cumsum(a) * dt])
    imu = []
    times = np.arange(0.05, 8.9, 1.0 / IMU_HZ)
    for before, now in pairwise(times):
        mean = (total[int(now / dt)] - total[int(before / dt)]) / (int(now / dt) - int(before / dt)) / dt
        force = way * mean + np.array([0.0, 0.0, 9.81]) + rng.normal(0.0, accel_noise, 3)
        rate = rng.normal(0.0, 0.01, 3)
        imu.append(ImuAt(float(now), vector(force), vector(rate)))
    poses = []
    for exposed_s in np.arange(0.1, 8.7, 0.005):
        place = way * x[int(exposed_s / dt)] + rng.normal(0.0, mocap_noise_m, 3)
        turn = rng.normal(0.0, 0.5 * math.radians(0.05), 3)
        attitude: Quat = (1.0, float(turn[0]), float(turn[1]), float(turn[2]))
        poses.append(PoseAt(float(exposed_s) + delay_s, vector(place), attitude))
    return imu, poses


def measured(imu: list[ImuAt], poses: list[PoseAt]) -> list[TapDelay]:
    noise = mocap_noise(poses)
    return [measure_tap(tap, imu, poses, noise) for tap in find_taps(imu)]


def test_taps_are_found_and_sway_is_not_taken_for_one() -> None:
    imu, _ = tapped(0.005)
    taps = find_taps(imu)
    assert [tap.t_s for tap in taps] == pytest.approx([at_s + 0.5 * TAP_S for at_s in TAPS_AT_S], abs=0.01)
    assert all(6.0 < tap.strength_m_s2 < 12.0 for tap in taps)
    assert find_taps(tapped(0.005, strength_m_s2=0.0)[0]) == []


def test_the_noise_of_motion_capture_is_measured() -> None:
    _, poses = tapped(0.005)
    position_m, rotation_rad = mocap_noise(poses)
    assert position_m == pytest.approx(0.0002, rel=0.15)
    assert rotation_rad == pytest.approx(math.radians(0.05), rel=0.15)


@pytest.mark.parametrize("delay_s", [0.0, 0.0207, 0.09])
def test_a_delay_is_found_finer_than_the_samples(delay_s: float) -> None:
    taps = measured(*tapped(delay_s, seed=1))
    assert [tap.problem for tap in taps] == [""] * len(TAPS_AT_S)
    result = combine(taps)
    assert not isinstance(result, str), result
    assert result.delay_s == pytest.approx(delay_s, abs=0.001)
    assert result.error_s < 0.001


def test_the_stated_error_of_a_tap_is_the_scatter_of_its_delay() -> None:
    off, told = [], []
    for seed in range(10, 14):
        for tap in measured(*tapped(0.010, seed=seed)):
            off.append(tap.delay_s - 0.010)
            told.append(tap.error_s)
    ratio = float(np.std(off)) / float(np.mean(told))
    assert 0.4 < ratio < 2.5


def test_weak_taps_are_rejected() -> None:
    imu, poses = tapped(0.005, strength_m_s2=3.0, accel_noise=0.2, mocap_noise_m=0.004)
    assert all(tap.problem.startswith("too weak") or "no similar motion" in tap.problem for tap in measured(imu, poses))
    assert isinstance(combine(measured(imu, poses)), str)


def test_a_stream_that_shows_something_else_is_rejected() -> None:
    imu, _ = tapped(0.005)
    _, others = tapped(0.005, strength_m_s2=0.0, seed=9)
    result = combine(measured(imu, others))
    assert isinstance(result, str)
    assert "0 of 6" in result


def made_up(*delays_ms: float, problem: str = "") -> list[TapDelay]:
    return [
        TapDelay(tap=Tap(float(k), 9.0), delay_s=1e-3 * ms, error_s=0.001, correlation=0.9, problem=problem)
        for k, ms in enumerate(delays_ms)
    ]


def test_too_few_taps_are_refused() -> None:
    told = combine([*made_up(5.0, 5.1, 4.9, 5.2), *made_up(7.0, problem="too weak: x")])
    assert isinstance(told, str)
    assert "4 of 5 taps are usable, expected 5" in told


def test_one_tap_that_is_far_off_does_not_count() -> None:
    taps = made_up(5.0, 5.4, 4.7, 5.2, 4.9, 5.1, 60.0)
    assert agreeing(taps) == taps[:-1]
    result = combine(taps)
    assert not isinstance(result, str)
    assert result.delay_s == pytest.approx(0.00505, abs=1e-4)
    assert len(result.used) == 6


def test_taps_that_disagree_are_refused() -> None:
    told = combine(made_up(2.0, 9.0, 16.0, 23.0, 30.0, 37.0))
    assert isinstance(told, str)
    assert "differ" in told


def test_lost_frames_around_a_tap_make_it_not_count() -> None:
    imu, poses = tapped(0.005)
    at_s = find_taps(imu)[0].t_s
    holes = [pose for pose in poses if not at_s - 0.02 < pose.t_s < at_s + 0.25]
    (first, *rest) = measured(imu, holes)
    assert first.problem
    assert not any(tap.problem for tap in rest)
    assert latency_fit.TAPS_MIN == 5


def test_the_table_of_taps_and_its_sum_are_printed() -> None:
    taps = made_up(35.9, 36.4, 35.7, 36.2, 36.0)
    m = Measured(
        taps=(*taps, *made_up(80.0, problem="too weak: x")),
        delay=combine(taps),
        round_trip_s=0.004,
        imu_age_s=0.002,
        mocap_latency_s=None,
        px4_ms=5.0,
    )
    shown = "\n".join(text(m))
    assert all(words in shown for words in ("too weak: x", "unknown", "and back 4.0 ms", "38.04 ms", "error 0.12 ms"))
    assert [row.id for row in rows(m, 30.0) if not row.ok] == ["latency.delay", "latency.long"]
    assert all(row.ok for row in rows(replace(m, px4_ms=38.0), 50.0))
    nothing = Measured(taps=(), delay=combine([]), round_trip_s=0.004, imu_age_s=None, mocap_latency_s=None, px4_ms=5.0)
    assert [row.id for row in rows(nothing, 30.0)] == ["latency.taps"]
    assert "unknown" in "\n".join(text(nothing))
