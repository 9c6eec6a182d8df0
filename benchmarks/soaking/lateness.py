"""Lateness of ticks for each minute of a flight, from its log, and of an empty loop beside it."""

from __future__ import annotations

import asyncio
import json
import os
import signal
from array import array
from collections.abc import Callable, Iterable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from mcap.reader import make_reader

from companion.flight.ticker import Ticker
from companion.model.constants import TICK_PERIOD_S
from companion.runtime.clock import flight_clock
from companion.runtime.event_loop import run
from companion.runtime.realtime import FLIGHT_PRIORITY, claim_realtime

MINUTE_S = 60.0


@dataclass(frozen=True, slots=True)
class Minute:
    """Lateness of the ticks of one minute, in ms."""

    begin_s: float
    """Start on `time.monotonic` for the empty loop, on the flight clock for a flight."""
    ticks: int
    p50: float
    p99: float
    max: float


class Minutes:
    """Collects ticks, and keeps only those of the present minute."""

    def __init__(self) -> None:
        self._begin_s: float | None = None
        self._lateness_s = array("d")
        self.done: list[Minute] = []
        self.missed = 0
        """Number of ticks that began later than a whole period."""

    def take(self, start_s: float, lateness_s: float) -> None:
        """Add a tick that began at `start_s`."""
        if self._begin_s is None:
            self._begin_s = start_s
        while start_s >= self._begin_s + MINUTE_S:
            self._close(self._begin_s)
            self._begin_s += MINUTE_S
        self._lateness_s.append(lateness_s)
        self.missed += lateness_s > TICK_PERIOD_S

    def finish(self) -> list[Minute]:
        """Return all minutes; a much shorter last one is left out."""
        if self._begin_s is not None and len(self._lateness_s) > 0.5 * MINUTE_S / TICK_PERIOD_S:
            self._close(self._begin_s)
        return self.done

    def _close(self, begin_s: float) -> None:
        if self._lateness_s:
            values_ms = 1e3 * np.array(self._lateness_s)
            p50, p99 = np.percentile(values_ms, [50, 99])
            count, most = len(values_ms), float(values_ms.max())
            self.done.append(Minute(begin_s=begin_s, ticks=count, p50=float(p50), p99=float(p99), max=most))
        self._lateness_s = array("d")


@dataclass(frozen=True, slots=True)
class Ticks:
    """All ticks of a flight's log."""

    minutes: list[Minute]
    ticks: int
    missed: int
    """Number of ticks that began later than a whole period."""
    skipped: int
    """Number of deadlines without a tick."""


def ticks_of_log(path: Path) -> Ticks:
    """Read the ticks of a log from `/sent`, one chunk at a time."""
    minutes = Minutes()
    count = 0
    first_s = last_s = 0.0
    with path.open("rb") as file:
        for _, _, message in make_reader(file).iter_messages(topics=["/sent"], log_time_order=False):
            sent: dict[str, Any] = json.loads(message.data)
            start_s = float(sent["start_s"])
            minutes.take(start_s, float(sent["lateness_s"]))
            first_s = start_s if count == 0 else first_s
            last_s = start_s
            count += 1
    wanted = round((last_s - first_s) / TICK_PERIOD_S) + 1 if count else 0
    return Ticks(minutes.finish(), count, minutes.missed, max(0, wanted - count))


def run_idle_ticks(take: Callable[[float, float], None], *, plain: bool = False) -> int:
    """Run empty ticks with a flight's event loop, ticker and priority until SIGTERM or the end of the parent process.

    Args:
        take: called with every tick's start (`time.monotonic`) and lateness, s.
        plain: use asyncio's own event loop instead.

    Returns:
        The number of deadlines without a tick.
    """
    return (asyncio.run if plain else run)(_run_idle_ticks(take))


async def _run_idle_ticks(take: Callable[[float, float], None]) -> int:
    over = asyncio.Event()
    asyncio.get_running_loop().add_signal_handler(signal.SIGTERM, over.set)
    claim_realtime(FLIGHT_PRIORITY)
    ticker = Ticker(TICK_PERIOD_S, flight_clock(0.0))
    parent = os.getppid()
    while not over.is_set() and os.getppid() == parent:
        tick = await ticker.next()
        take(tick.start_s, tick.lateness_s)
    return ticker.skipped


def run_empty_loop(path: Path) -> None:
    """Run the empty loop, then write its minutes as JSON."""
    minutes = Minutes()
    skipped = run_idle_ticks(minutes.take)
    rows = [[m.begin_s, m.ticks, m.p50, m.p99, m.max] for m in minutes.finish()]
    path.write_text(json.dumps({"minutes": rows, "missed": minutes.missed, "skipped": skipped}))


def read_minutes(rows: Iterable[list[float]]) -> list[Minute]:
    """Read the minutes that `run_empty_loop` has written."""
    return [
        Minute(begin_s=begin_s, ticks=int(ticks), p50=p50, p99=p99, max=most) for begin_s, ticks, p50, p99, most in rows
    ]
