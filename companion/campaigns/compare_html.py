"""compare.html: one file with the comparison's tables, pictures, settings and versions; opens anywhere, prints well."""

from __future__ import annotations

import json
from collections.abc import Sequence
from html import escape
from pathlib import Path
from typing import TYPE_CHECKING, Any

from companion.analysis.page import CLOSING, folded, opening, picture
from companion.campaigns.compare import Cell, Row
from companion.campaigns.compare_table import (
    COMPLIANCE,
    EXPLAINED,
    TRACKING,
    Column,
    by_payload,
    ours_text,
    printed_text,
)
from companion.campaigns.printed import SOURCE

if TYPE_CHECKING:
    from companion.campaigns.compare_plots import Picture

_STYLE = """
:root { --width: 78rem; }
.wide { overflow-x: auto; }
th, td { padding: .24rem .45rem; white-space: nowrap; text-align: right; }
th { vertical-align: bottom; }
th.l, td.l { text-align: left; }
td.less { padding-left: 1.4rem; color: var(--soft); }
td.paper, th.paper { color: var(--soft); background: var(--card); }
th.span { text-align: center; } span.bad { color: var(--bad); } tbody tr:first-child td { border-top: 2px solid var(--line); }
figure img { max-width: 60rem; }
@media print { td.paper { print-color-adjust: exact; -webkit-print-color-adjust: exact; } }
"""


def write_html(
    rows: Sequence[Row],
    cells: Sequence[Cell],
    pictures: Sequence[Picture],
    settings: dict[str, Any],
    versions: dict[str, str],
    notes: Sequence[str],
    path: Path,
) -> None:
    """Write the page; `notes` are told at its top."""
    failures = [row for row in rows if row["error"]]
    parts = [
        opening("Comparison of controllers", _STYLE),
        "<h1>Comparison of controllers</h1>",
        f"<p class='sub'>{escape(str(settings['mission']))} · {len(rows)} flights in the fast closed loop · seeds "
        f"{escape(', '.join(str(seed) for seed in settings['seeds']))}</p>",
        *(f"<p><strong>{escape(note)}</strong></p>" for note in notes),
        "<h2>Tracking</h2>",
        f"<p class='sub'>RMS, mean ± standard deviation over seeds. Grey: as printed in the paper ({escape(SOURCE)}).</p>",
        _tracking(cells),
        "<h2>After the catch</h2>",
        _plain(cells, COMPLIANCE),
        f"<p class='sub'>{_marked(EXPLAINED)}</p>",
        "<h2>Pictures</h2>" if pictures else "",
        *(picture(one.path, one.title, _marked(one.caption)) for one in pictures),
        "<h2>Record</h2>",
        folded(
            "Internal errors",
            "\n".join(
                f"{r['controller']}/{r['preset']} {r['payload_kg']:g} kg seed {r['seed']}: {r['error']}"
                for r in failures
            ),
        ),
        folded("Settings", json.dumps(settings, indent=2)),
        folded("Versions", json.dumps(versions, indent=2)),
        CLOSING,
    ]
    path.write_text("\n".join(part for part in parts if part), encoding="utf-8")


def _tracking(cells: Sequence[Cell]) -> str:
    head = (
        "<tr><th class='l' rowspan='2'>payload</th><th class='l' rowspan='2'>controller</th>"
        "<th class='span' colspan='4'>before the catch</th><th class='span' colspan='4'>after the catch</th></tr><tr>"
        + "".join(f"<th>{_title(column)}</th><th class='paper'>paper</th>" for column in TRACKING)
        + "</tr>"
    )
    return _body(
        cells,
        head,
        lambda cell: [
            pair
            for column in TRACKING
            for pair in (("", ours_text(cell, column)), ("paper", printed_text(cell, column)))
        ],
        4,
    )


def _plain(cells: Sequence[Cell], columns: Sequence[Column]) -> str:
    titles = "".join(f"<th>{_title(column)}</th>" for column in columns)
    head = f"<tr><th class='l'>payload</th><th class='l'>controller</th>{titles}</tr>"
    return _body(cells, head, lambda cell: [("", ours_text(cell, column)) for column in columns], 0)


def _body(cells: Sequence[Cell], head: str, texts_of: Any, failure_at: int) -> str:
    bodies = []
    for payload_kg, group in by_payload(cells):
        lines = []
        for n, cell in enumerate(group):
            texts = [(kind, escape(text)) for kind, text in texts_of(cell)]
            if cell.failures:
                ours = texts[failure_at][1]
                failure = f"<span class='bad'>{escape(cell.failure_text)}</span>"
                texts[failure_at] = ("", f"{ours}<br>{failure}" if ours else failure)
            first = f"<td class='l' rowspan='{len(group)}'>{payload_kg:g} kg</td>" if n == 0 else ""
            cellular = "".join(f"<td class='{kind}'>{text}</td>" for kind, text in texts)
            kind = "l" if cell.short_label == cell.label else "l less"
            name = f"<td class='{kind}'>{escape(cell.short_label.strip())}</td>"
            lines.append(f"<tr>{first}{name}{cellular}</tr>")
        bodies.append(f"<tbody>{''.join(lines)}</tbody>")
    return f"<div class='wide'><table><thead>{head}</thead>{''.join(bodies)}</table></div>"


def _title(column: Column) -> str:
    return f"{_marked(column.title)} [{escape(column.unit)}]"


def _marked(text: str) -> str:
    """Indices as such."""
    marked = escape(text)
    for letter in "pqzα":
        marked = marked.replace(f"e_{letter}", f"e<sub>{letter}</sub>")
    return marked.replace("M_d", "M<sub>d</sub>").replace("K_d", "K<sub>d</sub>")
