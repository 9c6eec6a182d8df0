"""Checks of the computer: disk space for the log, processor, real-time permission, memory, cores, recorder. Pure functions."""

from __future__ import annotations

from collections.abc import Iterator

from companion.config.computer import Computer
from companion.config.vehicle import Vehicle
from companion.model.check_row import Row
from companion.model.observations import Machine, Observations
from companion.preflight.checks import Check
from companion.runtime.cores import listed

DISK = Check(
    "machine.disk",
    "disk space",
    "room for the log of a mission twice as long; refused if there is not even room for this one",
    "an incomplete log cannot explain the flight, and a full disk slows down the whole computer",
)
GOVERNOR = Check(
    "machine.governor",
    "processor",
    "governor `performance` on every core, where it is reported",
    "at a reduced clock frequency, ticks are late",
    warns=True,
)
REALTIME = Check(
    "machine.realtime",
    "real-time permission",
    "SCHED_FIFO",
    "without it, ticks are late on a busy computer",
    warns=True,
)
MEMORY_LOCK = Check(
    "machine.memory_lock",
    "memory lock",
    "RLIMIT_MEMLOCK unlimited, unless `computer.lock_memory` is false",
    "reading swapped-out pages from the card in flight takes tens of milliseconds",
    warns=True,
)
CPUS = Check(
    "machine.cpus",
    "cores of the flight",
    "this computer has every core of `computer.cpus`, and at least one more",
    "the flight would share its cores with all other processes",
)
RECORDER = Check(
    "machine.recorder",
    "recorder",
    "the recorder process starts and opens a log",
    "a flight without a log cannot be explained",
)
CHECKS = (DISK, GOVERNOR, REALTIME, MEMORY_LOCK, CPUS, RECORDER)

LOG_BYTES_PER_S = 300_000
"""Data rate of flight.mcap; measured: 0.24 MB/s."""
REPORT_BYTES = 20_000_000
DEFAULT_MISSION_S = 120.0
GROUND_S = 30.0
"""Recording time before take-off and after landing, s."""


def rows(o: Observations, vehicle: Vehicle) -> Iterator[Row]:
    """Return the rows of the computer."""
    machine = o.machine
    if machine is not None:
        if machine.disk_free_bytes is not None:
            yield _disk(machine.disk_free_bytes, o.mission_s if o.mission_s is not None else DEFAULT_MISSION_S)
        others = sorted({governor for governor in machine.governors if governor != "performance"})
        read = ", ".join(others) or ("performance" if machine.governors else "no governor is reported")
        fix = "run sudo companion install --systemd; for this session only: cpupower frequency-set -g performance"
        yield GOVERNOR.row(not others, read, "performance", fix)
        read = machine.realtime or "refused: the flight runs at normal priority"
        fix = _PERMIT.format("@dialout - rtprio 60")
        yield REALTIME.row(machine.realtime is not None, read, "SCHED_FIFO", fix)
        yield _memory_lock(machine, vehicle.computer)
        yield _cpus(machine, vehicle.computer)
    if o.recorder is not None:
        fix = "remove the cause that this row names"
        yield RECORDER.row(not o.recorder, o.recorder or "opens a log", "the recorder opens a log", fix)


_PERMIT = (
    "sudo companion install --systemd allows it for the service and for members of the dialout group; or add `{}` to "
    "/etc/security/limits.conf yourself; then log in again"
)


def _memory_lock(machine: Machine, computer: Computer) -> Row:
    if not computer.lock_memory:
        return MEMORY_LOCK.good("computer.lock_memory is false: not requested")
    refused, fix = machine.memory_lock, _PERMIT.format("@dialout - memlock unlimited")
    return MEMORY_LOCK.row(refused is None, refused or "permitted", "RLIMIT_MEMLOCK unlimited", fix)


def _cpus(machine: Machine, computer: Computer) -> Row:
    there = f"cores {listed(machine.cpus)}"
    if not computer.cpus:
        return CPUS.good(f"all: {there}")
    asked = f"computer.cpus {listed(computer.cpus)}"
    if missing := set(computer.cpus) - set(machine.cpus):
        fix = f"remove {listed(missing)} from computer.cpus; on another computer add --set 'vehicle.computer.cpus=[]'"
        return CPUS.bad(there, asked, fix)
    if not set(machine.cpus) - set(computer.cpus):
        fix = "remove at least one core from computer.cpus; otherwise recorder and guardian share all cores with the flight"
        return CPUS.doubtful(there, f"{asked} and one more", fix)
    return CPUS.good(asked, f"among {there}")


def _disk(free_bytes: int, mission_s: float) -> Row:
    once = LOG_BYTES_PER_S * (mission_s + GROUND_S) + REPORT_BYTES
    twice = LOG_BYTES_PER_S * (2.0 * mission_s + GROUND_S) + REPORT_BYTES
    read, wanted = f"{free_bytes / 1e6:.0f} MB free", f"{twice / 1e6:.0f} MB for a mission of {mission_s:.0f} s"
    fix = "delete old flights, or choose another disk with --out"
    return DISK.graded(free_bytes >= twice, free_bytes >= once, read, wanted, fix)
