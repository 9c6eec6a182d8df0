"""A thread that owns a device whose calls wait: the arm's bus, or a force sensor of another package."""

from __future__ import annotations

import asyncio
import contextlib
import functools
import threading
from collections.abc import Callable
from typing import Final, TypeVar

from companion.io.protocols import DeviceError
from companion.runtime.event_loop import real_time
from companion.runtime.native_threads import name_thread

_CLOSE_TIMEOUT_S: Final = 2.0
_T = TypeVar("_T")


class DeviceThread:
    """Opens a device, serves it until it is stopped, and closes it, all in one thread. It can be started once.

    Args:
        open_device: opens the device; returns an error instead of raising it.
        serve: exchanges data with the device until `stopping` is set.
        close_device: closes the device, whether or not it was opened; never raises.
        wake: called after `stopping` is set; wakes `serve` if it waits.
    """

    def __init__(
        self,
        name: str,
        open_device: Callable[[], DeviceError | None],
        serve: Callable[[], None],
        close_device: Callable[[], None],
        wake: Callable[[], None] = lambda: None,
    ) -> None:
        self._name = name
        self._open_device, self._serve, self._close_device, self._wake = open_device, serve, close_device, wake
        self.stopping = threading.Event()
        self._thread: threading.Thread | None = None
        self._loop: asyncio.AbstractEventLoop | None = None
        self._finished: asyncio.Future[None] | None = None

    async def start(self, timeout_s: float, too_late: str) -> None:
        """Open the device.

        Raises:
            DeviceError: the device cannot be opened, or is not open after `timeout_s` (the text is then `too_late`). The device is
                closed before the error is raised.
        """
        if self._thread is not None:
            raise RuntimeError(f"{self._name} can be opened only once")
        self._loop = asyncio.get_running_loop()
        opened: asyncio.Future[DeviceError | None] = self._loop.create_future()
        self._finished = self._loop.create_future()
        self._thread = threading.Thread(target=self._run, args=(opened,), name=self._name, daemon=True)
        self._thread.start()
        try:
            with real_time():
                await asyncio.wait((opened,), timeout=timeout_s)
        except BaseException:
            await self.stop()
            raise
        failure = opened.result() if opened.done() else DeviceError(too_late)
        if failure is not None:
            await self.stop()
            raise failure

    async def stop(self) -> None:
        """End the thread, which closes the device. A device that does not return is left to the end of the process."""
        self.stopping.set()
        self._wake()
        if self._thread is None or self._finished is None:
            return
        await asyncio.wait((self._finished,), timeout=_CLOSE_TIMEOUT_S)
        if self._finished.done():
            self._thread.join(_CLOSE_TIMEOUT_S)  # it only has to end

    def post(self, callback: Callable[[], None]) -> None:
        """Run a callback in the event loop; called by the thread."""
        assert self._loop is not None
        with contextlib.suppress(RuntimeError):  # the loop is closed: no caller waits
            self._loop.call_soon_threadsafe(callback)

    def _run(self, opened: asyncio.Future[DeviceError | None]) -> None:
        try:
            name_thread(self._name)
            failure = self._open_device()
            self.post(functools.partial(resolve, opened, failure))
            if failure is None:
                self._serve()
        finally:
            self._close_device()
            assert self._finished is not None
            self.post(functools.partial(resolve, self._finished, None))


def resolve(future: asyncio.Future[_T], result: _T) -> None:
    """Set the result of a future that may have been cancelled."""
    if not future.done():
        future.set_result(result)
