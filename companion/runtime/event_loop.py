"""Event loop for processes with precise timers."""

from __future__ import annotations

import asyncio
import selectors
from collections.abc import Coroutine
from typing import Any, TypeVar

_T = TypeVar("_T")


def fine_loop() -> asyncio.AbstractEventLoop:
    """Return an event loop with timers more precise than 1 ms.

    asyncio's default loop waits in `epoll`, whose timeouts Python rounds up to whole milliseconds; `select` takes microseconds.
    `select` does not support descriptors from 1024 on, which these processes do not reach.
    """
    return asyncio.SelectorEventLoop(selectors.SelectSelector())


def run(main: Coroutine[Any, Any, _T]) -> _T:
    """Run a coroutine like `asyncio.run`, on a `fine_loop`."""
    with asyncio.Runner(loop_factory=fine_loop) as runner:
        return runner.run(main)
