"""Event loop for processes with precise timers."""

from __future__ import annotations

import asyncio
import selectors
import signal
import time
from collections.abc import Coroutine
from typing import Any, TypeVar

_T = TypeVar("_T")

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


def run(main: Coroutine[Any, Any, _T]) -> _T:
    """Run a coroutine like `asyncio.run`, on a `fine_loop`."""
    with asyncio.Runner(loop_factory=fine_loop) as runner:
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
