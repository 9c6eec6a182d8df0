"""Two ways for a flight process to hang, on a signal from the simulated world. Nothing happens in any other process."""

from __future__ import annotations

import ctypes
import os
import signal
import sys
import time


def _hold_gil(*_: object) -> None:
    """As an extension does that blocks inside the interpreter's lock: no thread of Python runs any more."""
    libc = ctypes.PyDLL(None)
    while True:
        libc.sleep(3600)


def _stall_loop(*_: object) -> None:
    """As a blocking call on the event loop: other threads run on, no tick comes."""
    # The signal interrupts the event loop; what sleeps here is its thread.
    until_s = time.monotonic() + float(os.environ.get("COMPANION_SITL_STALL_S", "inf"))
    while (left_s := until_s - time.monotonic()) > 0.0:
        time.sleep(min(left_s, 3600.0))


if "companion.flight.main" in sys.orig_argv:
    signal.signal(signal.SIGUSR1, _hold_gil)
    signal.signal(signal.SIGUSR2, _stall_loop)
