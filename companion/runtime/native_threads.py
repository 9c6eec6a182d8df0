"""Threads that belong to a native library and call into Python."""

from __future__ import annotations

import ctypes
import threading

_own = threading.local()
"""Lives as long as the calling thread's interpreter state."""


def keep_interpreter_state() -> None:
    """To be called in a callback from a native thread: the interpreter's state for that thread outlives the callback.

    Each callback of such a thread makes an interpreter state of 16 kB and throws it away again, in fresh pages every time: at 900
    callbacks a second as many page faults. One PyGILState_Ensure that is never released keeps the first one; a thread that ends
    leaves it behind, so it is for the few threads that live as long as the process does.
    """
    if not getattr(_own, "kept", False):
        _own.kept = True
        ctypes.pythonapi.PyGILState_Ensure()
