"""Real-time settings that the processes of a flight request from the operating system."""

from __future__ import annotations

import contextlib
import ctypes
import errno
import gc
import os
import resource
import sys
import threading
from collections.abc import Collection, Iterator
from dataclasses import dataclass
from pathlib import Path

GIL_SWITCH_S = 0.0005
"""Interpreter switch interval: the longest time that the bus thread waits for the computation of a tick. Python's default of 5 ms
is as long as a whole tick.
"""
FLIGHT_PRIORITY = 50
GUARDIAN_PRIORITY = 60
"""Priority of the guardian, above the flight process, so that it runs even if the flight process spins."""
WORLD_PRIORITY = 40
"""Priority of the simulated world, below the flight process, which the world must not disturb."""

_MCL_CURRENT, _MCL_FUTURE, _MCL_ONFAULT = 1, 2, 4  # <bits/mman.h>, the same numbers on x86 and ARM
_CAP_IPC_LOCK = 14  # <linux/capability.h>


@dataclass(frozen=True, slots=True)
class Realtime:
    """Result of `claim_realtime`; `str()` returns it as one line of text."""

    priority: int | None
    """SCHED_FIFO priority of all threads; None if it was refused and the process runs at normal priority."""
    cpus: tuple[int, ...]
    """Cores that the process may run on."""
    memory_locked: bool
    """Whether current pages, and those touched later, stay in memory (mlockall)."""
    refused: tuple[str, ...]

    def __str__(self) -> str:
        got = [f"SCHED_FIFO {self.priority}"] if self.priority is not None else []
        got += ["memory locked"] if self.memory_locked else []
        return "; ".join(
            [*got, *self.refused, f"CPUs {','.join(map(str, self.cpus))}", "garbage collection off"],
        )


def claim_realtime(priority: int, *, cpus: Collection[int] = (), lock_memory: bool = True) -> Realtime:
    """Apply the settings for precise timing to all threads of this process: garbage collection off, interpreter switch interval,
    cores, locked memory, SCHED_FIFO.

    Call it again to include threads that were started later; they inherit all but the priority. Children inherit the cores only.

    Args:
        priority: SCHED_FIFO priority, 1 to 99.
        cpus: cores that the process runs on; empty to leave them unchanged.
        lock_memory: whether to keep the process in memory. Pages are locked when they are touched (MCL_ONFAULT), which avoids
            loading all thread stacks and mapped libraries.
    """
    collect_no_garbage()
    sys.setswitchinterval(GIL_SWITCH_S)
    refused = [why for why in (_set_cpus(cpus), _lock_memory() if lock_memory else None) if why is not None]
    locked = lock_memory and not any(why.startswith(_NOT_LOCKED) for why in refused)
    not_first = _set_fifo(priority)
    if not_first is not None:
        refused.insert(0, not_first)
    return Realtime(
        priority=priority if not_first is None else None,
        cpus=tuple(sorted(os.sched_getaffinity(0))),
        memory_locked=locked,
        refused=tuple(refused),
    )


def collect_no_garbage() -> None:
    """Switch garbage collection off: it would take up to 36 ms in flight."""
    gc.collect()
    gc.freeze()
    gc.disable()


@contextlib.contextmanager
def realtime_thread(priority: int) -> Iterator[None]:
    """Run the calling thread, and the threads that it starts meanwhile, with SCHED_FIFO during a `with` block, if that is permitted.

    Args:
        priority: SCHED_FIFO priority, 1 to 99.
    """
    try:
        before = os.sched_getscheduler(0), os.sched_getparam(0)
        os.sched_setscheduler(0, os.SCHED_FIFO, os.sched_param(priority))
    except (OSError, AttributeError):
        yield
        return
    try:
        yield
    finally:
        os.sched_setscheduler(0, *before)


def realtime_permitted(priority: int) -> str | None:
    """Return the scheduling that `claim_realtime` would get, tried on a short-lived thread; None if it would be refused."""
    got: list[str] = []

    def attempt() -> None:
        with contextlib.suppress(OSError, AttributeError):
            os.sched_setscheduler(0, os.SCHED_FIFO, os.sched_param(priority))  # 0: the calling thread alone
            got.append(f"SCHED_FIFO {priority}")

    thread = threading.Thread(target=attempt, name="realtime-permission")
    thread.start()
    thread.join()
    return got[0] if got else None


def memory_lock_refused() -> str | None:
    """Return why memory must not be locked, or None if it may be.

    It must not be locked under a finite RLIMIT_MEMLOCK: once the limit is used up, the process would get no more memory, even in
    flight.
    """
    limit_bytes = resource.getrlimit(resource.RLIMIT_MEMLOCK)[0]
    if limit_bytes == resource.RLIM_INFINITY or _has_capability(_CAP_IPC_LOCK):
        return None
    return f"{_NOT_LOCKED} (RLIMIT_MEMLOCK is {limit_bytes // 1024} kB, expected unlimited)"


_NOT_LOCKED = "memory not locked"


def _set_fifo(priority: int) -> str | None:
    try:
        policy = os.SCHED_FIFO | os.SCHED_RESET_ON_FORK
        # Every thread, because the tick waits for the bus thread and uses data that MAVSDK's threads receive.
        for thread in _threads():
            with contextlib.suppress(ProcessLookupError):  # it has just ended
                os.sched_setscheduler(thread, policy, os.sched_param(priority))
    except (OSError, AttributeError) as error:
        return f"normal priority ({error.__class__.__name__}: no permission for SCHED_FIFO)"
    return None


def _set_cpus(cpus: Collection[int]) -> str | None:
    if not cpus:
        return None
    try:
        for thread in _threads():
            with contextlib.suppress(ProcessLookupError):
                os.sched_setaffinity(thread, cpus)
    except (OSError, ValueError) as error:
        asked = ",".join(map(str, sorted(cpus)))
        return f"not moved to CPUs {asked} ({getattr(error, 'strerror', None) or error}; this computer has {os.cpu_count()})"
    return None


def _lock_memory() -> str | None:
    why = memory_lock_refused()
    if why is not None:
        return why
    try:
        c = ctypes.CDLL(None, use_errno=True)
        if c.mlockall(_MCL_CURRENT | _MCL_FUTURE | _MCL_ONFAULT) != 0:
            return f"{_NOT_LOCKED} ({errno.errorcode.get(ctypes.get_errno(), 'refused')})"
    except (OSError, AttributeError) as error:  # a C library without it
        return f"{_NOT_LOCKED} ({error})"
    return None


def _threads() -> list[int]:
    return [int(thread.name) for thread in Path("/proc/self/task").iterdir()]


def _has_capability(number: int) -> bool:
    for line in Path("/proc/self/status").read_text(encoding="ascii", errors="replace").splitlines():
        name, _, value = line.partition(":")
        if name == "CapEff":
            return bool(int(value, 16) >> number & 1)
    return False
