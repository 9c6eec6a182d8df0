"""The plots of a comparison, as in the paper's figures: ||e_p||, ||e_q|| and the joint angles over time, one figure per payload, and an
overview of all position errors.

Needs matplotlib (extra `analysis`).
"""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from pathlib import Path
from typing import Any

import numpy as np
from matplotlib.figure import Figure

from companion.analysis.log import Array
from companion.analysis.page import Picture
from companion.analysis.plot_style import (
    CATCH,
    COLOURS,
    DASHED,
    INK,
    dress,
    figure_legend,
    mark_catch,
    mark_end,
    new_figure,
    write_png,
)
from companion.campaigns.compare.aggregate import COMPLETED, Group
from companion.campaigns.compare.grid import ABLATED, is_ablation, short_label
from companion.campaigns.process import Message

_PANES = (
    ("e_p_m", None, r"$\|e_p\|$ [m]"),
    ("e_q_deg", None, r"$\|e_q\|$ [deg]"),
    ("alpha_deg", 0, r"$\alpha_1$ [deg]"),
    ("alpha_deg", 1, r"$\alpha_2$ [deg]"),
)


def write_pictures(messages: Sequence[Message], groups: Sequence[Group], out: Path) -> list[Picture]:
    """Draw everything that there is data for.

    Args:
        messages: results of the flights; a `series` {t_s, e_p_m, e_q_deg, alpha_deg[2], alpha_reference_deg[2], catch_t_s} is
            drawn over time.
        groups: their rows, aggregated.
        out: folder for the PNG files.
    """
    written = []
    colours = _colours(group.label for group in sorted(groups, key=lambda group: is_ablation(group.preset)))
    if any(group.spread(f"rms.{part}.e_p_m") for group in groups for part in ("pre", "post")):
        path = out / "errors.png"
        write_png(_overview(groups, colours), path)
        caption = "RMS of ‖e_p‖ before and after the catch, mean and standard deviation over seeds; diamonds: printed in the paper."
        written.append(Picture(path, "Position errors", caption))
    drawn = [message for message in messages if message["series"] is not None]
    for payload_kg in sorted({message["row"]["payload_kg"] for message in drawn}):
        these = [message for message in drawn if message["row"]["payload_kg"] == payload_kg]
        whole = [message for message in these if not is_ablation(message["row"]["preset"])]
        kinds = [("tracking", "Tracking errors and arm", whole)]
        if len(whole) < len(these):
            below = [m for m in these if m not in whole or (m["row"]["controller"], m["row"]["preset"]) == ABLATED]
            kinds.append(("ablation", f"{'/'.join(ABLATED)} and its ablations", below))
        for name, title, chosen in kinds:
            if not chosen:
                continue
            path, title = out / f"{name}_{payload_kg:g}kg.png", f"{title}, {payload_kg:g} kg"
            write_png(_courses(title, chosen, colours), path)
            seed = chosen[0]["row"]["seed"]
            caption = (
                f"Seed {seed}; dashed vertical line: the catch; cross: the end of a flight that was not completed."
            )
            written.append(Picture(path, title, caption))
    return written


def _courses(title: str, messages: Sequence[Message], colours: dict[str, str]) -> Figure:
    figure = new_figure(8.2)
    axes = figure.subplots(4, 1, sharex=True, height_ratios=(1.15, 1.0, 1.0, 1.0))
    for ax, (key, joint, label) in zip(axes, _PANES, strict=True):
        dress(ax)
        ax.set_ylabel(label)
        for message in messages:
            row, series = message["row"], message["series"]
            colour = colours[_label(row)]
            t_s, values = _array(series["t_s"]), _values(series[key], joint)
            name = short_label(row["controller"], row["preset"]).strip()
            ax.plot(t_s, values, color=colour, lw=1.2, label=name, zorder=3)
            if row["outcome"] != COMPLETED:
                mark_end(ax, t_s, values, colour)
        if joint is None:
            ax.set_ylim(bottom=0.0, top=_top(messages, key))
        else:
            longest = max((message["series"] for message in messages), key=lambda series: len(series["t_s"]))
            reference = _values(longest["alpha_reference_deg"], joint)
            ax.plot(_array(longest["t_s"]), reference, color=INK, lw=1.1, ls=DASHED, label="reference", zorder=4)
        ax.margins(x=0.0)
    caught = [m["series"]["catch_t_s"] for m in messages if m["series"]["catch_t_s"] is not None]
    if caught:
        mark_catch(axes, float(np.median(caught)))
    axes[-1].set_xlabel("mission time [s]")
    handles, names = axes[2].get_legend_handles_labels()
    figure_legend(figure, title, handles, names, columns=4)
    return figure


def _top(messages: Sequence[Message], key: str) -> float:
    """Return the upper limit of an axis of errors; an incomplete flight is cut off before it hides the others."""
    courses = [(_array(m["series"][key]), m["row"]["outcome"] == COMPLETED) for m in messages]
    peaks = [(float(np.nanmax(values)), completed) for values, completed in courses if np.isfinite(values).any()]
    if not peaks:
        return 1.0
    every, completed = [peak for peak, _ in peaks], [peak for peak, whole in peaks if whole]
    limit = 2.0 * max(completed) if completed else 3.0 * float(np.median(every))
    return 1.1 * max(1e-3, min(max(every), limit))


def _overview(groups: Sequence[Group], colours: dict[str, str]) -> Figure:
    payloads = sorted({group.payload_kg for group in groups})
    shown = {group.label: short_label(group.controller, group.preset).strip() for group in groups}
    labels = list(shown)
    figure = new_figure(1.5 + 0.16 * len(labels) * len(payloads) + 0.3 * len(payloads))
    axes = figure.subplots(1, 2, sharex=True, sharey=True)
    step = 0.8 / len(labels)
    for ax, part, title in ((axes[0], "pre", "before the catch"), (axes[1], "post", "after the catch")):
        dress(ax)
        ax.set_title(title, loc="left", fontsize=10, color=INK)
        ax.set_xlabel(r"RMS $\|e_p\|$ [m]")
        for group in groups:
            y = payloads.index(group.payload_kg) + (labels.index(group.label) - (len(labels) - 1) / 2) * step
            spread = group.spread(f"rms.{part}.e_p_m")
            if spread is not None:
                ax.barh(y, spread.mean, height=0.85 * step, color=colours[group.label], zorder=3)
                ax.errorbar(spread.mean, y, xerr=spread.std or 0.0, color=INK, lw=1.0, capsize=2, zorder=4)
            if part == "post" and group.failures:
                ax.annotate(group.failure_text, (spread.mean if spread else 0.0, y), xytext=(8, 0), va="center",
                            textcoords="offset points", fontsize=8, color=CATCH, zorder=6)  # fmt: skip
            paper = None if group.printed is None else group.printed.pre if part == "pre" else group.printed.post
            if paper is not None:
                ax.plot(paper.e_p_m, y, "D", ms=5, mfc="white", mec=INK, mew=1.2, zorder=5)
    axes[0].set_xlim(left=0.0)
    axes[0].set_yticks(range(len(payloads)), [f"{payload_kg:g} kg" for payload_kg in payloads])
    axes[0].invert_yaxis()
    handles = [axes[0].barh([0], [0], color=colours[label]) for label in labels]
    names = list(shown.values())
    if any(group.printed for group in groups):
        handles.append(axes[0].plot([], [], "D", ms=5, mfc="white", mec=INK, mew=1.2)[0])
        names.append("printed in the paper")
    figure_legend(figure, "Position errors", handles, names, columns=3)
    return figure


def _label(row: dict[str, Any]) -> str:
    return f"{row['controller']}/{row['preset']}"


def _colours(labels: Iterable[str]) -> dict[str, str]:
    """Return a colour for each label, the same in every picture."""
    return {label: COLOURS[k % len(COLOURS)] for k, label in enumerate(dict.fromkeys(labels))}


def _array(values: Sequence[float | None]) -> Array:
    return np.array([np.nan if value is None else value for value in values], dtype=np.float64)


def _values(series: Any, joint: int | None) -> Array:
    return _array(series if joint is None else series[joint])
