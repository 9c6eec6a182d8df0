"""Event loops for processes with precise timers: in real time, and in simulated time."""

from __future__ import annotations

import asyncio
import contextlib
import math
import select
import selectors
import signal
import time
from collections.abc import Callable, Coroutine, Iterator
from typing import Any, TypeVar

from companion.runtime import simulated_time
from companion.runtime.simulated_time import SimulatedTime

_T = TypeVar("_T")

_LOOK_S = 0.002
_RECENT_S = 0.001
"""Longer than a tick's first round, which takes 0.1 to 0.5 ms, depending on the computer."""


class _Selector(selectors.SelectSelector):
    """Does not ask the kernel twice within `_RECENT_S` if callbacks wait. asyncio asks before each round of callbacks, and a tick takes
    two rounds; the second question would take 10 us, or 40 us with cold caches.
    """

    _asked_s = 0.0

    def select(self, timeout: float | None = None) -> list[tuple[selectors.SelectorKey, int]]:
        if timeout is not None and timeout <= 0.0 and time.monotonic() - self._asked_s < _RECENT_S:
            return []
        ready = super().select(timeout)
        self._asked_s = time.monotonic()
        return ready


def fine_loop() -> asyncio.AbstractEventLoop:
    """Return an event loop with timers more precise than 1 ms.

    asyncio's default loop waits in `epoll`, whose timeouts Python rounds up to whole milliseconds; `select` takes microseconds.
    `select` does not support descriptors of 1024 and above, which these processes do not reach.
    """
    return asyncio.SelectorEventLoop(_Selector())


class _SimulatedSelector(selectors.PollSelector):
    """Reports to the world when nothing is left to do at the present instant, then waits for the next grant."""

    def __init__(self, simulated: SimulatedTime) -> None:
        super().__init__()
        self._simulated = simulated
        self._grant = select.poll()
        self._grant.register(simulated, select.POLLIN)
        self.held = 0
        """Number of callers that wait for a thread of this process, for which time stands."""

    def wake_on(self, descriptor: int) -> None:
        """Also end the wait for a grant when this descriptor is readable: the loop's own, for signals and threads."""
        self._grant.register(descriptor, select.POLLIN)

    def select(self, timeout: float | None = None) -> list[tuple[selectors.SelectorKey, int]]:
        ready = super().select(0)
        simulated = self._simulated
        if ready or (timeout is not None and timeout <= 0.0):
            return ready
        if self.held or simulated.known_lost:
            return super().select(timeout if simulated.lost else None)
        simulated.report(math.inf if timeout is None else simulated.now() + timeout)
        self._grant.poll()
        simulated.take_grants()
        return super().select(0)


class SimulatedLoop(asyncio.SelectorEventLoop):
    """Event loop whose timers follow simulated time (`companion.runtime.simulated_time`)."""

    def __init__(self, simulated: SimulatedTime) -> None:
        self._simulated = simulated
        self._waits = _SimulatedSelector(simulated)
        super().__init__(self._waits)
        self._waits.wake_on(self._ssock.fileno())  # type: ignore[attr-defined]

    def time(self) -> float:
        """Return simulated time, s."""
        return self._simulated.now()

    def run_in_executor(self, executor: Any, func: Callable[..., _T], *args: Any) -> asyncio.Future[_T]:  # type: ignore[override]
        """Run a call in a thread, in real time: meanwhile the world runs no faster."""
        waits = contextlib.ExitStack()
        waits.enter_context(real_time())
        future = super().run_in_executor(executor, func, *args)
        future.add_done_callback(lambda _: waits.close())
        return future

    @contextlib.contextmanager
    def time_stands(self) -> Iterator[None]:
        """Let simulated time stand while the block waits for a thread of this process."""
        self._waits.held += 1
        try:
            yield
        finally:
            self._waits.held -= 1


def time_stands() -> contextlib.AbstractContextManager[None]:
    """Return a context in which simulated time stands, for a wait for a thread of this process. In real time it does nothing."""
    loop = asyncio.get_running_loop()
    return loop.time_stands() if isinstance(loop, SimulatedLoop) else contextlib.nullcontext()


async def start_over(simulated: SimulatedTime) -> None:
    """Ask the world to start over, at time zero, and wait until it has, if it can."""
    simulated.begins = True
    await asyncio.sleep(_LOOK_S)
    while simulated.now() < 0.0:  # noqa: ASYNC110 - time jumps, and timers with it
        await asyncio.sleep(_LOOK_S)


@contextlib.contextmanager
def real_time() -> Iterator[None]:
    """Let simulated time run no faster than real time while the block waits for a thread on the computer's clock."""
    simulated = simulated_time.current()
    if simulated is None:
        yield
        return
    simulated.threads += 1
    try:
        yield
    finally:
        simulated.threads -= 1


def process_loop() -> asyncio.AbstractEventLoop:
    """Return an event loop in simulated time if this process has it, else in real time."""
    simulated = simulated_time.current()
    return fine_loop() if simulated is None else SimulatedLoop(simulated)


def run(main: Coroutine[Any, Any, _T]) -> _T:
    """Run a coroutine like `asyncio.run`, on a `process_loop`."""
    with asyncio.Runner(loop_factory=process_loop) as runner:
        return runner.run(main)


def run_until_interrupted(work: Coroutine[Any, Any, _T]) -> _T:
    """Run a coroutine in its own event loop. Ctrl-C cancels the coroutine; KeyboardInterrupt is raised once it has ended.

    Raises:
        KeyboardInterrupt: Ctrl-C was pressed.
    """

    async def guarded() -> tuple[_T] | None:
        interrupted = asyncio.Event()
        loop = asyncio.get_running_loop()
        task = asyncio.ensure_future(work)

        def interrupt() -> None:
            interrupted.set()
            task.cancel()

        loop.add_signal_handler(signal.SIGINT, interrupt)
        try:
            await asyncio.wait((task,))
        finally:
            loop.remove_signal_handler(signal.SIGINT)
        if interrupted.is_set():
            if not task.cancelled():
                task.exception()  # the result is retrieved because it did not end the work
            return None
        return (task.result(),)

    done = asyncio.run(guarded())
    if done is None:
        raise KeyboardInterrupt
    return done[0]
