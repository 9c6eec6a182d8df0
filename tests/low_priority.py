"""`python -m tests.low_priority COMMAND ...`: run a command that takes what the other processes leave of the processors.

To be started in a session of its own. Linux shares the processors among sessions first (sched_autogroup) and among the processes of a
session second: a niceness alone counts in its session only. So a foreign program gets a whole core before a session of the lowest
priority gets anything, even if its niceness is 19. Where that is so, `PLACE` says what is done instead.
"""

from __future__ import annotations

import contextlib
import fcntl
import os
import sys
from collections.abc import Iterator
from pathlib import Path

import pytest

LOWEST = 19
LOW = 10
PLACE = "COMPANION_TESTS_PLACE"
"""Environment variable: set if a foreign program takes a core, and what has to be in time has real-time priority."""
EQUAL = "equal"
"""A value of `PLACE`: the session of the command, and one of each worker of pytest (`-p tests.low_priority`), has the priority of any
other.
"""
OURS = "ours"
"""A value of `PLACE`: the foreign program runs in our session with a niceness above `LOW`, and the command there with `LOW`. What waits
and flies gets a session of its own then: where programs of three priorities share one, those of niceness 0 wait up to two seconds for
a core (Linux 6.18).
"""


def pytest_configure(config: pytest.Config) -> None:
    """Give a worker its own session, if sessions are equal."""
    if os.environ.get(PLACE) == EQUAL and hasattr(config, "workerinput"):
        os.setsid()


@pytest.hookimpl(wrapper=True)
def pytest_collection(session: pytest.Session) -> Iterator[None]:
    """Let one worker collect at a time: the first writes the bytecode of what it imports (15 s of a core in a new clone), the others
    read it.
    """
    if not hasattr(session.config, "workerinput"):
        return (yield)
    with open(__file__, "rb") as lock:
        fcntl.flock(lock, fcntl.LOCK_EX)
        return (yield)


if __name__ == "__main__":
    os.nice(LOW if os.environ.get(PLACE) == OURS else LOWEST)
    if PLACE not in os.environ:
        with contextlib.suppress(OSError):  # a kernel without groups of sessions, where niceness counts everywhere
            Path("/proc/self/autogroup").write_text(str(LOWEST), encoding="ascii")
    os.execvp(sys.argv[1], sys.argv[1:])
