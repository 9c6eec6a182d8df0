"""Asking whether real-time scheduling is permitted changes nothing in the process that asks."""

from __future__ import annotations

import gc
import os
import subprocess
import sys
import threading
from pathlib import Path

from companion.realtime import FLIGHT_PRIORITY, realtime_permitted


def schedulers() -> set[int]:
    return {os.sched_getscheduler(int(thread.name)) for thread in Path("/proc/self/task").iterdir()}


def test_the_permission_is_tried_on_a_thread_of_its_own() -> None:
    before, threads = schedulers(), threading.active_count()
    told = realtime_permitted(FLIGHT_PRIORITY)
    assert told in (None, f"SCHED_FIFO {FLIGHT_PRIORITY}")
    assert schedulers() == before
    assert threading.active_count() == threads
    assert gc.isenabled()


def test_children_of_a_process_at_real_time_priority_are_not() -> None:
    ask = "import os; print(os.sched_getscheduler(0) & ~os.SCHED_RESET_ON_FORK)"
    program = (
        "import subprocess, sys; from companion.realtime import claim_realtime; got = claim_realtime(1);"
        f"child = subprocess.run([sys.executable, '-c', {ask!r}], capture_output=True, text=True, check=True);"
        "print(got, child.stdout, sep='|')"
    )
    ended = subprocess.run([sys.executable, "-c", program], capture_output=True, text=True, check=True)
    got, child = ended.stdout.split("|")
    assert got.startswith(("SCHED_FIFO 1", "normal priority"))
    assert int(child) == os.SCHED_OTHER
