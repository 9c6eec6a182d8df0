"""The comparison's pictures, as in the paper's figures: ||e_p||, ||e_q|| and the arm's angles over time, all controllers in one figure
per payload, and all errors after the catch in one picture.

Needs matplotlib (extra `analysis`).
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from matplotlib.figure import Figure

from companion.analysis.log import Array
from companion.analysis.plot_style import CATCH, DASHED, INK, dress, mark_catch, new_figure, write_png
from companion.campaigns.compare import ABLATED, COMPLETED, Cell

_COLOURS = (
    "#1f6fb4",
    "#e07b22",
    "#2e9d6b",
    "#8a5cc2",
    "#b8860b",
    "#17a2b8",
    "#d1495b",
    "#6b705c",
    "#3d405b",
    "#a3b18a",
)


@dataclass(frozen=True, slots=True)
class Track:
    """The course of one flight."""

    label: str
    """Law and gains."""
    short_label: str
    """As beside the others of its picture."""
    ablation: bool
    payload_kg: float
    seed: int
    outcome: str
    series: dict[str, Any]
    """t_s, e_p_m, e_q_deg, alpha_deg[2], alpha_reference_deg[2], catch_t_s; None where a value is not known."""

    @property
    def completed(self) -> bool:
        """Whether the mission was."""
        return self.outcome == COMPLETED


@dataclass(frozen=True, slots=True)
class Picture:
    """One written picture."""

    path: Path
    title: str
    caption: str


def write_pictures(tracks: Sequence[Track], cells: Sequence[Cell], out: Path) -> list[Picture]:
    """Draw everything that there is data for, as PNG into `out`."""
    written = []
    base = "/".join(ABLATED)
    colours = _colours({**{t.label: t.ablation for t in tracks}, **{c.label: c.short_label != c.label for c in cells}})
    overview = _overview(cells, colours)
    if overview is not None:
        path = out / "errors.png"
        write_png(overview, path)
        caption = "RMS of ‖e_p‖ before and after the catch, mean and standard deviation over seeds; diamonds: printed in the paper."
        written.append(Picture(path, "Position errors", caption))
    for payload_kg in sorted({track.payload_kg for track in tracks}):
        these = [track for track in tracks if track.payload_kg == payload_kg]
        groups = [("tracking", "Tracking errors and arm", [t for t in these if not t.ablation])]
        if any(t.ablation for t in these):
            groups.append(
                ("ablation", f"{base} and what is taken from it", [t for t in these if t.ablation or t.label == base])
            )
        for name, title, group in groups:
            if not group:
                continue
            path = out / f"{name}_{payload_kg:g}kg.png"
            whole = f"{title}, {payload_kg:g} kg"
            write_png(_courses(whole, group, colours), path)
            caption = f"Seed {group[0].seed}; dashed vertical line: the catch; a cross: the end of a flight that was not completed."
            written.append(Picture(path, whole, caption))
    return written


def _courses(title: str, tracks: Sequence[Track], colours: dict[str, str]) -> Figure:
    figure = new_figure(8.2)
    axes = figure.subplots(4, 1, sharex=True, height_ratios=(1.15, 1.0, 1.0, 1.0))
    panes = (("e_p_m", None), ("e_q_deg", None), ("alpha_deg", 0), ("alpha_deg", 1))
    labels = (r"$\|e_p\|$ [m]", r"$\|e_q\|$ [deg]", r"$\alpha_1$ [deg]", r"$\alpha_2$ [deg]")
    for ax, label, (key, joint) in zip(axes, labels, panes, strict=True):
        dress(ax)
        ax.set_ylabel(label)
        for track in tracks:
            colour = colours[track.label]
            t_s, values = _array(track.series["t_s"]), _values(track.series[key], joint)
            ax.plot(t_s, values, color=colour, lw=1.2, label=track.short_label.strip(), zorder=3)
            if not track.completed and len(t_s):
                known = np.flatnonzero(np.isfinite(values))
                if len(known):
                    ax.plot(t_s[known[-1]], values[known[-1]], "x", color=colour, ms=9, mew=2.2, zorder=5)
        if joint is not None:
            longest = max(tracks, key=lambda track: len(track.series["t_s"]))
            wanted = _values(longest.series["alpha_reference_deg"], joint)
            ax.plot(_array(longest.series["t_s"]), wanted, color=INK, lw=1.1, ls=DASHED, label="reference", zorder=4)
        else:
            ax.set_ylim(bottom=0.0, top=_top(tracks, key))
        ax.margins(x=0.0)
    caught = [track.series["catch_t_s"] for track in tracks if track.series["catch_t_s"] is not None]
    if caught:
        mark_catch(axes, float(np.median(caught)))
    axes[-1].set_xlabel("mission time [s]")
    handles, names = axes[2].get_legend_handles_labels()
    figure.legend(
        handles, names, loc="outside upper left", ncols=min(4, len(names)), fontsize=8.5, frameon=False, handlelength=1.8,
        title=title, title_fontproperties={"size": 13, "weight": "bold"}, alignment="left",
    )  # fmt: skip
    return figure


def _top(tracks: Sequence[Track], key: str) -> float:
    """Upper end of an axis of errors: a flight that was not completed is cut off rather than hide the others."""

    def peaks(among: Sequence[Track]) -> list[float]:
        courses = [_array(track.series[key]) for track in among]
        return [float(np.nanmax(course)) for course in courses if np.isfinite(course).any()]

    completed, others = peaks([t for t in tracks if t.completed]), peaks([t for t in tracks if not t.completed])
    if completed:
        highest = max(completed)
        return 1.1 * max(1e-3, min(max([highest, *others]), 2.0 * highest))
    return 1.1 * max(1e-3, min(max(others), 3.0 * float(np.median(others)))) if others else 1.0


def _overview(cells: Sequence[Cell], colours: dict[str, str]) -> Figure | None:
    payloads = sorted({cell.payload_kg for cell in cells})
    shown = {cell.label: cell.short_label.strip() for cell in cells}
    labels = list(shown)
    if not any(cell.figures["rms.pre.e_p_m"] or cell.figures["rms.post.e_p_m"] for cell in cells):
        return None
    figure = new_figure(1.5 + 0.16 * len(labels) * len(payloads) + 0.3 * len(payloads))
    axes = figure.subplots(1, 2, sharey=True)
    step = 0.8 / max(1, len(labels))
    names_of = ("rms.pre.e_p_m", "rms.post.e_p_m")
    reached = [s.mean + (s.std or 0.0) for cell in cells for name in names_of if (s := cell.figures[name]) is not None]
    papers = [cell.printed for cell in cells if cell.printed is not None]
    reached += [figures.e_p_m for paper in papers for figures in (paper.pre, paper.post) if figures is not None]
    for ax, part, title in ((axes[0], "pre", "before the catch"), (axes[1], "post", "after the catch")):
        dress(ax)
        ax.set_title(title, loc="left", fontsize=10, color=INK)
        ax.set_xlabel(r"RMS $\|e_p\|$ [m]")
        for cell in cells:
            y = payloads.index(cell.payload_kg) + (labels.index(cell.label) - (len(labels) - 1) / 2) * step
            spread, colour = cell.figures[f"rms.{part}.e_p_m"], colours[cell.label]
            if spread is not None:
                ax.barh(y, spread.mean, height=0.85 * step, color=colour, zorder=3)
                ax.errorbar(spread.mean, y, xerr=spread.std or 0.0, color=INK, lw=1.0, capsize=2, zorder=4)
            if part == "post" and cell.failures:
                x = spread.mean if spread is not None else 0.0
                ax.annotate(cell.failure_text, (x, y), xytext=(8, 0), textcoords="offset points", va="center", fontsize=8,
                            color=CATCH, zorder=6)  # fmt: skip
            figures = None if cell.printed is None else (cell.printed.pre if part == "pre" else cell.printed.post)
            if figures is not None:
                ax.plot(figures.e_p_m, y, "D", ms=5, mfc="white", mec=INK, mew=1.2, zorder=5)
        ax.set_xlim(0.0, 1.05 * max(reached))
    axes[0].set_yticks(range(len(payloads)), [f"{payload_kg:g} kg" for payload_kg in payloads])
    axes[0].invert_yaxis()
    handles = [axes[0].barh([0], [0], color=colours[label]) for label in labels]
    names = list(shown.values())
    if papers:
        handles.append(axes[0].plot([], [], "D", ms=5, mfc="white", mec=INK, mew=1.2)[0])
        names.append("printed in the paper")
    figure.legend(handles, names, loc="outside upper left", ncols=3, fontsize=8.5, frameon=False, title="Position errors",
                  title_fontproperties={"size": 13, "weight": "bold"}, alignment="left")  # fmt: skip
    return figure


def _colours(ablation: dict[str, bool]) -> dict[str, str]:
    """Of each label, the same in every picture; whole presets get the first ones, whatever is taken from them the others."""
    labels = sorted(ablation, key=lambda label: ablation[label])
    return {label: _COLOURS[k % len(_COLOURS)] for k, label in enumerate(labels)}


def _array(values: Sequence[float | None]) -> Array:
    return np.array([np.nan if value is None else value for value in values], dtype=np.float64)


def _values(series: Any, joint: int | None) -> Array:
    return _array(series if joint is None else series[joint])
