"""Support for threads of native libraries that call Python."""

from __future__ import annotations

import ctypes
import threading

_own = threading.local()
"""Its values exist for as long as the calling thread's interpreter state does."""


def keep_interpreter_state() -> None:
    """Keep the interpreter state of the calling native thread after its callback; call it in the callback.

    Otherwise each callback allocates and frees an interpreter state of 16 kB, which costs a page fault per callback, of which there are
    900 a second. One PyGILState_Ensure without a release keeps the first state. It leaks when the thread ends, so use it only for
    threads that live as long as the process.
    """
    if not getattr(_own, "kept", False):
        _own.kept = True
        ctypes.pythonapi.PyGILState_Ensure()
