"""Axes over the mission time, on which a flight's phases and its catch are marked. Needs matplotlib (extra `analysis`)."""

from __future__ import annotations

from typing import Any

import numpy as np
from matplotlib.figure import Figure

from companion.analysis import metrics
from companion.analysis.log import Array, FlightLog
from companion.analysis.plot_style import DASHED, INK, dress, mark_catch, new_figure
from companion.model.outputs import Outputs
from companion.model.types import PhaseKind

_PHASES_NAMED_MAX = 40
"""Number of phases above which only kinds of phases are distinguished."""
_PHASES = {PhaseKind.TAKEOFF: "#eaf3fb", PhaseKind.FLIGHT: "#ffffff", PhaseKind.LANDING: "#f6f0e3"}


def stack(
    log: FlightLog, title: str, heights: tuple[float, ...], height_in: float = 6.8
) -> tuple[Figure, list[Any], Array]:
    """Return a figure, its axes over a common time axis with phases and catch marked, and each tick's mission time or NaN."""
    figure = new_figure(height_in, layout=None)  # a layout by measuring takes half of the time of drawing
    figure.subplots_adjust(left=0.09, right=0.985, top=1.0 - 0.62 / height_in, bottom=0.5 / height_in, hspace=0.13)
    grid = figure.subplots(len(heights), 1, sharex=True, squeeze=False, height_ratios=heights)
    axes = [row[0] for row in grid]
    flying = np.array([o.phase_kind in _PHASES for o in log.outputs], dtype=np.bool_)
    t_s = log.columns.mission_t_s
    span = t_s[flying] if flying.any() else t_s
    for ax in axes:
        dress(ax)
        ax.set_xlim(float(span[0]), float(max(span[-1], span[0] + 0.1)))
        ax.margins(y=0.12)
    _mark_phases(log, axes)
    axes[-1].set_xlabel("mission time [s]")
    figure.suptitle(title, y=1.0 - 0.08 / height_in, fontsize=13, fontweight="bold", color=INK)
    return figure, axes, np.where(flying, t_s, np.nan) if flying.any() else t_s


def _mark_phases(log: FlightLog, axes: list[Any]) -> None:
    start = 0
    outputs = log.outputs
    whole_s = max(outputs[-1].mission_t_s, 1e-3)
    named = len({o.phase for o in outputs}) <= _PHASES_NAMED_MAX

    def same(one: Outputs, other: Outputs) -> bool:
        return one.phase_kind == other.phase_kind and (one.phase == other.phase or not named)

    for k in range(1, len(outputs) + 1):
        if k < len(outputs) and same(outputs[k], outputs[start]):
            continue
        colour = _PHASES.get(outputs[start].phase_kind)
        if colour is not None:
            begin_s, end_s = outputs[start].mission_t_s, outputs[min(k, len(outputs) - 1)].mission_t_s
            for ax in axes:
                ax.axvspan(begin_s, end_s, facecolor=colour, zorder=0, lw=0)
                if start:
                    ax.axvline(begin_s, color="#d5dbe1", lw=0.8, zorder=1)
            name = outputs[start].phase if named else outputs[start].phase_kind.value
            # A name is written only where it fits: about 90 characters fill the whole axis.
            if (end_s - begin_s) / whole_s > 0.012 * len(name):
                middle_s = (begin_s + end_s) / 2
                transform = axes[0].get_xaxis_transform()
                axes[0].text(
                    middle_s, 1.02, name, transform=transform, ha="center", va="bottom", fontsize=8.5, color="#5b6b79"
                )
        start = k
    caught = metrics.catch_index(log)
    if caught is not None:
        mark_catch(axes, outputs[caught].mission_t_s)


def line(ax: Any, t: Array, values: Array, label: str, colour: str, *, reference: bool = False) -> None:
    """Draw a quantity over time; a reference is dashed."""
    style: dict[str, Any] = (
        {"lw": 1.2, "ls": DASHED, "alpha": 0.9, "zorder": 4} if reference else {"lw": 1.2, "zorder": 3}
    )
    ax.plot(t, values, color=colour, label=label, **style)


def legend(ax: Any, columns: int = 1) -> None:
    """Draw the legend where it hides least."""
    ax.legend(
        fontsize=8.5, ncols=columns, framealpha=0.9, edgecolor="none", handlelength=1.8, columnspacing=1.2, loc="best"
    )
