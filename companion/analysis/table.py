"""A table as data: columns format the items; the terminal and an HTML page (`page.html`) show the same cells."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass
from itertools import groupby
from typing import Any

from rich import box
from rich.markup import escape
from rich.table import Table as TerminalTable

STYLES = {"bad": "red", "warning": "yellow", "critical": "red", "soft": "dim", "paper": "dim"}
"""Terminal styles of the kinds of cells and rows; `page.html` has a CSS class for each."""


@dataclass(frozen=True, slots=True)
class Line:
    """Line style of one flight in the plots; a page shows the line beside the flight's name."""

    colour: str
    dashes: tuple[float, ...] = ()
    """Lengths of dashes and gaps in turn, in units of the line width; empty for a solid line."""


@dataclass(frozen=True, slots=True)
class Cell:
    """The content of one cell."""

    text: str
    kind: str = ""
    """A key of `STYLES`, or a CSS class of the page."""
    note: str = ""
    """A second line below the text."""
    note_kind: str = "soft"
    line: Line | None = None


@dataclass(frozen=True, slots=True)
class Column:
    """One column: its title and the format of its items."""

    title: str
    """Title, which may have several lines."""
    show: Callable[[Any], str | Cell]
    left: bool = False
    """Whether to align the cells left; numbers are aligned right."""
    kind: str = ""
    """Default kind of the cells."""
    line: Line | None = None


@dataclass(frozen=True, slots=True)
class Row:
    """The cells of one item."""

    cells: tuple[Cell, ...]
    kind: str = ""
    new_group: bool = False
    """Whether a rule separates the row from the one above it."""


@dataclass(frozen=True, slots=True)
class Table:
    """Rows of cells with their columns."""

    columns: tuple[Column, ...]
    rows: tuple[Row, ...]
    title: str = ""
    folded: bool = False
    """Whether a page shows only the title until the reader opens the table."""


def table(
    columns: Sequence[Column],
    items: Iterable[Any],
    *,
    title: str = "",
    kind: Callable[[Any], str] = lambda _: "",
    group: Callable[[Any], object] = lambda _: None,
    folded: bool = False,
) -> Table:
    """Return a table of items.

    Args:
        kind: returns the kind of an item's row, a key of `STYLES` or empty.
        group: returns the group of an item; a rule separates neighbouring groups.
    """
    rows = []
    for number, (_, members) in enumerate(groupby(items, group)):
        for place, item in enumerate(members):
            shown = [column.show(item) for column in columns]
            cells = tuple(one if isinstance(one, Cell) else Cell(one) for one in shown)
            rows.append(Row(cells, kind(item), place == 0 and number > 0))
    return Table(tuple(columns), tuple(rows), title, folded)


def number(value: float | None, form: str, unknown: str = "") -> str:
    """Format a number; return `unknown` for None."""
    return unknown if value is None else format(value, form)


def for_terminal(shown: Table) -> TerminalTable:
    """Return the table for a `rich.console.Console`."""
    made = TerminalTable(
        title=shown.title or None,
        title_justify="left",
        title_style="bold",
        header_style="bold",
        box=box.SIMPLE,
        pad_edge=False,
        padding=(0, 1, 0, 0),
    )
    for column in shown.columns:
        made.add_column(
            escape(column.title),
            justify="left" if column.left else "right",
            vertical="top",
            style=STYLES.get(column.kind, ""),
            overflow="fold",
        )
    for row in shown.rows:
        if row.new_group:
            made.add_section()
        made.add_row(*map(_markup, row.cells), style=STYLES.get(row.kind, ""))
    return made


def _markup(cell: Cell) -> str:
    parts = ((cell.text, STYLES.get(cell.kind)), (cell.note, STYLES.get(cell.note_kind)))
    return "\n".join(f"[{style}]{escape(text)}[/]" if style else escape(text) for text, style in parts if text)


def pairs(title: str, rows: Sequence[tuple[str, ...]], *heads: str) -> Table:
    """Return a table of names and values; `heads` are the titles of the columns of values."""
    columns = [Column(head, lambda row, k=k: row[k], left=k == 0) for k, head in enumerate(("", *(heads or ("",))))]  # type: ignore[misc]
    return table(columns, rows, title=title)
