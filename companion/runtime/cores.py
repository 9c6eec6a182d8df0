"""Cores of this computer: which there are, and how the processes beside the flight keep off those that are its own."""

from __future__ import annotations

import contextlib
import os
import threading
from collections.abc import Collection
from pathlib import Path

CPU_MAX = 1023
"""Largest number that sched_setaffinity(2) takes in its usual set (CPU_SETSIZE less one)."""


def usable_cpus() -> tuple[int, ...]:
    """Cores that this process may be put on, isolated ones (isolcpus=) and those that it is not on now included; what the system's
    cpusets withhold is not among them. Tried on a thread that ends at once.
    """
    found: set[int] = set()

    def attempt() -> None:
        with contextlib.suppress(OSError):
            os.sched_setaffinity(
                0, range(CPU_MAX + 1)
            )  # 0: the calling thread alone; what does not exist is passed over
        found.update(os.sched_getaffinity(0))

    thread = threading.Thread(target=attempt, name="cores")
    thread.start()
    thread.join()
    return tuple(sorted(found))


def others(own: Collection[int], now: Collection[int], usable: Collection[int]) -> frozenset[int]:
    """Cores for what is not the flight: those that it is on, less the flight's `own`; if none is left, any that is not.

    Empty: there is nothing to change, or nowhere to go.
    """
    left = frozenset(now) - frozenset(own) or frozenset(usable) - frozenset(own)
    return frozenset() if left == frozenset(now) else left


def keep_off(own: Collection[int]) -> None:
    """Move all threads of this process off the flight's `own` cores; what it starts follows. Without another core it stays."""
    if not own:
        return
    cpus = others(own, os.sched_getaffinity(0), usable_cpus())
    if not cpus:
        return
    for thread in Path("/proc/self/task").iterdir():
        with contextlib.suppress(OSError):  # it has just ended
            os.sched_setaffinity(int(thread.name), cpus)


def listed(cpus: Collection[int]) -> str:
    """For people, as the kernel writes it: `0-2,5`."""
    runs: list[list[int]] = []
    for cpu in sorted(cpus):
        if runs and runs[-1][-1] == cpu - 1:
            runs[-1] = [runs[-1][0], cpu]
        else:
            runs.append([cpu])
    return ",".join("-".join(map(str, run)) for run in runs)
