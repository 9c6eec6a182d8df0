"""Verdict of a soak: growth of memory and lateness, as a table and as a plot."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from statistics import fmean, median

from rich.console import Console

from benchmarks.report import number, print_table
from benchmarks.soaking.lateness import Minute

MEMORY_GROWTH_MAX = 1.05
LATENESS_GROWTH_MAX = 1.2
"""Largest growth relative to the growth of the empty loop, because other processes share the computer."""
EARLY, LATE = (5.0 / 60.0, 15.0 / 60.0), (50.0 / 60.0, 1.0)
"""Shares of the flight: minutes 5 to 15 and the last 10 of an hour."""
ROLES = ("flight", "recorder", "guardian", "world", "launcher")


@dataclass(frozen=True, slots=True)
class Sample:
    """Usage of all processes at one moment."""

    t_s: float
    """Time since the first sample."""
    rss_mb: dict[str, float]
    cpu_s: dict[str, float]
    pss_mb: dict[str, float]
    """Proportional set size; not in every sample."""


@dataclass(frozen=True, slots=True)
class Growth:
    """Growth of one process."""

    role: str
    early_mb: float
    """Mean resident memory over `EARLY`."""
    late_mb: float
    ratio: float
    early_pss_mb: float | None
    late_pss_mb: float | None
    early_cpu_percent: float
    """CPU time in percent of one core."""
    late_cpu_percent: float


def airborne(samples: Sequence[Sample]) -> list[Sample]:
    """Return the samples in which every process runs; the recorder starts last, and the launcher continues with the grading of the
    log.
    """
    return [sample for sample in samples if all(role in sample.rss_mb for role in ROLES)]


def memory_growth(samples: Sequence[Sample]) -> list[Growth]:
    """Return the growth of every process, given `airborne` samples."""
    if not samples:
        return []
    begin_s, end_s = samples[0].t_s, samples[-1].t_s

    def within(share: tuple[float, float]) -> list[Sample]:
        low, high = (begin_s + part * (end_s - begin_s) for part in share)
        return [sample for sample in samples if low <= sample.t_s <= high]

    early, late = within(EARLY), within(LATE)
    found = []
    for role in ROLES:
        if len(early) > 1 and len(late) > 1:
            before, after = (fmean(sample.rss_mb[role] for sample in part) for part in (early, late))
            pss, late_pss = (_mean([s.pss_mb[role] for s in part if role in s.pss_mb]) for part in (early, late))
            cpu, late_cpu = (_cpu_percent(part, role) for part in (early, late))
            found.append(
                Growth(
                    role=role,
                    early_mb=before,
                    late_mb=after,
                    ratio=after / before,
                    early_pss_mb=pss,
                    late_pss_mb=late_pss,
                    early_cpu_percent=cpu,
                    late_cpu_percent=late_cpu,
                )
            )
    return found


def _mean(values: Sequence[float]) -> float | None:
    return fmean(values) if values else None


def _cpu_percent(part: Sequence[Sample], role: str) -> float:
    first, last = part[0], part[-1]
    return 100.0 * (last.cpu_s[role] - first.cpu_s[role]) / (last.t_s - first.t_s)


def thirds(minutes: Sequence[Minute], value: str) -> tuple[float, float] | None:
    """Return a percentile's (`p50`, `p99`, `max`) median over the minutes of the first and last third, ms, or None if too short."""
    count = len(minutes) // 3
    if count == 0:
        return None
    first = [float(getattr(minute, value)) for minute in minutes[:count]]
    last = [float(getattr(minute, value)) for minute in minutes[-count:]]
    return median(first), median(last)


def lateness_problems(flight: Sequence[Minute], empty: Sequence[Minute]) -> list[str]:
    """Return one line for each percentile of the flight's lateness that grew more than the empty loop's lateness permits, or the reason
    why the growth cannot be judged.
    """
    found = []
    for value in ("p50", "p99"):
        of_flight, of_empty = thirds(flight, value), thirds(empty, value)
        if of_flight is None:
            found.append("too short to show growth of lateness")
            break
        grown = of_flight[1] / of_flight[0]
        allowed = LATENESS_GROWTH_MAX * (max(1.0, of_empty[1] / of_empty[0]) if of_empty is not None else 1.0)
        if grown > allowed:
            found.append(f"lateness {value} grew {grown:.2f} times, {allowed:.2f} allowed")
    return found


def print_tables(console: Console, growth: Sequence[Growth], flight: Sequence[Minute], empty: Sequence[Minute]) -> None:
    """Print both tables."""
    rows = [
        {
            "process": row.role,
            "RSS MB": number(row.early_mb, 1),
            "RSS MB late": number(row.late_mb, 1),
            "ratio": number(row.ratio, 3),
            "PSS MB": number(row.early_pss_mb, 1),
            "PSS MB late": number(row.late_pss_mb, 1),
            "CPU %": number(row.early_cpu_percent, 1),
            "CPU % late": number(row.late_cpu_percent, 1),
        }
        for row in growth
    ]
    red = [index for index, row in enumerate(growth) if row.ratio > MEMORY_GROWTH_MAX]
    print_table("memory and CPU time, early and late in the flight", rows, console, red)
    lateness = []
    for name, minutes in (("flight", flight), ("empty loop", empty)):
        row = {"loop": name}
        for key in ("p50", "p99", "max"):
            first, last = thirds(minutes, key) or (None, None)
            row |= {f"{key} first": number(first, 3), f"{key} last": number(last, 3)}
        lateness.append({**row, "worst": number(max((minute.max for minute in minutes), default=None))})
    print_table("tick lateness, ms: median over the minutes of a third", lateness, console)


def draw(samples: Sequence[Sample], flight: Sequence[Minute], empty: Sequence[Minute], path: Path) -> None:
    """Draw memory and lateness over time as a PNG."""
    from matplotlib.ticker import NullFormatter

    from companion.analysis.plot_style import INK, dress, new_figure, write_png

    colours = {
        "flight": "#1864ab",
        "recorder": "#2b8a3e",
        "guardian": "#862e9c",
        "world": "#e8590c",
        "launcher": "#868e96",
    }
    samples = airborne(samples)
    figure = new_figure(6.4)
    memory, late = figure.subplots(2, 1, sharex=True)
    for role in ROLES:
        seen = [((s.t_s - samples[0].t_s) / 60.0, s.rss_mb[role]) for s in samples if role in s.rss_mb]
        if seen:
            memory.plot(*zip(*seen, strict=True), color=colours[role], lw=1.4, label=role)
    memory.set_ylim(bottom=0.0)
    memory.set_ylabel("resident memory [MB]")
    for name, minutes, dash in (("flight", flight, "-"), ("empty loop", empty, (0, (4, 2)))):
        if not minutes:
            continue
        middle = [(minute.begin_s - minutes[0].begin_s) / 60.0 + 0.5 for minute in minutes]
        for value, colour in (("p50", "#1864ab"), ("p99", "#e8590c"), ("max", "#868e96")):
            values = [float(getattr(minute, value)) for minute in minutes]
            late.plot(middle, values, color=colour, ls=dash, lw=1.3, label=f"{name} {value}")
    late.set_yscale("log")
    late.set_yticks([0.5, 1.0, 2.0, 5.0, 10.0, 20.0, 50.0, 100.0])
    late.yaxis.set_major_formatter("{x:g}")
    late.yaxis.set_minor_formatter(NullFormatter())
    late.set_ylabel("tick lateness [ms]")
    late.set_xlabel("minute of the flight")
    for ax in (memory, late):
        dress(ax)
        ax.legend(fontsize=8, ncols=3, frameon=False)
        ax.margins(x=0.0)
    figure.suptitle("Soak", fontsize=13, fontweight="bold", color=INK)
    write_png(figure, path)
