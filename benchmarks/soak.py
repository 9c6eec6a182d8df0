"""Flies for an hour over real wires, and checks that memory and lateness do not grow and that no tick or catch is missed.

    python -m benchmarks.soak                             # 60 minutes: configs/missions/soak.yaml, 150 catches
    python -m benchmarks.soak --minutes 3 --json FILE --plot FILE.png
    python -m benchmarks.soak --read DIR                  # evaluate an earlier flight again

Exit code 0 only if the mission was completed, every throw was caught, no tick was missed, and neither memory nor lateness grew.
"""

from __future__ import annotations

import argparse
import json
import os
import re
import signal
import subprocess
import sys
import time
from collections.abc import Sequence
from dataclasses import asdict
from pathlib import Path
from typing import Any

import numpy as np
from rich.console import Console

from benchmarks.report import write_json
from benchmarks.soaking.lateness import Minute, Ticks, ticks_of_log
from benchmarks.soaking.processes import family, pss_mb, usage
from benchmarks.soaking.verdict import (
    MEMORY_GROWTH_MAX,
    Growth,
    Sample,
    airborne,
    draw,
    lateness_problems,
    memory_growth,
    print_tables,
)
from companion.config.loader import load_flight
from companion.mission.plan import Plan

MISSION = Path(__file__).parents[1] / "configs/missions/soak.yaml"
SAMPLE_S = 1.0
EMPTY_LOOP = "empty_loop.npy"
PSS_EVERY = 10
"""Samples between two readings of PSS, for which the kernel walks all pages and may delay the process."""
BATTERY_MARGIN = 5.0
"""Battery life as a multiple of the flight, so that the battery does not end it."""
START_S, END_S = 60.0, 900.0
"""Time for starting the flight, and for grading its long log."""
_HEARD = re.compile(r"heard (\d+) (?:heart)?beats, (\d+) missed, silent for (\d+) ms")


def repetitions(minutes: float) -> tuple[int, float]:
    """Return the number of repetitions of the mission that fit into the time, at least 2, and their planned duration, s."""
    once, twice = (_planned_s(count) for count in (1, 2))
    count = max(2, min(1000, 1 + int((60.0 * minutes - once) / (twice - once))))
    return count, _planned_s(count)


def _planned_s(count: int) -> float:
    config = load_flight(MISSION, overrides=[f"mission.repeat={count}"])
    return Plan.build(config.mission, config.vehicle).duration_s


def fly(minutes: float, overrides: Sequence[str], folder: Path, console: Console) -> int:
    """Fly the soak flight, write its samples and logs to the folder, and return its exit code."""
    count, planned_s = repetitions(minutes)
    folder.mkdir(parents=True)
    settings = [
        f"mission.repeat={count}",
        f"world.throws={count}",
        f"world.battery_life_s={BATTERY_MARGIN * planned_s:.0f}",
        *overrides,
    ]
    command = [
        *(sys.executable, "-m", "companion", "fly", str(MISSION), "--sitl", "--real-time", "--world", "ideal"),
        *("--out", str(folder / "flight"), "--set", *settings),
    ]
    console.print(f"{count} repetitions, {planned_s / 60.0:.1f} minutes; {folder}", highlight=False, soft_wrap=True)
    empty_command = [sys.executable, "-m", "benchmarks.measuring.beside", "empty", str(folder / EMPTY_LOOP)]
    with (folder / "fly.txt").open("wb") as out, (folder / "samples.jsonl").open("w") as samples:
        empty = subprocess.Popen(empty_command)
        flight = subprocess.Popen(command, stdout=out, stderr=out, env={**os.environ, "PYTHONUNBUFFERED": "1"})
        try:
            _watch(flight, empty, planned_s, samples, console)
        finally:
            _end(empty)
            if flight.poll() is None:
                flight.send_signal(signal.SIGINT)  # it lands
                flight.wait(END_S)
    return flight.returncode


def _watch(
    flight: subprocess.Popen[bytes],
    empty: subprocess.Popen[bytes],
    planned_s: float,
    samples: Any,
    console: Console,
) -> None:
    """Write memory and CPU time once a second until the flight has ended and its log is graded."""
    begun_s = next_s = time.monotonic()
    number = 0
    pids: dict[str, int] = {}
    while flight.poll() is None:
        now_s = time.monotonic()
        if now_s - begun_s > planned_s + START_S + END_S:
            raise SystemExit(
                f"soak: the flight has not ended {START_S + END_S:.0f} s after its planned time; it lands now"
            )
        flew = "flight" in pids
        if len(pids) < 5 or number % 10 == 0:
            pids = family(flight.pid)
        if flew and "flight" not in pids:
            _end(empty)  # the flight is over; its log is being graded
        found = {role: used for role, pid in pids.items() if (used := usage(pid)) is not None}
        row: dict[str, Any] = {
            "t_s": now_s - begun_s,
            "rss_mb": {role: used.rss_mb for role, used in found.items()},
            "cpu_s": {role: used.cpu_s for role, used in found.items()},
            "pss_mb": {},
        }
        if number % PSS_EVERY == 0:
            row["pss_mb"] = {role: pss for role, pid in pids.items() if (pss := pss_mb(pid)) is not None}
        samples.write(json.dumps(row) + "\n")
        samples.flush()
        number += 1
        if number % 600 == 0:
            console.print(f"  {number // 60} minutes", highlight=False)
        next_s += SAMPLE_S
        time.sleep(max(0.0, next_s - time.monotonic()))


def _end(process: subprocess.Popen[bytes]) -> None:
    if process.poll() is None:
        process.terminate()
        process.wait(30.0)


def judge(folder: Path, console: Console) -> dict[str, Any]:
    """Return every figure of the flight in the folder."""
    flown = folder / "flight"
    samples = [Sample(**json.loads(line)) for line in (folder / "samples.jsonl").read_text().splitlines()]
    summary = json.loads((flown / "summary.json").read_text())
    world = json.loads((flown / "world.json").read_text())
    config = json.loads((flown / "config.json").read_text())
    heard = _HEARD.search((flown / "guardian.log").read_text())
    empty = Ticks.of(*np.load(folder / EMPTY_LOOP))
    with console.status("reading the log"):
        ticks = ticks_of_log(flown / "flight.mcap")
    flew = airborne(samples)
    growth = memory_growth(flew)
    noticed = [event["id"] for event in summary["events"]]
    result: dict[str, Any] = {
        "repetitions": config["mission"]["repeat"],
        "minutes": (flew[-1].t_s - flew[0].t_s) / 60.0 if flew else 0.0,
        "outcome": summary["outcome"],
        "throws": world["throws"],
        "catches": world["catches"],
        "catches_noticed": noticed.count("catch"),
        "left_noticed": noticed.count("payload_left"),
        "warnings": sorted({event["id"] for event in summary["events"] if event["severity"] != "info"}),
        "ticks": ticks.ticks,
        "ticks_missed": ticks.missed,
        "ticks_skipped": ticks.skipped,
        "recorder_dropped": summary["recorder"]["dropped"],
        "log_mb": (flown / "flight.mcap").stat().st_size / 1e6,
        "guardian_heard": int(heard[1]) if heard else None,
        "guardian_missed": int(heard[2]) if heard else None,
        "guardian_silent_ms": int(heard[3]) if heard else None,
        "world_slipped_s": world["slipped_s"],
        "rms": summary["rms"],
        "growth": [asdict(row) for row in growth],
        "lateness": [asdict(minute) for minute in ticks.minutes],
        "empty_loop": asdict(empty),
    }
    return {**result, "problems": problems_of(result, growth, ticks, empty.minutes)}


def problems_of(result: dict[str, Any], growth: Sequence[Growth], ticks: Ticks, empty: Sequence[Minute]) -> list[str]:
    """Return the limits that were not met."""
    found = [] if result["outcome"] == "completed" else [f"outcome {result['outcome']}"]
    for name in ("throws", "catches", "catches_noticed"):
        if result[name] != result["repetitions"]:
            found.append(f"{result[name]} {name.replace('_', ' ')} in {result['repetitions']} repetitions")
    for name in ("guardian_missed", "recorder_dropped"):
        if result[name] != 0:
            found.append(f"{name.replace('_', ' ')}: {result[name]}")
    if not growth:
        found.append("too short to show growth of memory")
    found += [
        f"memory of the {row.role} process grew {row.ratio:.3f} times"
        for row in growth
        if row.ratio > MEMORY_GROWTH_MAX
    ]
    return found + lateness_problems(ticks.minutes, empty)


def show(result: dict[str, Any], folder: Path, plot: Path | None, console: Console) -> None:
    """Print tables and counts, and draw the plot."""
    flight = [Minute(**row) for row in result["lateness"]]
    empty = [Minute(**row) for row in result["empty_loop"]["minutes"]]
    print_tables(console, [Growth(**row) for row in result["growth"]], flight, empty)
    for name in (
        *("repetitions", "minutes", "outcome", "throws", "catches", "catches_noticed", "left_noticed", "warnings"),
        *("ticks", "ticks_missed", "ticks_skipped", "recorder_dropped", "log_mb"),
        *("guardian_heard", "guardian_missed", "guardian_silent_ms", "world_slipped_s"),
    ):
        value = result[name]
        text = f"{value:.1f}" if isinstance(value, float) else str(value)
        console.print(f"  {name.replace('_', ' '):<20} {text}", highlight=False)
    for problem in result["problems"]:
        console.print(f"[red]{problem}[/]", highlight=False)
    if plot is not None:
        samples = [Sample(**json.loads(line)) for line in (folder / "samples.jsonl").read_text().splitlines()]
        draw(samples, flight, empty, plot)


def main(argv: list[str] | None = None) -> int:
    parser = argparse.ArgumentParser(prog="python -m benchmarks.soak", description=(__doc__ or "").partition("\n")[0])
    parser.add_argument("--minutes", type=float, default=60.0, help="time in the air, rounded to whole repetitions")
    parser.add_argument(
        "--set", dest="overrides", action="append", default=[], metavar="KEY=VALUE",
        help="of the flight; e.g. wider time-outs on a machine that is held up as a whole now and then",
    )  # fmt: skip
    parser.add_argument("--out", type=Path, help="folder for log and samples; must not exist")
    parser.add_argument("--read", type=Path, help="evaluate the folder of an earlier run, without a flight")
    parser.add_argument("--json", type=Path, help="write the figures here as well")
    parser.add_argument("--plot", type=Path, help="draw memory and lateness over time as a PNG")
    arguments = parser.parse_args(argv)
    console = Console(width=100)
    folder: Path = arguments.read or arguments.out or Path("flights") / f"{time.strftime('%Y%m%d-%H%M%S')}-soak"
    if arguments.read is None:
        if folder.exists():
            parser.error(f"{folder} exists already; choose another --out")
        code = fly(arguments.minutes, arguments.overrides, folder, console)
        if code != 0:
            console.print(
                f"the flight ended with exit code {code}; see {folder / 'fly.txt'}", highlight=False, soft_wrap=True
            )
    try:
        result = judge(folder, console)
    except OSError as error:
        parser.exit(1, f"soak: {error.filename}: {error.strerror}; the flight left no data to evaluate\n")
    show(result, folder, arguments.plot, console)
    write_json(arguments.json, result)
    return 1 if result["problems"] else 0


if __name__ == "__main__":
    sys.exit(main())
