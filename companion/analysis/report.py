"""report.html: one file with the result table, plots, events, configuration and versions; opens anywhere, prints well."""

from __future__ import annotations

import base64
import json
from collections.abc import Iterable
from datetime import UTC, datetime
from html import escape
from pathlib import Path
from typing import Any

from companion.analysis.log import FlightLog
from companion.analysis.plots import Plot, write_plots

_STYLE = """
:root { --ink: #22303c; --soft: #5b6b79; --line: #dde3e8; --good: #1f8a5b; --bad: #c2255c; --card: #f6f8fa; }
* { box-sizing: border-box; }
body { margin: 0 auto; padding: 2rem 1.5rem 4rem; max-width: 62rem; color: var(--ink); background: #fff;
  font: 15px/1.5 system-ui, -apple-system, "Segoe UI", Roboto, "Helvetica Neue", Arial, sans-serif; }
h1 { font-size: 1.6rem; margin: 0; } h2 { font-size: 1.15rem; margin: 2.2rem 0 .6rem; }
.sub { color: var(--soft); margin: .2rem 0 1.2rem; }
.badge { display: inline-block; padding: .1rem .7rem; border-radius: 1rem; color: #fff; font-size: .9rem; vertical-align: .2rem;
  background: var(--bad); }
.badge.completed { background: var(--good); }
.cards { display: grid; grid-template-columns: repeat(auto-fit, minmax(24rem, 1fr)); gap: 1rem; }
.card { background: var(--card); border-radius: .5rem; padding: .8rem 1rem; }
.card h3 { margin: 0 0 .4rem; font-size: .95rem; color: var(--soft); font-weight: 600; }
table { border-collapse: collapse; width: 100%; font-variant-numeric: tabular-nums; }
td, th { padding: .22rem .5rem .22rem 0; text-align: left; border-bottom: 1px solid var(--line); vertical-align: top; }
th { color: var(--soft); font-weight: 600; font-size: .85rem; } .card tr:last-child td { border-bottom: 0; }
td.n, th.n { text-align: right; padding: .22rem .3rem .22rem 1rem; white-space: nowrap; }
tr.warning td { background: #fff7e6; } tr.critical td { background: #fdeaf0; }
figure { margin: 0 0 1.6rem; break-inside: avoid; } figure img { width: 100%; border: 1px solid var(--line); border-radius: .4rem; }
figcaption { color: var(--soft); font-size: .88rem; }
details { margin-top: .6rem; } summary { cursor: pointer; color: var(--soft); }
pre { background: var(--card); padding: 1rem; border-radius: .5rem; overflow: auto; font-size: 12px; line-height: 1.4; }
@media print { body { padding: 0; max-width: none; font-size: 11px; } .cards { grid-template-columns: 1fr 1fr; }
  details { display: none; }
  .card, .badge { print-color-adjust: exact; -webkit-print-color-adjust: exact; } }
"""


def write_report(log: FlightLog, summary: dict[str, Any], out_dir: Path) -> Path:
    """Write the plots as PNG and report.html into `out_dir`; returns the path of report.html."""
    plots = write_plots(log, out_dir)
    path = out_dir / "report.html"
    path.write_text(_page(log, summary, plots), encoding="utf-8")
    return path


def _page(log: FlightLog, summary: dict[str, Any], plots: list[Plot]) -> str:
    about = log.metadata.get("companion", {})
    mission = (log.config.get("mission") or {}).get("name", "flight")
    vehicle = (log.config.get("vehicle") or {}).get("name", "")
    outcome = str(summary["outcome"])
    subtitle = " · ".join(
        text
        for text in (
            _start(log),
            vehicle,
            f"{summary['controller']}, preset {summary['preset']}",
            ""
            if summary["payload_kg"] is None
            else f"payload {summary['payload_kg']:g} kg (known to the simulated world only)",
        )
        if text
    )
    parts = [
        "<!doctype html><html lang='en'><head><meta charset='utf-8'>",
        "<meta name='viewport' content='width=device-width, initial-scale=1'>",
        f"<title>{escape(str(mission))}: {escape(outcome)}</title><style>{_STYLE}</style></head><body>",
        f"<h1>{escape(str(mission))} <span class='badge {escape(outcome)}'>{escape(outcome)}</span></h1>",
        f"<p class='sub'>{escape(subtitle)}</p>",
        _results(summary),
        "<h2>Plots</h2>" if plots else "",
        *(_figure(plot) for plot in plots),
        _events(summary["events"]),
        "<h2>Record</h2>",
        _rows(
            (name.removeprefix("version_"), value)
            for name, value in sorted(about.items())
            if name.startswith("version_")
        ),
        _folded("Effective configuration", json.dumps(log.config, indent=2) if log.config else ""),
        *(
            _folded(f"Metadata: {name}", json.dumps(values, indent=2, sort_keys=True))
            for name, values in sorted(log.metadata.items())
            if name not in ("companion", "config")
        ),
        "</body></html>\n",
    ]
    return "\n".join(part for part in parts if part)


def _results(summary: dict[str, Any]) -> str:
    pre, post = summary["rms"]["pre"], summary["rms"]["post"]
    rms = "".join(
        f"<tr><td>{label}</td><td class='n'>{_number(pre[key], digits)}</td><td class='n'>{_number(post[key], digits)}</td></tr>"
        for label, key, digits in (
            ("position ‖e<sub>p</sub>‖ [m]", "e_p_m", 4),
            ("attitude ‖e<sub>q</sub>‖ [deg]", "e_q_deg", 2),
            ("arm ‖e<sub>α</sub>‖ [deg]", "e_alpha_deg", 2),
        )
    )
    loop, latency, recorder = summary["loop"], summary["latency_ms"], summary["recorder"]
    durations = "".join(
        f"<tr><td>{label}</td>"
        + "".join(f"<td class='n'>{_number(row[key], 2)}</td>" for key in ("p50", "p99", "max"))
        + "</tr>"
        for label, row in (
            ("tick lateness", loop["lateness_ms"]),
            ("joint read → current write", latency["joint_read_to_write"]),
            ("mocap datagram → setpoint", latency["mocap_to_setpoint"]),
        )
    )
    flight = _rows(
        [
            ("catch at", _number(summary["catch_t_s"], 2, " s")),
            ("final height error", _number(summary["final_e_z_m"], 3, " m")),
            ("impedance error, position", _number(summary["impedance_error"]["position_n"], 2, " N")),
            ("impedance error, arm", _number(summary["impedance_error"]["arm_nm"], 3, " N m")),
            ("least tether slack", _number(summary["tether"]["min_slack_m"], 2, " m")),
        ]
    )
    machinery = _rows(
        [
            ("control loop", f"{_number(loop['rate_hz'], 1)} Hz, {loop['ticks']} ticks, {loop['missed']} missed"),
            ("recorded", f"{recorder['samples']} ticks, {recorder['dropped']} dropped"),
            *([("recorder", recorder["error"])] if recorder.get("error") else []),
        ]
    )
    return (
        "<div class='cards'>"
        "<div class='card'><h3>RMS error</h3><table><tr><th></th><th class='n'>before catch</th><th class='n'>after catch</th></tr>"
        f"{rms}</table></div>"
        f"<div class='card'><h3>Flight</h3>{flight}</div>"
        "<div class='card'><h3>Timing [ms]</h3><table>"
        "<tr><th></th><th class='n'>p50</th><th class='n'>p99</th><th class='n'>max</th></tr>"
        f"{durations}</table></div>"
        f"<div class='card'><h3>Machinery</h3>{machinery}</div>"
        "</div>"
    )


def _events(events: list[dict[str, Any]]) -> str:
    if not events:
        return "<h2>Events</h2><p class='sub'>None.</p>"
    rows = "".join(
        f"<tr class='{escape(event['severity'])}'><td class='n'>{_number(event['mission_t_s'], 2)}</td><td>{escape(event['id'])}</td>"
        f"<td>{escape(event['severity'])}</td><td>{escape(event['action'])}</td><td>{escape(event['text'])}</td></tr>"
        for event in events
    )
    head = "<tr><th class='n'>mission t [s]</th><th>event</th><th>severity</th><th>action</th><th></th></tr>"
    return f"<h2>Events</h2><table>{head}{rows}</table>"


def _figure(plot: Plot) -> str:
    data = base64.b64encode(plot.path.read_bytes()).decode()
    return (
        f"<figure><img alt='{escape(plot.title)}' src='data:image/png;base64,{data}'>"
        f"<figcaption>{escape(plot.caption)}</figcaption></figure>"
    )


def _rows(rows: Iterable[tuple[str, object]]) -> str:
    body = "".join(f"<tr><td>{escape(name)}</td><td class='n'>{escape(str(value))}</td></tr>" for name, value in rows)
    return f"<table>{body}</table>" if body else ""


def _folded(title: str, text: str) -> str:
    return f"<details><summary>{escape(title)}</summary><pre>{escape(text)}</pre></details>" if text else ""


def _number(value: float | None, digits: int, unit: str = "") -> str:
    return "–" if value is None else f"{value:.{digits}f}{unit}"


def _start(log: FlightLog) -> str:
    offset_ns = log.metadata.get("companion", {}).get("epoch_offset_ns", "")
    if not offset_ns.isdecimal():
        return ""
    return datetime.fromtimestamp(int(offset_ns) / 1e9, UTC).strftime("%Y-%m-%d %H:%M:%S UTC")
