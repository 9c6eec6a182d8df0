"""Flies the same flights on the stub and on a real PX4 (SITL) and tabulates the differences.

    PX4_SITL=.../build/px4_sitl_default python -m benchmarks.px4 --keep flights/px4           # 48 flights, 40 minutes
    PX4_SITL=.../build/px4_sitl_default python -m benchmarks.px4 --keep flights/paths --path offboard --path direct --case catch-0.2kg
    python -m benchmarks.px4 --keep flights/px4 --table                                       # only flights in the folder
    python -m benchmarks.px4 --keep flights/lab --world lab --case catch-0.1kg --case catch-0.2kg --case catch-0.3kg

Flights in the folder are not flown again. Times after a fault are on the autopilot's own clock: from the ULog of a real PX4 (needs
pyulog), from the world for the stub. Exit code 0: every flight ended as expected; 1: a flight did not, or could not be flown.
"""

from __future__ import annotations

import argparse
import contextlib
import json
import math
import statistics
import subprocess
import sys
import time
from collections.abc import Callable, Sequence
from dataclasses import asdict, dataclass
from itertools import groupby, pairwise, product
from pathlib import Path
from typing import Any

from benchmarks.measuring.hovering import LIMITS
from benchmarks.px4_log import Px4Log, newest
from benchmarks.report import write_json
from benchmarks.soaking.processes import family, usage
from companion.analysis.log import FlightLog, LogError
from companion.campaigns.faults.sitl_flights import WITNESS
from sitl.px4.hil_link import Px4Error
from tests.support import set_options

ROOT = Path(__file__).parents[1]
MISSION = ROOT / "configs/missions/catch.yaml"
AUTOPILOTS = ("stub", "px4")
PATHS = ("offboard", "direct")
"""Values of `devices.autopilot.setpoint_path`."""
TIMEOUT_S = 300.0
CPU_PERIOD_S = 1.0
CPU = "flight_cpu.json"
"""File in the flight's folder: CPU time of the flight process in each second, % of a core."""
IN_THE_AIR = slice(-20, -2)
"""Seconds before the end of a flight, of which none is spent on the ground in a completed catch."""
LIKE_THE_STUB = 0.25
"""Largest relative difference of the position error after the catch."""


@dataclass(frozen=True, slots=True)
class Case:
    """A flight with its expected outcome."""

    name: str
    overrides: tuple[str, ...]
    outcome: str
    fault: bool


def _fault(name: str, fault: dict[str, Any]) -> Case:
    return Case(name, (f"world.faults={json.dumps([fault])}",), "aborted", fault=True)


CASES = (
    *(Case(f"catch-{kg:g}kg", (f"world.payload_kg={kg:g}",), "completed", fault=False) for kg in (0.1, 0.2, 0.3)),
    *(
        _fault(kind, {"kind": kind, "after": "catch", "t_s": 0.1})
        for kind in ("kill_flight", "stop_flight", "hold_gil")
    ),
    _fault("stall_loop", {"kind": "stall_loop", "after": "catch", "t_s": 0.1, "duration_s": 5.0}),
    _fault("mocap_loss", {"kind": "mocap_loss", "after": "catch", "t_s": 0.1, "duration_s": 2.0}),
)


@dataclass(frozen=True, slots=True)
class Row:
    """One flight. Times `*_s` of faults count from the fault; None means unknown or never."""

    case: str
    autopilot: str
    path: str | None
    """Setpoint path; None for the vehicle file's."""
    version: str | None
    run: int
    outcome: str
    as_it_must: bool
    e_p_before_m: float | None
    """RMS position error before the catch."""
    e_p_m: float | None
    """RMS position error after the catch."""
    e_q_deg: float | None
    e_alpha_deg: float | None
    latency_p50_ms: float | None
    """Latency from motion capture to setpoint, median."""
    latency_p99_ms: float | None
    cpu_percent: float | None
    """CPU of the flight process, % of a core, median of the seconds in the air."""
    modes: str
    last_setpoint_s: float | None = None
    vision_gap_s: float | None = None
    mode: str | None = None
    """First mode after OFFBOARD."""
    mode_s: float | None = None
    failsafe_s: float | None = None
    disarmed_s: float | None = None
    drift_m: float | None = None
    """Horizontal distance from the position at the fault to the final position."""
    worst_tilt_deg: float | None = None


def fly(case: Case, world: str, autopilot: str, path: str | None, run: int, folder: Path) -> None:
    """Fly once, unless the folder holds the flight already."""
    if (folder / "summary.json").exists():
        return
    command = [
        sys.executable,
        "-m",
        "companion",
        "fly",
        str(MISSION),
        f"--sitl={autopilot}",
        "--real-time",
        "--out",
        str(folder),
    ]
    command += ["--world", world, "--seed", str(run), "--set", *case.overrides]
    if path is not None:
        command.append(f"vehicle.devices.autopilot.setpoint_path={path}")
    if not case.fault:
        command += set_options(**LIMITS)
    folder.parent.mkdir(parents=True, exist_ok=True)
    with (
        open(folder.with_name(f"{folder.name}.txt"), "wb") as output,
        subprocess.Popen(command, stdout=output, stderr=subprocess.STDOUT) as process,
    ):
        try:
            percents = _watch(process)
        except BaseException:
            process.terminate()
            raise
    if folder.is_dir():
        (folder / CPU).write_text(json.dumps(percents), encoding="utf-8")


def _watch(process: subprocess.Popen[bytes]) -> list[float]:
    """Wait for the end of the flight and return the CPU of its flight process in each second, % of a core.

    Raises:
        TimeoutExpired: the flight takes too long.
    """
    begun_s = time.monotonic()
    used: list[tuple[float, float]] = []
    while process.poll() is None:
        now_s = time.monotonic()
        if now_s - begun_s > TIMEOUT_S:
            raise subprocess.TimeoutExpired(process.args, TIMEOUT_S)
        pid = family(process.pid).get("flight")
        if pid is not None and (present := usage(pid)) is not None:
            used.append((now_s, present.cpu_s))
        with contextlib.suppress(subprocess.TimeoutExpired):
            process.wait(CPU_PERIOD_S)
    return [100.0 * (after - before) / (t - s) for (s, before), (t, after) in pairwise(used)]


def row_of(case: Case, autopilot: str, path: str | None, run: int, folder: Path) -> Row | None:
    """Read a flight's folder; return None if it was not flown."""
    if not (folder / "summary.json").exists():
        return None
    summary = json.loads((folder / "summary.json").read_text(encoding="utf-8"))
    before, post = summary["rms"]["pre"], summary["rms"]["post"]
    latency = summary["latency_ms"]["mocap_to_setpoint"]
    known: dict[str, Any] = {
        "case": case.name, "autopilot": autopilot, "path": path, "version": summary["autopilot"]["version"], "run": run,
        "outcome": summary["outcome"], "as_it_must": summary["outcome"] == case.outcome,
        "e_p_before_m": before["e_p_m"], "e_p_m": post["e_p_m"], "e_q_deg": post["e_q_deg"], "e_alpha_deg": post["e_alpha_deg"],
        "latency_p50_ms": latency["p50"], "latency_p99_ms": latency["p99"], "modes": "",
        "cpu_percent": _cpu_percent(folder),
    }  # fmt: skip
    witness = json.loads((folder / WITNESS).read_text(encoding="utf-8")) if (folder / WITNESS).exists() else None
    if case.fault and (witness is None or witness["fault_begun_s"] is None):
        known["as_it_must"] = False  # it ended before the fault
    if case.fault and witness is not None and witness["course"]:
        known |= _course_of(witness["course"])
    if autopilot == "px4":
        log = Px4Log.read(newest(folder), summary["autopilot"].get("clock_begun_s", 0.0))
        known["modes"] = log.modes()
        if case.fault and witness is not None and witness["fault_begun_s"] is not None:
            known |= asdict(log.after(witness["fault_begun_s"]))
    else:
        known["modes"] = _modes_of(folder)
        if case.fault and witness is not None and witness["fault_begun_s"] is not None:
            known |= _after_fault_of_the_stub(witness)
    return Row(**known)


def _cpu_percent(folder: Path) -> float | None:
    if not (folder / CPU).exists():
        return None
    percents = json.loads((folder / CPU).read_text(encoding="utf-8"))[IN_THE_AIR]
    return statistics.median(percents) if percents else None


def _course_of(course: list[Any]) -> dict[str, Any]:
    """Return drift and tilt from the world's true course (`sitl.faults.injector.Sample`)."""
    (_, begin_m, *_), (_, end_m, *_) = course[0], course[-1]
    tilts_rad = [tilt_rad for _, _, tilt_rad, *_ in course]
    return {"drift_m": math.dist(begin_m[:2], end_m[:2]), "worst_tilt_deg": math.degrees(max(tilts_rad))}


def _modes_of(folder: Path) -> str:
    """Return the modes that the companion received while armed."""
    try:
        statuses = [inputs.status for inputs in FlightLog.read(folder / "flight.mcap").inputs]
    except LogError:
        return ""
    flown = [status.mode.name for status in statuses if status is not None and status.armed]
    return ", ".join(mode for mode, _ in groupby(flown))


def _after_fault_of_the_stub(witness: dict[str, Any]) -> dict[str, Any]:
    fault_s, report = witness["fault_begun_s"], witness.get("flight_fault") or {}
    later = [(t_s - fault_s, mode, armed) for t_s, mode, armed in witness["modes"] if t_s > fault_s]
    left = next(((t_s, mode) for t_s, mode, _ in later if mode != "OFFBOARD"), (None, None))
    return {
        "last_setpoint_s": report.get("last_setpoint_s"),
        "vision_gap_s": report.get("vision_gap_s"),
        "mode": left[1],
        "mode_s": left[0],
        "disarmed_s": next((t_s for t_s, _, armed in later if not armed), None),
    }


Cell = Callable[[Sequence[Row]], str]


def _count(rows: Sequence[Row]) -> str:
    return f"{sum(row.as_it_must for row in rows)} of {len(rows)}"


def _spread_of(key: str, digits: int, scale: float = 1.0) -> Cell:
    return lambda rows: _spread([getattr(row, key) for row in rows], scale, digits)


FLIGHT_COLUMNS: dict[str, Cell] = {
    "ended as it must": _count,
    "e_p before the catch, mm": _spread_of("e_p_before_m", 1, 1e3),
    "after it, mm": _spread_of("e_p_m", 1, 1e3),
    "e_q, deg": _spread_of("e_q_deg", 2),
    "arm error, deg": _spread_of("e_alpha_deg", 2),
    "mocap to setpoint, ms: p50": _spread_of("latency_p50_ms", 1),
    "p99": _spread_of("latency_p99_ms", 1),
    "CPU, %": _spread_of("cpu_percent", 0),
    "modes": lambda rows: " / ".join(sorted({row.modes for row in rows})),
}
FAULT_COLUMNS: dict[str, Cell] = {
    "ended as it must": _count,
    "last setpoint, s": _spread_of("last_setpoint_s", 3),
    "longest gap in vision, s": _spread_of("vision_gap_s", 3),
    "next mode": lambda rows: " / ".join(sorted({row.mode or "-" for row in rows})),
    "after, s": _spread_of("mode_s", 3),
    "PX4's own failsafe, s": _spread_of("failsafe_s", 2),
    "disarmed, s": _spread_of("disarmed_s", 1),
    "drift, m": _spread_of("drift_m", 2),
    "largest tilt, deg": _spread_of("worst_tilt_deg", 0),
}


def markdown(rows: Sequence[Row]) -> str:
    """Return two tables for docs/internals/px4.md, flights without and with a fault, with the spread over the runs."""
    versions = sorted({row.version or "?" for row in rows if row.autopilot == "px4"})
    lines = [f"PX4 {' and '.join(versions)}; each cell: smallest to largest of the runs."]
    for fault, columns in ((False, FLIGHT_COLUMNS), (True, FAULT_COLUMNS)):
        lines += ["", f"| {' | '.join(('fault' if fault else 'flight', 'autopilot', 'path', *columns))} |"]
        lines.append("|---" * (len(columns) + 3) + "|")
        for case, autopilot, path in product(CASES, AUTOPILOTS, (None, *PATHS)):
            some = [row for row in rows if (row.case, row.autopilot, row.path) == (case.name, autopilot, path)]
            if some and case.fault is fault:
                cells = (case.name, autopilot, path or "-", *(cell(some) for cell in columns.values()))
                lines.append(f"| {' | '.join(cells)} |")
    lines += _offboard_to_direct(rows)
    return "\n".join(lines) + "\n"


def _offboard_to_direct(rows: Sequence[Row]) -> list[str]:
    """Return a table of the ratios of pairs of completed flights that differ in the setpoint path only; nothing without a pair."""
    keys = {"mocap to setpoint: p50": "latency_p50_ms", "p99": "latency_p99_ms", "CPU": "cpu_percent"}
    flown = [row for row in rows if row.outcome == "completed" and row.cpu_percent is not None]
    lines = []
    for autopilot in AUTOPILOTS:
        pairs = [
            (row, other)
            for row, other in product(flown, flown)
            if (row.path, row.autopilot, other.path, other.autopilot) == (PATHS[0], autopilot, PATHS[1], autopilot)
            and (row.case, row.run) == (other.case, other.run)
        ]
        if pairs:
            found = [[getattr(row, key) / getattr(other, key) for row, other in pairs] for key in keys.values()]
            cells = [f"{statistics.median(ratios):.2f} ({min(ratios):.2f} to {max(ratios):.2f})" for ratios in found]
            lines.append(f"| {' | '.join((autopilot, str(len(pairs)), *cells))} |")
    if not lines:
        return []
    head = f"| {' | '.join(('offboard / direct', 'pairs', *keys))} |"
    return ["", head, "|---" * (len(keys) + 2) + "|", *lines]


def _spread(values: Sequence[float | None], scale: float, digits: int) -> str:
    known = [value * scale for value in values if value is not None]
    if not known:
        return "-"
    low, high = f"{min(known):.{digits}f}", f"{max(known):.{digits}f}"
    return low if low == high else f"{low} to {high}"


def verdicts(rows: Sequence[Row]) -> list[str]:
    """Return one line for each flight or figure that is not as expected."""
    found = [f"{row.case} on the {row.autopilot}, run {row.run}: {row.outcome}" for row in rows if not row.as_it_must]
    for case in CASES:
        errors = {
            autopilot: [row.e_p_m for row in rows if (row.case, row.autopilot) == (case.name, autopilot) and row.e_p_m]
            for autopilot in AUTOPILOTS
        }
        if not case.fault and all(errors.values()):
            stub, real = (statistics.mean(errors[autopilot]) for autopilot in AUTOPILOTS)
            if abs(real / stub - 1.0) > LIKE_THE_STUB:
                found.append(f"{case.name}: e_p after the catch {1e3 * real:.1f} mm, on the stub {1e3 * stub:.1f} mm")
    return found


def main(argv: list[str] | None = None) -> int:
    parser = argparse.ArgumentParser(description=(__doc__ or "").partition("\n")[0])
    parser.add_argument("--keep", type=Path, required=True, metavar="DIR", help="folder of the flights")
    parser.add_argument("--case", choices=[case.name for case in CASES], action="append", help="default: all")
    parser.add_argument("--autopilot", choices=AUTOPILOTS, action="append", help="default: both")
    parser.add_argument("--path", choices=PATHS, action="append", help="setpoint path (default: the vehicle file's)")
    parser.add_argument("--repeat", type=int, default=3, help="flights of each case, seeds 1 to N")
    parser.add_argument("--world", default="ideal", metavar="lab|ideal|FILE", help="default: %(default)s")
    parser.add_argument("--table", action="store_true", help="fly nothing")
    parser.add_argument("--json", type=Path, help="write the rows here as well")
    arguments = parser.parse_args(argv)
    rows: list[Row] = []
    failed = False
    cases = [case for case in CASES if arguments.case is None or case.name in arguments.case]
    paths = arguments.path or (None,)
    for run in range(1, arguments.repeat + 1):
        turn = paths if run % 2 else paths[::-1]
        for case, autopilot, path in product(cases, arguments.autopilot or AUTOPILOTS, turn):
            folder = arguments.keep / "-".join((case.name, autopilot, *([path] if path else []), str(run)))
            try:
                if not arguments.table:
                    fly(case, arguments.world, autopilot, path, run, folder)
                row = row_of(case, autopilot, path, run, folder)
            except (Px4Error, subprocess.TimeoutExpired) as error:
                print(f"{folder}: {error}", file=sys.stderr)
                failed = True
                continue
            if row is not None:
                rows.append(row)
                if not arguments.table:
                    print(f"{folder.name}: {row.outcome}", file=sys.stderr, flush=True)
    print(markdown(rows))
    problems = verdicts(rows)
    for problem in problems:
        print(problem, file=sys.stderr)
    write_json(arguments.json, [asdict(row) for row in rows])
    return 1 if problems or failed else 0


if __name__ == "__main__":
    sys.exit(main())
