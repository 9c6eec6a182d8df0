"""`python -m tests.low_priority COMMAND ...`: run a command that takes what the other processes leave of the processors.

To be started in a session of its own. Linux shares the processors among sessions first (sched_autogroup) and among the processes of a
session second: a niceness alone counts in its session only.
"""

from __future__ import annotations

import contextlib
import os
import sys
from pathlib import Path

LOWEST = 19

if __name__ == "__main__":
    os.nice(LOWEST)
    with contextlib.suppress(OSError):  # a kernel without groups of sessions, where niceness counts everywhere
        Path("/proc/self/autogroup").write_text(str(LOWEST), encoding="ascii")
    os.execvp(sys.argv[1], sys.argv[1:])
