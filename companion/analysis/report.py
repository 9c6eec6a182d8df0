"""report.html: one self-contained file with the result table, plots, events, configuration and versions."""

from __future__ import annotations

import json
from collections.abc import Sequence
from datetime import UTC, datetime
from pathlib import Path
from typing import Any

from companion.analysis.animation import movie_of, player_html
from companion.analysis.contact import contact_lines
from companion.analysis.log import FlightLog
from companion.analysis.page import Page, Section, write_page
from companion.analysis.plots import write_plots
from companion.analysis.summary import effective_config, world_text
from companion.analysis.table import Cell, Column, Table, pairs, table
from companion.model.types import Outcome, SafetyAction


def write_report(log: FlightLog, summary: dict[str, Any], out_dir: Path) -> Path:
    """Write the plots as PNG and report.html into `out_dir`; return the path of report.html."""
    plots = write_plots(log, out_dir)
    config, movie = effective_config(log, summary), movie_of(log, summary)
    catches = summary["catch_t_s"] is not None or (log.config.get("mission") or {}).get("catch") is not None
    payload_kg = summary["payload_kg"] if catches else None
    about = (
        _start(log),
        (log.config.get("vehicle") or {}).get("name", ""),
        f"{summary['controller']}, preset {summary['preset']}",
        "" if payload_kg is None else f"payload {payload_kg:g} kg (known to the simulated world only)",
        world_text(summary.get("world")),
    )
    versions = [
        (name.removeprefix("version_"), value)
        for name, value in sorted(log.metadata.get("companion", {}).items())
        if name.startswith("version_")
    ]
    folded = {"Effective configuration": json.dumps(config, indent=2) if config else ""}
    for name, values in sorted(log.metadata.items()):
        if name not in ("companion", "config"):
            folded[f"Metadata: {name}"] = json.dumps(values, indent=2, sort_keys=True)
    path = out_dir / "report.html"
    page = Page(
        str((log.config.get("mission") or {}).get("name", "flight")),
        " · ".join(text for text in about if text),
        [
            Section("", cards=_results(summary, log.stride, catches)),
            *([Section("Plots", pictures=plots)] if plots else []),
            Section("Events", "" if summary["events"] else "None.", [_events(summary["events"])]),
            Section("Record", tables=[pairs("", versions)], folded=folded),
        ],
        verdict=_why_ended(summary),
        good=False,
        badge=str(summary["outcome"]),
        player_html="" if movie is None else player_html(movie),
        width_rem=62,
    )
    write_page(page, path)
    return path


def _why_ended(summary: dict[str, Any]) -> str:
    """Return the text of the event that ended the mission early; empty if the mission was completed or no event ended it."""
    if summary["outcome"] == Outcome.COMPLETED.value:
        return ""
    ranked = [(SafetyAction(event["action"]).rank, str(event["text"])) for event in summary["events"]]
    # The first landing explains more than an earlier hold.
    for least in (SafetyAction.LAND, SafetyAction.HOLD):
        for rank, text in ranked:
            if rank >= least.rank:
                return text
    return ""


def _results(summary: dict[str, Any], stride: int, catches: bool) -> list[Table]:
    parts = {"pre": "in flight"} if summary["catch_t_s"] is None else {"pre": "before catch", "post": "after catch"}
    loop, latency, recorder, stages = (summary[key] for key in ("loop", "latency_ms", "recorder", "stages_ms"))
    rms = [
        (name, *(_number(summary["rms"][part][key], digits) for part in parts))
        for name, key, digits in (
            ("position ‖e_p‖ [m]", "e_p_m", 4),
            ("attitude ‖e_q‖ [deg]", "e_q_deg", 2),
            ("arm ‖e_α‖ [deg]", "e_alpha_deg", 2),
        )
    ]
    flight = [
        ("final height error", _number(summary["final_e_z_m"], 3, " m")),
        ("minimum tether slack", _number(summary["tether"]["min_slack_m"], 2, " m")),
    ]
    if catches:
        flight[:0] = [
            ("catch at", _number(summary["catch_t_s"], 2, " s")),
            ("impedance error, position", _number(summary["impedance_error"]["position_n"], 2, " N")),
            ("impedance error, arm", _number(summary["impedance_error"]["arm_nm"], 3, " N m")),
        ]
    if summary.get("catch_confirmed") is False:
        flight.insert(1, ("catch confirmed", "no, the flight ended too soon after the impact"))
    if (observed := summary.get("force_observer_error_n")) is not None:
        text = f"RMS {observed['rms']:.2f} N, largest {observed['max']:.1f} N"
        flight.append(("momentum observer minus sensor", text))
    if stride > 1:
        flight.append(("ticks evaluated and drawn", f"one in {stride} (long flight)"))
    timing = [
        (name, *(_number(figures[key], 2) for key in ("p50", "p99", "max")))
        for name, figures in (
            ("tick lateness", loop["lateness_ms"]),
            ("joint read → current write", latency["joint_read_to_write"]),
            ("mocap datagram → setpoint", latency["mocap_to_setpoint"]),
            ("whole tick", stages["whole"]),
            ("· wait for the joints", stages["wait_for_joints"]),
            ("· core: inputs → outputs", stages["core"]),
            ("· setpoint and currents sent", stages["send"]),
            ("servo bus: read", stages["bus_read"]),
            ("servo bus: read → write, total", stages["bus_cycle"]),
        )
    ]
    processes = [
        ("control loop", f"{_number(loop['rate_hz'], 1)} Hz, {loop['ticks']} ticks, {loop['missed']} missed"),
        ("recorded", f"{recorder['samples']} ticks, {recorder['dropped']} dropped"),
    ]
    clock = summary["clock"]
    if clock["kind"] == "simulated":
        pace = "" if clock["pace"] is None else f", {clock['pace']:.1f} x real time"
        processes.insert(0, ("clock", f"simulated{pace}"))
    if summary["log_end_missing"] is not None:
        processes.append(("end of the log", summary["log_end_missing"]))
    if recorder.get("error"):
        processes.append(("recorder", recorder["error"]))
    return [
        pairs("RMS error", rms, *parts.values()),
        pairs("Flight", flight),
        *([pairs("Contact", contact)] if (contact := contact_lines(summary)) else []),
        *([] if clock["kind"] == "simulated" else [pairs("Timing [ms]", timing, "p50", "p99", "max")]),
        pairs("Loop and log", processes),
    ]


def _events(events: Sequence[dict[str, Any]]) -> Table:
    columns = (
        Column("mission t [s]", lambda event: _number(event["mission_t_s"], 2)),
        Column("event", lambda event: str(event["id"]), left=True),
        Column("severity", lambda event: str(event["severity"]), left=True),
        Column("action", lambda event: str(event["action"]), left=True),
        Column("", lambda event: Cell(event["text"], "text"), left=True),
    )
    return table(columns, events, kind=lambda event: str(event["severity"]))


def _number(value: float | None, digits: int, unit: str = "") -> str:
    return "–" if value is None else f"{value:z.{digits}f}{unit}"


def _start(log: FlightLog) -> str:
    offset_ns = log.metadata.get("companion", {}).get("epoch_offset_ns", "")
    if not offset_ns.isdecimal():
        return ""
    return datetime.fromtimestamp(int(offset_ns) / 1e9, UTC).strftime("%Y-%m-%d %H:%M:%S UTC")
