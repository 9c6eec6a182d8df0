"""`companion fly` after its arguments are parsed: run the flight, display it, write summary and report."""

from __future__ import annotations

import math
from pathlib import Path
from typing import Any

from rich.console import Console

from companion.analysis.contact import PROBE, contact_lines, write_probe
from companion.analysis.log import FlightLog, LogError
from companion.analysis.proposal import PROPOSAL, write_proposal
from companion.analysis.summary import summarise, write_summary
from companion.launcher.launcher import FlightResult, Launcher, Sitl
from companion.launcher.reports import LAND_SIGNALS
from companion.model.types import Outcome
from companion.runtime.console import FlightDisplay, print_error, print_result
from companion.runtime.subprocesses import LaunchError, signals_call
from companion.sitl_config.loader import SitlConfig

TICKS_MAX = 60_000
"""Maximum number of ticks that are evaluated. A flight of more than 5 minutes is thinned, because one hour at 200 Hz would need 6
GB of memory.
"""


def run_flight(
    config: SitlConfig,
    out: Path,
    *,
    sitl: Sitl | None,
    console: Console,
    report: bool = True,
    speed: float | None = None,
) -> int:
    """Run a flight, write its summary and, if requested, its report; return the exit code.

    Args:
        sitl: as for `Launcher`.
        speed: as for `Launcher`.
    """
    where = config.vehicle.name if sitl is None else "SITL" if sitl == "stub" else "a real PX4 in SITL"
    title = f"{config.mission.name}: {config.controller.law} ({config.controller.preset}) on {where}"
    display = FlightDisplay(console, title)

    launcher = Launcher(config, out, sitl=sitl, on_message=display.on_message, speed=speed)
    # A second Ctrl-C after the end of a short flight must not lose the summary.
    with signals_call(LAND_SIGNALS, launcher.request_landing):
        with display:
            try:
                result = launcher.run()
            except LaunchError as error:
                result = FlightResult(Outcome.REFUSED, lines=(str(error),))
        for line in result.lines:
            print_error(line)
        try:
            log, summary = summary_of(config, result, out, speed)
        except OSError as error:
            print_error(f"{out}: summary.json cannot be written: {error.strerror}")
            return result.exit_code
    page = None
    if log is not None and report:
        try:
            with console.status("writing the report"):
                page = report_of(log, summary, out)
        except KeyboardInterrupt:
            print_error(f"report cancelled; write it with: companion report {out / 'flight.mcap'}")
        except OSError as error:
            print_error(f"{out}: the report cannot be written: {error.strerror}")
    print_result(console, summary, out, page, contact_lines(summary), catches=config.mission.catch is not None)
    if (out / PROPOSAL).exists():
        text = f"gains as optimised in flight: {out / PROPOSAL}; fly them with --controller {out / PROPOSAL}"
        console.print(text, highlight=False, markup=False, soft_wrap=True)
    return result.exit_code


def summary_of(
    config: SitlConfig, result: FlightResult, out: Path, speed: float | None
) -> tuple[FlightLog | None, dict[str, Any]]:
    """Read the log if it exists, write summary.json, and return both.

    Raises:
        OSError: the file cannot be written.
    """
    log = None
    path = out / "flight.mcap"
    if path.exists():
        try:
            log = FlightLog.read(path, ticks_max=TICKS_MAX)
        except LogError as error:
            print_error(error)
    summary = summarise(
        log,
        outcome=result.outcome.value,
        controller=config.controller.law,
        preset=config.controller.preset,
        payload_kg=result.world.get("payload_kg"),
        recorder=result.recorder,
    )
    summary["clock"] |= {"pace": result.pace, "speed": speed if speed is None or math.isfinite(speed) else "max"}
    summary["autopilot"] = autopilot_of(log, result.world)
    knobs = result.world.get("knobs")
    summary["world"] = knobs and {
        "name": config.laboratory.name,
        "drawn": config.laboratory.drawn(config.world),
        **knobs,
        "contact": result.world.get("contact"),
    }
    if summary["intercept"] is not None:
        summary["intercept"]["miss_m"] = result.world.get("miss_m")
    logged = {event["id"] for event in summary["events"]}
    summary["events"] += [event for event in result.events if event["id"] not in logged]
    summary["events"] += result.guardian_events
    write_summary(summary, out / "summary.json")
    if log is not None:
        write_probe(log, out / PROBE)
        write_proposal(log, out / PROPOSAL)
    return log, summary


def autopilot_of(log: FlightLog | None, world: dict[str, Any]) -> dict[str, Any]:
    """Return the autopilot's kind (stub or px4), version and the world's report about it; on hardware, PX4's own version."""
    firmware = None if log is None else log.metadata.get("autopilot", {}).get("firmware")
    return {"kind": "px4", "version": firmware, "firmware": firmware, **world.get("autopilot", {})}


def report_of(log: FlightLog, summary: dict[str, Any], out: Path) -> Path | None:
    """Write report.html with its plots and return its path; None without matplotlib, which a flight does not need."""
    try:
        from companion.analysis.report import write_report
    except ImportError:
        return None
    return write_report(log, summary, out)
