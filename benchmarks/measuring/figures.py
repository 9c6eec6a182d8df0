"""Rows of figures with their references, targets and verdicts, computed from the measurements."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field

MET, NOT_MET, NOT_MEASURED = "met", "**not met**", "not measured"
P50_P99 = ("p50", "p99")


@dataclass(frozen=True, slots=True)
class Target:
    """A limit for some of a row's figures."""

    at_most: float
    of: Sequence[str] = P50_P99
    """Statistics that the limit applies to."""
    ratio: bool = True
    """Whether the limit applies to the ratio to the reference, or to the figure itself."""


@dataclass(frozen=True, slots=True)
class Row:
    """One line of a table."""

    what: str
    """What was measured, with its unit."""
    beside: str
    """Name of the reference; empty if there is none."""
    figures: Mapping[str, float]
    """Figures by statistic (p50, p99, ...), or a single `value`; empty if not measured."""
    beside_figures: Mapping[str, float] = field(default_factory=dict)
    target: Target | None = None
    why_not: str = ""
    """Reason for a missing figure, in one line."""

    @property
    def ratios(self) -> dict[str, float]:
        """Ratios of the statistics that both have, where the reference is not 0."""
        return {
            name: value / self.beside_figures[name]
            for name, value in self.figures.items()
            if self.beside_figures.get(name)
        }

    @property
    def verdict(self) -> str:
        """`MET`, `NOT_MET`, `NOT_MEASURED`, or empty without a target."""
        if self.target is None:
            return "" if self.figures else NOT_MEASURED
        judged = self.ratios if self.target.ratio else self.figures
        values = [judged.get(name) for name in self.target.of]
        if any(value is None for value in values):
            return NOT_MEASURED
        return MET if all(value is not None and value <= self.target.at_most for value in values) else NOT_MET


@dataclass(frozen=True, slots=True)
class Section:
    """One table."""

    title: str
    how: Sequence[str]
    """Explanation, one string per paragraph."""
    statistics: Sequence[str]
    """Columns, in order."""
    rows: Sequence[Row]


def problems(sections: Sequence[Section]) -> list[str]:
    """Return one line for each row that has a target and did not meet it or was not measured."""
    found = []
    for row in (row for section in sections for row in section.rows):
        if row.target is not None and row.verdict != MET:
            beside = f" beside {row.beside}" if row.beside else ""
            found.append(f"{row.what}{beside}: {row.verdict.strip('*')}{f': {row.why_not}' if row.why_not else ''}")
    return found


def figure(value: float) -> str:
    """Format a figure with three significant digits, whole numbers in full."""
    if value == round(value):
        return f"{value:.0f}"
    return f"{value:.0f}" if abs(value) >= 100 else f"{value:.3g}"
