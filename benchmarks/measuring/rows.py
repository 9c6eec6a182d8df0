"""The tables of the page: each figure with its reference and its target."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from typing import Any, NamedTuple

from benchmarks.measuring import texts
from benchmarks.measuring.figures import P50_P99, Row, Section, Target
from benchmarks.measuring.pi import PI5_S, nbody_check, slower
from benchmarks.soaking.processes import MAIN, NATIVE
from companion.model.constants import TICK_PERIOD_S

Figures = Mapping[str, Any]
LATENESS = ("p50", "p99", "p99.9", "max")
VALUE = ("value",)
ESTIMATE = ("estimate", "from", "to")
THREADS = {MAIN: "main thread", NATIVE: "native threads (MAVSDK)", "arm-bus": "arm's bus thread"}
PI_GOALS = {"Pi 4, 1.8 GHz": (60.0, 1.5), "Pi 5, 2.4 GHz": (30.0, 0.75)}
"""Largest share of a core that the flight process may take, %, and largest CPU time of a tick, ms."""
NO_PART = {"not_measured": "that part was not run"}
BARE = "bare loop on native MAVSDK"
BARE_BESIDE = f"{BARE}, in the same minutes"
BARE_BUS = "bare dynamixel-sdk, the world's bus"


class Found(NamedTuple):
    """Figures by statistic, or the reason why they were not measured."""

    figures: Mapping[str, float]
    why_not: str = ""


NOTHING = Found({})


def sections(parts: Mapping[str, Figures]) -> list[Section]:
    """Return all tables.

    Args:
        parts: figures by part; `{"not_measured": why}` for a failed part; a part that was not run is missing.
    """

    def find(*path: str, as_figures: Callable[[Any], Mapping[str, float]] = _spread) -> Found:
        found: Any = parts.get(path[0], NO_PART)
        for key in path[1:]:
            if isinstance(found, Mapping) and "not_measured" in found:
                break
            found = found.get(key) if isinstance(found, Mapping) else None
        if isinstance(found, Mapping) and "not_measured" in found:
            return Found({}, str(found["not_measured"]))
        return NOTHING if found is None else Found(as_figures(found))

    def value(*path: str) -> Found:
        return find(*path, as_figures=lambda found: {"value": float(found)})

    def median(*path: str) -> Found:
        return find(*path, as_figures=lambda found: {"p50": float(found)})

    def microseconds(*path: str) -> Found:
        return find(*path, as_figures=lambda found: {k: 1e3 * v for k, v in _spread(found).items() if k in P50_P99})

    def usage(what: str, role: str, key: str, beside: str, at_most: float | None = None) -> Row:
        target = None if at_most is None else Target(at_most, VALUE, ratio=False)
        return _row(
            what, beside, value("hover", "processes", role, key), value("hover", "processes", beside, key), target
        )

    late, raw = find("hover", "flight", "lateness_ms"), median("core", "raw_tick_us")
    setpoint, bare = find("hover", "setpoint_ms"), find("hover", "bare", "inside")
    wire = find("joints", "alone", "wire_ms", as_figures=lambda found: dict.fromkeys(P50_P99, float(found)))
    alone = find("hover", "late_alone", as_figures=lambda found: {"value": float(len(found))})
    counts = {
        "ticks": "ticks",
        "later than one period": "later_than_one",
        "later than two periods": "later_than_two",
        "deadlines without a tick": "skipped",
    }
    loops = {"the companion's edge alone": "edge", "pymavlink echo": "pymavlink"}
    ends = {"to setpoint": "inside", "to setpoint, wire to wire": "wire"}
    system = find(
        "hover", "threads", as_figures=lambda found: {"value": sum(float(each["system"]) for each in found.values())}
    )
    threads = find(
        "hover", "threads", as_figures=lambda found: {name: _cpu(each)["value"] for name, each in found.items()}
    )
    main_thread = find("hover", "threads", MAIN, as_figures=_cpu)
    lateness = "lateness of a tick, ms"
    cpu, memory = "cpu_percent", "rss_mb"
    return [
        Section("Ticks", texts.TICKS, LATENESS, [
            _row(lateness, "empty asyncio loop", late, find("hover", "plain", "lateness_ms"), Target(1.5, ("p99",))),
            _row(lateness, "empty loop", late, find("hover", "empty", "lateness_ms")),
        ]),
        Section("Late ticks", texts.LATE, VALUE, [
            _row("later than two periods while the empty loop was not late", "", alone, target=Target(0.0, VALUE, ratio=False)),
            *(_row(name, "empty loop", value("hover", "flight", key), value("hover", "empty", key)) for name, key in counts.items()),
        ]),
        Section("Motion capture to setpoint", texts.SETPOINT, P50_P99, [
            _row("mocap to setpoint, ms: flight", BARE_BESIDE, setpoint, bare, Target(2.0)),
            _row("tick begun to setpoint, ms: flight", BARE_BESIDE, find("hover", "start_to_setpoint_ms"), bare),
            *(
                _row(f"mocap {end}, ms: {name}", BARE, find("setpoint", key, which), find("setpoint", "native", which))
                for end, which in ends.items()
                for name, key in loops.items()
            ),
        ]),
        Section("Servo bus", (*texts.BUS, *_bus_notes(parts.get("joints", NO_PART))), P50_P99, [
            _row("joint read begun to currents written, ms: flight", BARE_BUS, find("hover", "bus_cycle_ms"),
                 find("joints", "in_world", "cycle_ms"), Target(1.5, ("p50",))),
            _row("the same, ms: bare dynamixel-sdk, a bus of its own", "bytes on the wire", find("joints", "alone", "cycle_ms"), wire),
            _row("answers there to currents written, ms: flight", BARE_BUS, find("hover", "read_to_write_ms"),
                 find("joints", "in_world", "command_ms")),
        ]),
        Section("Computing", texts.CORE, P50_P99, [
            _row("FlightCore.step, us", "raw MuJoCo", microseconds("core", "core_ms"), raw, Target(100.0, ("p50",), ratio=False)),
            _row("the law alone, us", "raw MuJoCo", median("core", "law_us"), raw),
            _row("the law with adaptive loads, us", "without them", median("core", "law_us"), median("core", "law_without_loads_us")),
            _row("a tick of the fast closed loop, plant and all, us", "raw MuJoCo", median("core", "tick_us"), raw),
            _row("inputs and FlightCore.step in the flight, us", "the fast closed loop", microseconds("hover", "core_ms"),
                 microseconds("core", "core_ms"), Target(80.0, ("p50",), ratio=False)),
            *(
                _row("FlightCore.step, compiled build, us", "plain Python", microseconds("compiled", "core_ms"),
                     microseconds("core", "core_ms"), Target(at_most, (of,), ratio=False))
                for of, at_most in (("p50", 20.0), ("p99", 40.0))
            ),
            _row("a tick of the fast closed loop, compiled build, us: 62.5 is 80 x real time", "plain Python",
                 median("compiled", "tick_us"), median("core", "tick_us"), Target(62.5, ("p50",), ratio=False)),
            _row("10,000 catches on all cores, compiled build, min", "plain Python", median("compiled", "catches_min"),
                 median("core", "catches_min"), Target(30.0, ("p50",), ratio=False)),
        ]),
        Section("What it costs", texts.COST, VALUE, [
            usage("CPU time of the flight process, %", "flight", cpu, "empty loop", 14.0),
            usage("the same, its worst second, %", "flight", "cpu_percent_worst", "empty loop"),
            _row("system time of the flight process, %", "", system, target=Target(7.0, VALUE, ratio=False)),
            _row("CPU time of its main thread, %", "", main_thread, target=Target(6.0, VALUE, ratio=False)),
            *(
                _row(f"CPU time of its {THREADS.get(name, name)}, %", "", Found({"value": percent}))
                for name, percent in threads.figures.items() if name != MAIN
            ),
            usage("memory of the flight process (RSS, its most), MB", "flight", memory, "empty loop", 150.0),
            usage("minor page faults of the flight process, a second", "flight", "minor_faults_s", "empty loop"),
            *(usage(f"CPU time of the {role}, %", role, cpu, "flight") for role in ("recorder", "guardian", "bare loop")),
            *(usage(f"memory of the {role}, MB", role, memory, "flight") for role in ("recorder", "guardian")),
        ]),
        Section("Raspberry Pi, an estimate", texts.PI, ESTIMATE, _pi_rows(find("pi", "here_s", as_figures=dict), threads)),
    ]  # fmt: skip


def _pi_rows(programs: Found, threads: Found) -> list[Row]:
    """Return the estimates for each Raspberry Pi, from the times of the programs here and the CPU time of the flight's threads, %."""
    here = {THREADS.get(name, name): percent for name, percent in threads.figures.items()}
    tick_ms = 10.0 * TICK_PERIOD_S * threads.figures.get(MAIN, 0.0)
    measured = bool(programs.figures and threads.figures)
    rows = []
    for board, factor in slower(programs.figures if measured else PI5_S).items():
        goals = PI_GOALS.get(board)
        for what, value, goal in (
            ("flight process, % of a core", sum(here.values()), goals and goals[0]),
            *((f"its {name}, %", percent, None) for name, percent in here.items()),
            ("main thread's CPU time in a tick, ms", tick_ms, goals and goals[1]),
        ):
            figures = dict(zip(ESTIMATE, (value * factor.mean, value * factor.low, value * factor.high), strict=True))
            target = None if goal is None else Target(goal, ESTIMATE[:1], ratio=False)
            found = (figures, {ESTIMATE[0]: value}) if measured else ({}, {})
            rows.append(Row(f"{board}: {what}", "this computer", *found, target, programs.why_not or threads.why_not))
    if measured:
        estimated_us, published_us = nbody_check(programs.figures)
        what = "check: a step of N-body on a Pi 4 at 1.5 GHz before Python 3.11, us"
        rows.append(Row(what, "published", {ESTIMATE[0]: estimated_us}, {ESTIMATE[0]: published_us}))
    return rows


def _row(what: str, beside: str, own: Found, other: Found = NOTHING, target: Target | None = None) -> Row:
    return Row(what, beside, own.figures, other.figures, target, own.why_not or other.why_not)


def _cpu(thread: Mapping[str, float]) -> dict[str, float]:
    """Return user and system time of a thread together, %."""
    return {"value": thread["user"] + thread["system"]}


def _spread(found: Any) -> dict[str, float]:
    """Return the statistics of a saved `Latency`."""
    names = {"p50": "p50", "p99": "p99", "p99.9": "p999", "max": "max"}
    return {name: float(found[key]) for name, key in names.items() if found.get(key) is not None}


def _bus_notes(joints: Figures) -> list[str]:
    """Return the bytes on the wire, and the cycles that failed."""
    alone, in_world = (joints.get(name) or {} for name in ("alone", "in_world"))
    notes = []
    if "wire_ms" in alone:
        request, answer, write = (alone[f"{name}_bytes"] for name in ("request", "answer", "write"))
        counts = f"{request} of the read, {answer} of both answers, {write} of the currents"
        baud = f"{alone['baud_bps'] / 1e6:g} Mbaud"
        notes.append(f"Bytes on the wire: {counts}; 10 bits each at {baud}: {alone['wire_ms']:.3g} ms.")
    return notes + [
        f"{found['failed']} cycles of the bare loop on {where} found no answer and do not count."
        for found, where in ((alone, "a bus of its own"), (in_world, "the world's bus"))
        if found.get("failed")
    ]
