"""side_by_side.html: facts about the flights, differing settings, all metrics, the plots and the events."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

from companion.analysis.page import Page, Picture, Section, write_page
from companion.analysis.table import Cell, Column, Table, table
from companion.campaigns.side_by_side.comparison import MARKED_FROM, Comparison, Figure
from companion.campaigns.side_by_side.plots import LINES
from companion.campaigns.side_by_side.settings import Setting, text_of

_EVENTS_SHOWN = 40
"""Number of events above which the table of events is folded."""


def write_html(comparison: Comparison, pictures: Sequence[Picture], path: Path) -> None:
    """Write the page."""
    zero = {"catch": "the catch", "takeoff": "take-off", "start": "the first tick of the log"}[comparison.align]
    tables = [_settings(comparison, comparison.settings, "")] if comparison.settings else []
    if comparison.addresses:
        title = "Addresses of the simulated devices, chosen for each flight"
        tables.append(_settings(comparison, comparison.addresses, title))
    marked = (
        f"Below each value: its difference from A. A value is marked if it differs from A's by more than {100 * MARKED_FROM:.0f} %, "
        "and only where a smaller value is certainly better. Single flights have no statistical weight; companion compare flies many."
    )
    events = _events(comparison)
    sections = [
        Section("What was flown", tables=[_about(comparison)]),
        Section(
            "Settings that differ",
            "" if comparison.settings else "None: the effective configurations are equal.",
            tables,
        ),
        Section("Figures", tables=[_figures(comparison)], text=marked),
        *([Section("Pictures", pictures=pictures)] if pictures else []),
        Section("Events", "" if events.rows else "None.", [events] if events.rows else ()),
    ]
    page = Page(
        "Flights side by side",
        f"{len(comparison.flights)} flights, aligned at {zero}; differences are from A.",
        sections,
        notes=[*comparison.cautions, *comparison.notes],
        verdict=comparison.fair,
        good=not comparison.cautions,
    )
    write_page(page, path)


def _columns(comparison: Comparison, show: Callable[[Any, int], Cell], *, left: bool = True) -> list[Column]:
    """Return one column per flight; `show` receives the item and the position of the flight."""
    return [
        Column(f"{flight.letter} {flight.name}", lambda item, n=n: show(item, n), left=left, line=LINES[n])  # type: ignore[misc]
        for n, flight in enumerate(comparison.flights)
    ]


def _about(comparison: Comparison) -> Table:
    def show(fact: tuple[str, tuple[str, ...]], n: int) -> Cell:
        name, texts = fact
        failed = name == "outcome" and not comparison.flights[n].completed
        return Cell(texts[n], "bad" if failed else "code" if name == "log" else "")

    facts = [*comparison.about, ("log", tuple(flight.path for flight in comparison.flights))]
    return table([Column("", lambda fact: str(fact[0]), left=True), *_columns(comparison, show)], facts)


def _settings(comparison: Comparison, settings: Sequence[Setting], folded_title: str) -> Table:
    def show(setting: Setting, n: int) -> Cell:
        return Cell(text_of(setting.values[n]), "code") if setting.present[n] else Cell("no such key", "soft")

    key = Column("key of the effective configuration", lambda setting: Cell(setting.key, "code"), left=True)
    return table([key, *_columns(comparison, show)], settings, title=folded_title, folded=bool(folded_title))


def _figures(comparison: Comparison) -> Table:
    columns = _columns(comparison, _figure, left=False)
    return table([Column("", lambda figure: str(figure.label), left=True), *columns], comparison.figures)


def _figure(figure: Figure, n: int) -> Cell:
    value, difference, first = figure.values[n], figure.differences[n], figure.values[0]
    text = "–" if value is None else f"{value:z.{figure.digits}f}"
    if n == 0:
        return Cell(text)
    if difference is None or first is None:
        return Cell(text, note="–")
    shown = f"{difference:+z.{figure.digits}f}"
    if float(shown) == 0:
        shown = "0" if difference == 0 else "≈ 0"
    elif first:
        ratio = (first + difference) / first
        # A percentage above 900, or of a value with a changed sign, is useless.
        if ratio >= 10:
            shown += f" ({ratio:.0f}\u00a0times)"
        elif ratio >= 0:
            shown += f" ({100 * (ratio - 1):+z.0f}\u00a0%)"
    verdict = figure.verdicts[n]
    return Cell(text, note=f"{shown} {verdict}" if verdict else shown, note_kind=verdict or "soft")


def _events(comparison: Comparison) -> Table:
    events = sorted(
        (
            (float(event["t_s"]) - zero_s, n, event)
            for n, (flight, zero_s) in enumerate(zip(comparison.flights, comparison.zeros_s, strict=True))
            for event in flight.summary["events"]
        ),
        key=lambda row: row[:2],
    )
    columns = (
        Column("t [s]", lambda row: f"{row[0]:+z.2f}"),
        Column("mission t [s]", lambda row: f"{float(row[2]['mission_t_s']):.2f}"),
        Column("", lambda row: Cell(comparison.flights[row[1]].letter, line=LINES[row[1]]), left=True),
        *(Column(title, lambda row, key=key: str(row[2][key]), left=True)  # type: ignore[misc]
          for title, key in (("event", "id"), ("severity", "severity"), ("action", "action"))),
        Column("", lambda row: Cell(row[2]["text"], "text"), left=True),
    )  # fmt: skip
    folded = len(events) > _EVENTS_SHOWN
    title = f"{len(events)} events" if folded else ""
    return table(columns, events, title=title, kind=lambda row: str(row[2]["severity"]), folded=folded)
