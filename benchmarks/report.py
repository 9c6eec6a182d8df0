"""Shared output of the measuring commands: a table in the terminal, and the same rows as JSON."""

from __future__ import annotations

import json
from collections.abc import Collection, Mapping, Sequence
from pathlib import Path
from typing import Any

from rich.console import Console
from rich.table import Table

LEFT = ("loop", "process")
"""Columns of words; all others hold figures."""


def number(value: float | None, digits: int = 2) -> str:
    """Return a figure as text for a table; None is a dash."""
    return "-" if value is None else f"{value:.{digits}f}"


def print_table(title: str, rows: Sequence[Mapping[str, str]], console: Console, red: Collection[int] = ()) -> None:
    """Print rows of cells by column name; the rows with an index in `red` have not met a limit."""
    table = Table(title=title, title_justify="left")
    for name in rows[0] if rows else ():
        table.add_column(name, justify="left" if name in LEFT else "right")
    for index, row in enumerate(rows):
        table.add_row(*row.values(), style="red" if index in red else "")
    console.print(table)


def write_json(path: Path | None, found: Any) -> None:
    """Write figures as JSON, unless no path was given."""
    if path is not None:
        path.write_text(json.dumps(found, indent=1) + "\n", encoding="utf-8")
