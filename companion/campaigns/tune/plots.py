"""The plots of a search: convergence, and the cost against each gain. Needs matplotlib (extra `analysis`)."""

from __future__ import annotations

from itertools import accumulate
from pathlib import Path
from typing import Any

import numpy as np

from companion.analysis.page import Picture
from companion.analysis.plot_style import CATCH, COLOURS, INK, SOFT, dress, figure_legend, new_figure, panels, write_png
from companion.campaigns.tune.result import Result, first_costs

_COLUMNS = 4
_HIGHEST = 2.0
"""Costs above this multiple of the start's cost are drawn at the upper edge."""


def write_pictures(result: Result, out: Path) -> list[Picture]:
    """Draw both plots into a folder and return them."""
    first = np.array(first_costs(result.search.evaluations, result.training.count))
    top = min(_HIGHEST * result.search.start.cost, 1.05 * float(first.max()))
    convergence, gains = out / "convergence.png", out / "gains.png"
    _draw_convergence(result, np.minimum(first, top), convergence)
    _draw_gains(result, np.minimum(first, top), gains)
    return [
        Picture(convergence, "Convergence", "Cost of every candidate, and the width of the search, over the search."),
        Picture(
            gains, "Cost against each gain", "Every candidate in the first laboratories; start dashed, found solid."
        ),
    ]


def _draw_convergence(result: Result, first: Any, path: Path) -> None:
    evaluations = result.search.evaluations
    figure = new_figure(4.2)
    above, below = figure.subplots(2, 1, sharex=True, height_ratios=(2, 1))
    numbers = np.arange(1, len(evaluations) + 1)
    whole = [n for n, one in enumerate(evaluations) if len(one.costs) == result.training.count]
    costs = [evaluations[n].cost for n in whole]
    (dots,) = above.plot(numbers, first, "o", ms=3, mew=0, color=SOFT, alpha=0.7)
    (full,) = above.plot(numbers[whole], costs, "o", ms=4, mew=0, color=COLOURS[0])
    (best,) = above.step(numbers[whole], list(accumulate(costs, min)), where="post", color=COLOURS[1], lw=1.6)
    above.set_ylabel("cost [m]")
    above.set_ylim(0.0, 1.05 * float(max(first.max(), *costs)))
    dress(above)
    generations = [one.generation for one in evaluations]
    ends = [max(n for n, g in enumerate(generations) if g == k + 1) + 1 for k in range(len(result.search.steps))]
    for values in zip(*result.search.steps, strict=True):
        below.plot(ends, values, color=INK, lw=0.8, alpha=0.6)
    below.set_ylabel("width of the\nsearch [range]")
    below.set_xlabel("candidate")
    dress(below)
    names = ["first laboratories", "all laboratories", "best so far"]
    figure_legend(figure, "Convergence", [dots, full, best], names, columns=3)
    write_png(figure, path)


def _draw_gains(result: Result, first: Any, path: Path) -> None:
    space, evaluations = result.space, result.search.evaluations
    lines = -(-len(space.axes) // _COLUMNS)
    figure = new_figure(0.8 + 1.7 * lines)
    values = np.array([space.values(one.point) for one in evaluations])
    colours = np.linspace(0.85, 0.15, len(evaluations))
    for ax, column in panels(figure.subplots(lines, _COLUMNS, squeeze=False), range(len(space.axes))):
        gain = result.gains[column]
        ax.scatter(values[:, column], first, s=7, c=colours, cmap="Blues_r", vmin=0.0, vmax=1.0, lw=0)
        ax.axvline(gain.start, color=INK, lw=1.0, ls=(0, (4, 2)))
        ax.axvline(gain.found, color=CATCH, lw=1.2)
        ax.set_xscale("log")
        # Labels of a logarithmic axis overlap in a small picture.
        ends = [gain.low, (gain.low * gain.high) ** 0.5, gain.high]
        ax.set_xticks(ends, [f"{value:.3g}" for value in ends])
        ax.set_xticks([], minor=True)
        ax.set_ylim(bottom=0.0)
        ax.set_xlabel(gain.name)
        dress(ax)
        ax.tick_params(which="both", labelsize=7)
    figure.supylabel("cost in the first laboratories [m]", fontsize=9.5, color=INK)
    write_png(figure, path)
