"""Compares flights from their logs and summaries: missions, differing settings, all metrics, and the fairness of the comparison."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from datetime import UTC, datetime
from typing import Any, Literal

from companion.analysis.flat import flat
from companion.analysis.summary import world_text
from companion.campaigns.side_by_side.flight import Flight
from companion.campaigns.side_by_side.settings import Setting, fairness, payload_kg, settings_of, simulated

Align = Literal["catch", "takeoff", "start"]
FLIGHTS_MAX = 6
"""Largest number of flights that can be distinguished in one plot."""
MARKED_FROM = 0.05
"""Fraction of the larger value below which a difference is not marked better or worse, because single flights scatter."""


class NotAlignable(Exception):
    """A flight lacks the requested event. The text is one line for the user."""


@dataclass(frozen=True, slots=True)
class Figure:
    """One metric of summary.json for every flight; None where it was not measured."""

    key: str
    """Dotted key of summary.json."""
    label: str
    digits: int
    values: tuple[float | None, ...]
    differences: tuple[float | None, ...]
    verdicts: tuple[str | None, ...]
    """`better` or `worse` than the first flight, for metrics for which a smaller value is certainly better."""


@dataclass(frozen=True)
class Comparison:
    """The content of the report."""

    flights: tuple[Flight, ...]
    align: Align
    zeros_s: tuple[float, ...]
    """Flight clock of each flight at the zero of the common time axis."""
    fair: str
    """One sentence on how the flights differ."""
    cautions: tuple[str, ...]
    """Reasons to read the metrics with care; empty if there are none."""
    notes: tuple[str, ...]
    about: tuple[tuple[str, tuple[str, ...]], ...]
    """Facts about the flights: the name of each fact and its text for each flight."""
    settings: tuple[Setting, ...]
    addresses: tuple[Setting, ...]
    """Differing addresses of simulated devices, which the simulated world chooses for each flight."""
    figures: tuple[Figure, ...]


_KNOWN: tuple[tuple[str, str, int, str], ...] = (
    # key, label, digits; smaller is certainly better: "flight" for completed flights of one mission, "machine" for all
    ("payload_kg", "payload [kg]", 3, ""),
    ("catch_t_s", "catch at, mission time [s]", 2, ""),
    ("rms.pre.e_p_m", "position error before the catch, RMS [m]", 4, "flight"),
    ("rms.pre.e_q_deg", "attitude error before the catch, RMS [deg]", 2, "flight"),
    ("rms.pre.e_alpha_deg", "arm error before the catch, RMS [deg]", 2, "flight"),
    ("rms.post.e_p_m", "position error after the catch, RMS [m]", 4, "flight"),
    ("rms.post.e_q_deg", "attitude error after the catch, RMS [deg]", 2, "flight"),
    ("rms.post.e_alpha_deg", "arm error after the catch, RMS [deg]", 2, ""),  # the arm must comply
    ("final_e_z_m", "height error at the end [m]", 4, ""),
    ("impedance_error.position_n", "impedance error, position [N]", 3, ""),
    ("impedance_error.arm_nm", "impedance error, arm [N m]", 4, ""),
    ("tether.min_slack_m", "minimum tether slack [m]", 3, ""),
    ("loop.rate_hz", "control loop [Hz]", 2, ""),
    ("loop.ticks", "ticks", 0, ""),
    ("loop.missed", "ticks one period late", 0, "machine"),
    *(
        (f"{key}.{part}", f"{label}, {part} [ms]", 2, "machine")
        for key, label in (
            ("loop.lateness_ms", "tick lateness"),
            ("latency_ms.mocap_to_setpoint", "mocap to setpoint"),
            ("latency_ms.joint_read_to_write", "joint read to current write"),
        )
        for part in ("p50", "p99", "max")
    ),
    ("recorder.samples", "recorded ticks", 0, ""),
    ("recorder.dropped", "ticks lost by the recorder", 0, "machine"),
    ("graded_every", "evaluated: one tick in", 0, ""),
    ("events.info", "events: info", 0, ""),
    ("events.warning", "events: warning", 0, ""),
    ("events.critical", "events: critical", 0, ""),
)


def compare(flights: Sequence[Flight], align: Align | None = None) -> Comparison:
    """Compare the flights (at least two) with the first one.

    Args:
        flights: flights in the order of the report.
        align: zero of the common time axis; None selects the catch if every flight has one, else the take-off, else the start.

    Raises:
        NotAlignable: a flight lacks the requested event.
    """
    chosen, notes = _alignment(flights, align)
    settings, addresses = settings_of([flight.config for flight in flights])
    fair, cautions, same_mission = fairness(flights, settings)
    if any(flight.summary["graded_every"] > 1 for flight in flights):
        notes.append(
            "Long flights are evaluated and drawn with fewer ticks: "
            + ", ".join(
                f"{f.letter} one tick in {f.summary['graded_every']}" for f in flights if f.summary["graded_every"] > 1
            )
            + "; the timing covers every tick."
        )
    zeros = [_zero_s(flight, chosen) for flight in flights]
    return Comparison(
        flights=tuple(flights),
        align=chosen,
        zeros_s=tuple(0.0 if zero is None else zero for zero in zeros),
        fair=fair,
        cautions=tuple(cautions),
        notes=tuple(notes),
        about=_about(flights),
        settings=tuple(settings),
        addresses=tuple(addresses),
        figures=_figures(flights, same_mission),
    )


def jsonable(comparison: Comparison) -> dict[str, Any]:
    """Return everything except the time series, for scripts. Unknown values are None; `absent` lists the flights that lack a key."""

    def rows(settings: Sequence[Setting]) -> list[dict[str, Any]]:
        letters = [flight.letter for flight in comparison.flights]
        return [
            {
                "key": setting.key,
                "values": setting.values,
                "absent": [letter for letter, there in zip(letters, setting.present, strict=True) if not there],
            }
            for setting in settings
        ]

    return {
        "flights": [
            {
                "letter": flight.letter,
                "name": flight.name,
                "log": flight.path,
                "sha256": flight.digest,
                **{name: texts[n] for name, texts in comparison.about},
                "zero_t_s": comparison.zeros_s[n],
                "summary": flight.summary,
            }
            for n, flight in enumerate(comparison.flights)
        ],
        **{name: getattr(comparison, name) for name in ("align", "fair", "cautions", "notes")},
        "configuration": rows(comparison.settings),
        "addresses": rows(comparison.addresses),
        "figures": [
            {name: getattr(figure, name) for name in ("key", "values", "differences", "verdicts")}
            for figure in comparison.figures
        ],
    }


def _zero_s(flight: Flight, align: Align) -> float | None:
    course = flight.course
    if align == "catch":
        return None if course.catch is None else float(course.t_s[course.catch])
    if align == "takeoff":
        return course.takeoff_s
    return float(course.t_s[0]) if len(course.t_s) else None


def _alignment(flights: Sequence[Flight], asked: Align | None) -> tuple[Align, list[str]]:
    notes: list[str] = []
    marks: tuple[tuple[Align, str], ...] = (("catch", "catch"), ("takeoff", "take-off"))
    for align, name in marks:
        lacking = [flight for flight in flights if _zero_s(flight, align) is None]
        if asked == align and lacking:
            raise NotAlignable(f"{lacking[0].path}: --align {align}: there is no {name} in this flight")
        if lacking:
            notes.append(f"No {name} in {', '.join(flight.letter for flight in lacking)}.")
        elif asked in (None, align):
            return align, notes
    return "start", notes


def _about(flights: Sequence[Flight]) -> tuple[tuple[str, tuple[str, ...]], ...]:
    def row(name: str, text: Any) -> tuple[str, tuple[str, ...]]:
        return name, tuple(str(text(flight)) for flight in flights)

    return (
        row("mission", lambda f: (f.config.get("mission") or {}).get("name") or "–"),
        row("law", lambda f: f.summary["controller"]),
        row("preset", lambda f: f.summary["preset"]),
        row("set by hand", lambda f: " ".join((f.config.get("sources") or {}).get("overrides") or ()) or "–"),
        row("payload", _payload),
        row("world", lambda f: world_text(f.config.get("world")) or "–" if simulated(f.config) else "–"),
        row("outcome", lambda f: f.summary["outcome"]),
        row("flown", _where),
        row("recorded", _recorded),
        row("companion", _version),
    )


def _payload(flight: Flight) -> str:
    known = payload_kg(flight)
    return "not known" if known is None else f"{known:g} kg"


def _where(flight: Flight) -> str:
    autopilot = flight.summary.get("autopilot") or {}
    firmware = autopilot.get("firmware") or "PX4 of unknown version"
    if simulated(flight.config):
        by = "stub, as " if autopilot.get("kind") == "stub" else ""
        return f"in the simulated world, {by}{firmware}"
    return f"{(flight.config.get('vehicle') or {}).get('name', 'vehicle')}, {firmware}"


def _recorded(flight: Flight) -> str:
    offset_ns = flight.metadata.get("companion", {}).get("epoch_offset_ns", "")
    course = flight.course
    if not offset_ns.isdecimal() or not len(course.t_s):
        return "–"
    start = datetime.fromtimestamp(int(offset_ns) / 1e9 + float(course.t_s[0]), UTC)
    return f"{start:%Y-%m-%d %H:%M:%S} UTC, {course.t_s[-1] - course.t_s[0]:.1f} s"


def _version(flight: Flight) -> str:
    about = flight.metadata.get("companion", {})
    git = about.get("version_git", "")
    return about.get("version_companion", "–") + (f" ({git[:12]})" if git else "")


def _figures(flights: Sequence[Flight], same_mission: bool) -> tuple[Figure, ...]:
    numbers = [_numbers(flight.summary) for flight in flights]
    known = {key: (label, digits, judge) for key, label, digits, judge in _KNOWN}
    keys = dict.fromkeys([*known, *(key for one in numbers for key in one)])
    figures = []
    for key in keys:
        values = tuple(one.get(key) for one in numbers)
        if all(value is None for value in values):
            continue
        label, digits, judge = known.get(key, (key, 4, ""))
        first = values[0]
        verdicts = tuple(
            _verdict(first, value)
            if judge == "machine" or (judge == "flight" and same_mission and flights[0].completed and flight.completed)
            else None
            for flight, value in zip(flights, values, strict=True)
        )
        differences = tuple(None if first is None or value is None else value - first for value in values)
        figures.append(
            Figure(key=key, label=label, digits=digits, values=values, differences=differences, verdicts=verdicts)
        )
    return tuple(figures)


def _numbers(summary: dict[str, Any]) -> dict[str, float | None]:
    """Return the numbers of a summary by dotted key, and the number of events of each severity."""
    found: dict[str, float | None] = {
        k: v for k, v in flat(summary) if isinstance(v, int | float) and not isinstance(v, bool)
    }
    severities = [event["severity"] for event in summary["events"]]
    return found | {f"events.{name}": severities.count(name) for name in ("info", "warning", "critical")}


def _verdict(first: float | None, value: float | None) -> str | None:
    if first is None or value is None or abs(value - first) <= MARKED_FROM * max(abs(first), abs(value)):
        return None
    return "better" if value < first else "worse"
