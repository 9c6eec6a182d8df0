"""`companion robustness` of a team file: two vehicles and their bar in many laboratories."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from rich.console import Console

from companion.analysis.page import Page, Picture, Section
from companion.analysis.table import Column, Table, for_terminal, number, table
from companion.campaigns.process import Message
from companion.campaigns.robustness.draws import SAFE
from companion.campaigns.runner import Campaign, Row, counted, outcomes
from companion.model.types import Outcome

FIGURES = {
    "bar_p_rms_m": ("place of the bar, mm RMS", 1e3),
    "bar_tilt_rms_deg": ("tilt of the bar, deg RMS", 1.0),
    "internal_force_rms_n": ("internal force, N RMS", 1.0),
    "share": ("share of the left vehicle", 1.0),
}
"""Figures of a completed flight, as `summary.json` has them, with their names and scales for the table."""


@dataclass(kw_only=True)
class PairRobustness(Campaign):
    """A campaign of a team; the configurations are those of the left and of the right member."""

    name = "robustness"
    csv_name = "draws.csv"

    team: str
    """Team file as named by the user."""
    seed: int

    def job(self) -> Message:
        """Return the job for `sitl.campaigns`."""
        return {**super().job(), "campaign": "pair", "seed": self.seed}

    def settings(self) -> dict[str, Any]:
        """Return the settings of the campaign for the results file."""
        return {**super().settings(), "team": self.team, "seed": self.seed}

    def label(self, row: Row) -> str:
        """Return the label that distinguishes a flight from the others."""
        return str(row["name"])

    def summary(self, rows: Sequence[Row]) -> dict[str, Any]:
        """Return the outcomes and the distribution of each figure."""
        return {
            "summary": {
                "flights": len(rows),
                "outcomes": outcomes(rows),
                **{key: quantiles(rows, key) for key in FIGURES},
            }
        }

    def csv_row(self, row: Row) -> dict[str, Any]:
        """Return the row as columns of the CSV file, each member's events in one of its own."""
        members = zip(("left", "right"), row["outcomes"], row["events"], strict=True)
        of_each = {
            key: value
            for name, outcome, events in members
            for key, value in ((f"{name}_outcome", outcome), (f"{name}_events", " ".join(events)))
        }
        return {key: value for key, value in row.items() if key not in ("outcomes", "events")} | of_each

    def page(self, rows: Sequence[Row], pictures: Sequence[Picture]) -> Page:
        """Return the page."""
        unsafe = sum(row["outcome"] not in SAFE for row in rows)
        return Page(
            "Robustness",
            f"{self.team} · {len(rows)} draws of world {self.world} in the fast loop",
            [Section("The bar", tables=[_figures_table(rows)]), Section("Not completed", tables=[_ended_table(rows)])],
            verdict=f"{len(rows)} flights: {counted(rows)}.",
            good=not unsafe,
        )

    def show(self, rows: Sequence[Row], console: Console) -> None:
        """Print the distribution and the flights that were not completed."""
        console.print(f"{len(rows)} flights: {counted(rows)}", highlight=False)
        console.print(for_terminal(_figures_table(rows)), highlight=False)
        if any(row["outcome"] != Outcome.COMPLETED.value for row in rows):
            console.print(for_terminal(_ended_table(rows)), highlight=False)

    def good(self, rows: Sequence[Row]) -> bool:
        """Return whether every flight ended safely."""
        return all(row["outcome"] in SAFE for row in rows)


def quantiles(rows: Sequence[Row], key: str) -> dict[str, float | None]:
    """Return median, 95th percentile and maximum of a figure over the completed flights."""
    values = [row[key] for row in rows if row["outcome"] == Outcome.COMPLETED.value and row[key] is not None]
    if not values:
        return {"p50": None, "p95": None, "max": None}
    p50, p95, most = np.percentile(values, (50, 95, 100)).tolist()
    return {"p50": p50, "p95": p95, "max": most}


def _figures_table(rows: Sequence[Row]) -> Table:
    def of(which: str) -> Column:
        def show(key: str) -> str:
            value = quantiles(rows, key)[which]
            return number(None if value is None else value * FIGURES[key][1], ".2f", "–")

        return Column(which, show)

    return table(
        (Column("figure", lambda key: FIGURES[key][0], left=True), of("p50"), of("p95"), of("max")),
        list(FIGURES),
        title="",
    )


def _ended_table(rows: Sequence[Row]) -> Table:
    ended = [row for row in rows if row["outcome"] != Outcome.COMPLETED.value]
    columns = (
        Column("flight", lambda row: str(row["name"]), left=True),
        Column("outcome", lambda row: str(row["outcome"]), left=True),
        Column("why", lambda row: str(row["why"] or row["error"] or "no event gives a reason"), left=True),
    )
    return table(columns, ended, title="")
