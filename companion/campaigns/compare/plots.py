"""The plots of a comparison: the distributions of the position error, the error over the model error, the error with and without
adaptation.

Needs matplotlib (extra `analysis`).
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from itertools import cycle, product
from pathlib import Path
from typing import Any

import numpy as np
from matplotlib.figure import Figure
from matplotlib.ticker import FuncFormatter, LogLocator, NullFormatter

from companion.analysis import plot_style
from companion.analysis.log import Array
from companion.analysis.page import Picture
from companion.analysis.plot_style import (
    CATCH,
    COLOURS,
    DASHED,
    INK,
    SOFT,
    dress,
    figure_legend,
    label_lowest,
    new_figure,
    panels,
)
from companion.campaigns.compare.aggregate import Group, Pairs, adaptation_pairs
from companion.campaigns.compare.grid import ABLATED, is_ablation, short_label

PARTS = {"pre": "before", "post": "after"}


def write_pictures(groups: Sequence[Group], out: Path) -> list[Picture]:
    """Write every plot for which there is data as PNG into a folder."""
    return plot_style.write_pictures(distributions(groups), out)


def distributions(groups: Sequence[Group]) -> list[tuple[str, str, str, Figure]]:
    """Return the name, title, caption and figure of each plot of position errors that has data."""
    figures = []
    errors = sorted({group.model_error for group in groups})
    whole = [group for group in groups if not is_ablation(group.preset)]
    first = [group for group in groups if group.model_error == errors[0]]
    ablated = [group for group in first if is_ablation(group.preset) or (group.controller, group.preset) == ABLATED]
    for name, title, shown in (
        ("errors", "Position errors", [group for group in first if not is_ablation(group.preset)]),
        (
            "ablations",
            "Position errors of the ablations",
            ablated if any(is_ablation(group.preset) for group in ablated) else [],
        ),
    ):
        if any(_finite(group, part) for group in shown for part in PARTS):
            caption = (
                "RMS of ‖e_p‖ of every flight, on a logarithmic axis. Long mark: p50, short mark: p95; a failed flight counts as worse "
                "than all others. Diamonds: values printed in the paper."
            )
            figures.append((name, title, caption, _strips(title, shown)))
    if len(errors) > 1 and any(_finite(group, "post") for group in whole):
        figures.append((
            "model_error",
            "Error against model error",
            "RMS of ‖e_p‖ after the catch. Line: p50; band: up to p95, open where more than 5 % of the flights failed.",
            _against_model_error(whole),
        ))  # fmt: skip
    pairs = adaptation_pairs(groups)
    if pairs:
        figures.append((
            "adaptation",
            "Adaptation off and on",
            "RMS of ‖e_p‖ after the catch, one point for each laboratory; below the diagonal the adaptation helps. Points on the frame "
            "are flights that failed.",
            _paired(pairs),
        ))  # fmt: skip
    return figures


def _finite(group: Group, part: str) -> list[float]:
    return [value for value in group.values(f"rms.{part}.e_p_m") if math.isfinite(value)]


def _strips(title: str, groups: Sequence[Group]) -> Figure:
    payloads = sorted({group.payload_kg for group in groups})
    shown = {group.label: short_label(group.controller, group.preset).strip() for group in groups}
    labels = list(shown)
    colours = dict(zip(labels, cycle(COLOURS), strict=False))
    figure = new_figure(1.3 + len(payloads) * (0.35 + 0.24 * len(labels)))
    axes = figure.subplots(len(payloads), 2, sharex=True, sharey=True, squeeze=False)
    for (row, payload_kg), (column, part) in product(enumerate(payloads), enumerate(PARTS)):
        ax = axes[row, column]
        dress(ax)
        _log_metres(ax, "x")
        ax.set_title(f"{payload_kg:g} kg, {PARTS[part]} the catch", loc="left", fontsize=9.5, color=INK)
        for group in groups:
            if group.payload_kg == payload_kg:
                _strip(ax, labels.index(group.label), group, part, colours[group.label])
    axes[0, 0].set_yticks(range(len(labels)), list(shown.values()))
    axes[0, 0].set_ylim(len(labels) - 0.4, -0.6)
    for ax in axes[-1]:
        ax.set_xlabel(r"RMS $\|e_p\|$ [m]")
    handles = [
        axes[0, 0].plot([], [], "o", ms=4, color=SOFT)[0],
        axes[0, 0].plot([], [], "|", ms=13, mew=2.2, color=INK)[0],
        axes[0, 0].plot([], [], "|", ms=8, mew=1.4, color=INK)[0],
    ]
    names = ["one flight", "p50", "p95"]
    if any(group.printed for group in groups):
        handles.append(axes[0, 0].plot([], [], "D", ms=5, mfc="white", mec=INK, mew=1.2)[0])
        names.append("printed in the paper")
    figure_legend(figure, title, handles, names, columns=4)
    return figure


def _strip(ax: Any, y: int, group: Group, part: str, colour: str) -> None:
    found = _finite(group, part)
    # Multiples of the golden ratio spread the points evenly, and every run draws the same picture.
    heights = [y + 0.56 * ((0.618034 * k) % 1.0 - 0.5) for k in range(len(found))]
    # Drawn as pixels: as vectors, thousands of points would make up most of an SVG.
    ax.plot(found, heights, "o", ms=3, mew=0, color=colour, alpha=0.6, zorder=3, rasterized=True)
    spread = group.spread(f"rms.{part}.e_p_m")
    if spread is not None:
        for value, size, width in ((spread.p50, 13, 2.2), (spread.p95, 8, 1.4)):
            if value is not None:
                ax.plot(value, y, "|", ms=size, mew=width, color=INK, zorder=5)
    paper = None if group.printed is None else group.printed.pre if part == "pre" else group.printed.post
    if paper is not None:
        ax.plot(paper.e_p_m, y, "D", ms=5, mfc="white", mec=INK, mew=1.2, zorder=6)
    if part == "post" and group.failures:
        ax.annotate(group.failure_text, (1.0, y), xycoords=ax.get_yaxis_transform(), xytext=(4, 0), va="center",
                    textcoords="offset points", fontsize=7.5, color=CATCH, annotation_clip=False)  # fmt: skip


def _against_model_error(groups: Sequence[Group]) -> Figure:
    labels = list(dict.fromkeys(group.label for group in groups))
    payloads = sorted({group.payload_kg for group in groups})
    columns = min(4, len(labels))
    rows = math.ceil(len(labels) / columns)
    figure = new_figure(1.2 + 2.3 * rows)
    axes = figure.subplots(rows, columns, sharex=True, sharey=True, squeeze=False)
    every = [value for group in groups for value in _finite(group, "post")]
    low, high = 0.8 * min(every), 1.3 * max(every)
    for ax, label in panels(axes, labels):
        dress(ax)
        ax.set_title(label, loc="left", fontsize=9, color=INK)
        for payload_kg, colour, marker in zip(payloads, COLOURS, "os^Dv*P", strict=False):
            line = sorted(
                (g for g in groups if (g.label, g.payload_kg) == (label, payload_kg)), key=lambda g: g.model_error
            )
            spreads = [group.spread("rms.post.e_p_m") for group in line]
            p50, p95 = (_array([getattr(s, key) if s is not None else None for s in spreads]) for key in ("p50", "p95"))
            share = [100 * group.model_error for group in line]
            ax.fill_between(share, p50, np.where(np.isfinite(p95), p95, 10 * high), color=colour, alpha=0.16, lw=0)
            ax.plot(share, p50, marker=marker, ms=4, lw=1.6, color=colour, label=f"{payload_kg:g} kg", zorder=3)
    axes[0, 0].set_ylim(low, high)
    _log_metres(axes[0, 0], "y")
    axes[0, 0].set_xticks(sorted({100 * group.model_error for group in groups}))
    for ax in axes[:, 0]:
        ax.set_ylabel(r"RMS $\|e_p\|$ [m]")
    label_lowest(axes, len(labels), "model error [%]")
    handles, names = axes[0, 0].get_legend_handles_labels()
    figure_legend(figure, "After the catch: p50, and band up to p95", handles, names, columns=4)
    return figure


def _paired(pairs: Sequence[Pairs]) -> Figure:
    shown = list(dict.fromkeys((one.group.label, one.group.model_error) for one in pairs))
    payloads = sorted({one.group.payload_kg for one in pairs})
    columns = min(3, len(shown))
    rows = math.ceil(len(shown) / columns)
    figure = new_figure(1.0 + 3.6 * rows)
    axes = figure.subplots(rows, columns, sharex=True, sharey=True, squeeze=False)
    every = [value for one in pairs for pair in one.base_m_this_m for value in pair if math.isfinite(value)]
    low, high = 0.8 * min(every), 1.4 * max(every)
    for ax, panel in panels(axes, shown):
        dress(ax)
        label, model_error = panel
        ax.set_title(f"{label}, model error {model_error:.0%}", loc="left", fontsize=9, color=INK)
        ax.plot([low, high], [low, high], color=SOFT, lw=1.0, ls=DASHED, zorder=2)
        for one in pairs:
            if (one.group.label, one.group.model_error) == panel:
                k = payloads.index(one.group.payload_kg)
                off, on = (np.minimum([pair[j] for pair in one.base_m_this_m], high) for j in range(2))
                ax.plot(off, on, "os^Dv*P"[k % 7], ms=4, mew=0, color=COLOURS[k], alpha=0.7, clip_on=False, zorder=3,
                        label=f"{one.group.payload_kg:g} kg: better in {one.better} of {len(off)}, p = {one.p_value:.2g}")  # fmt: skip
        # Below the axes: points of failed flights lie on the frame.
        ax.legend(
            loc="upper left", bbox_to_anchor=(0.0, -0.16), fontsize=7.5, frameon=False, handletextpad=0.2, borderpad=0.1
        )
    for ax in axes.flat:
        ax.set_box_aspect(1)
    axes[0, 0].set_xlim(low, high)
    axes[0, 0].set_ylim(low, high)
    _log_metres(axes[0, 0], "x", "y")
    for ax in axes[:, 0]:
        ax.set_ylabel(r"adaptation on, RMS $\|e_p\|$ [m]")
    label_lowest(axes, len(shown), r"adaptation off, RMS $\|e_p\|$ [m]")
    figure.suptitle(
        "After the catch, adaptation off and on", x=0.01, ha="left", fontsize=13, fontweight="bold", color=INK
    )
    return figure


def _log_metres(ax: Any, *names: str) -> None:
    """Make the axes `x` or `y` logarithmic, with labels at 1, 2 and 5 of each decade, such as 0.02."""
    for name in names:
        ax.set(**{f"{name}scale": "log"})
        axis = getattr(ax, f"{name}axis")
        axis.set_major_locator(LogLocator(subs=(1.0, 2.0, 5.0), numticks=30))
        axis.set_major_formatter(FuncFormatter(lambda value, _: f"{value:g}"))
        axis.set_minor_formatter(NullFormatter())


def _array(values: Sequence[float | None]) -> Array:
    return np.array([np.nan if value is None else value for value in values], dtype=np.float64)
