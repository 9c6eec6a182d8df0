"""Minutes of hover over real wires, with recorder, broker and monitor, an empty loop and a bare loop beside it."""

from __future__ import annotations

import contextlib
import json
import shutil
import signal
import subprocess
import sys
import time
from collections.abc import Callable, Sequence
from dataclasses import asdict, dataclass, field
from itertools import pairwise
from pathlib import Path
from typing import Any

import numpy as np

from benchmarks.measuring.hover_log import Array, HoverLog, read_hover
from benchmarks.measuring.hovering import (
    END_TIMEOUT_S,
    HOVER,
    LIMITS,
    START_TIMEOUT_S,
    NoFlight,
    await_hover,
    output_path,
    start_hover,
)
from benchmarks.measuring.latency import RATE_HZ, Latency
from benchmarks.soaking.processes import Usage, family, threads, usage
from benchmarks.soaking.verdict import ROLES as FLIGHT_ROLES
from companion.model.constants import TICK_PERIOD_S
from companion.runtime.realtime import FLIGHT_PRIORITY, realtime_permitted
from tests.broker import loopback_broker
from tests.support import ROOT

HOVER_S, QUICK_HOVER_S = 600.0, 60.0
SETTLE_S = 3.0
"""Time at the start and at the end of the hover that is not counted."""
BARE_LEAD_S = 12.0
"""The bare loop is shorter than the hover by this time, so that it ends before the landing."""
SAMPLE_S = 1.0
SAY_EVERY = 30
WITHIN_S = 0.1
"""A stall of the whole computer delays both loops within this time of each other."""
EMPTY, BARE = "empty loop", "bare loop"
ROLES = (*FLIGHT_ROLES, EMPTY, BARE)

Figures = dict[str, Any]


Threads = tuple[float, dict[str, tuple[float, float]]]
"""A time, and the user and system time of each thread of the flight process until then, s."""


class PartError(Exception):
    """A part could not be measured; the text is one line."""


@dataclass
class _Sampled:
    """Usage of one process, second by second."""

    t_s: list[float] = field(default_factory=list)
    used: list[Usage] = field(default_factory=list)


def measure(folder: Path, hover_s: float, say: Callable[[str], None]) -> Figures:
    """Fly a hover while a viewer watches, read the log, and return the figures.

    Args:
        folder: folder for logs; must exist and be empty.
        hover_s: duration of the hover.
        say: called with each line about the progress.

    Raises:
        PartError: there is no broker, or the vehicle did not hover.
    """
    if shutil.which("mosquitto") is None and shutil.which("mosquitto", path="/usr/sbin:/usr/local/sbin") is None:
        raise PartError("no broker: apt install mosquitto")
    with contextlib.ExitStack() as stack:
        broker = stack.enter_context(loopback_broker(folder))
        watching = stack.enter_context(_beside("viewer", folder, "-m", "benchmarks.measuring.viewer", broker.url))
        _await_viewer(watching, folder / "viewer.txt")
        empty = stack.enter_context(_beside("empty", folder, *_loop("empty", folder / "empty.npy")))
        stack.enter_context(_beside("plain", folder, *_loop("plain", folder / "plain.npy")))
        flight = start_hover(folder, hover_s, broker.url, report=False)
        stack.callback(_land, flight)
        try:
            await_hover(flight, folder)
        except NoFlight as error:
            raise PartError(f"no hover: {str(error).splitlines()[-1]}") from None
        to_wall_s = time.time() - time.monotonic()
        frames = round((hover_s - BARE_LEAD_S) * RATE_HZ)
        bare = stack.enter_context(_beside("bare", folder, *_loop("bare", folder / "bare.json"), str(frames)))
        say(f"hovering for {hover_s:g} s")
        samples, machine, by_thread = _watch(flight, empty.pid, bare, hover_s, say)
        viewer = _viewer(watching, folder / "viewer.txt")
    say("reading the log")
    return _judge(folder, flight.returncode, samples, machine, by_thread, viewer, to_wall_s)


def _await_viewer(process: subprocess.Popen[bytes], said: Path) -> None:
    """Wait until the monitor's page is open, so that the start of the browser is not measured."""
    deadline_s = time.monotonic() + START_TIMEOUT_S
    while not said.stat().st_size:
        if process.poll() is not None or time.monotonic() > deadline_s:
            raise PartError("no viewer: the monitor's page did not open")
        time.sleep(0.1)


def _loop(which: str, path: Path) -> tuple[str, ...]:
    return ("-m", "benchmarks.measuring.beside", which, str(path))


@contextlib.contextmanager
def _beside(name: str, folder: Path, *arguments: str) -> Any:
    """Run a Python process in its own group, with its output in NAME.txt; end it by SIGTERM, then by SIGKILL."""
    with (folder / f"{name}.txt").open("wb") as said:
        process = subprocess.Popen(
            [sys.executable, *arguments],
            stdin=subprocess.DEVNULL,
            stdout=said,
            stderr=said,
            start_new_session=True,
            cwd=ROOT,
        )
    try:
        yield process
    finally:
        process.terminate()
        try:
            process.wait(30.0)
        except subprocess.TimeoutExpired:
            process.kill()
            process.wait()


def _land(flight: subprocess.Popen[bytes]) -> None:
    """Land the flight and end its processes."""
    if flight.poll() is None:
        flight.send_signal(signal.SIGINT)
        try:
            flight.wait(END_TIMEOUT_S)
        except subprocess.TimeoutExpired:
            flight.terminate()
            flight.wait(END_TIMEOUT_S)


def _watch(
    flight: subprocess.Popen[bytes],
    empty_pid: int,
    bare: subprocess.Popen[bytes],
    hover_s: float,
    say: Callable[[str], None],
) -> tuple[dict[str, _Sampled], list[tuple[float, ...]], list[Threads]]:
    """Sample every process and the whole computer once a second until the flight has ended."""
    begun_s = next_s = time.monotonic()
    samples: dict[str, _Sampled] = {}
    machine: list[tuple[float, ...]] = []
    by_thread: list[Threads] = []
    pids: dict[str, int] = {}
    number = 0
    while flight.poll() is None:
        now_s = time.monotonic()
        if now_s - begun_s > hover_s + END_TIMEOUT_S:
            raise PartError(f"the flight has not ended {END_TIMEOUT_S:g} s after its time")
        if len(pids) < len(ROLES):
            pids = {**family(flight.pid), EMPTY: empty_pid, BARE: bare.pid}
        for role, pid in pids.items():
            used = usage(pid)
            if used is not None:
                sampled = samples.setdefault(role, _Sampled())
                sampled.t_s.append(now_s)
                sampled.used.append(used)
        machine.append((now_s, *machine_cpu()))
        if "flight" in pids and (found := threads(pids["flight"])):
            by_thread.append((now_s, found))
        number += 1
        if number % SAY_EVERY == 0:
            say(f"{number} of {hover_s:g} s")
        next_s += SAMPLE_S
        with contextlib.suppress(subprocess.TimeoutExpired):
            flight.wait(max(0.0, next_s - time.monotonic()))
    return samples, machine, by_thread


def machine_cpu() -> tuple[float, float, float]:
    """Return the CPU time of all cores since boot, in the kernel's clock ticks: total, idle, stolen by the host."""
    fields = [float(word) for word in Path("/proc/stat").read_text(encoding="ascii").split("\n", 1)[0].split()[1:9]]
    return sum(fields), fields[3] + fields[4], fields[7]


def _viewer(process: subprocess.Popen[bytes], said: Path) -> str:
    lines = said.read_text(encoding="utf-8", errors="replace").splitlines()
    if process.poll() is not None:
        return f"none: the viewer ended by itself: {lines[-1] if lines else 'it said nothing'}"
    return ", ".join(lines) or "none: nothing was shown"


def _judge(
    folder: Path,
    code: int,
    samples: dict[str, _Sampled],
    machine: Sequence[tuple[float, ...]],
    by_thread: Sequence[Threads],
    viewer: str,
    to_wall_s: float,
) -> Figures:
    try:
        summary = json.loads((folder / "flight/summary.json").read_text(encoding="utf-8"))
        log = read_hover(folder / "flight/flight.mcap", HOVER, SETTLE_S)
    except (OSError, ValueError) as error:
        said = output_path(folder).read_text(encoding="utf-8", errors="replace").splitlines()[-1:]
        raise PartError(f"the flight ended with exit code {code} and left no hover: {error}; {said}") from None
    start_s = log.start_s + (log.epoch_offset_s - to_wall_s)  # by time.monotonic
    begin_s, end_s = float(start_s[0]), float(start_s[-1]) - SETTLE_S
    inside = (start_s >= begin_s) & (start_s <= end_s)
    late_s = log.timing.lateness_s[inside]
    beside, plain = (
        loop[:, (loop[0] >= begin_s) & (loop[0] <= end_s)]
        for loop in (np.load(folder / f"{name}.npy") for name in ("empty", "plain"))
    )
    if not len(late_s) or not beside.shape[1] or not plain.shape[1]:
        raise PartError(f"the hover was too short to be measured: the flight ended with exit code {code}")
    return {
        "exit_code": code,
        "outcome": summary["outcome"],
        "recorder_dropped": summary["recorder"]["dropped"],
        "warnings": sorted({event["text"] for event in summary["events"] if event["severity"] != "info"}),
        "hover_s": end_s - begin_s,
        "viewer": viewer,
        "realtime": log.realtime or realtime_permitted(FLIGHT_PRIORITY) or "normal priority",
        "limits": LIMITS,
        "flight": _ticks(start_s[inside], late_s),
        "empty": _ticks(*beside),
        "plain": _ticks(*plain),
        "late_alone": late_alone(start_s[inside], late_s, *beside),
        **_latencies(log),
        "bare": _bare(folder),
        "processes": {role: _of_process(sampled, begin_s, end_s) for role, sampled in samples.items()},
        "threads": of_threads([row for row in by_thread if begin_s <= row[0] <= end_s]),
        "machine": _machine([row for row in machine if begin_s <= row[0] <= end_s]),
    }


def late_alone(start_s: Array, late_s: Array, beside_start_s: Array, beside_late_s: Array) -> list[float]:
    """Return the lateness, s, of ticks that began later than two periods while no tick of the loop beside was later than one within
    `WITHIN_S`, because a stall of the computer meets the two loops at different points of their periods.
    """
    beside_s = beside_start_s[beside_late_s > TICK_PERIOD_S]
    late = late_s > 2.0 * TICK_PERIOD_S
    together = np.searchsorted(beside_s, start_s + WITHIN_S, "right") > np.searchsorted(beside_s, start_s - WITHIN_S)
    alone: list[float] = late_s[late & ~together].tolist()
    return alone


def _ticks(start_s: Array, late_s: Array) -> Figures:
    return {
        "lateness_ms": asdict(Latency.of(late_s)),
        "later_than_one": int((late_s > TICK_PERIOD_S).sum()),
        "later_than_two": int((late_s > 2.0 * TICK_PERIOD_S).sum()),
        "ticks": len(start_s),
        "skipped": int(np.maximum(np.rint(np.diff(start_s) / TICK_PERIOD_S) - 1.0, 0.0).sum()),
    }


def _latencies(log: HoverLog) -> Figures:
    timing = log.timing
    cycle = timing.bus_cycle_s
    return {
        "setpoint_ms": asdict(Latency.of(timing.mocap_to_setpoint_s)),
        "start_to_setpoint_ms": asdict(Latency.of(log.start_to_setpoint_s)),
        "core_ms": asdict(Latency.of(timing.core_s)),
        "bus_cycle_ms": asdict(Latency.of(cycle)) if len(cycle) else None,
        "read_to_write_ms": asdict(Latency.of(timing.joint_read_to_write_s)),
    }


def _bare(folder: Path) -> Figures:
    """Return the bare loop's figures, or the reason why there are none."""
    try:
        found: Figures = json.loads((folder / "bare.json").read_text(encoding="utf-8"))
    except (OSError, ValueError):
        said = (folder / "bare.txt").read_text(encoding="utf-8", errors="replace").strip().splitlines()
        return {"not_measured": said[-1] if said else "it had not ended at the end of the flight"}
    return found


def _of_process(sampled: _Sampled, begin_s: float, end_s: float) -> Figures | None:
    """Return the usage over the hover, or None if it was too short."""
    kept = [(t, used) for t, used in zip(sampled.t_s, sampled.used, strict=True) if begin_s <= t <= end_s]
    if len(kept) < 3:
        return None
    (first_s, first), (last_s, last) = kept[0], kept[-1]
    seconds = [100.0 * (after.cpu_s - before.cpu_s) / (t - s) for (s, before), (t, after) in pairwise(kept)]
    span_s = last_s - first_s
    return {
        "cpu_percent": 100.0 * (last.cpu_s - first.cpu_s) / span_s,
        "cpu_percent_worst": max(seconds),
        "rss_mb": max(used.rss_mb for _, used in kept),
        "minor_faults_s": (last.minor_faults - first.minor_faults) / span_s,
    }


def of_threads(rows: Sequence[Threads]) -> Figures | None:
    """Return user and system time of each thread between the first and the last row, % of one core; None if there are too few."""
    if len(rows) < 2:
        return None
    (first_s, first), (last_s, last) = rows[0], rows[-1]
    return {
        name: {
            kind: 100.0 * (after - before) / (last_s - first_s)
            for kind, after, before in zip(("user", "system"), last[name], first.get(name, (0.0, 0.0)), strict=True)
        }
        for name in last
    }


def _machine(rows: Sequence[tuple[float, ...]]) -> Figures | None:
    if len(rows) < 2:
        return None
    total, idle, stolen = (last - first for first, last in zip(rows[0][1:], rows[-1][1:], strict=True))
    return {"busy_percent": 100.0 * (1.0 - idle / total), "stolen_percent": 100.0 * stolen / total}
