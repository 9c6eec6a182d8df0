"""How many tests of a kind run at a time, and whether other programs take a core.

A flight takes about a core (the flight process 0.4, the simulated world 0.3, recorder, guardian and launcher the rest), a waiting test
a third. The bytes of a pty are carried by a thread of the kernel that waits for a core like any other program. Where the flight, the
guardian and the simulated world get real-time priority, they go on in time whatever else two cores have to do. Without it their limits
are met by fewer.
"""

from __future__ import annotations

import contextlib
import os
import time
from pathlib import Path

from companion.runtime.realtime import FLIGHT_PRIORITY

AT_A_TIME = {"waiting": (2, 3), "flights": (1, 2)}
"""By stage: without and with real-time priority, on two cores or more."""
_SESSION, _USER, _SYSTEM, _NICE = 3, 11, 12, 16
"""Fields of /proc/PID/stat after the name (proc_pid_stat(5))."""


def real_time() -> bool:
    """Ask the kernel whether processes may have real-time priority."""
    try:
        os.sched_setscheduler(0, os.SCHED_FIFO, os.sched_param(FLIGHT_PRIORITY))
    except OSError:
        return False
    os.sched_setscheduler(0, os.SCHED_OTHER, os.sched_param(0))
    return True


def at_a_time(stage: str) -> int:
    """Return the number of simultaneous tests of a stage of `AT_A_TIME`."""
    without, with_real_time = AT_A_TIME[stage]
    if len(os.sched_getaffinity(0)) < 2:
        return 1
    return with_real_time if real_time() else without


def core_is_taken(within_s: float = 0.5, times: int = 4) -> bool:
    """Measure whether other programs use more than half a core all the time (/proc/stat): in each of several measurements, because a
    short program is no load.
    """

    def idle_ticks() -> int:
        first = Path("/proc/stat").read_text(encoding="ascii").splitlines()[0].split()
        return int(first[4]) + int(first[5])

    for _ in range(times):
        before, begun_s = idle_ticks(), time.monotonic()
        time.sleep(within_s)
        idle = (idle_ticks() - before) / os.sysconf("SC_CLK_TCK") / (time.monotonic() - begun_s)
        if (os.cpu_count() or 1) - idle < 0.5:
            return False
    return True


def is_taken_within(session: int, above: int, within_s: float = 0.5) -> bool:
    """Measure whether programs of a session that have a niceness above a limit use more than a quarter of a core together."""

    def used_ticks() -> dict[str, int]:
        used = {}
        for path in Path("/proc").glob("[0-9]*/stat"):
            with contextlib.suppress(OSError):  # it has ended
                words = path.read_text(encoding="ascii", errors="replace").rpartition(")")[2].split()
                if int(words[_SESSION]) == session and int(words[_NICE]) > above:
                    used[path.parent.name] = int(words[_USER]) + int(words[_SYSTEM])
        return used

    before, begun_s = used_ticks(), time.monotonic()
    time.sleep(within_s)
    used = sum(ticks - before.get(pid, ticks) for pid, ticks in used_ticks().items())
    return used / os.sysconf("SC_CLK_TCK") > 0.25 * (time.monotonic() - begun_s)
