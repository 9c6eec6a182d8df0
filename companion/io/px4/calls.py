"""Runs blocking calls into MAVSDK outside the event loop, one at a time, each with a deadline and a name."""

from __future__ import annotations

import asyncio
from collections.abc import Callable
from concurrent.futures import Future, ThreadPoolExecutor, wait
from typing import Any, TypeVar

from companion.io.px4.link import device_error
from companion.runtime.event_loop import real_time

NATIVE_CALL_DEADLINE_S = 5.0
"""Deadline for a native call. MAVSDK sends a command or parameter request up to six times at intervals of 0.5 s."""

_T = TypeVar("_T")


class NativeCalls:
    """The worker thread of one link."""

    def __init__(self, address: str) -> None:
        self._address = address
        self._worker = ThreadPoolExecutor(max_workers=1, thread_name_prefix="autopilot")
        self._last: Future[Any] | None = None

    async def run(self, expected: str, deadline_s: float, call: Callable[..., _T], *args: Any) -> _T:
        """Run a blocking native call; `expected` names its purpose for the error text.

        Raises:
            DeviceError: the call did not return within `deadline_s`.
        """
        future = self._worker.submit(call, *args)
        self._last = future
        try:
            with real_time():
                async with asyncio.timeout(deadline_s):
                    return await asyncio.wrap_future(future)
        except TimeoutError:
            found = f"no answer within {deadline_s:g} s"
            raise device_error(self._address, expected, found, "check the link") from None

    def finish(self, deadline_s: float) -> bool:
        """Accept no more calls and wait for the one in progress. Return False if that call hangs; MAVSDK must not be destroyed then."""
        self._worker.shutdown(wait=False, cancel_futures=True)
        return self._last is None or not wait([self._last], deadline_s).not_done
