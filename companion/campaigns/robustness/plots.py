"""The plot of a robustness campaign: the distribution of e_p over random draws and its correlations.

Needs matplotlib (extra `analysis`).
"""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np

from companion.analysis.plot_style import CATCH, COLOURS, INK, SOFT, dress, figure_legend, new_figure, panels, write_png
from companion.campaigns.robustness.draws import DRIVERS, drivers, graded, influence, sensor_of
from companion.campaigns.runner import Row

_COLOURS = dict(zip(("working", "lost after the catch", "missing at the catch"), COLOURS, strict=False))
_AGAINST = ("payload_kg", "throw_speed_m_s", "setpoint_delay_s", "catch_x_m", "hover_thrust_error")
"""Quantities to plot: the first four that the world drew are shown."""
BARS = 10


def write_distribution(rows: Sequence[Row], title: str, path: Path) -> bool:
    """Draw the plot; return False if no flight caught its payload and was completed."""
    flown = graded(rows)
    if not flown:
        return False
    figure = new_figure(6.0)
    axes = figure.subplots(2, 3)
    sensors = [sensor_of(row) for row in flown]
    error_mm = np.array([row["e_p_m"] for row in flown]) * 1e3
    _histogram(axes[0, 0], error_mm, sensors)
    drawn = {key: np.array([drivers(row["world"])[key] for row in flown], dtype=np.float64) for key in _AGAINST}
    known = [key for key, values in drawn.items() if np.isfinite(values).any()]
    for ax, key in panels(axes.ravel()[1:5], known[:4]):
        _scatter(ax, drawn[key], error_mm, sensors)
        ax.set_xlabel(DRIVERS[key])
        ax.set_ylabel(r"RMS $\|e_p\|$ [mm]")
    _bars(axes[1, 2], list(influence(rows).items()))
    handles = [axes[0, 1].plot([], [], "o", color=colour, ms=5)[0] for colour in _COLOURS.values()]
    figure_legend(figure, title, handles, [f"force sensor {name}" for name in _COLOURS], columns=3)
    write_png(figure, path)
    return True


def _histogram(ax: Any, error_mm: Any, sensors: Sequence[str]) -> None:
    groups = [[e for e, s in zip(error_mm.tolist(), sensors, strict=True) if s == name] for name in _COLOURS]
    bins = np.linspace(0.0, 1.02 * float(error_mm.max()), 31)
    ax.hist(groups, bins=bins, stacked=True, color=list(_COLOURS.values()))
    for share, text, height in ((50, "p50", 0.99), (95, "p95", 0.92)):
        at = float(np.percentile(error_mm, share))
        ax.axvline(at, color=CATCH, lw=1.2, ls=(0, (5, 3)))
        ax.annotate(f"{text} {at:.1f}", (at, height), xycoords=ax.get_xaxis_transform(), xytext=(3, 0),
                    textcoords="offset points", va="top", fontsize=8, color=CATCH)  # fmt: skip
    ax.set_xlabel(r"RMS $\|e_p\|$ after the catch [mm]")
    ax.set_ylabel("flights")
    dress(ax)


def _scatter(ax: Any, values: Any, error_mm: Any, sensors: Sequence[str]) -> None:
    for name, colour in _COLOURS.items():
        these = np.array([sensor == name for sensor in sensors])
        ax.plot(values[these], error_mm[these], "o", ms=3, mew=0, color=colour, alpha=0.65)
    ax.set_ylim(bottom=0.0)
    dress(ax)


def _bars(ax: Any, found: Sequence[tuple[str, float]]) -> None:
    if not found:
        ax.set_visible(False)
        return
    shown = list(found[:BARS])[::-1]
    ax.barh(range(len(shown)), [value for _, value in shown], color=SOFT, height=0.7)
    # Labels are placed next to zero: left of the axis they would take half of the width.
    for at, (key, value) in enumerate(shown):
        left = value > 0
        ax.text(
            -0.03 if left else 0.03,
            at,
            DRIVERS[key],
            ha="right" if left else "left",
            va="center",
            fontsize=7,
            color=INK,
        )
    ax.set_yticks([])
    ax.axvline(0.0, color=INK, lw=0.8)
    ax.set_xlim(-1.35, 1.35)
    ax.set_xticks([-1.0, -0.5, 0.0, 0.5, 1.0])
    ax.set_xlabel(r"rank correlation with $\|e_p\|$")
    dress(ax)
    ax.spines["left"].set_visible(False)
