"""`companion faults` as a campaign: one fault per flight in every phase of a mission."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from contextlib import AbstractContextManager
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from rich.console import Console

from companion.analysis.page import Page, Picture, Section
from companion.analysis.table import Cell, Column, Table, for_terminal, number, table
from companion.campaigns.faults.judge import good
from companion.campaigns.faults.sitl_flights import WireFlights, default_jobs
from companion.campaigns.faults.variants import Variant
from companion.campaigns.runner import Campaign, Flights, Row, counted, outcomes
from companion.sitl_config.faults import KINDS, FlightPhase


@dataclass(kw_only=True)
class Faults(Campaign):
    """A campaign of flights with injected faults, flown in the fast loop or with `companion fly --sitl` over the real protocols."""

    name = "faults"
    csv_name = "faults.csv"

    planned: Sequence[tuple[Variant, FlightPhase]]
    wires: Sequence[str] | None = None
    """Arguments of `companion fly` for flights over the real protocols; None for the fast loop."""

    def start(self, out: Path) -> AbstractContextManager[Flights]:
        """Start the flights; a flight of `companion fly` writes a folder into `out`."""
        if self.wires is None:
            return super().start(out)
        return WireFlights(self.planned, self.wires, self.configs[0], out, self.jobs or default_jobs())

    def settings(self) -> dict[str, Any]:
        """Return the settings of the campaign for the results file."""
        return {**super().settings(), "controller": self.configs[0].sources.controller, "where": self._where}

    @property
    def _where(self) -> str:
        return "in the fast closed loop" if self.wires is None else "over the real protocols"

    def label(self, row: Row) -> str:
        """Return the label that distinguishes a flight from the others."""
        return f"{row['fault']} {shown_size(row)}".strip() + f" in {row['phase']}"

    def summary(self, rows: Sequence[Row]) -> dict[str, Any]:
        """Return the outcomes and the extreme values of all flights."""
        return {
            "summary": {
                "flights": len(rows),
                "faults": len({(row["fault"], row["size"], row["duration_s"]) for row in rows}),
                "outcomes": outcomes(rows),
                "bad": sum(not good(row) for row in rows),
                "worst_tilt_deg": extreme(rows, "worst_tilt_deg", max),
                "min_height_m": extreme(rows, "min_height_m", min),
                "min_slack_m": extreme(rows, "min_slack_m", min),
            }
        }

    def page(self, rows: Sequence[Row], pictures: Sequence[Picture]) -> Page:
        """Return the page: first the bad flights, then all flights."""
        bad = [row for row in rows if not good(row)]
        explained = (
            "Times are in s from the start of the fault. Height: minimum while the vehicle should have been airborne. Slack: "
            "minimum tether slack. Drift: distance from the abort to the landing, or the largest error of a mission that "
            "continued."
        )
        sections = [Section("All flights", tables=[flights_table(rows, details=True)], text=explained)]
        if bad:
            sections.insert(0, Section("Bad flights", tables=[flights_table(bad, details=True)]))
        return Page(
            "Fault campaign",
            f"{self.configs[0].sources.mission} · {len(rows)} flights {self._where} · world {self.world} · {counted(rows)}",
            sections,
            f"{len(bad)} of {len(rows)} flights violated a safety requirement."
            if bad
            else "No flight violated a safety requirement.",
            good=not bad,
        )

    def show(self, rows: Sequence[Row], console: Console) -> None:
        """Print one line per flight, then the problems."""
        console.print(for_terminal(flights_table(rows)), highlight=False)
        console.print(f"{len(rows)} flights: {counted(rows)}", highlight=False)
        for row in rows:
            if not good(row):
                text = f"{self.label(row)}: {'; '.join([*row['problems'], *_error(row)])}"
                console.print(text, style="red", highlight=False, markup=False)

    def good(self, rows: Sequence[Row]) -> bool:
        """Return whether every flight was good."""
        return all(map(good, rows))


def extreme(rows: Sequence[Row], key: str, pick: Callable[[list[float]], float]) -> float | None:
    """Return the value of a key that `pick` (max or min) selects over all rows; None if no row has a value."""
    values = [row[key] for row in rows if row[key] is not None]
    return pick(values) if values else None


def shown_size(row: Row) -> str:
    """Return a fault's size with its unit, and its duration if that is not the size itself; empty if the fault has no size."""
    if row["size"] is None:
        return ""
    text = f"{row['size']:g} {row['unit']}".strip()
    same = row["unit"] == "s" and row["size"] == row["duration_s"]
    return text if row["duration_s"] is None or same else f"{text}, {row['duration_s']:g} s"


def size_meaning(size: str | None, unit: str) -> str:
    """Return the meaning of the size of a kind of fault, such as `shift, m`."""
    return "" if size is None else f"{size}, {unit}" if unit else size


def flights_table(rows: Sequence[Row], *, details: bool = False) -> Table:
    """Return a table with one line per flight.

    Args:
        details: whether to add a column with problems and events.
    """

    def text(title: str, key: str) -> Column:
        return Column(title, lambda row: row[key] or "", left=True)

    def value(title: str, key: str, form: str) -> Column:
        return Column(title, lambda row: number(row[key], form))

    columns = [
        text("fault", "fault"),
        Column("size", shown_size),
        text("phase", "phase"),
        text("outcome", "outcome"),
        value("detected s", "detected_s", ".3f"),
        text("by", "event"),
        value("reacted s", "reacted_s", ".3f"),
        text("action", "action"),
        value("tilt deg", "worst_tilt_deg", ".1f"),
        value("height m", "min_height_m", ".2f"),
        value("slack m", "min_slack_m", ".2f"),
        value("drift m", "drift_m", ".2f"),
    ]
    if any(row["contact_n"] is not None for row in rows):
        columns.append(value("force N", "contact_n", ".1f"))
    if details:
        columns.append(
            Column(
                "problems, events",
                lambda row: Cell("; ".join([*row["problems"], *row["events"], *_error(row)]), "text"),
                left=True,
            )
        )
    return table(columns, rows, kind=lambda row: "" if good(row) else "bad")


def _error(row: Row) -> list[str]:
    return [row["error"]] if row["error"] else []


def kinds_table() -> Table:
    """Return the table of `companion faults --list`."""
    columns = (
        Column("kind", lambda kind: kind["kind"], left=True),
        Column("what happens", lambda kind: kind["what"], left=True),
        Column("size", lambda kind: size_meaning(kind["size"], kind["unit"]), left=True),
        Column("default", lambda kind: number(kind["default"], "g"), left=True),
        Column("phases", lambda kind: " ".join(kind["phases"]), left=True),
    )
    return table(columns, kinds_list())


def kinds_list() -> list[dict[str, Any]]:
    """Return the kinds of faults as plain data, for `companion faults --list --json`."""
    keys = ("what", "size", "unit", "default", "named_by", "phases")
    return [{"kind": name, **{key: getattr(kind, key) for key in keys}} for name, kind in KINDS.items()]
