"""`python -m tests.at_a_time waits|flights`: how many tests of a kind run at a time, one fewer where other programs take a core.

A flight takes about half a core, a waiting test a third. The bytes of a pty are carried by a thread of the kernel that waits for a core
like any other program, so neither fills two cores. Where the flight, the guardian and the simulated world get real-time priority, they
go on in time whatever else two cores have to do. Without it their limits are met by fewer.
"""

from __future__ import annotations

import os
import sys
import time
from pathlib import Path

from companion.runtime.realtime import FLIGHT_PRIORITY

AT_A_TIME = {"waits": (2, 3), "flights": (1, 3)}
"""Without and with real-time priority, on two cores or more."""
BUSY_CORES = "COMPANION_TESTS_BUSY_CORES"
"""Environment variable: how many cores other programs used before the first stage."""


def busy_cores(within_s: float = 0.5, times: int = 4) -> float:
    """Measure how many cores are in use all the time (/proc/stat): the least of several measurements, because a short program is no
    load.
    """

    def idle_ticks() -> int:
        first = Path("/proc/stat").read_text(encoding="ascii").splitlines()[0].split()
        return int(first[4]) + int(first[5])

    most_idle = 0.0
    for _ in range(times):
        before, begun_s = idle_ticks(), time.monotonic()
        time.sleep(within_s)
        most_idle = max(most_idle, (idle_ticks() - before) / os.sysconf("SC_CLK_TCK") / (time.monotonic() - begun_s))
    return max(0.0, (os.cpu_count() or 1) - most_idle)


def at_a_time(kind: str) -> int:
    """Asks the kernel, and leaves this process with real-time priority if it may have it."""
    alone, together = AT_A_TIME[kind]
    if len(os.sched_getaffinity(0)) < 2:
        return 1
    if float(os.environ.get(BUSY_CORES, "0")) > 0.5:
        together -= 1
    try:
        os.sched_setscheduler(0, os.SCHED_FIFO, os.sched_param(FLIGHT_PRIORITY))
    except OSError:
        return alone
    return together


if __name__ == "__main__":
    print(at_a_time(sys.argv[1]))
