"""Names of threads for the operating system."""

from __future__ import annotations

import contextlib
import threading
from pathlib import Path

_NAME_CHARACTERS = 15
"""Length to which the kernel limits the name of a thread."""


def name_thread(name: str) -> None:
    """Give the calling thread its name in the kernel, which `top -H` and the benchmarks show; Python does so only from 3.14 on."""
    with contextlib.suppress(OSError):  # no /proc
        Path(f"/proc/self/task/{threading.get_native_id()}/comm").write_text(name[:_NAME_CHARACTERS], encoding="ascii")
