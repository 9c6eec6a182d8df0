"""Opens a device again after it has hung up, such as a USB serial port that vanished and comes back under its name."""

from __future__ import annotations

import contextlib
import threading
from collections.abc import Callable
from typing import Final, Generic, Protocol, TypeVar

REOPEN_PERIOD_S: Final = 0.1
"""Pause between two attempts. An attempt at a port that is missing takes some 20 us."""


class Closable(Protocol):
    """An open device."""

    def close(self) -> None:
        """Close it."""


T = TypeVar("T", bound=Closable)


class Reopening(Generic[T]):
    """Attempts to open a lost device until it is open, in a thread of its own: the kernel may wait for a USB device or a TCP peer, and
    the control tick must not.

    Args:
        open_device: opens the device and sends nothing to it; raises an exception while that is impossible.
    """

    def __init__(self, name: str, open_device: Callable[[], T]) -> None:
        self._open_device = open_device
        self._ended = threading.Event()
        self._lock = threading.Lock()
        self._device: T | None = None
        self._thread = threading.Thread(target=self._run, name=name, daemon=True)
        self._start()

    def take(self) -> T | None:
        """Return the open device, once, or None before it is open. Never waits for it."""
        if self._thread.ident is None:
            self._start()
        with self._lock:
            device, self._device = self._device, None
        return device

    def close(self) -> None:
        """End the attempts; close the device if it was not taken."""
        with self._lock:
            self._ended.set()
        device = self.take()
        if device is not None:
            device.close()

    def _start(self) -> None:
        with contextlib.suppress(RuntimeError):  # the process can start no thread now; `take` tries again
            self._thread.start()

    def _run(self) -> None:
        while not self._ended.wait(REOPEN_PERIOD_S):
            try:
                device = self._open_device()
            except Exception:  # a port that is just vanishing raises any exception of its driver
                continue
            with self._lock:
                ended = self._ended.is_set()
                if not ended:
                    self._device = device
            if ended:
                device.close()
            return
