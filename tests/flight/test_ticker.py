"""Ticks lean on frames, and nothing that arrives moves them far; in simulated time."""

from __future__ import annotations

import asyncio
import itertools
from collections.abc import Callable, Iterable

import pytest
from hypothesis import given
from hypothesis import strategies as st

from companion.flight.ticker import EARLY_S, LATE_S, Ticker, TickTime
from tests.flight.simulated import SimulatedTime, simulated

P = 0.005
RATE_HZ = 1.0 / P


def ticks_of(
    frames_s: Iterable[float],
    until_s: float,
    rate_hz: float = RATE_HZ,
    work: Callable[[int, SimulatedTime], None] = lambda tick, time: None,
) -> tuple[list[TickTime], Ticker]:
    """Ticks from 0 to `until_s` of a loop to which frames arrive at those times; `work` is done in each."""

    async def run(loop: asyncio.AbstractEventLoop, time: SimulatedTime) -> tuple[list[TickTime], Ticker]:
        ticker = Ticker(P, lambda: time.now_s, rate_hz)
        for frame_s in frames_s:
            loop.call_at(frame_s, ticker.frame, frame_s)
        ticks: list[TickTime] = []
        while time.now_s < until_s:
            ticks.append(await ticker.next())
            work(len(ticks), time)
        return ticks, ticker

    return simulated(run)


def starts_of(ticks: list[TickTime]) -> list[float]:
    return [tick.start_s for tick in ticks]


def gaps_of(ticks: list[TickTime]) -> list[float]:
    starts_s = starts_of(ticks)
    return [after - before for before, after in itertools.pairwise(starts_s)]


def test_without_frames_it_keeps_absolute_deadlines() -> None:
    ticks, ticker = ticks_of([], 1.0)
    assert starts_of(ticks) == pytest.approx([P * (n + 1) for n in range(len(ticks))], abs=1e-9)
    assert max(tick.lateness_s for tick in ticks) < 1e-9
    assert ticker.skipped == 0


@pytest.mark.parametrize("offset_s", [0.0004, 0.0013, 0.0024, 0.0026, 0.0049])
@pytest.mark.parametrize("frame_period_s", [P, 0.00495, 0.00505])
def test_after_a_moment_each_tick_starts_with_its_frame(offset_s: float, frame_period_s: float) -> None:
    frames_s = [offset_s + n * frame_period_s for n in range(300)]
    ticks, _ = ticks_of(frames_s, 1.2)
    late = [tick for tick in ticks if 0.3 < tick.start_s < 1.2]
    assert starts_of(late) == pytest.approx(
        [f for f in frames_s if late[0].start_s - 1e-6 < f <= late[-1].start_s + 1e-6]
    )
    assert max(tick.lateness_s for tick in late) < 1e-9


def test_a_missing_frame_costs_a_millisecond_and_moves_nothing() -> None:
    frames_s = [n * P for n in range(1, 300) if n != 200]
    ticks, _ = ticks_of(frames_s, 1.4)
    around_s = [start_s for start_s in starts_of(ticks) if 0.994 < start_s < 1.006]
    assert around_s == pytest.approx([0.995, 1.0 + LATE_S, 1.005], abs=1e-6)
    assert [tick.lateness_s for tick in ticks if 0.999 < tick.start_s < 1.002] == pytest.approx([LATE_S])


def test_frames_that_stay_away_are_not_waited_for_any_more() -> None:
    ticks, _ = ticks_of([n * P for n in range(1, 200)], 2.0)
    later = [tick for tick in ticks if tick.start_s > 1.02]
    assert gaps_of(later) == pytest.approx([P] * (len(later) - 1))
    assert max(tick.lateness_s for tick in later) < 1e-9


def test_a_frame_just_after_its_time_is_not_a_tick_of_its_own() -> None:
    frames_s = sorted([*(n * P for n in range(1, 300)), 1.0 + 0.0003, 1.0 + 0.002])
    ticks, _ = ticks_of(frames_s, 1.4)
    assert min(gaps_of(ticks)) > P - 0.0005


@pytest.mark.parametrize("rate_hz", [0.0, 100.0, 120.0, 190.0, 240.0])
def test_frames_of_another_rate_are_not_ridden_on(rate_hz: float) -> None:
    frames_s = [n / (rate_hz or 200.0) for n in range(1, 300)]
    ticks, _ = ticks_of(frames_s, 1.0, rate_hz)
    assert gaps_of(ticks) == pytest.approx([P] * (len(ticks) - 1))


@given(frames_s=st.lists(st.floats(0.0, 1.0), max_size=2000), seed_s=st.floats(0.0, P))
def test_whatever_arrives_ticks_stay_about_a_period_apart(frames_s: list[float], seed_s: float) -> None:
    regular_s = [seed_s + n * P for n in range(100)]  # first in step, then anything
    ticks, ticker = ticks_of(sorted(frames_s + regular_s), 1.0)
    spread_s = EARLY_S + LATE_S + 0.00025 + 1e-9
    assert P - spread_s <= min(gaps_of(ticks))
    assert max(gaps_of(ticks)) <= P + spread_s
    assert 0.9 / P < len(ticks) < 1.1 / P
    assert ticker.skipped == 0


@pytest.mark.parametrize("frames", [True, False])
def test_a_stall_is_reported_and_not_made_up_for(frames: bool) -> None:
    def stall(tick: int, time: SimulatedTime) -> None:
        if tick == 150:
            time.now_s += 0.0223

    frames_s = [n * P for n in range(1, 300)] if frames else []
    ticks, ticker = ticks_of(frames_s, 1.2, work=stall)
    assert ticker.skipped == 3
    assert len([gap for gap in gaps_of(ticks) if gap > 1.5 * P]) == 1
    assert min(gaps_of(ticks)) > 0.002


def test_a_stall_while_it_waits_is_lateness() -> None:
    async def run(loop: asyncio.AbstractEventLoop, time: SimulatedTime) -> TickTime:
        ticker = Ticker(P, lambda: time.now_s, RATE_HZ)
        for n in range(1, 100):
            loop.call_at(n * P, ticker.frame, n * P)
        tick = await ticker.next()
        while tick.start_s < 0.3:
            tick = await ticker.next()

        def held_up() -> None:
            time.now_s += 0.0172

        loop.call_later(0.002, held_up)
        return await ticker.next()

    assert simulated(run).lateness_s == pytest.approx(0.0142, abs=0.0011)


def test_when_the_next_tick_is_due_is_known_before() -> None:
    async def run(loop: asyncio.AbstractEventLoop, time: SimulatedTime) -> list[float]:
        ticker = Ticker(P, lambda: time.now_s, RATE_HZ)
        for n in range(1, 100):
            loop.call_at(n * P + 0.001, ticker.frame, n * P + 0.001)
        leads_s: list[float] = []
        while time.now_s < 0.45:
            due_s = ticker.due_s
            leads_s.append((await ticker.next()).start_s - due_s)
        return leads_s

    assert simulated(run)[-20:] == pytest.approx([0.0] * 20, abs=2e-5)
