"""`companion robustness` of a team file: two vehicles and their bar in many laboratories."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

from rich.console import Console

from companion.analysis.page import Page, Picture, Section
from companion.analysis.pair import FIGURES
from companion.analysis.table import Column, Table, for_terminal, number, table
from companion.campaigns.process import Message
from companion.campaigns.robustness.campaign import Drawn
from companion.campaigns.robustness.draws import SAFE, quantiles, why_of
from companion.campaigns.runner import Row, counted, outcomes
from companion.model.types import Outcome

_SHOWN = tuple(key for key in FIGURES if key != "let_go")
"""Figures of the table, of completed flights."""


@dataclass(kw_only=True)
class PairRobustness(Drawn):
    """A campaign of a team; the configurations are those of the left and of the right member."""

    team: str
    """Team file as named by the user."""

    def job(self) -> Message:
        """Return the job for `sitl.campaigns`."""
        return {**super().job(), "campaign": "pair", "seed": self.seed}

    def settings(self) -> dict[str, Any]:
        """Return the settings of the campaign for the results file."""
        return {**super().settings(), "team": self.team, "seed": self.seed}

    def summary(self, rows: Sequence[Row]) -> dict[str, Any]:
        """Return the outcomes and the distribution of each figure."""
        return {
            "summary": {
                "flights": len(rows),
                "outcomes": outcomes(rows),
                **{key: _spread(rows, key) for key in _SHOWN},
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


def _spread(rows: Sequence[Row], key: str) -> dict[str, float | None]:
    """Return the distribution of a figure over the completed flights."""
    completed = [row for row in rows if row["outcome"] == Outcome.COMPLETED.value]
    return quantiles([row[key] for row in completed if row[key] is not None])


def _figures_table(rows: Sequence[Row]) -> Table:
    def of(which: str) -> Column:
        def show(key: str) -> str:
            value = _spread(rows, key)[which]
            return number(None if value is None else value * FIGURES[key][2], ".2f", "–")

        return Column(which, show)

    figure = Column("figure", lambda key: "{}, {}".format(*FIGURES[key]), left=True)
    return table((figure, of("p50"), of("p95"), of("max")), _SHOWN, title="")


def _ended_table(rows: Sequence[Row]) -> Table:
    ended = [row for row in rows if row["outcome"] != Outcome.COMPLETED.value]
    columns = (
        Column("flight", lambda row: str(row["name"]), left=True),
        Column("outcome", lambda row: str(row["outcome"]), left=True),
        Column("why", why_of, left=True),
    )
    return table(columns, ended, title="")
