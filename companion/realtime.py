"""What a process of the flight asks of the operating system."""

from __future__ import annotations

import contextlib
import gc
import os
import sys
import threading
from pathlib import Path

GIL_SWITCH_S = 0.0005
"""The bus thread gets the interpreter this soon from a tick that computes on; Python's default is 5 ms, a whole period."""
FLIGHT_PRIORITY = 50
GUARDIAN_PRIORITY = 60
"""Above the flight: a flight process that spins must not keep the guardian from noticing."""
WORLD_PRIORITY = 40
"""Of the simulated world: below the flight that it must not disturb."""


def claim_realtime(priority: int) -> str:
    """Switch garbage collection off and ask for real-time scheduling of every thread of this process; not of its children, nor of
    threads that come later.

    Returns:
        One line that says what was got. Without the permission (rtprio) the flight goes on at normal priority.
    """
    gc.collect()
    gc.freeze()
    gc.disable()
    sys.setswitchinterval(GIL_SWITCH_S)
    try:
        policy = os.SCHED_FIFO | os.SCHED_RESET_ON_FORK
        # Every thread: the tick waits for the bus thread, and what MAVSDK's threads receive is what it flies on.
        for thread in Path("/proc/self/task").iterdir():
            with contextlib.suppress(ProcessLookupError):  # it has just ended
                os.sched_setscheduler(int(thread.name), policy, os.sched_param(priority))
    except (OSError, AttributeError) as error:
        return f"normal priority ({error.__class__.__name__}: no permission for SCHED_FIFO); garbage collection off"
    return f"SCHED_FIFO {priority}; garbage collection off"


def realtime_permitted(priority: int) -> str | None:
    """Whether `claim_realtime` would get real-time scheduling: tried on a thread that ends at once. None: it is refused."""
    got: list[str] = []

    def attempt() -> None:
        with contextlib.suppress(OSError, AttributeError):
            os.sched_setscheduler(0, os.SCHED_FIFO, os.sched_param(priority))  # 0: the calling thread alone
            got.append(f"SCHED_FIFO {priority}")

    thread = threading.Thread(target=attempt, name="realtime-permission")
    thread.start()
    thread.join()
    return got[0] if got else None
