"""Kills and hangs the flight process at the catch, over real wires, and measures how the guardian lands the vehicle.

    python -m benchmarks.guardian --repeat 5            # all four kinds, 20 flights, some 12 minutes
    python -m benchmarks.guardian --kind hold_gil --json table.json

The limits are those of docs/safety-guardian.md. Exit code 0 only if every flight kept all of them.
"""

from __future__ import annotations

import argparse
import json
import sys
import tempfile
import time
from pathlib import Path
from typing import Any

from rich.console import Console

from benchmarks.report import number, print_table, write_json
from companion.analysis.log import FlightLog
from companion.launcher.launcher import Launcher, landing_signals
from companion.sitl_config.loader import load_sitl
from sitl.faults.processes import SIGNALS

MISSION = Path(__file__).parents[1] / "configs/missions/catch.yaml"
LIMITS = {"last_setpoint_s": 0.15, "vision_back_s": 0.5, "land_s": 1.0, "drift_m": 0.5}
LOG_END_S = 0.3
"""Longest time from the end of the log to the takeover."""


REPORTED = ("last_setpoint_s", "vision_gap_s", "vision_back_s", "land_s", "disarmed_s", "drift_m", "worst_tilt_deg")
"""Figures of the world's report; times in s since the fault, on the world's clock, or None if it never happened."""

Row = dict[str, Any]


def fly(kind: str, seed: int, after_catch_s: float, folder: Path) -> Row:
    """Fly once with one fault."""
    fault = json.dumps([{"kind": kind, "after": "catch", "t_s": after_catch_s}])
    config = load_sitl(MISSION, overrides=[f"world.faults={fault}", f"world.seed={seed}"])
    folder.mkdir(parents=True)
    launcher = Launcher(config, folder, sitl=True, on_message=lambda message: None)
    with landing_signals(launcher.request_landing):
        result = launcher.run()
    report = result.world.get("flight_fault") or {}
    log = FlightLog.read(folder / "flight.mcap")
    events = {event["id"]: event for event in result.guardian_events}
    took_over = events.get("guardian_took_over")
    whole = (
        log.closed
        and log.missing_ticks() == 0
        and took_over is not None
        and took_over["t_s"] - log.outputs[-1].t_s < LOG_END_S
    )
    row: Row = {
        "kind": kind,
        "seed": seed,
        "outcome": result.outcome.value,
        "caught": bool(result.world.get("caught")),
        **{key: report.get(key) for key in REPORTED},
        "log_whole": whole,
    }
    return {**row, "problems": problems_of(row)}


def problems_of(row: Row) -> list[str]:
    """Return the limits that the flight did not keep."""
    found = []
    if row["outcome"] != "aborted":
        found.append(f"outcome {row['outcome']}")
    if not row["caught"]:
        found.append("nothing was caught")
    for key, limit in LIMITS.items():
        if row[key] is None or row[key] > limit:
            found.append(f"{key} {'never' if row[key] is None else row[key]} (limit {limit})")
    if row["disarmed_s"] is None:
        found.append("not disarmed")
    if not row["log_whole"]:
        found.append("the log is incomplete")
    return found


def cells(row: Row) -> dict[str, str]:
    """Return the row of the table."""
    digits = {"disarmed_s": 1, "drift_m": 2, "worst_tilt_deg": 0}
    return {
        "fault": row["kind"],
        "seed": str(row["seed"]),
        "outcome": row["outcome"],
        **{key.replace("_", " "): number(row[key], digits.get(key, 3)) for key in REPORTED if key != "vision_back_s"},
        "log": "complete" if row["log_whole"] else "incomplete",
    }


def main(argv: list[str] | None = None) -> int:
    parser = argparse.ArgumentParser(description=(__doc__ or "").partition("\n")[0])
    parser.add_argument("--kind", choices=list(SIGNALS), action="append", help="default: all")
    parser.add_argument("--repeat", type=int, default=1, help="flights of each kind")
    parser.add_argument(
        "--after-catch-s", type=float, default=0.05, help="of the first flight; 0.1 s later in each further one"
    )
    parser.add_argument("--json", type=Path, help="write the rows here as well")
    parser.add_argument("--keep", type=Path, help="keep the flights' folders in here")
    arguments = parser.parse_args(argv)
    console = Console(width=150)
    rows: list[Row] = []
    with tempfile.TemporaryDirectory() as scratch:
        folder = arguments.keep or Path(scratch)
        for i in range(arguments.repeat):
            for kind in arguments.kind or SIGNALS:
                begun_s = time.monotonic()
                row = fly(kind, i + 1, arguments.after_catch_s + 0.1 * i, folder / f"{kind}-{i + 1}")
                rows.append(row)
                verdict = "; ".join(row["problems"]) or "ok"
                console.print(f"{kind} {i + 1}: {verdict} ({time.monotonic() - begun_s:.0f} s)", highlight=False)
    failed = [index for index, row in enumerate(rows) if row["problems"]]
    print_table("the flight process at the catch; s since the fault", list(map(cells, rows)), console, failed)
    good = len(rows) - len(failed)
    console.print(f"{good} of {len(rows)} kept every limit")
    write_json(arguments.json, rows)
    return 0 if good == len(rows) else 1


if __name__ == "__main__":
    sys.exit(main())
