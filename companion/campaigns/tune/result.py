"""The results of a search: gains, their sensitivities, and costs in held-out laboratories."""

from __future__ import annotations

import math
import random
import shlex
from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import Any

from companion.campaigns.cost import cost_of, flight_cost
from companion.campaigns.robustness.draws import rank_correlation
from companion.campaigns.runner import Row
from companion.campaigns.tune.draws import Draws
from companion.campaigns.tune.search import Evaluation, Search, rungs_of
from companion.campaigns.tune.space import Space
from companion.model.types import Outcome

BOOTSTRAPS = 2000
NEAR_BOUND = 0.03
"""Distance from a bound, as a share of the logarithmic range, below which a gain is marked."""


@dataclass(frozen=True, slots=True)
class HeldOut:
    """Rows of start and found gains in the same held-out laboratories."""

    before: Sequence[Row]
    after: Sequence[Row]

    def costs(self) -> tuple[float, float]:
        """Return the cost of the start and that of the found gains."""
        return cost_of([*map(flight_cost, self.before)]), cost_of([*map(flight_cost, self.after)])

    def change_95(self) -> tuple[float, float]:
        """Return the 95 % interval of the relative change of the cost.

        It is the paired bootstrap's over the laboratories: start and found gains have flown in the same ones.
        """
        pairs = [(flight_cost(old), flight_cost(new)) for old, new in zip(self.before, self.after, strict=True)]
        draw = random.Random(0)
        changes = []
        for _ in range(BOOTSTRAPS):
            before, after = zip(*draw.choices(pairs, k=len(pairs)), strict=True)
            changes.append(cost_of(after) / cost_of(before) - 1.0)
        changes.sort()
        tail = round(0.025 * BOOTSTRAPS)
        return changes[tail], changes[-1 - tail]


@dataclass(frozen=True, slots=True)
class Gain:
    """What the search found for one axis."""

    name: str
    start: float
    found: float
    low: float
    high: float
    spread: float | None
    """Factor by which the distribution of the search still varies the gain at its end; None if it never learned."""
    correlation: float | None
    """Rank correlation of the gain with the cost in the first laboratories, over all candidates."""
    near_bound: bool


@dataclass(frozen=True)
class Result:
    """The results of a search that has ended."""

    settings: dict[str, Any]
    command: str
    fly: str
    space: Space
    search: Search
    training: Draws
    held_out: Draws
    judged: HeldOut

    @cached_property
    def better(self) -> bool:
        """Whether the found gains surely cost less than the start in laboratories like the held-out ones."""
        return self.search.best is not self.search.start and self.change_95[1] < 0.0

    @cached_property
    def change_95(self) -> tuple[float, float]:
        """The 95 % interval of the relative change of the cost in the held-out laboratories."""
        return self.judged.change_95()

    @cached_property
    def gains(self) -> list[Gain]:
        """What was found for each axis."""
        space, search = self.space, self.search
        costs = first_costs(search.evaluations, self.training.count)
        found = space.values(search.best.point)
        steps = search.steps[-1] if search.steps else None
        made = []
        for n, (axis, value) in enumerate(zip(space.axes, found, strict=True)):
            at = search.best.point[n]
            made.append(
                Gain(
                    axis.name,
                    axis.start,
                    value,
                    axis.low * axis.start,
                    axis.high * axis.start,
                    None if steps is None else math.exp(steps[n] * math.log(axis.high / axis.low)),
                    rank_correlation([one.point[n] for one in search.evaluations], costs),
                    min(at, 1.0 - at) < NEAR_BOUND,
                )
            )
        return made

    @property
    def verdict(self) -> str:
        """Return one sentence on the result."""
        if self.search.best is self.search.start:
            return "no candidate costs less than the start in the laboratories of the search; no controller file was written"
        before, after = self.judged.costs()
        low, high = self.change_95
        share = f"{after / before - 1.0:+.0%}, 95 % interval {low:+.0%} to {high:+.0%}"
        text = f"cost in {self.held_out.count} held-out laboratories: {before:.4f} before, {after:.4f} after ({share})"
        if self.better:
            return text
        return f"{text}; the gains are not surely better, so no controller file was written"

    def data(self, file: Path | None) -> dict[str, Any]:
        """Return the result as plain data."""
        before, after = self.judged.costs()
        search = self.search
        pairs = [
            (flight_cost(old), flight_cost(new)) for old, new in zip(self.judged.before, self.judged.after, strict=True)
        ]
        return {
            "better": self.better,
            "file": None if file is None else str(file),
            "fly": None if file is None else self.fly_line(file),
            "evaluations": len(search.evaluations),
            "converged": search.converged,
            "held_out": {
                "cost_before": before,
                "cost_after": after,
                "change_95": list(self.change_95),
                "completed_before": completed(self.judged.before),
                "completed_after": completed(self.judged.after),
                "better_flights": sum(new < old for old, new in pairs),
                "flights": len(pairs),
                "first_laboratory": self.held_out.first,
            },
            "training": {
                "cost_before": search.start.cost,
                "cost_after": search.best.cost,
                "laboratories": self.training.count,
                "first_laboratory": self.training.first,
            },
            "gains": [
                {
                    "name": gain.name,
                    "start": gain.start,
                    "found": gain.found,
                    "bounds": [gain.low, gain.high],
                    "spread": gain.spread,
                    "rank_correlation": gain.correlation,
                    "near_bound": gain.near_bound,
                }
                for gain in self.gains
            ],
            "settings": self.settings,
            "command": self.command,
        }

    def fly_line(self, file: Path) -> str:
        """Return the command that flies the gains of a file."""
        return f"{self.fly} --controller {shlex.quote(str(file))}"


def flown(row: Row) -> bool:
    """Return whether a flight was completed."""
    return bool(row["outcome"] == Outcome.COMPLETED.value and not row["error"])


def completed(rows: Sequence[Row]) -> int:
    """Return the number of completed flights."""
    return sum(flown(row) for row in rows)


def first_costs(evaluations: Sequence[Evaluation], draws: int) -> list[float]:
    """Return the cost of each candidate in the first laboratories, in which every candidate was flown."""
    first = rungs_of(draws)[0]
    return [cost_of(one.costs[:first]) for one in evaluations]
