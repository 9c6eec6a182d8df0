"""Support for threads of native libraries that call Python."""

from __future__ import annotations

import ctypes
import threading

_own = threading.local()
"""Thread-local data; it exists for as long as the calling thread's interpreter state."""


def keep_interpreter_state() -> None:
    """Keep the interpreter state of the calling native thread after its callback; call it in the callback.

    Otherwise each callback, of which there are 900 per second, allocates and frees an interpreter state of 16 kB, which costs a
    page fault. One PyGILState_Ensure without a release keeps the first state. It leaks when the thread ends, so use it only for
    threads that live as long as the process.
    """
    if not getattr(_own, "kept", False):
        _own.kept = True
        ctypes.pythonapi.PyGILState_Ensure()
