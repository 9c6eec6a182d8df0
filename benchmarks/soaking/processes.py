"""Memory and CPU time of a flight's processes, read from /proc without disturbing them."""

from __future__ import annotations

import contextlib
import os
from dataclasses import dataclass
from pathlib import Path

ROLES = {
    "companion.flight.main": "flight",
    "companion.recorder.main": "recorder",
    "companion.guardian": "guardian",
    "sitl": "world",
}
LAUNCHER = "launcher"
"""Role of the process that starts all others."""
_PAGE_BYTES = os.sysconf("SC_PAGE_SIZE")
_CLOCK_TICKS = os.sysconf("SC_CLK_TCK")


@dataclass(frozen=True, slots=True)
class Usage:
    """Usage of one process at one moment."""

    rss_mb: float
    """Resident memory, shared pages included, 1e6 bytes."""
    cpu_s: float
    """User and system time since its start."""
    minor_faults: int
    """Number of page faults without disk access since its start."""


def family(root_pid: int) -> dict[str, int]:
    """Return the process ids of a flight by role; roles that do not run are missing."""
    parents: dict[int, int] = {}
    for entry in Path("/proc").iterdir():
        if entry.name.isdecimal():
            with contextlib.suppress(OSError, ValueError, IndexError):
                # The name, in brackets, may hold anything.
                parents[int(entry.name)] = int((entry / "stat").read_text().rpartition(")")[2].split()[1])
    found = {LAUNCHER: root_pid}
    for pid in parents:
        if _descends(pid, root_pid, parents):
            role = next((ROLES[word] for word in _command(pid) if word in ROLES), None)
            if role is not None:
                found[role] = pid
    return found


def _descends(pid: int, root_pid: int, parents: dict[int, int]) -> bool:
    while pid in parents:
        pid = parents[pid]
        if pid == root_pid:
            return True
    return False


def _command(pid: int) -> list[str]:
    with contextlib.suppress(OSError):
        return Path(f"/proc/{pid}/cmdline").read_text().split("\0")
    return []


def usage(pid: int) -> Usage | None:
    """Return the present usage of a process, or None if it has ended."""
    try:
        pages = int(Path(f"/proc/{pid}/statm").read_text().split()[1])
        fields = Path(f"/proc/{pid}/stat").read_text().rpartition(")")[2].split()
    except (OSError, IndexError):
        return None
    return Usage(pages * _PAGE_BYTES / 1e6, (int(fields[11]) + int(fields[12])) / _CLOCK_TICKS, int(fields[7]))


MAIN, NATIVE = "main", "native"
"""Names under which `threads` counts the main thread, and all threads that have no name of their own: those of native libraries."""


def threads(pid: int) -> dict[str, tuple[float, float]]:
    """Return the user and the system time of a process's threads by name since their start, s; empty if it has ended."""
    found: dict[str, tuple[float, float]] = {}
    with contextlib.suppress(OSError):
        own_name = Path(f"/proc/{pid}/comm").read_text()
        for task in Path(f"/proc/{pid}/task").iterdir():
            with contextlib.suppress(OSError, IndexError):
                name = (task / "comm").read_text()
                fields = (task / "stat").read_text().rpartition(")")[2].split()
                kind = MAIN if task.name == str(pid) else NATIVE if name == own_name else name.strip()
                user_s, system_s = found.get(kind, (0.0, 0.0))
                found[kind] = user_s + int(fields[11]) / _CLOCK_TICKS, system_s + int(fields[12]) / _CLOCK_TICKS
    return found


def pss_mb(pid: int) -> float | None:
    """Return the proportional set size in 1e6 bytes. It is expensive, because the kernel walks all pages."""
    try:
        lines = Path(f"/proc/{pid}/smaps_rollup").read_text().splitlines()
    except OSError:
        return None
    return next((int(line.split()[1]) * 1024 / 1e6 for line in lines if line.startswith("Pss:")), None)
