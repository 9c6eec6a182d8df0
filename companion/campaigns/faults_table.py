"""A fault campaign as tables: for the terminal, for the page, and as Markdown for the docs."""

from __future__ import annotations

import json
from collections.abc import Sequence
from html import escape
from pathlib import Path
from typing import Any

from rich import box
from rich.markup import escape as escape_markup
from rich.table import Table

from companion.analysis.page import CLOSING, folded, opening
from companion.campaigns.faults import GOOD, Row, good, outcomes
from companion.sitl_config.faults import KINDS, PHASES

_STYLE = """
:root { --width: 84rem; }
.wide { overflow-x: auto; }
th, td { padding: .2rem .5rem; white-space: nowrap; text-align: right; }
th.l, td.l { text-align: left; }
td.n { white-space: normal; text-align: left; color: var(--soft); min-width: 16rem; }
tr.bad td { color: var(--bad); }
"""
_HEAD = (
    ("fault", "l"), ("size", "r"), ("phase", "l"), ("outcome", "l"), ("detected s", "r"), ("by", "l"), ("reacted s", "r"),
    ("action", "l"), ("tilt deg", "r"), ("height m", "r"), ("slack m", "r"), ("drift m", "r"),
)  # fmt: skip


def kinds_table() -> Table:
    """`companion faults --list`."""
    table = Table(box=box.SIMPLE, pad_edge=False, header_style="bold")
    for name in ("kind", "what happens", "size", "default", "phases"):
        table.add_column(name, overflow="fold")
    for name, kind in KINDS.items():
        table.add_row(
            name, kind.what, _size_text(kind.size, kind.unit), _number(kind.default, "g"), " ".join(kind.phases)
        )
    return table


def kinds_list() -> list[dict[str, Any]]:
    """`companion faults --list --json`."""
    return [
        {
            "kind": name,
            "what": kind.what,
            "size": kind.size,
            "unit": kind.unit,
            "default": kind.default,
            "named_by": list(kind.named_by),
            "phases": list(kind.phases),
        }
        for name, kind in KINDS.items()
    ]


def kinds_markdown() -> str:
    """The table of docs/faults.md."""
    rows = ["| kind | what happens | size | default | told by |", "|---|---|---|---|---|"]
    for name, kind in KINDS.items():
        told = ", ".join(f"`{event}`" for event in kind.named_by) or "nothing: it needs no answer"
        default = _number(kind.default, "g")
        rows.append(f"| `{name}` | {kind.what} | {_size_text(kind.size, kind.unit)} | {default} | {told} |")
    return "\n".join(rows)


def outcomes_markdown(rows: Sequence[Row]) -> str:
    """One line per fault and size: outcome by phase with the time to its detection, and the worst of all phases."""
    phases = [phase for phase in PHASES if any(row["phase"] == phase for row in rows)]
    head = ["fault", "size", *phases, "tilt, deg", "height, m", "slack, m", "drift, m"]
    lines = [f"| {' | '.join(head)} |", f"|{'---|' * len(head)}"]
    for group in _grouped(rows):
        cells = [_cell(next((row for row in group if row["phase"] == phase), None)) for phase in phases]
        worst = [
            _worst(group, "worst_tilt_deg", max, ".0f"),
            _worst(group, "min_height_m", min, ".2f"),
            _worst(group, "min_slack_m", min, ".2f"),
            _worst(group, "drift_m", max, ".2f"),
        ]
        lines.append(f"| {' | '.join([_name(group[0]), _shown(group[0]), *cells, *worst])} |")
    return "\n".join(lines)


def _name(row: Row) -> str:
    return f"`{row['fault']}`"


def _cell(row: Row | None) -> str:
    if row is None:
        return ""
    outcome = row["outcome"] if good(row) else f"**{row['outcome']}**"
    return f"{outcome} {_number(row['detected_s'], '.2f')}".strip()


def _grouped(rows: Sequence[Row]) -> list[list[Row]]:
    groups: dict[tuple[Any, ...], list[Row]] = {}
    for row in rows:
        groups.setdefault((row["fault"], row["size"], row["duration_s"]), []).append(row)
    return list(groups.values())


def _worst(rows: Sequence[Row], key: str, pick: Any, form: str) -> str:
    values = [row[key] for row in rows if row[key] is not None]
    return _number(pick(values), form) if values else ""


def _size_text(size: str | None, unit: str) -> str:
    return "" if size is None else f"{size}, {unit}" if unit else size


def _number(value: float | None, form: str) -> str:
    return "" if value is None else format(value, form)


def _shown(row: Row) -> str:
    """Size with unit, and how long it lasted if that is another thing."""
    if row["size"] is None:
        return ""
    text = f"{row['size']:g} {row['unit']}".strip()
    same = row["unit"] == "s" and row["size"] == row["duration_s"]
    return text if row["duration_s"] is None or same else f"{text}, {row['duration_s']:g} s"


def _texts(row: Row) -> list[str]:
    return [
        row["fault"],
        _shown(row),
        row["phase"],
        row["outcome"],
        _number(row["detected_s"], ".3f"),
        row["event"] or "",
        _number(row["reacted_s"], ".3f"),
        row["action"],
        _number(row["worst_tilt_deg"], ".1f"),
        _number(row["min_height_m"], ".2f"),
        _number(row["min_slack_m"], ".2f"),
        _number(row["drift_m"], ".2f"),
    ]


def flights_table(rows: Sequence[Row]) -> Table:
    """One line per flight."""
    table = Table(box=box.SIMPLE, pad_edge=False, header_style="bold")
    for name, side in _HEAD:
        table.add_column(name, justify="left" if side == "l" else "right", no_wrap=True)
    for row in rows:
        style = "" if row["outcome"] in GOOD and good(row) else "red" if not good(row) else "yellow"
        table.add_row(*map(escape_markup, _texts(row)), style=style)
    return table


def write_html(
    rows: Sequence[Row], settings: dict[str, Any], versions: dict[str, str], notes: Sequence[str], path: Path
) -> None:
    """Write the page; `notes` are told at its top."""
    counted = ", ".join(f"{count} {name}" for name, count in outcomes(rows).items())
    bad = [row for row in rows if not good(row)]
    parts = [
        opening("Fault campaign", _STYLE),
        "<h1>Fault campaign</h1>",
        f"<p class='sub'>{escape(str(settings['mission']))} · {len(rows)} flights {escape(settings['where'])} · {escape(counted)}</p>",
        *(f"<p><strong>{escape(note)}</strong></p>" for note in notes),
        f"<h2>{len(bad)} flights that must not be</h2>" if bad else "<h2>Nothing happened that must not</h2>",
        _html(bad) if bad else "",
        "<h2>All flights</h2>",
        _html(rows),
        "<p class='sub'>Times in s since the fault. Height: least, while the machine was to be up. Slack: least of the tether. "
        "Drift: from where the mission was given up to where it stands, or else the most off its way.</p>",
        "<h2>Record</h2>",
        folded("Settings", json.dumps(settings, indent=2)),
        folded("Versions", json.dumps(versions, indent=2)),
        CLOSING,
    ]
    path.write_text("\n".join(part for part in parts if part), encoding="utf-8")


def _html(rows: Sequence[Row]) -> str:
    head = "".join(f"<th class='{'l' if side == 'l' else ''}'>{escape(name)}</th>" for name, side in _HEAD)
    lines = []
    for row in rows:
        cells = "".join(
            f"<td class='{'l' if side == 'l' else ''}'>{escape(text)}</td>"
            for text, (_, side) in zip(_texts(row), _HEAD, strict=True)
        )
        more = "; ".join([*row["problems"], *row["events"], *([row["error"]] if row["error"] else [])])
        lines.append(f"<tr class='{'' if good(row) else 'bad'}'>{cells}<td class='n'>{escape(more)}</td></tr>")
    head += "<th class='l'>problems, events</th>"
    return f"<div class='wide'><table><thead><tr>{head}</tr></thead><tbody>{''.join(lines)}</tbody></table></div>"
