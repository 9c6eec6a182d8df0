"""CMA-ES over the unit cube, with a race within each generation.

All candidates of a generation fly the first laboratories, the better half of them the next ones, and the better half of these the
rest: CMA-ES needs only the order of the candidates, and a hopeless one shows early. Laboratories and noise are the same for all.

The search is a function of its seed and of the costs only. So a search that was interrupted is repeated from the start with the costs
that are known already, and gives the same bits.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, field
from typing import Any

import numpy as np

from companion.campaigns.cost import cost_of
from companion.campaigns.tune.space import Point

FIRST_STEP = 0.15
"""Initial standard deviation, as a share of the logarithmic range of each parameter."""
CONVERGED = 2e-3
"""Largest standard deviation at which the search ends before its budget is used."""

Evaluate = Callable[[Sequence[Point], Sequence[int]], Sequence[Sequence[float]]]
"""Returns the cost of each point (rows) in each laboratory (columns, numbers from 0)."""


@dataclass(slots=True)
class Evaluation:
    """What is known of one candidate."""

    point: Point
    generation: int
    """0 for the start."""
    costs: list[float] = field(default_factory=list)
    """Its costs in the first laboratories, as far as it came in the race."""

    @property
    def cost(self) -> float:
        """Return the cost of the candidate, over the laboratories in which it has flown."""
        return cost_of(self.costs)


def rungs_of(draws: int) -> list[int]:
    """Return the number of laboratories that a candidate has flown at each stage of the race: a quarter, half, all."""
    return sorted({math.ceil(draws / 4), math.ceil(draws / 2), draws})


def survivors_of(candidates: int, rungs: int) -> list[int]:
    """Return the number of candidates in each stage of a race."""
    return [max(1, math.ceil(candidates / 2**rung)) for rung in range(rungs)]


def population_of(dimensions: int) -> int:
    """Return the number of candidates of a generation (CMA-ES default)."""
    return 4 + int(3 * math.log(dimensions))


def batches_of(budget: int, dimensions: int, draws: int) -> Iterator[int]:
    """Yield the number of flights of each batch of a search, in order; the flights of a batch can be flown at the same time."""
    rungs, left = rungs_of(draws), budget - 1
    yield draws
    while left > 0:
        candidates = min(left, population_of(dimensions))
        left -= candidates
        before = 0
        for rung, survivors in zip(rungs, survivors_of(candidates, len(rungs)), strict=True):
            yield survivors * (rung - before)
            before = rung


class Search:
    """One search.

    Args:
        budget: number of candidates to evaluate, the start included.
    """

    def __init__(self, start: Point, draws: int, budget: int, seed: int, evaluate: Evaluate) -> None:
        import cma

        self._draws, self._budget, self._evaluate = draws, budget, evaluate
        self.evaluations: list[Evaluation] = []
        """All candidates, in order; the first is the start."""
        self.steps: list[tuple[float, ...]] = []
        """Standard deviation of each coordinate after each generation."""
        randn = np.random.RandomState(seed).randn
        options = {"bounds": [0.0, 1.0], "seed": math.nan, "randn": randn, "verbose": -9}
        options["popsize"] = population_of(len(start))
        self._strategy: Any = cma.CMAEvolutionStrategy(list(start), FIRST_STEP, options)

    @property
    def start(self) -> Evaluation:
        """Return the start."""
        return self.evaluations[0]

    @property
    def best(self) -> Evaluation:
        """Return the best of the candidates that have flown in all laboratories."""
        return min((one for one in self.evaluations if len(one.costs) == self._draws), key=lambda one: one.cost)

    @property
    def converged(self) -> bool:
        """Return whether the distribution is so narrow that further candidates are the same."""
        return bool(self.steps) and max(self.steps[-1]) < CONVERGED

    def run(self, start: Point) -> None:
        """Search until the budget is used or the search has converged. The last candidate is the centre of the distribution."""
        self._race([start], 0)
        generation = 0
        while (left := self._budget - len(self.evaluations)) > 0 and not self.converged:
            generation += 1
            if generation > 1 and left == 1:
                self._race([self._point(self._strategy.result.xfavorite)], generation)
                return
            asked = self._strategy.ask()
            points = [self._point(one) for one in asked]
            if left <= len(points):
                # Too few for a generation; one stays for the centre.
                self._race(points[: left - 1 if generation > 1 else left], generation)
                continue
            order = self._race(points, generation)
            ranks = [0.0] * len(points)
            for rank, index in enumerate(order):
                ranks[index] = float(rank)
            self._strategy.tell(asked, ranks)
            self.steps.append(tuple(float(value) for value in self._strategy.result.stds))

    @staticmethod
    def _point(values: Any) -> Point:
        return tuple([min(1.0, max(0.0, float(value))) for value in values])

    def _race(self, points: Sequence[Point], generation: int) -> list[int]:
        """Evaluate candidates; return their indices, the best first."""
        entered = [Evaluation(point, generation) for point in points]
        self.evaluations += entered
        rungs = rungs_of(self._draws)
        if generation == 0:
            rungs = rungs[-1:]
        order = list(range(len(points)))
        flown = 0
        for rung, survivors in zip(rungs, survivors_of(len(points), len(rungs)), strict=True):
            racing = order[:survivors]
            costs = self._evaluate([points[index] for index in racing], range(flown, rung))
            for index, more in zip(racing, costs, strict=True):
                entered[index].costs += more
            racing.sort(key=lambda index: (entered[index].cost, index))
            order[:survivors] = racing
            flown = rung
        return order
