"""Makes the flight process hang in one of two ways when the simulated world sends a signal. Other processes are not affected."""

from __future__ import annotations

import ctypes
import os
import signal
import sys
import time


def _hold_gil(*_: object) -> None:
    """Block while holding the interpreter lock, as a faulty extension module does; no Python thread runs."""
    libc = ctypes.PyDLL(None)
    while True:
        libc.sleep(3600)


def _stall_loop(*_: object) -> None:
    """Block the event loop: other threads continue, but no tick runs."""
    from companion.runtime.clock import monotonic  # simulated time, if the flight lives in it

    # The signal handler runs in the thread of the event loop.
    until_s = monotonic() + float(os.environ.get("COMPANION_SITL_STALL_S", "inf"))
    while (left_s := until_s - monotonic()) > 0.0:
        time.sleep(min(left_s, 0.01))


if "companion.flight.main" in sys.orig_argv:
    signal.signal(signal.SIGUSR1, _hold_gil)
    signal.signal(signal.SIGUSR2, _stall_loop)
