"""Kill and hang the flight process at the catch, over real wires, and read from the world's clock how the guardian lands the vehicle.

    python benchmarks/guardian.py --repeat 5            # all four kinds, 20 flights, some 12 minutes
    python benchmarks/guardian.py --kind hold_gil --json table.json

The limits are those of docs/safety-guardian.md. Exit code 0 only if every flight kept all of them.
"""

from __future__ import annotations

import argparse
import json
import sys
import tempfile
import time
from collections.abc import Sequence
from dataclasses import asdict, dataclass
from pathlib import Path

from rich.console import Console
from rich.table import Table

from companion.analysis.log import FlightLog
from companion.launcher.launcher import Launcher, landing_signals
from companion.sitl_config.loader import load_sitl
from sitl.faults.processes import SIGNALS

MISSION = Path(__file__).parents[1] / "configs/missions/catch.yaml"
SETPOINTS_STOP_S = 0.15
VISION_BACK_S = 0.5
LAND_S = 1.0
DRIFT_M = 0.5
LOG_END_S = 0.3
"""The log reaches at least so near to the fault."""


@dataclass(frozen=True, slots=True)
class Row:
    """One flight; times in s since the fault, by the world's clock."""

    kind: str
    seed: int
    outcome: str
    caught: bool
    last_setpoint_s: float | None
    vision_gap_s: float | None
    vision_back_s: float | None
    land_s: float | None
    disarmed_s: float | None
    drift_m: float | None
    worst_tilt_deg: float | None
    log_whole: bool
    problems: tuple[str, ...]


def fly(kind: str, seed: int, after_catch_s: float, folder: Path) -> Row:
    """One flight with one fault."""
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
    row = Row(
        kind=kind,
        seed=seed,
        outcome=result.outcome.value,
        caught=bool(result.world.get("caught")),
        last_setpoint_s=report.get("last_setpoint_s"),
        vision_gap_s=report.get("vision_gap_s"),
        vision_back_s=report.get("vision_back_s"),
        land_s=report.get("land_s"),
        disarmed_s=report.get("disarmed_s"),
        drift_m=report.get("drift_m"),
        worst_tilt_deg=report.get("worst_tilt_deg"),
        log_whole=whole,
        problems=(),
    )
    return Row(**{**asdict(row), "problems": tuple(problems_of(row))})


def problems_of(row: Row) -> list[str]:
    """Limits that the flight did not keep."""
    found = []
    if row.outcome != "aborted":
        found.append(f"outcome {row.outcome}")
    if not row.caught:
        found.append("nothing was caught")
    limits = (
        ("last setpoint", row.last_setpoint_s, SETPOINTS_STOP_S),
        ("vision back", row.vision_back_s, VISION_BACK_S),
        ("LAND", row.land_s, LAND_S),
        ("drift", row.drift_m, DRIFT_M),
    )
    found += [
        f"{name} {value if value is not None else 'never'}"
        for name, value, limit in limits
        if value is None or value > limit
    ]
    if row.disarmed_s is None:
        found.append("not disarmed")
    if not row.log_whole:
        found.append("log not whole")
    return found


def table_of(rows: Sequence[Row]) -> Table:
    table = Table(title="the flight process at the catch; s since the fault, by the world's clock")
    names = (
        "fault",
        "seed",
        "outcome",
        "last setpoint",
        "vision gap",
        "LAND",
        "disarmed",
        "drift m",
        "tilt deg",
        "log",
    )
    for name in names:
        table.add_column(name, justify="left" if name in ("fault", "outcome", "log") else "right")

    def number(value: float | None, digits: int = 3) -> str:
        return "-" if value is None else f"{value:.{digits}f}"

    for row in rows:
        table.add_row(
            row.kind,
            str(row.seed),
            row.outcome,
            number(row.last_setpoint_s),
            number(row.vision_gap_s),
            number(row.land_s),
            number(row.disarmed_s, 1),
            number(row.drift_m, 2),
            number(row.worst_tilt_deg, 0),
            "whole" if row.log_whole else "not whole",
            style="red" if row.problems else "",
        )
    return table


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
    console = Console()
    rows: list[Row] = []
    with tempfile.TemporaryDirectory() as scratch:
        folder = arguments.keep or Path(scratch)
        for i in range(arguments.repeat):
            for kind in arguments.kind or SIGNALS:
                begun_s = time.monotonic()
                row = fly(kind, i + 1, arguments.after_catch_s + 0.1 * i, folder / f"{kind}-{i + 1}")
                rows.append(row)
                verdict = "; ".join(row.problems) or "ok"
                console.print(f"{kind} {i + 1}: {verdict} ({time.monotonic() - begun_s:.0f} s)", highlight=False)
    console.print(table_of(rows))
    good = sum(not row.problems for row in rows)
    console.print(f"{good} of {len(rows)} kept every limit")
    if arguments.json is not None:
        arguments.json.write_text(json.dumps([asdict(row) for row in rows], indent=1) + "\n", encoding="utf-8")
    return 0 if good == len(rows) else 1


if __name__ == "__main__":
    sys.exit(main())
