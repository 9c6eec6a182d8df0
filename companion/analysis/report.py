"""report.html: one self-contained file with the result table, plots, events, configuration and versions."""

from __future__ import annotations

import json
from collections.abc import Iterable
from datetime import UTC, datetime
from html import escape
from pathlib import Path
from typing import Any

from companion.analysis.animation import movie_of, player_html
from companion.analysis.log import FlightLog
from companion.analysis.page import CLOSING, folded, opening, picture
from companion.analysis.plots import Plot, write_plots
from companion.analysis.summary import effective_config

_STYLE = """
:root { --width: 62rem; }
.badge { display: inline-block; padding: .1rem .7rem; border-radius: 1rem; color: #fff; font-size: .9rem; vertical-align: .2rem;
  background: var(--bad); }
.badge.completed { background: var(--good); }
.cards { display: grid; grid-template-columns: repeat(auto-fit, minmax(24rem, 1fr)); gap: 1rem; }
.card { background: var(--card); border-radius: .5rem; padding: .8rem 1rem; }
.card h3 { margin: 0 0 .4rem; font-size: .95rem; color: var(--soft); font-weight: 600; }
td, th { padding: .22rem .5rem .22rem 0; text-align: left; } .card tr:last-child td { border-bottom: 0; }
td.n, th.n { text-align: right; padding: .22rem .3rem .22rem 1rem; white-space: nowrap; }
tr.warning td { background: #fff7e6; } tr.critical td { background: #fdeaf0; }
#player canvas { width: 100%; aspect-ratio: 960 / 440; border: 1px solid var(--line); border-radius: .4rem; }
#player div { display: flex; gap: .8rem; } #player input { flex: 1; } #player button { font: inherit; width: 5rem; }
@media print { #player div { display: none; } .cards { grid-template-columns: 1fr 1fr; }
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
    config = effective_config(log, summary)
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
        opening(f"{mission}: {outcome}", _STYLE),
        f"<h1>{escape(str(mission))} <span class='badge {escape(outcome)}'>{escape(outcome)}</span></h1>",
        f"<p class='sub'>{escape(subtitle)}</p>",
        _movie(log, summary),
        _results(summary, log.stride),
        "<h2>Plots</h2>" if plots else "",
        *(picture(plot.path, plot.title, escape(plot.caption)) for plot in plots),
        _events(summary["events"]),
        "<h2>Record</h2>",
        _rows(
            (name.removeprefix("version_"), value)
            for name, value in sorted(about.items())
            if name.startswith("version_")
        ),
        folded("Effective configuration", json.dumps(config, indent=2) if config else ""),
        *(
            folded(f"Metadata: {name}", json.dumps(values, indent=2, sort_keys=True))
            for name, values in sorted(log.metadata.items())
            if name not in ("companion", "config")
        ),
        CLOSING,
    ]
    return "\n".join(part for part in parts if part)


def _movie(log: FlightLog, summary: dict[str, Any]) -> str:
    movie = movie_of(log, summary)
    return "" if movie is None else player_html(movie)


def _results(summary: dict[str, Any], stride: int) -> str:
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
    stages = summary["stages_ms"]
    durations = "".join(
        f"<tr><td>{label}</td>"
        + "".join(f"<td class='n'>{_number(row[key], 2)}</td>" for key in ("p50", "p99", "max"))
        + "</tr>"
        for label, row in (
            ("tick lateness", loop["lateness_ms"]),
            ("joint read → current write", latency["joint_read_to_write"]),
            ("mocap datagram → setpoint", latency["mocap_to_setpoint"]),
            ("whole tick", stages["whole"]),
            ("· wait for the joints", stages["wait_for_joints"]),
            ("· core: inputs → decision", stages["core"]),
            ("· setpoint and currents sent", stages["send"]),
            ("servo bus: read", stages["bus_read"]),
            ("servo bus: read → write, whole", stages["bus_cycle"]),
        )
    )
    flight = _rows(
        [
            ("catch at", _number(summary["catch_t_s"], 2, " s")),
            *(
                [("catch confirmed", "no, the flight ended too soon after it")]
                if summary.get("catch_confirmed") is False
                else []
            ),
            ("final height error", _number(summary["final_e_z_m"], 3, " m")),
            ("impedance error, position", _number(summary["impedance_error"]["position_n"], 2, " N")),
            ("impedance error, arm", _number(summary["impedance_error"]["arm_nm"], 3, " N m")),
            ("least tether slack", _number(summary["tether"]["min_slack_m"], 2, " m")),
            *([("long flight: graded and drawn is", f"every {stride}th tick")] if stride > 1 else []),
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


def _rows(rows: Iterable[tuple[str, object]]) -> str:
    body = "".join(f"<tr><td>{escape(name)}</td><td class='n'>{escape(str(value))}</td></tr>" for name, value in rows)
    return f"<table>{body}</table>" if body else ""


def _number(value: float | None, digits: int, unit: str = "") -> str:
    return "–" if value is None else f"{value:z.{digits}f}{unit}"


def _start(log: FlightLog) -> str:
    offset_ns = log.metadata.get("companion", {}).get("epoch_offset_ns", "")
    if not offset_ns.isdecimal():
        return ""
    return datetime.fromtimestamp(int(offset_ns) / 1e9, UTC).strftime("%Y-%m-%d %H:%M:%S UTC")
