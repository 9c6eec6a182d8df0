"""The event loop of processes that keep time."""

from __future__ import annotations

import asyncio
import selectors
from collections.abc import Coroutine
from typing import Any, TypeVar

_T = TypeVar("_T")


def fine_loop() -> asyncio.AbstractEventLoop:
    """An event loop whose timers are not late by up to 1 ms.

    asyncio's own waits in `epoll`, whose time-outs Python rounds up to whole milliseconds; `select` takes microseconds. It knows no
    descriptors of 1024 and above: a handful is open here.
    """
    return asyncio.SelectorEventLoop(selectors.SelectSelector())


def run(main: Coroutine[Any, Any, _T]) -> _T:
    """`asyncio.run` on a `fine_loop`."""
    with asyncio.Runner(loop_factory=fine_loop) as runner:
        return runner.run(main)
