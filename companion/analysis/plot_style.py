"""Common style of all plots: size, colours, axes, the mark of the catch. Needs matplotlib (extra `analysis`)."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Any

from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure

DPI = 150
WIDTH_IN = 9.0
INK = "#22303c"
CATCH = "#c2255c"
DASHED = (0, (4, 2))
"""Line style of references and desired values."""


def new_figure(height_in: float) -> Figure:
    """Return an empty figure of the common width."""
    return Figure(figsize=(WIDTH_IN, height_in), dpi=DPI, layout="constrained", facecolor="white")


def write_png(figure: Figure, path: Path) -> None:
    """Write the figure to a file."""
    FigureCanvasAgg(figure).print_png(path)


def dress(ax: Any) -> None:
    """Apply the common style: grid behind the data, no frame above and on the right, muted labels."""
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


def mark_catch(axes: Sequence[Any], t_s: float) -> None:
    """Mark the catch by a dashed vertical line through axes over time, labelled in the first one."""
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
