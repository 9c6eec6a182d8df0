"""An event loop on simulated time, for a single process."""

from __future__ import annotations

import asyncio
import contextlib
import selectors
from collections.abc import Callable, Coroutine
from typing import Any, TypeVar

T = TypeVar("T")


class SimulatedTime(selectors.SelectSelector):
    """Waiting takes no time, it only is later afterwards."""

    now_s = 0.0

    def select(self, timeout: float | None = None) -> Any:
        assert timeout is not None, "everything waits for something that nobody will do"
        self.now_s += max(0.0, timeout)
        return super().select(0.0)


def simulated(
    run: Callable[[asyncio.AbstractEventLoop, SimulatedTime], Coroutine[Any, Any, T]], time: SimulatedTime | None = None
) -> T:
    """Run a coroutine in an event loop on simulated time."""
    time = time or SimulatedTime()
    with contextlib.closing(asyncio.SelectorEventLoop(time)) as loop:
        loop.time = lambda: time.now_s  # type: ignore[method-assign]
        return loop.run_until_complete(run(loop, time))
