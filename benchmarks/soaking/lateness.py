"""Lateness of ticks for each minute of a flight, from its log, and of an empty loop beside it."""

from __future__ import annotations

import asyncio
import json
import os
import signal
from array import array
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt
from mcap.reader import make_reader

from companion.flight.ticker import Ticker
from companion.model.constants import TICK_PERIOD_S
from companion.runtime.clock import flight_clock
from companion.runtime.event_loop import run
from companion.runtime.realtime import FLIGHT_PRIORITY, claim_realtime

MINUTE_S = 60.0

Array = npt.NDArray[np.float64]


@dataclass(frozen=True, slots=True)
class Minute:
    """Lateness of the ticks of one minute, in ms."""

    begin_s: float
    """Start on `time.monotonic` for the empty loop, on the flight clock for a flight."""
    ticks: int
    p50: float
    p99: float
    max: float


def minutes_of(start_s: Array, lateness_s: Array) -> list[Minute]:
    """Return the lateness of each minute from the start and the lateness of every tick, s; a much shorter last one is left out."""
    minute = ((start_s - start_s[:1]) // MINUTE_S).astype(int)
    last = minute[-1] if len(minute) else -1
    found = []
    for number in np.unique(minute).tolist():
        values_ms = 1e3 * lateness_s[minute == number]
        if number < last or len(values_ms) > 0.5 * MINUTE_S / TICK_PERIOD_S:
            p50, p99, most = np.percentile(values_ms, [50, 99, 100]).tolist()
            begin_s = float(start_s[0]) + MINUTE_S * number
            found.append(Minute(begin_s=begin_s, ticks=len(values_ms), p50=p50, p99=p99, max=most))
    return found


@dataclass(frozen=True, slots=True)
class Ticks:
    """All ticks of a loop."""

    minutes: list[Minute]
    ticks: int
    missed: int
    """Number of ticks that began later than a whole period."""
    skipped: int
    """Number of deadlines without a tick."""

    @classmethod
    def of(cls, start_s: Array, lateness_s: Array) -> Ticks:
        """Return the ticks from the start and the lateness of each, s."""
        count = len(start_s)
        wanted = round((start_s[-1] - start_s[0]) / TICK_PERIOD_S) + 1 if count else 0
        missed = int((lateness_s > TICK_PERIOD_S).sum())
        return cls(minutes_of(start_s, lateness_s), count, missed, max(0, wanted - count))


def ticks_of_log(path: Path) -> Ticks:
    """Read the ticks of a log from `/sent`, one chunk at a time."""
    starts_s, lateness_s = array("d"), array("d")
    with path.open("rb") as file:
        for _, _, message in make_reader(file).iter_messages(topics=["/sent"], log_time_order=False):
            sent: dict[str, Any] = json.loads(message.data)
            starts_s.append(sent["start_s"])
            lateness_s.append(sent["lateness_s"])
    return Ticks.of(np.array(starts_s), np.array(lateness_s))


def run_idle_ticks(take: Callable[[float, float], None], *, plain: bool = False) -> None:
    """Run empty ticks with a flight's event loop, ticker and priority until SIGTERM or the end of the parent process.

    Args:
        take: called with every tick's start (`time.monotonic`) and lateness, s.
        plain: use asyncio's own event loop instead.
    """
    (asyncio.run if plain else run)(_run_idle_ticks(take))


async def _run_idle_ticks(take: Callable[[float, float], None]) -> None:
    over = asyncio.Event()
    asyncio.get_running_loop().add_signal_handler(signal.SIGTERM, over.set)
    claim_realtime(FLIGHT_PRIORITY)
    ticker = Ticker(TICK_PERIOD_S, flight_clock(0.0))
    parent = os.getppid()
    while not over.is_set() and os.getppid() == parent:
        tick = await ticker.next()
        take(tick.start_s, tick.lateness_s)
