"""Grants and reports between the world and a process of the flight, without either."""

from __future__ import annotations

import asyncio
import os
import select
import socket
import time
from collections.abc import Iterator

import pytest

from companion.runtime.event_loop import SimulatedLoop
from companion.runtime.simulated_time import Descriptors, Page, SimulatedTime
from sitl import lockstep
from sitl.lockstep import TimeKeeper
from tests.support import DEADLINE_S


class Pair:
    """The world's end of simulated time, and that of a process."""

    def __init__(self, speed: float = float("inf")) -> None:
        page = Page.create()
        world, process = socket.socketpair(socket.AF_UNIX, socket.SOCK_SEQPACKET)
        self.keeper = TimeKeeper(Page(page), {"flight": world}, speed)
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


async def advance(pair: Pair, now_s: float, data: bool = False) -> asyncio.Task[None]:
    """Begin to advance, as far as the world gets without the process."""
    task = asyncio.ensure_future(pair.keeper.advance(now_s, data))
    for _ in range(10):
        await asyncio.sleep(0)
    return task


def test_the_world_waits_until_a_process_that_is_due_has_reported(pair: Pair) -> None:
    async def run() -> None:
        with pair.keeper.listening():
            pair.report(1.0)
            assert (await advance(pair, 0.998)).done(), "nothing is due"
            at_work = await advance(pair, 1.0)
            assert not at_work.done()
            assert pair.process.now() == 1.0
            pair.report(2.0)
            await asyncio.wait_for(at_work, DEADLINE_S)

    asyncio.run(run())


def test_an_old_report_is_no_answer_to_a_grant(pair: Pair) -> None:
    """A thread woke the process, which reports a second time what it has done before."""

    async def run() -> None:
        with pair.keeper.listening():
            pair.report(1.0)
            await advance(pair, 0.998)
            at_work = await advance(pair, 1.0)
            pair.process.report(1.0)  # it has not read the grant
            await asyncio.sleep(0.01)
            assert not at_work.done()
            pair.report(2.0)
            await asyncio.wait_for(at_work, DEADLINE_S)

    asyncio.run(run())


def test_a_frame_is_a_reason_to_go_on_unless_the_process_does_not_want_it(pair: Pair) -> None:
    async def run() -> None:
        with pair.keeper.listening():
            pair.report(9.0)
            await advance(pair, 0.0)
            at_work = await advance(pair, 1.0, data=True)
            assert not at_work.done()
            pair.process.take_grants()
            pair.process.report(9.0, data=False)
            await asyncio.wait_for(at_work, DEADLINE_S)
            assert (await advance(pair, 2.0, data=True)).done()

    asyncio.run(run())


def test_a_process_that_hangs_is_no_longer_waited_for_until_it_reports(
    pair: Pair, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(lockstep, "PATIENCE_S", 0.05)

    async def run() -> None:
        with pair.keeper.listening():
            pair.report(0.0)
            await advance(pair, 0.0)
            await asyncio.wait_for(pair.keeper.advance(0.002, False), DEADLINE_S)
            assert not pair.keeper.processes["flight"].waited_for
            pair.report(5.0)
            await asyncio.sleep(0.01)
            assert pair.keeper.processes["flight"].waited_for
            at_work = await advance(pair, 5.0)
            assert not at_work.done()
            pair.report(9.0)
            await asyncio.wait_for(at_work, DEADLINE_S)

    asyncio.run(run())


def test_a_process_that_ends_is_not_waited_for(pair: Pair) -> None:
    async def run() -> None:
        with pair.keeper.listening():
            pair.report(0.0)
            at_work = await advance(pair, 0.002)
            pair.process.close()
            await asyncio.wait_for(at_work, DEADLINE_S)

    asyncio.run(run())


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
        """Grant the process an instant after its timer."""
        time.sleep(0.05)
        pair.keeper.processes["flight"].read()
        pair.keeper.page.now_s = 101.0
        pair.keeper.processes["flight"].grant()

    loop.run_in_executor(None, world)
    loop.run_until_complete(task)
    loop.close()
    assert fired == [101.0]
