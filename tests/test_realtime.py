"""Asking whether real-time scheduling is permitted changes nothing in the process that asks."""

from __future__ import annotations

import gc
import os
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
