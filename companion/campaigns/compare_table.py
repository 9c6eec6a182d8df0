"""The comparison as tables: what stands in which cell, for the terminal and for HTML, and as CSV."""

from __future__ import annotations

import csv
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from itertools import groupby
from pathlib import Path
from typing import Any

from rich import box
from rich.console import Console
from rich.markup import escape
from rich.measure import Measurement
from rich.table import Table

from companion.campaigns.compare import MISSED, Cell, Row, Spread, flat


@dataclass(frozen=True, slots=True)
class Column:
    """One figure of the table."""

    name: str
    """As in `compare.FIGURES`."""
    title: str
    unit: str
    digits: int


TRACKING = (
    Column("rms.pre.e_p_m", "‖e_p‖", "m", 4),
    Column("rms.pre.e_q_deg", "‖e_q‖", "deg", 2),
    Column("rms.post.e_p_m", "‖e_p‖", "m", 4),
    Column("rms.post.e_q_deg", "‖e_q‖", "deg", 2),
)
"""The columns of the paper's table."""
COMPLIANCE = (
    Column("rms.post.e_alpha_deg", "‖e_α‖", "deg", 2),
    Column("impedance_error.arm_nm", "arm impedance", "N m", 3),
    Column("impedance_error.position_n", "base impedance", "N", 2),
    Column("peak_e_p_m", "peak ‖e_p‖", "m", 3),
    Column("final_abs_e_z_m", "final |e_z|", "m", 4),
    Column("torque_activity_nm", "torque activity", "N m", 4),
)
"""What has to be seen beside the errors: an arm that is stiff or chatters can make them look good."""
EXPLAINED = (
    "RMS, mean ± standard deviation over seeds. e_p and e_q by motion capture, e_q against the attitude that the law asked for. "
    "Impedance: RMS after the catch of M_d e'' + K_d e' + K_p e - e_tau with each preset's own gains, which is what keeps the machine "
    "from its own desired impedance; PSC has none for the base. Torque activity: RMS change of the commanded joint torques from one "
    "tick to the next. A flight that was not flown to its end is counted, its errors are not averaged."
)


def spread_text(spread: Spread | None, digits: int, *, deviation: bool = True) -> str:
    """`0.0224±.0012`; a dash where nothing is known."""
    if spread is None:
        return "–"
    text = f"{spread.mean:.{digits}f}"
    if spread.std is None or not deviation:
        return text
    return f"{text}±{f'{spread.std:.{digits}f}'.removeprefix('0') or '0'}"


def ours_text(cell: Cell, column: Column, *, deviation: bool = True) -> str:
    """Our figure; nothing where flights that ended early have none."""
    spread = cell.figures[column.name]
    return "" if spread is None and cell.failures else spread_text(spread, column.digits, deviation=deviation)


def printed_text(cell: Cell, column: Column) -> str:
    """The paper's figure, empty if it prints none."""
    if cell.printed is None:
        return ""
    _, part, key = column.name.split(".")
    figures = cell.printed.pre if part == "pre" else cell.printed.post
    if figures is None:
        return "crashed"
    return f"{getattr(figures, key):.{column.digits}f}"


def by_payload(cells: Sequence[Cell]) -> Iterator[tuple[float, list[Cell]]]:
    """Cells of the same payload together."""
    ordered = sorted(cells, key=lambda cell: cell.payload_kg)
    for payload_kg, group in groupby(ordered, key=lambda cell: cell.payload_kg):
        yield payload_kg, list(group)


def print_tables(cells: Sequence[Cell], console: Console) -> None:
    """Both tables; without the deviations where the terminal is too narrow for them, but never with figures cut off."""
    unlimited, width = console.options.update(max_width=10_000), console.width
    for make in (tracking_table, compliance_table):
        table = make(cells)
        if Measurement.get(console, unlimited, table).maximum > width:
            table = make(cells, deviation=False)
        console.width = max(width, Measurement.get(console, unlimited, table).maximum)
        console.print(table, highlight=False)
        console.width = width


def tracking_table(cells: Sequence[Cell], *, deviation: bool = True) -> Table:
    """The paper's table, its printed values beside ours."""
    table = _table("Tracking before and after the catch")
    for part, column in zip(("before", "before", "after", "after"), TRACKING, strict=True):
        gap = " " if deviation else "\n"
        table.add_column(f"{part}\n{column.title}{gap}[{column.unit}]".replace("[", r"\["), justify="right")
        table.add_column("\npaper", justify="right", style="dim")
    for payload_kg, group in by_payload(cells):
        for n, cell in enumerate(group):
            texts = []
            for column in TRACKING:
                texts += [ours_text(cell, column, deviation=deviation), printed_text(cell, column)]
            _add(table, payload_kg if n == 0 else None, cell, texts, 4)
        table.add_section()
    return table


def compliance_table(cells: Sequence[Cell], *, deviation: bool = True) -> Table:
    """What the errors do not tell."""
    table = _table("After the catch")
    for column in COMPLIANCE:
        words = column.title.replace(" ", "\n", 1) if " " in column.title else f"\n{column.title}"
        gap = " " if deviation else "\n"
        table.add_column(f"{words}{gap}[{column.unit}]".replace("[", r"\["), justify="right")
    for payload_kg, group in by_payload(cells):
        for n, cell in enumerate(group):
            texts = [ours_text(cell, column, deviation=deviation) for column in COMPLIANCE]
            _add(table, payload_kg if n == 0 else None, cell, texts, 0)
        table.add_section()
    return table


def _table(title: str) -> Table:
    table = Table(
        title=title,
        title_justify="left",
        title_style="bold",
        header_style="bold",
        box=box.SIMPLE,
        pad_edge=False,
        padding=(0, 1, 0, 0),
    )
    table.add_column("\npayload", no_wrap=True)
    table.add_column("\ncontroller", no_wrap=True)
    return table


def _add(table: Table, payload_kg: float | None, cell: Cell, texts: list[str], failure_at: int) -> None:
    """A line; what went wrong is said in the place of the figures that it cost, or below those of the other seeds."""
    if cell.failures:
        style = "red" if set(cell.failures) != {MISSED} else "yellow"
        failure = f"[{style}]{escape(cell.failure_text)}[/]"
        texts[failure_at] = f"{texts[failure_at]}\n{failure}" if texts[failure_at] else failure
    table.add_row("" if payload_kg is None else f"{payload_kg:g} kg", escape(cell.short_label), *texts)


def write_csv(rows: Sequence[Row], path: Path) -> None:
    """One line per flight, nested names joined by dots; an unknown value is empty."""
    with open(path, "w", newline="", encoding="utf-8") as file:
        writer: Any = csv.writer(file)
        for n, row in enumerate(rows):
            names, values = zip(*flat(row), strict=True)
            if n == 0:
                writer.writerow(names)
            writer.writerow(values)
