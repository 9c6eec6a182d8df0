"""What a process of the flight gets from the operating system, and that it says so; asking what is permitted changes nothing."""

from __future__ import annotations

import gc
import json
import os
import subprocess
import sys
import threading
from pathlib import Path
from typing import Any

import pytest

from companion.runtime.realtime import FLIGHT_PRIORITY, memory_lock_refused, realtime_permitted, realtime_thread


def schedulers() -> set[int]:
    return {os.sched_getscheduler(int(thread.name)) for thread in Path("/proc/self/task").iterdir()}


def in_a_process_of_its_own(*lines: str) -> dict[str, Any]:
    """Runs a program with everything of `companion.runtime.realtime`; the dictionary that it prints last."""
    program = "\n".join(
        [
            "import gc, json, os, resource, subprocess, sys, threading",
            "from companion.runtime.realtime import *",
            *lines,
        ]
    )
    ended = subprocess.run([sys.executable, "-c", program], capture_output=True, text=True, check=True)
    told = json.loads(ended.stdout)
    assert isinstance(told, dict)
    return told


LOCKED = (
    "def locked():",
    "    with open('/proc/self/status') as status: [kb] = [line.split()[1] for line in status if line.startswith('VmLck')]",
    "    return int(kb)",
)


def test_the_permission_is_tried_on_a_thread_of_its_own() -> None:
    before, threads, collects = schedulers(), threading.active_count(), gc.isenabled()
    told = realtime_permitted(FLIGHT_PRIORITY)
    assert told in (None, f"SCHED_FIFO {FLIGHT_PRIORITY}")
    assert schedulers() == before
    assert threading.active_count() == threads
    assert gc.isenabled() == collects


def test_a_motion_has_real_time_priority_until_its_end() -> None:
    def of_this_thread() -> int:
        return os.sched_getscheduler(0)

    permitted = realtime_permitted(FLIGHT_PRIORITY) is not None
    with realtime_thread(FLIGHT_PRIORITY):
        assert of_this_thread() == (os.SCHED_FIFO if permitted else os.SCHED_OTHER)
        inherited: list[int] = []
        thread = threading.Thread(target=lambda: inherited.append(of_this_thread()))
        thread.start()
        thread.join()
        assert inherited == [of_this_thread()]
    assert of_this_thread() == os.SCHED_OTHER


def test_children_of_a_process_at_real_time_priority_are_not() -> None:
    told = in_a_process_of_its_own(
        "got = claim_realtime(1)",
        "ask = 'import os; print(os.sched_getscheduler(0) & ~os.SCHED_RESET_ON_FORK)'",
        "child = subprocess.run([sys.executable, '-c', ask], capture_output=True, text=True, check=True)",
        "print(json.dumps({'got': str(got), 'child': int(child.stdout)}))",
    )
    assert told["got"].startswith(("SCHED_FIFO 1", "normal priority"))
    assert told["child"] == os.SCHED_OTHER


def test_every_thread_gets_what_the_record_says() -> None:
    told = in_a_process_of_its_own(
        *LOCKED,
        "stay = threading.Event()",
        "thread = threading.Thread(target=stay.wait); thread.start()",
        "got = claim_realtime(1, cpus={min(os.sched_getaffinity(0))})",
        "ids = [int(name) for name in os.listdir('/proc/self/task')]",
        "policies = [os.sched_getscheduler(i) & ~os.SCHED_RESET_ON_FORK for i in ids]",
        "cpus = [sorted(os.sched_getaffinity(i)) for i in ids]",
        "stay.set(); thread.join()",
        "print(json.dumps({'priority': got.priority, 'refused': got.refused, 'cpus': got.cpus, 'locked': got.memory_locked,",
        "    'line': str(got), 'policies': policies, 'thread_cpus': cpus, 'locked_kb': locked(), 'gc': gc.isenabled(),",
        "    'switch': sys.getswitchinterval()}))",
    )
    assert len(told["policies"]) == 2
    assert set(told["policies"]) == {os.SCHED_FIFO if told["priority"] == 1 else os.SCHED_OTHER}
    first = min(os.sched_getaffinity(0))
    assert told["cpus"] == [first]
    assert told["thread_cpus"] == [[first], [first]]
    assert told["locked"] == (told["locked_kb"] > 0) == (memory_lock_refused() is None)
    assert len(told["refused"]) == (told["priority"] is None) + (not told["locked"])
    assert told["gc"] is False
    assert told["switch"] == pytest.approx(0.0005)
    assert "\n" not in told["line"]
    assert all(why in told["line"] for why in told["refused"])


def test_locked_memory_is_not_brought_in_before_it_is_touched() -> None:
    """256 MB that nobody touches would be in memory at once if all of it were locked; so would be every thread's stack."""
    told = in_a_process_of_its_own(
        *LOCKED,
        "import mmap",
        "got = claim_realtime(1)",
        "def resident():",
        "    with open('/proc/self/statm') as statm: return int(statm.read().split()[1]) * resource.getpagesize() / 1e6",
        "before = resident()",
        "area = mmap.mmap(-1, 256_000_000)",
        "print(json.dumps({'locked': got.memory_locked, 'grown_mb': resident() - before, 'locked_mb': locked() / 1e3}))",
        "area.close()",
    )
    if not told["locked"]:
        pytest.skip("locking memory is not permitted here")
    assert told["grown_mb"] < 20
    assert told["locked_mb"] > 250


def test_a_limit_on_locked_memory_is_no_trap_in_flight() -> None:
    """With mlockall under a limit, memory beyond it is refused to a process that flies: so nothing is locked under one."""
    told = in_a_process_of_its_own(
        *LOCKED,
        "import companion.runtime.realtime as own",
        "own._CAP_IPC_LOCK = 63",  # a capability that nobody has: as a user's process
        "resource.setrlimit(resource.RLIMIT_MEMLOCK, (8 << 20, resource.getrlimit(resource.RLIMIT_MEMLOCK)[1]))",
        "got = claim_realtime(1)",
        "area = bytearray(64_000_000)",
        "told = {'locked': got.memory_locked, 'kb': locked(), 'refused': got.refused[-1], 'permitted': memory_lock_refused()}",
        "print(json.dumps(told))",
    )
    assert (told["locked"], told["kb"]) == (False, 0)
    assert told["refused"] == "memory not locked (RLIMIT_MEMLOCK is 8192 kB, expected unlimited)"
    assert told["permitted"] == told["refused"]


def test_cores_that_are_not_there_are_reported() -> None:
    told = in_a_process_of_its_own(
        "got = claim_realtime(1, cpus={1000}, lock_memory=False)",
        "print(json.dumps({'cpus': got.cpus, 'line': str(got), 'locked': got.memory_locked}))",
    )
    assert told["cpus"] == sorted(os.sched_getaffinity(0))
    assert "not moved to CPUs 1000" in told["line"]
    assert not told["locked"]
