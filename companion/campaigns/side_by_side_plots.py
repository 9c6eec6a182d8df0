"""Pictures of several flights over each other: errors, actuation, path, lateness. Flights are told apart by colour, and by dashes too.

Needs matplotlib (extra `analysis`).
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Literal

import numpy as np
from matplotlib.figure import Figure
from matplotlib.lines import Line2D
from matplotlib.ticker import FuncFormatter

from companion.analysis.log import Array
from companion.analysis.plot_style import INK, dress, mark_catch, new_figure, write_png
from companion.campaigns.side_by_side import Comparison
from companion.campaigns.side_by_side_course import Flight

AXIS = {
    "catch": "time since the catch [s]",
    "takeoff": "time since the take-off command [s]",
    "start": "time since the first tick of the log [s]",
}
_ZERO = {"takeoff": "take-off", "start": "start"}
_SOFT = "#8b98a5"
_EVENT_MARKS = {"info": ("|", 7.0), "warning": ("^", 6.0), "critical": ("X", 7.5)}
_NAME_SHARE = 0.0074
"""Width of one character of an event's name, as a share of the axis."""

_CROWD_SHARE = 0.015
"""Marks that are closer than that, as a share of the axis, lie on each other."""
_GRAVITY = {"warning": 1, "critical": 2}


@dataclass(frozen=True, slots=True)
class Line:
    """How one flight is drawn. `dashes` in points of a line 1 point wide, ink and gap in turn; empty: solid."""

    colour: str
    dashes: tuple[float, ...]

    @property
    def style(self) -> Any:
        """For matplotlib."""
        return (0, self.dashes) if self.dashes else "-"


LINES = (
    Line("#0072b2", ()),
    Line("#d55e00", (4.5, 1.6)),
    Line("#000000", (1.2, 1.4)),
    Line("#009e73", (6.0, 1.5, 1.2, 1.5)),
    Line("#cc79a7", (9.0, 3.0)),
    Line("#e69f00", (3.5, 1.2, 1.0, 1.2, 1.0, 1.2)),
)
"""Colours of Okabe and Ito, "Color Universal Design": distinct with any colour blindness; each with a dash of its own."""


@dataclass(frozen=True, slots=True)
class Picture:
    """One written picture."""

    path: Path
    title: str
    caption: str


def write_pictures(comparison: Comparison, out_dir: Path) -> list[Picture]:
    """Draw everything that there is data for, as PNG into `out_dir`; no name is one of a single flight's plots."""
    zero = {"catch": "the catch", "takeoff": "the take-off command", "start": "the log's first tick"}[comparison.align]
    lane = f"Time counts from {zero}. Lowest: events of each flight, | info, triangle warning, cross critical."
    ends = " A cross on a line: where a flight ended that was not completed."
    makers: tuple[tuple[str, str, str, Callable[[Comparison], Figure | None]], ...] = (
        ("errors", "Errors", f"By motion capture against the reference; e_q against the law's setpoint. {lane}{ends}", _errors),
        ("actuation", "Thrust, gain and tether", f"Commanded thrust, switching gain, tether slack. {lane}{ends}", _actuation),
        ("path", "Path", "By motion capture, from above and from the side; grey: references; circles: catches.", _path),
        (
            "lateness",
            "Lateness",
            "Share of all ticks that started later than so many milliseconds: the lower and the further left, the better.",
            _lateness,
        ),
    )  # fmt: skip
    written = []
    for name, title, caption, make in makers:
        figure = make(comparison)
        if figure is not None:
            path = out_dir / f"side_by_side_{name}.png"
            write_png(figure, path)
            written.append(Picture(path, title, caption))
    return written


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
    comparison: Comparison,
    title: str,
    panes: tuple[tuple[str, Callable[[Flight], Array]], ...],
    *,
    from_zero: bool,
) -> Figure | None:
    """Axes above each other over the common time, events of every flight below; panes without any data are left out."""
    flights = comparison.flights
    kept = [(label, of) for label, of in panes if any(np.isfinite(of(f)[f.course.flying]).any() for f in flights)]
    if not kept:
        return None
    lane_in = 0.35 + 0.24 * len(flights)
    figure = new_figure(0.9 + 2.0 * len(kept) + lane_in + 0.2 * ((len(flights) + 1) // 2))
    grid = figure.subplots(len(kept) + 1, 1, sharex=True, squeeze=False, height_ratios=[2.0] * len(kept) + [lane_in])
    axes, lane = [row[0] for row in grid[:-1]], grid[-1][0]
    spans = [_span(flight, zero_s) for flight, zero_s in zip(flights, comparison.zeros_s, strict=True)]
    known = [span for span in spans if span is not None]
    begin, end = min(span[0] for span in known), max(span[1] for span in known)
    axes[0].set_xlim(begin - 0.012 * (end - begin), end + 0.012 * (end - begin))
    for ax, (label, of) in zip(axes, kept, strict=True):
        dress(ax)
        ax.set_ylabel(label)
        graded: list[Array] = []
        for n, (flight, zero_s) in enumerate(zip(flights, comparison.zeros_s, strict=True)):
            course, values = flight.course, of(flight)
            t = course.t_s - zero_s
            drawn = np.where(course.flying, values, np.nan)
            _draw(ax, t, drawn, n, flight)
            seen = values[course.graded if course.graded.any() else course.flying]
            graded.append(seen[np.isfinite(seen)])
        if from_zero:
            # The take-off's transient would hide the flight itself.
            most = max((float(seen.max()) for seen in graded if len(seen)), default=0.0)
            ax.set_ylim(0.0, 1.12 * max(most, 1e-3))
        else:
            ax.margins(y=0.1)
    _lane(lane, comparison)
    _mark_zero(comparison, [*axes, lane])
    _mark_grave_events(comparison, axes)
    lane.set_xlabel(AXIS[comparison.align])
    figure.align_ylabels([*axes, lane])
    _title(figure, comparison, title)
    return figure


def _draw(ax: Any, t: Array, values: Array, n: int, flight: Flight) -> None:
    line = LINES[n]
    # The first flight lies below: dashes over a solid line show both where they agree.
    ax.plot(t, values, color=line.colour, ls=line.style, lw=1.25, zorder=3 + 0.1 * n)
    known = np.flatnonzero(np.isfinite(values))
    if not flight.completed and len(known):
        ax.plot(t[known[-1]], values[known[-1]], "x", color=line.colour, ms=9, mew=2.2, zorder=5, clip_on=False)


def _lane(ax: Any, comparison: Comparison) -> None:
    """One row of events for each flight, named where there is room."""
    dress(ax)
    count = len(comparison.flights)
    low, high = ax.get_xlim()
    for n, (flight, zero_s) in enumerate(zip(comparison.flights, comparison.zeros_s, strict=True)):
        height = count - 1 - n
        events = sorted(
            (float(event["t_s"]) - zero_s, event["severity"], event["id"]) for event in flight.summary["events"]
        )
        events = [event for event in events if low <= event[0] <= high]
        for t, severity, _ in events:
            mark, size = _EVENT_MARKS.get(severity, _EVENT_MARKS["info"])
            ax.plot(t, height, mark, color=LINES[n].colour, ms=size, mew=1.4, zorder=4, clip_on=False)
        _names(ax, events, height, low, high)
    ax.set_ylim(-0.6, count - 0.4)
    ax.set_yticks(range(count), [flight.letter for flight in reversed(comparison.flights)])
    ax.set_ylabel("events")
    ax.grid(visible=False, axis="y")


def _names(ax: Any, events: list[tuple[float, str, str]], height: float, low: float, high: float) -> None:
    """Name each crowd of marks by its gravest event, where that covers no other mark."""
    crowds: list[list[tuple[float, str, str]]] = []
    for event in events:
        if crowds and event[0] - crowds[-1][-1][0] < _CROWD_SHARE * (high - low):
            crowds[-1].append(event)
        else:
            crowds.append([event])
    free_from = low
    for k, crowd in enumerate(crowds):
        name = max(crowd, key=lambda event: _GRAVITY.get(event[1], 0))[2] + (f" +{len(crowd) - 1}" if crowd[1:] else "")
        width = (high - low) * _NAME_SHARE * (len(name) + 2)
        first, last = crowd[0][0], crowd[-1][0]
        if last >= free_from and last + width <= (crowds[k + 1][0][0] if k + 1 < len(crowds) else high):
            _name(ax, name, last, height, "left")
            free_from = last + width
        elif first - width >= free_from:
            _name(ax, name, first, height, "right")
            free_from = last
        else:
            free_from = max(free_from, last)


def _name(ax: Any, text: str, t: float, height: float, side: Literal["left", "right"]) -> None:
    ax.annotate(
        _plain(text),
        (t, height),
        xytext=(6 if side == "left" else -6, 0),
        textcoords="offset points",
        ha=side,
        va="center",
        fontsize=7.5,
        color=INK,
    )


def _mark_zero(comparison: Comparison, axes: list[Any]) -> None:
    if comparison.align == "catch":
        mark_catch(axes, 0.0)
        return
    for ax in axes:
        ax.axvline(0.0, color=_SOFT, lw=1.0, zorder=2)


def _mark_grave_events(comparison: Comparison, axes: list[Any]) -> None:
    """Warnings and worse reach up into the panes: what comes after them is no undisturbed flight."""
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
    axes = figure.subplots(2, 1, sharex=True)
    for ax, row, name in ((axes[0], 1, "y"), (axes[1], 2, "z")):
        dress(ax)
        seen: list[Array] = []
        for n, flight in enumerate(comparison.flights):
            course, line = flight.course, LINES[n]
            flown = np.where(course.flying[:, None], course.flown_world_m, np.nan)
            wanted = np.where(course.flying[:, None], course.reference_world_m, np.nan)
            ax.plot(wanted[:, 0], wanted[:, row], color="#b7c0c8", lw=3.0, zorder=2, solid_capstyle="round")
            ax.plot(flown[:, 0], flown[:, row], color=line.colour, ls=line.style, lw=1.35, zorder=3 + 0.1 * n)
            if course.catch is not None:
                ax.plot(*flown[course.catch, [0, row]], "o", ms=7, mfc="white", mec=line.colour, mew=1.8, zorder=5)
            known = np.flatnonzero(np.isfinite(flown[:, row]))
            if not flight.completed and len(known):
                ax.plot(*flown[known[-1], [0, row]], "x", color=line.colour, ms=9, mew=2.2, zorder=5)
            seen += [flown[:, row], wanted[:, row]]
        every = np.concatenate(seen)
        every = every[np.isfinite(every)]
        # A straight path gets room: noise of millimetres is not to look like a slalom.
        middle, half = (every.min() + every.max()) / 2, max(0.3, 0.62 * float(np.ptp(every)))
        ax.set_ylim(middle - half, middle + half)
        ax.set_ylabel(f"{name} [m]")
    axes[0].set_title("From above", loc="left", fontsize=10, color=INK)
    axes[1].set_title("From the side", loc="left", fontsize=10, color=INK)
    axes[1].set_xlabel("x [m]")
    _title(figure, comparison, "Path")
    return figure


def _lateness(comparison: Comparison) -> Figure | None:
    """Share of ticks later than a time, over that time: tails, which a histogram hides, are what matters."""
    lateness = [1e3 * f.course.lateness_s[np.isfinite(f.course.lateness_s)] for f in comparison.flights]
    if not any(len(values) for values in lateness):
        return None
    figure = new_figure(3.6 + 0.2 * ((len(lateness) + 1) // 2))
    ax = figure.subplots()
    dress(ax)
    for n, late_ms in enumerate(lateness):
        if len(late_ms):
            ordered = np.sort(late_ms)
            share = 1.0 - np.arange(len(ordered)) / len(ordered)
            # Some thousand steps draw the same line as all of them; the tail keeps every one.
            body, tail = np.linspace(0, len(ordered) - 1, 4000).astype(int), np.arange(len(ordered))[-500:]
            kept = np.unique(np.concatenate([body, tail]))
            ax.plot(
                ordered[kept],
                100.0 * share[kept],
                color=LINES[n].colour,
                ls=LINES[n].style,
                lw=1.5,
                drawstyle="steps-pre",
                zorder=3 + 0.1 * n,
            )
    ax.set_yscale("log")
    ax.yaxis.set_major_formatter(FuncFormatter(lambda value, _: f"{value:g}"))
    known = np.concatenate(lateness)
    typical, late, most = (float(np.percentile(known, percent)) for percent in (50, 99, 100))
    if typical > 0.0 and most > 10.0 * late:
        # One stall would press everything else against the axis.
        ax.set_xscale("log")
        ax.xaxis.set_major_formatter(FuncFormatter(lambda value, _: f"{value:g}"))
        ax.set_xlim(left=typical / 3.0)
    else:
        ax.set_xlim(left=0.0)
    ax.set_ylim(top=130.0)
    ax.set_xlabel("tick start after its deadline [ms]")
    ax.set_ylabel("ticks later than that [%]")
    _title(figure, comparison, "Lateness of the control tick")
    return figure


def _span(flight: Flight, zero_s: float) -> tuple[float, float] | None:
    t_s, flying = flight.course.t_s, flight.course.flying
    part = t_s[flying] if flying.any() else t_s
    return (float(part[0]) - zero_s, max(float(part[-1]), float(part[0]) + 0.1) - zero_s) if len(part) else None


def _title(figure: Figure, comparison: Comparison, title: str) -> None:
    handles = [
        Line2D([], [], color=LINES[n].colour, ls=LINES[n].style, lw=1.6, label=_plain(flight.title))
        for n, flight in enumerate(comparison.flights)
    ]
    figure.legend(
        handles=handles,
        loc="outside upper center",
        ncols=2,
        fontsize=8.5,
        frameon=False,
        handlelength=3.2,
        title=title,
        title_fontproperties={"size": 13, "weight": "bold"},
    ).get_title().set_color(INK)


def _plain(text: str) -> str:
    """Never read as a formula."""
    return text.replace("$", r"\$")
