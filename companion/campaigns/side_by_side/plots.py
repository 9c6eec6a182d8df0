"""Plots that overlay several flights: errors, actuation, path, lateness. Flights differ in colour and in dashes.

Needs matplotlib (extra `analysis`).
"""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
from matplotlib.figure import Figure
from matplotlib.lines import Line2D
from matplotlib.ticker import FuncFormatter

from companion.analysis import plot_style
from companion.analysis.log import Array
from companion.analysis.page import Picture
from companion.analysis.plot_style import (
    COLOURS,
    SOFT,
    dress,
    figure_legend,
    mark_catch,
    mark_end,
    new_figure,
    path_panes,
    scale_path,
)
from companion.analysis.table import Line
from companion.campaigns.side_by_side.comparison import Comparison
from companion.campaigns.side_by_side.flight import Flight

AXIS = {
    "catch": "time since the catch [s]",
    "takeoff": "time since the take-off command [s]",
    "start": "time since the first tick of the log [s]",
}
LINES = tuple(
    Line(colour, dashes)
    for colour, dashes in zip(
        COLOURS,
        ((), (4.5, 1.6), (1.2, 1.4), (6.0, 1.5, 1.2, 1.5), (9.0, 3.0), (3.5, 1.2, 1.0, 1.2, 1.0, 1.2)),
        strict=False,
    )
)
"""Line styles of the flights, by position."""
_EVENT_MARKS = {"info": ("|", 7.0), "warning": ("^", 6.0), "critical": ("X", 7.5)}


def write_pictures(comparison: Comparison, out_dir: Path) -> list[Picture]:
    """Write every plot for which there is data as PNG into `out_dir`, under names that differ from a single flight's plots."""
    zero = {"catch": "the catch", "takeoff": "the take-off command", "start": "the first tick of the log"}[
        comparison.align
    ]
    lane = f"Time starts at {zero}. Bottom: the events of each flight (bar: info, triangle: warning, cross: critical)."
    ends = " Cross on a line: the end of a flight that was not completed."
    makers: tuple[tuple[str, str, str, Callable[[Comparison], Figure | None]], ...] = (
        ("errors", "Errors", f"e_p, e_q: measured by motion capture; e_q: relative to the attitude setpoint. {lane}{ends}", _errors),
        ("actuation", "Thrust, gain and tether", f"Commanded thrust, switching gain, tether slack. {lane}{ends}", _actuation),
        ("path", "Path", "Measured by motion capture, from above and from the side; grey: references; circles: catches.", _path),
        (
            "lateness",
            "Lateness",
            "Fraction of the ticks that started later than a given time; lower and further left is better.",
            _lateness,
        ),
    )  # fmt: skip
    figures = ((name, title, caption, make(comparison)) for name, title, caption, make in makers)
    return plot_style.write_pictures(figures, out_dir, "side_by_side_")


def _errors(comparison: Comparison) -> Figure | None:
    return _over_time(
        comparison,
        "Errors",
        (
            (r"$\|e_p\|$ [m]", lambda flight: flight.course.e_p_m),
            (r"$\|e_q\|$ [deg]", lambda flight: flight.course.e_q_deg),
            (r"$\|e_\alpha\|$ [deg]", lambda flight: flight.course.e_alpha_deg),
        ),
        from_zero=True,
    )


def _actuation(comparison: Comparison) -> Figure | None:
    return _over_time(
        comparison,
        "Thrust, switching gain and tether",
        (
            ("thrust [%]", lambda flight: flight.course.thrust_percent),
            (r"switching gain $\rho$", lambda flight: flight.course.rho),
            ("tether slack [m]", lambda flight: flight.course.slack_m),
        ),
        from_zero=False,
    )


def _over_time(
    comparison: Comparison, title: str, panes: tuple[tuple[str, Callable[[Flight], Array]], ...], *, from_zero: bool
) -> Figure | None:
    """Draw panes over the common time, with the events of every flight below; panes without data are left out."""
    flights = comparison.flights
    kept = [(label, of) for label, of in panes if any(np.isfinite(of(f)[f.course.flying]).any() for f in flights)]
    if not kept:
        return None
    lane_in = 0.35 + 0.24 * len(flights)
    figure = new_figure(0.9 + 2.0 * len(kept) + lane_in + 0.2 * ((len(flights) + 1) // 2))
    grid = figure.subplots(len(kept) + 1, 1, sharex=True, squeeze=False, height_ratios=[2.0] * len(kept) + [lane_in])
    axes, lane = [row[0] for row in grid[:-1]], grid[-1][0]
    for ax in [*axes, lane]:
        ax.margins(x=0.012)
    for ax, (label, of) in zip(axes, kept, strict=True):
        dress(ax)
        ax.set_ylabel(label)
        graded: list[Array] = []
        for n, (flight, zero_s) in enumerate(zip(flights, comparison.zeros_s, strict=True)):
            course, values = flight.course, of(flight)
            t, drawn = course.t_s - zero_s, np.where(course.flying, values, np.nan)
            # The first flight is at the bottom: where they agree, dashes over a solid line show both.
            ax.plot(t, drawn, **_style(n), lw=1.25, zorder=3 + 0.1 * n)
            if not flight.completed:
                mark_end(ax, t, drawn, LINES[n].colour)
            seen = values[course.graded if course.graded.any() else course.flying]
            graded.append(seen[np.isfinite(seen)])
        if from_zero:
            # The axis is scaled without the take-off, whose transient is larger than all errors in flight.
            most = max((float(seen.max()) for seen in graded if len(seen)), default=0.0)
            ax.set_ylim(0.0, 1.12 * max(most, 1e-3))
        else:
            ax.margins(y=0.1)
    _lane(lane, comparison)
    _mark_zero(comparison, [*axes, lane])
    _mark_severe_events(comparison, axes)
    lane.set_xlabel(AXIS[comparison.align])
    figure.align_ylabels([*axes, lane])
    _title(figure, comparison, title)
    return figure


def _style(n: int) -> dict[str, Any]:
    return {"color": LINES[n].colour, "ls": (0, LINES[n].dashes) if LINES[n].dashes else "-"}


def _lane(ax: Any, comparison: Comparison) -> None:
    """Draw one row of events for each flight; the page has a table of them."""
    dress(ax)
    count = len(comparison.flights)
    low, high = ax.get_xlim()
    for n, (flight, zero_s) in enumerate(zip(comparison.flights, comparison.zeros_s, strict=True)):
        for event in flight.summary["events"]:
            t = float(event["t_s"]) - zero_s
            if low <= t <= high:
                mark, size = _EVENT_MARKS.get(event["severity"], _EVENT_MARKS["info"])
                ax.plot(t, count - 1 - n, mark, color=LINES[n].colour, ms=size, mew=1.4, zorder=4, clip_on=False)
    ax.set_ylim(-0.6, count - 0.4)
    ax.set_yticks(range(count), [flight.letter for flight in reversed(comparison.flights)])
    ax.set_ylabel("events")
    ax.grid(visible=False, axis="y")


def _mark_zero(comparison: Comparison, axes: list[Any]) -> None:
    if comparison.align == "catch":
        mark_catch(axes, 0.0)
        return
    for ax in axes:
        ax.axvline(0.0, color=SOFT, lw=1.0, zorder=2)


def _mark_severe_events(comparison: Comparison, axes: list[Any]) -> None:
    low, high = axes[0].get_xlim()
    for n, (flight, zero_s) in enumerate(zip(comparison.flights, comparison.zeros_s, strict=True)):
        for event in flight.summary["events"]:
            t = float(event["t_s"]) - zero_s
            if event["severity"] != "info" and low <= t <= high:
                for ax in axes:
                    ax.axvline(t, color=LINES[n].colour, lw=0.7, ls=":", alpha=0.8, zorder=1.5)


def _path(comparison: Comparison) -> Figure | None:
    flights = [f for f in comparison.flights if np.isfinite(f.course.flown_world_m[f.course.flying]).any()]
    if not flights:
        return None
    figure = new_figure(5.6 + 0.2 * ((len(comparison.flights) + 1) // 2))
    panes, seen = path_panes(figure), list[Array]()
    for n, flight in enumerate(comparison.flights):
        course, colour = flight.course, LINES[n].colour
        flown = np.where(course.flying[:, None], course.flown_world_m, np.nan)
        wanted = np.where(course.flying[:, None], course.reference_world_m, np.nan)
        for ax, row in panes:
            ax.plot(wanted[:, 0], wanted[:, row], color="#b7c0c8", lw=3.0, zorder=2, solid_capstyle="round")
            ax.plot(flown[:, 0], flown[:, row], **_style(n), lw=1.35, zorder=3 + 0.1 * n)
            if course.catch is not None:
                ax.plot(*flown[course.catch, [0, row]], "o", ms=7, mfc="white", mec=colour, mew=1.8, zorder=5)
            if not flight.completed:
                mark_end(ax, flown[:, 0], flown[:, row], colour)
        seen += [flown, wanted]
    scale_path(panes, *seen)
    _title(figure, comparison, "Path")
    return figure


def _lateness(comparison: Comparison) -> Figure | None:
    """Draw the fraction of ticks later than a time over that time; unlike a histogram, it shows the tail."""
    lateness = [1e3 * f.course.lateness_s[np.isfinite(f.course.lateness_s)] for f in comparison.flights]
    if not any(len(values) for values in lateness):
        return None
    figure = new_figure(3.6 + 0.2 * ((len(lateness) + 1) // 2))
    ax = figure.subplots()
    dress(ax)
    for n, late_ms in enumerate(lateness):
        if len(late_ms):
            ax.ecdf(late_ms, complementary=True, **_style(n), lw=1.5, zorder=3 + 0.1 * n)
    ax.set_yscale("log")
    ax.yaxis.set_major_formatter(FuncFormatter(lambda value, _: f"{100 * value:g}"))
    known = np.concatenate(lateness)
    typical, late, most = (float(np.percentile(known, percent)) for percent in (50, 99, 100))
    if typical > 0.0 and most > 10.0 * late:
        # A linear axis would show everything but one stall near zero.
        ax.set_xscale("log")
        ax.xaxis.set_major_formatter(FuncFormatter(lambda value, _: f"{value:g}"))
        ax.set_xlim(left=typical / 3.0)
    else:
        ax.set_xlim(left=0.0)
    ax.set_ylim(bottom=0.5 / max(map(len, lateness)), top=1.3)
    ax.set_xlabel("tick start after its deadline [ms]")
    ax.set_ylabel("ticks later than that [%]")
    _title(figure, comparison, "Lateness of the control tick")
    return figure


def _title(figure: Figure, comparison: Comparison, title: str) -> None:
    handles = [Line2D([], [], **_style(n), lw=1.6) for n in range(len(comparison.flights))]
    figure_legend(figure, title, handles, [flight.title for flight in comparison.flights], columns=2)
