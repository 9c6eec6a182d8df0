"""Names of threads for the operating system, and support for threads of native libraries that call Python."""

from __future__ import annotations

import contextlib
import ctypes
import threading
from pathlib import Path

_NAME_CHARACTERS = 15
"""Length to which the kernel limits the name of a thread."""
_own = threading.local()
"""Thread-local data; it exists for as long as the calling thread's interpreter state."""


def name_thread(name: str) -> None:
    """Give the calling thread its name in the kernel, which `top -H` and the benchmarks show; Python does so only from 3.14 on."""
    with contextlib.suppress(OSError):  # no /proc
        Path(f"/proc/self/task/{threading.get_native_id()}/comm").write_text(name[:_NAME_CHARACTERS], encoding="ascii")


def keep_interpreter_state() -> None:
    """Keep the interpreter state of the calling native thread after its callback; call it in the callback.

    Otherwise each callback, of which there are 900 per second, allocates and frees an interpreter state of 16 kB, which costs a
    page fault. One PyGILState_Ensure without a release keeps the first state. It leaks when the thread ends, so use it only for
    threads that live as long as the process.
    """
    if not getattr(_own, "kept", False):
        _own.kept = True
        ctypes.pythonapi.PyGILState_Ensure()
