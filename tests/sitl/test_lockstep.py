"""Grants and reports between the world and a process of the flight, without either."""

from __future__ import annotations

import asyncio
import contextlib
import os
import select
import socket
import threading
import time
from collections.abc import Callable, Iterator
from types import SimpleNamespace

import pytest

from companion.runtime.event_loop import SimulatedLoop
from companion.runtime.simulated_time import Descriptors, Page, SimulatedTime
from sitl import lockstep
from sitl.lockstep import MachineTime, TimeKeeper
from tests.support import DEADLINE_S


class Pair:
    """The world's end of simulated time, and that of a process."""

    def __init__(self, speed: float = float("inf")) -> None:
        page = Page.create()
        world, process = socket.socketpair(socket.AF_UNIX, socket.SOCK_SEQPACKET)
        self.keeper = TimeKeeper([MachineTime(Page(page), {"flight": world})], speed)
        self.process = SimulatedTime(Descriptors(page, process.detach()))
        self.world = world
        os.close(page)

    def report(self, wake_s: float) -> None:
        """As the process does when it has done everything."""
        self.process.take_grants()
        self.process.report(wake_s)


@pytest.fixture
def pair() -> Iterator[Pair]:
    made = Pair()
    yield made
    made.process.close()
    made.world.close()


@contextlib.contextmanager
def at_work(pair: Pair, wake_s: float, *, first: Callable[[], None] = lambda: None) -> Iterator[list[float]]:
    """The process meanwhile: it works at the instant that it is granted, and reports. The times at which it did."""
    worked: list[float] = []

    def work() -> None:
        select.select((pair.process,), (), (), DEADLINE_S)
        first()
        worked.append(pair.process.now())
        pair.report(wake_s)

    thread = threading.Thread(target=work)
    thread.start()
    try:
        yield worked
    finally:
        thread.join()


def advance(pair: Pair, now_s: float, *, data: bool = False) -> None:
    pair.keeper.machines[0].processes["flight"].read()
    asyncio.run(pair.keeper.advance(now_s, data))


def test_the_world_waits_until_a_process_that_is_due_has_reported(pair: Pair) -> None:
    pair.report(1.0)
    advance(pair, 0.998)  # nothing is due: it would wait for ever
    with at_work(pair, 2.0, first=lambda: time.sleep(0.05)) as worked:
        advance(pair, 1.0)
        assert worked == [1.0]


def test_an_old_report_is_no_answer_to_a_grant(pair: Pair) -> None:
    """A thread woke the process, which reports a second time what it has done before."""
    pair.report(1.0)
    advance(pair, 0.998)

    def woken() -> None:
        pair.process.report(1.0)
        time.sleep(0.05)

    with at_work(pair, 2.0, first=woken) as worked:
        advance(pair, 1.0)
        assert worked == [1.0]


def test_a_frame_is_a_reason_to_go_on_unless_the_process_does_not_want_it(pair: Pair) -> None:
    pair.report(9.0)
    advance(pair, 0.0)
    with at_work(pair, 9.0) as worked:
        advance(pair, 1.0, data=True)
        assert worked == [1.0]
    pair.process.report(9.0, data=False)
    advance(pair, 2.0, data=True)  # nothing is due


def test_a_hung_process_is_ignored_until_it_reports_again(pair: Pair, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(lockstep, "PATIENCE_S", 0.05)
    pair.report(0.0)
    advance(pair, 0.0)
    assert not pair.keeper.machines[0].processes["flight"].waited_for
    pair.report(5.0)
    with at_work(pair, 9.0) as worked:
        advance(pair, 4.0)
        assert pair.keeper.machines[0].processes["flight"].waited_for
        advance(pair, 5.0)
        assert worked == [5.0]


def test_a_process_that_ends_is_not_waited_for(pair: Pair) -> None:
    pair.report(0.0)
    ends = threading.Timer(0.05, pair.process.close)
    ends.start()
    advance(pair, 0.002)
    ends.join()
    assert pair.keeper.machines[0].processes["flight"].ended


def test_the_world_is_slow_until_every_process_has_started(pair: Pair, monkeypatch: pytest.MonkeyPatch) -> None:
    slept: list[float] = []

    async def sleep(delay_s: float) -> None:
        slept.append(delay_s)

    monkeypatch.setattr(lockstep, "time", SimpleNamespace(monotonic=lambda: 5.0))
    monkeypatch.setattr(lockstep, "asyncio", SimpleNamespace(sleep=sleep))
    advance(pair, -2.0)
    advance(pair, -1.998)
    assert slept == [pytest.approx(0.02)]
    pair.report(9.0)
    advance(pair, -1.996)
    assert len(slept) == 1


def test_without_a_world_time_follows_the_computers_clock(pair: Pair) -> None:
    pair.keeper.set(5.0)
    pair.world.close()
    assert pair.process.lost
    before_s = pair.process.now()
    assert before_s >= 5.0
    time.sleep(0.02)
    assert pair.process.now() > before_s
    assert pair.process.wait(select.poll(), 0.01, data=False) == []


def test_timers_of_the_event_loop_follow_simulated_time(pair: Pair) -> None:
    """The loop reports when its next timer is due, and fires it at once when the world says so."""
    fired: list[float] = []

    async def sleeper() -> None:
        await asyncio.sleep(100.0)
        fired.append(pair.process.now())

    pair.keeper.set(1.0)
    loop = SimulatedLoop(pair.process)
    task = loop.create_task(sleeper())

    def world() -> None:
        """Grant the process the instant of its timer, once it has reported it."""
        flight = pair.keeper.machines[0].processes["flight"]
        while not flight.wants(101.0, data=False):
            select.select([flight], [], [])
            flight.read()
        pair.keeper.machines[0].page.now_s = 101.0
        flight.grant()

    loop.run_in_executor(None, world)
    loop.run_until_complete(task)
    loop.close()
    assert fired == [101.0]
