"""Finds the usable CPU cores and keeps other processes off those that are reserved for the flight process."""

from __future__ import annotations

import contextlib
import os
import threading
from collections.abc import Collection
from pathlib import Path

CPU_MAX = 1023
"""Largest core number that sched_setaffinity(2) accepts in a default set (CPU_SETSIZE - 1)."""


def usable_cpus() -> tuple[int, ...]:
    """Return the cores that this process may run on, in ascending order.

    They include isolated cores (isolcpus=) and cores outside its current affinity, but not those that a cpuset excludes. A
    short-lived thread finds them by trying.
    """
    found: set[int] = set()

    def attempt() -> None:
        with contextlib.suppress(OSError):
            os.sched_setaffinity(0, range(CPU_MAX + 1))  # the calling thread only; cores that do not exist are ignored
        found.update(os.sched_getaffinity(0))

    thread = threading.Thread(target=attempt, name="cores")
    thread.start()
    thread.join()
    return tuple(sorted(found))


def others(own: Collection[int], now: Collection[int], usable: Collection[int]) -> frozenset[int]:
    """Return the cores that a process other than the flight process should move to.

    Args:
        own: cores reserved for the flight process.
        now: cores that the process may run on now.
        usable: cores that it could run on.

    Returns:
        The cores of `now` without `own`, or if there are none, those of `usable` without `own`. Empty if nothing needs to change or
        no core is left.
    """
    left = frozenset(now) - frozenset(own) or frozenset(usable) - frozenset(own)
    return frozenset() if left == frozenset(now) else left


def keep_off(own: Collection[int]) -> None:
    """Move all threads of this process, and the children that it will start, off the flight's `own` cores if there are others."""
    if not own:
        return
    cpus = others(own, os.sched_getaffinity(0), usable_cpus())
    if not cpus:
        return
    for thread in Path("/proc/self/task").iterdir():
        with contextlib.suppress(OSError):  # it has just ended
            os.sched_setaffinity(int(thread.name), cpus)


def listed(cpus: Collection[int]) -> str:
    """Return the cores in the kernel's notation: `0-2,5`."""
    runs: list[list[int]] = []
    for cpu in sorted(cpus):
        if runs and runs[-1][-1] == cpu - 1:
            runs[-1] = [runs[-1][0], cpu]
        else:
            runs.append([cpu])
    return ",".join("-".join(map(str, run)) for run in runs)
