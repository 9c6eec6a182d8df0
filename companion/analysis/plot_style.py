"""Common style of all plots: size, colours, axes, the line at the catch. Needs matplotlib (extra `analysis`)."""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Sequence
from pathlib import Path
from typing import Any, Literal, TypeVar

import matplotlib
import numpy as np
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.backends.backend_svg import FigureCanvasSVG
from matplotlib.figure import Figure

from companion.analysis.page import Picture

_T = TypeVar("_T")
DPI = 150
WIDTH_IN = 9.0
INK = "#22303c"
SOFT = "#8b98a5"
CATCH = "#c2255c"
REFERENCE = "#55626e"
SERIES = ("#1f6fb4", "#e07b22", "#2e9d6b", "#8a5cc2", "#b0304f", "#7a6a3a", "#3a9fb0")
"""Colours of the lines in a flight's report."""
SERIES_DARK = ("#0b365c", "#7d3d05", "#12482f", "#432a63", "#5a1527", "#3d351c", "#1a4f59")
"""Colours of a reference that is drawn over the measurement of the same quantity."""
DASHED = (0, (4, 2))
"""Line style of a reference; the measured motion is solid."""
COLOURS = ("#0072b2", "#d55e00", "#000000", "#009e73", "#cc79a7", "#e69f00", "#56b4e9", "#8a5cc2", "#6b705c", "#a3b18a")
"""Colours of flights and laws in comparisons; the first six by Okabe and Ito, "Color Universal Design", for any colour vision."""


def new_figure(height_in: float, *, layout: Literal["constrained"] | None = "constrained") -> Figure:
    """Return an empty figure of the common width; without a layout the caller sets the margins."""
    return Figure(figsize=(WIDTH_IN, height_in), dpi=DPI, layout=layout, facecolor="white")


def write_png(figure: Figure, path: Path) -> None:
    """Write the figure as PNG."""
    FigureCanvasAgg(figure).print_png(path)


def write_pictures(
    figures: Iterable[tuple[str, str, str, Figure | None]], out: Path, prefix: str = ""
) -> list[Picture]:
    """Write the figures that are not None as PNG into a folder. Each has a name, a title and a caption."""
    written = []
    for name, title, caption, figure in figures:
        if figure is not None:
            path = out / f"{prefix}{name}.png"
            write_png(figure, path)
            written.append(Picture(path, title, caption))
    return written


def write_svg(figure: Figure, path: Path) -> None:
    """Write the figure as SVG; the same data always gives the same bytes."""
    with matplotlib.rc_context({"svg.hashsalt": "companion"}):
        FigureCanvasSVG(figure).print_svg(path, metadata={"Date": None, "Creator": None})


def panels(axes: Any, items: Sequence[_T]) -> Iterator[tuple[Any, _T]]:
    """Yield each item with the axes that show it, and hide the axes that are left over."""
    for place, ax in enumerate(axes.flat):
        if place < len(items):
            yield ax, items[place]
        else:
            ax.set_visible(False)


def label_lowest(axes: Any, count: int, label: str) -> None:
    """Label the x axis of the lowest used panel of each column, if the grid of shared axes holds `count` panels."""
    columns = axes.shape[1]
    for ax in list(axes.flat)[max(0, count - columns) : count]:
        ax.tick_params(labelbottom=True)
        ax.set_xlabel(label)


def dress(ax: Any) -> None:
    """Draw the grid behind the data, only the left and lower axes, and small labels."""
    ax.grid(True, color="#e6eaee", lw=0.7)
    ax.set_axisbelow(True)
    ax.tick_params(colors=INK, labelsize=9, length=3)
    for side in ("top", "right"):
        ax.spines[side].set_visible(False)
    for side in ("left", "bottom"):
        ax.spines[side].set_color("#aab4bd")
    for label in (ax.xaxis.label, ax.yaxis.label):
        label.set_color(INK)
        label.set_size(9.5)


WIDTH_TO_HEIGHT = 2.1
"""Of the panes of a path, both heights together."""


def path_panes(figure: Figure) -> list[tuple[Any, int]]:
    """Return the axes for a path seen from above (y over x) and from the side (z over x), and for each the index of its height."""
    axes = figure.subplots(2, 1, sharex=True)
    for ax, name, title in zip(axes, "yz", ("From above", "From the side"), strict=True):
        dress(ax)
        ax.set_ylabel(f"{name} [m]")
        ax.set_title(title, loc="left", fontsize=10, color=INK)
        ax.set_aspect("equal")
    axes[1].set_xlabel("x [m]")
    return [(axes[0], 1), (axes[1], 2)]


def scale_path(panes: Sequence[tuple[Any, int]], *positions_m: Any) -> None:
    """Give the panes the range and the height that positions need, with one scale for all axes.

    A pane shows 0.6 m or more, so that noise of millimetres does not look large.

    Args:
        positions_m: arrays of shape (N, 3).
    """
    every_m = np.concatenate(positions_m)
    low_m, high_m = np.nanmin(every_m, axis=0), np.nanmax(every_m, axis=0)
    middle_m, half_m = (low_m + high_m) / 2, np.maximum(0.3, 0.55 * (high_m - low_m))
    wanted = WIDTH_TO_HEIGHT * (half_m[1] + half_m[2])
    half_m *= (max(1.0, wanted / half_m[0]), *[max(1.0, half_m[0] / wanted)] * 2)  # fills the figure
    for ax, row in panes:
        ax.set_xlim(middle_m[0] - half_m[0], middle_m[0] + half_m[0])
        ax.set_ylim(middle_m[row] - half_m[row], middle_m[row] + half_m[row])
    panes[0][0].get_gridspec().set_height_ratios([half_m[row] for _, row in panes])


def figure_legend(figure: Figure, title: str, handles: Sequence[Any], names: Sequence[str], columns: int) -> None:
    """Write the title and the legend above the axes; a `$` in a name is shown literally."""
    figure.legend(
        handles, [name.replace("$", r"\$") for name in names], loc="outside upper left", ncols=min(columns, len(names)), fontsize=8.5,
        frameon=False, handlelength=2.6, title=title, title_fontproperties={"size": 13, "weight": "bold"}, alignment="left",
    ).get_title().set_color(INK)  # fmt: skip


def mark_catch(axes: Sequence[Any], t_s: float) -> None:
    """Draw a dashed vertical line at the time of the catch in all axes, and label it in the first one."""
    for ax in axes:
        ax.axvline(t_s, color=CATCH, lw=1.3, ls=(0, (5, 3)), zorder=2)
    axes[0].annotate(
        "catch",
        (t_s, 0.97),
        xycoords=axes[0].get_xaxis_transform(),
        xytext=(-4, 0),
        textcoords="offset points",
        ha="right",
        va="top",
        fontsize=9,
        color=CATCH,
    )


def mark_end(ax: Any, x: Any, y: Any, colour: str) -> None:
    """Mark the last known point of a line with a cross: the end of a flight that was not completed."""
    known = np.flatnonzero(np.isfinite(y))
    if len(known):
        ax.plot(x[known[-1]], y[known[-1]], "x", color=colour, ms=9, mew=2.2, zorder=5, clip_on=False)
