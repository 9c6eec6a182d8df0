"""side_by_side.html: one file with what was flown, what was set differently, all figures and the pictures over each other."""

from __future__ import annotations

from collections.abc import Sequence
from html import escape
from pathlib import Path

from companion.analysis.page import CLOSING, opening, picture
from companion.campaigns.side_by_side import MARKED_FROM, Comparison, Figure
from companion.campaigns.side_by_side_plots import LINES, Picture
from companion.campaigns.side_by_side_settings import Setting, text_of

_STYLE = """
:root { --width: 72rem; }
.wide { overflow-x: auto; } .figures table { width: auto; } .figures td.n { min-width: 7.2rem; }
td:first-child { white-space: nowrap; padding-right: 1rem; }
th, td { padding: .24rem .6rem .24rem 0; text-align: left; }
td.n, th.n { text-align: right; padding: .24rem 0 .24rem 1rem; }
td.n { white-space: nowrap; }
td.key { font-family: ui-monospace, monospace; font-size: .85rem; }
td.value { font-family: ui-monospace, monospace; font-size: .85rem; overflow-wrap: anywhere; min-width: 7rem; }
td small { color: var(--soft); display: block; } td small span { display: inline-block; }
td.n small { white-space: normal; }
td .better { color: var(--good); font-weight: 600; } td .worse { color: var(--bad); font-weight: 600; }
.absent { color: var(--soft); } .failed { color: var(--bad); font-weight: 600; }
.fair { background: var(--card); border-left: .3rem solid var(--good); border-radius: .3rem; padding: .7rem 1rem; margin: 1rem 0; }
.fair.care { border-color: var(--bad); } .fair p { margin: 0; font-weight: 600; } .fair ul { margin: .4rem 0 0; padding-left: 1.2rem; }
.line { vertical-align: middle; margin-right: .35rem; } th .name { color: var(--ink); }
tr.warning td { background: #fff7e6; } tr.critical td { background: #fdeaf0; }
figure { max-width: 62rem; }
@media print { .fair, tr.warning td, tr.critical td { print-color-adjust: exact; -webkit-print-color-adjust: exact; } }
"""
_EVENTS_SHOWN = 40
"""More of them are folded away."""


def write_html(comparison: Comparison, pictures: Sequence[Picture], path: Path) -> None:
    """Write the page."""
    names = " / ".join(flight.name for flight in comparison.flights)
    aligned = {"catch": "the catch", "takeoff": "take-off", "start": "the log's first tick"}[comparison.align]
    parts = [
        opening(f"Side by side: {names}", _STYLE),
        "<h1>Flights side by side</h1>",
        f"<p class='sub'>{len(comparison.flights)} flights, aligned at {aligned}; differences are to A.</p>",
        _fairness(comparison),
        "<h2>What was flown</h2>",
        _about(comparison),
        "<h2>What was set differently</h2>",
        _settings(comparison, comparison.settings)
        if comparison.settings
        else "<p class='sub'>Nothing: the effective configurations are the same, key by key.</p>",
        _addresses(comparison),
        "<h2>Figures</h2>",
        _figures(comparison),
        "<h2>Pictures</h2>" if pictures else "",
        *(picture(one.path, one.title, _marked(one.caption)) for one in pictures),
        "<h2>Events</h2>",
        _events(comparison),
        CLOSING,
    ]
    path.write_text("\n".join(part for part in parts if part), encoding="utf-8")


def _fairness(comparison: Comparison) -> str:
    told = "".join(f"<li>{escape(line)}</li>" for line in (*comparison.cautions, *comparison.notes))
    return (
        f"<div class='fair{' care' if comparison.cautions else ''}'><p>{escape(comparison.fair)}</p>"
        + (f"<ul>{told}</ul>" if told else "")
        + "</div>"
    )


def _heads(comparison: Comparison, kind: str = "") -> str:
    return "".join(
        f"<th{kind}>{_line(n)}<span class='name'>{flight.letter}</span> {escape(flight.name)}</th>"
        for n, flight in enumerate(comparison.flights)
    )


def _line(n: int) -> str:
    """How the flight is drawn in the pictures."""
    dashes = (
        f" stroke-dasharray='{' '.join(f'{1.6 * length:g}' for length in LINES[n].dashes)}'" if LINES[n].dashes else ""
    )
    return (
        f"<svg class='line' width='30' height='8' aria-hidden='true'><line x1='0' y1='4' x2='30' y2='4' "
        f"stroke='{LINES[n].colour}' stroke-width='2.5'{dashes}/></svg>"
    )


def _about(comparison: Comparison) -> str:
    rows = []
    for name, texts in comparison.about:
        cells = []
        for flight, text in zip(comparison.flights, texts, strict=True):
            failed = " class='failed'" if name == "outcome" and not flight.completed else ""
            cells.append(f"<td{failed}>{escape(text)}</td>")
        rows.append(f"<tr><td>{escape(name)}</td>{''.join(cells)}</tr>")
    logs = "".join(f"<td class='value'>{escape(flight.path)}</td>" for flight in comparison.flights)
    rows.append(f"<tr><td>log</td>{logs}</tr>")
    return _table(f"<tr><th></th>{_heads(comparison)}</tr>", rows)


def _settings(comparison: Comparison, settings: Sequence[Setting]) -> str:
    rows = [
        f"<tr><td class='key'>{escape(setting.key)}</td>"
        + "".join(
            f"<td class='value'>{escape(text_of(value))}</td>" if there else "<td class='absent'>no such key</td>"
            for value, there in zip(setting.values, setting.present, strict=True)
        )
        + "</tr>"
        for setting in settings
    ]
    return _table(f"<tr><th>key of the effective configuration</th>{_heads(comparison)}</tr>", rows)


def _addresses(comparison: Comparison) -> str:
    if not comparison.addresses:
        return ""
    return (
        "<details><summary>Addresses of the simulated devices, chosen anew for each flight</summary>"
        f"{_settings(comparison, comparison.addresses)}</details>"
    )


def _figures(comparison: Comparison) -> str:
    rows = [
        f"<tr><td>{escape(figure.label)}</td>"
        + "".join(_figure(figure, n) for n in range(len(comparison.flights)))
        + "</tr>"
        for figure in comparison.figures
    ]
    told = (
        f"Below each value: its difference to A. Marked is what is smaller or larger than A's by more than "
        f"{100 * MARKED_FROM:.0f} %, and only where smaller is plainly better. One flight each is no statistics: "
        "<code>companion compare</code> flies many."
    )
    table = _table(f"<tr><th></th>{_heads(comparison, ' class=n')}</tr>", rows)
    return f"<div class='figures'>{table}</div><p class='sub'>{told}</p>"


def _figure(figure: Figure, n: int) -> str:
    value, difference, first = figure.values[n], figure.differences[n], figure.values[0]
    text = "–" if value is None else f"{value:z.{figure.digits}f}"
    if n == 0:
        return f"<td class='n'>{text}</td>"
    if difference is None or first is None:
        return f"<td class='n'>{text}<small>–</small></td>"
    told = f"{difference:+z.{figure.digits}f}"
    if float(told) == 0:
        told = "0" if difference == 0 else "≈ 0"
    elif first:
        ratio = (first + difference) / first
        # Thousands of percent, or those of a figure that changed its sign, say nothing.
        told += (
            f" ({ratio:.0f}\u00a0times)"
            if ratio >= 10
            else f" ({100 * (ratio - 1):+z.0f}\u00a0%)"
            if ratio >= 0
            else ""
        )
    verdict = figure.verdicts[n]
    marked = f" <span class='{verdict}'>{verdict}</span>" if verdict else ""
    return f"<td class='n'>{text}<small>{told}{marked}</small></td>"


def _events(comparison: Comparison) -> str:
    events = sorted(
        (
            (float(event["t_s"]) - zero_s, n, event)
            for n, (flight, zero_s) in enumerate(zip(comparison.flights, comparison.zeros_s, strict=True))
            for event in flight.summary["events"]
        ),
        key=lambda row: row[:2],
    )
    if not events:
        return "<p class='sub'>None.</p>"
    rows = [
        f"<tr class='{escape(event['severity'])}'><td class='n'>{t:+z.2f}</td><td class='n'>{float(event['mission_t_s']):.2f}</td>"
        f"<td>{_line(n)}{comparison.flights[n].letter}</td><td>{escape(event['id'])}</td><td>{escape(event['severity'])}</td>"
        f"<td>{escape(event['action'])}</td><td>{escape(event['text'])}</td></tr>"
        for t, n, event in events
    ]
    head = (
        "<tr><th class='n'>t [s]</th><th class='n'>mission t [s]</th><th></th><th>event</th><th>severity</th>"
        "<th>action</th><th></th></tr>"
    )
    table = _table(head, rows)
    return table if len(rows) <= _EVENTS_SHOWN else f"<details><summary>{len(rows)} events</summary>{table}</details>"


def _table(head: str, rows: Sequence[str]) -> str:
    return f"<div class='wide'><table><thead>{head}</thead><tbody>{''.join(rows)}</tbody></table></div>"


def _marked(text: str) -> str:
    """Indices as such."""
    return escape(text).replace("e_q", "e<sub>q</sub>")
