"""`companion fly` from the launcher's side: run it, show it, write down what came of it."""

from __future__ import annotations

import json
import sys
from pathlib import Path
from typing import Any

from rich.console import Console

from companion.analysis.log import FlightLog, LogError
from companion.analysis.summary import empty_summary, summarise, write_summary
from companion.config.loader import FlightConfig
from companion.exit_codes import EXIT_REFUSED
from companion.launcher import FlightResult, Launcher, LaunchError
from companion.terminal import FlightDisplay, print_result
from companion.types import Outcome


def run_flight(config: FlightConfig, out: Path, *, sitl: bool, console: Console) -> int:
    """Fly, then write summary and report; returns the exit code."""
    where = "SITL" if sitl else config.vehicle.name
    title = f"{config.mission.name}: {config.controller.law} ({config.controller.preset}) on {where}"
    with FlightDisplay(console, title) as display:
        launcher = Launcher(config, out, sitl=sitl, on_message=display.on_message)
        try:
            result = launcher.run()
        except LaunchError as error:
            print(error, file=sys.stderr)
            return EXIT_REFUSED
    for line in result.refusal:
        print(line, file=sys.stderr)
    summary, report = _results(config, result, out, console)
    print_result(console, summary, out, report)
    return result.exit_code


def _results(
    config: FlightConfig, result: FlightResult, out: Path, console: Console
) -> tuple[dict[str, Any], Path | None]:
    log = None
    path = out / "flight.mcap"
    if path.exists():
        try:
            log = FlightLog.read(path)
        except LogError as error:
            print(error, file=sys.stderr)
    about: dict[str, Any] = {
        "outcome": result.outcome.value,
        "controller": config.controller.law,
        "preset": config.controller.preset,
        "payload_kg": result.world.get("payload_kg"),
        "recorder": result.recorder,
    }
    summary = summarise(log, **about) if log is not None else empty_summary(**about)
    write_summary(summary, out / "summary.json")
    if log is None:
        return summary, None
    with console.status("writing the report"):
        return summary, report_of(log, summary, out)


def report_of(log: FlightLog, summary: dict[str, Any], out: Path) -> Path | None:
    """report.html with its plots; None without matplotlib, which a flight does not need."""
    try:
        from companion.analysis.report import write_report
    except ImportError:
        return None
    return write_report(log, summary, out)


def report_again(path: Path, out: Path) -> Path | None:
    """`companion report`: summary and report of a log; what only the flight knew is taken from the summary beside the log.

    Raises:
        LogError: the file is no log.
    """
    log = FlightLog.read(path)
    before = path.parent / "summary.json"
    known = json.loads(before.read_text(encoding="utf-8")) if before.exists() else {}
    recorded = [outputs.outcome for outputs in log.outputs if outputs.outcome is not None]
    summary = summarise(
        log,
        outcome=known.get("outcome") or (recorded or [Outcome.LOST])[-1].value,
        controller=log.config["controller"]["law"],
        preset=log.config["controller"]["preset"],
        payload_kg=known.get("payload_kg"),
        recorder=known.get("recorder"),
    )
    out.mkdir(parents=True, exist_ok=True)
    write_summary(summary, out / "summary.json")
    return report_of(log, summary, out)
