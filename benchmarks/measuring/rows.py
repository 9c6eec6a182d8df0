"""The tables of the page: each figure with its reference and its target."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from typing import Any, NamedTuple

from benchmarks.measuring import texts
from benchmarks.measuring.figures import P50_P99, Row, Section, Target

Figures = Mapping[str, Any]
LATENESS = ("p50", "p99", "p99.9", "max")
VALUE = ("value",)
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
    loops = {"the companion's edge alone": "edge", "pymavlink echo": "pymavlink", "bare loop over gRPC": "grpc"}
    ends = {"to setpoint": "inside", "to setpoint, wire to wire": "wire"}
    lateness, what = "lateness of a tick, ms", "mocap to setpoint, ms: flight"
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
            _row(what, BARE_BESIDE, setpoint, bare, Target(1.5)),
            _row(what, "bare loop over gRPC", setpoint, find("setpoint", "grpc", "wire"), Target(0.2)),
            _row("tick begun to setpoint, ms: flight", BARE_BESIDE, find("hover", "start_to_setpoint_ms"), bare),
            *(
                _row(f"mocap {end}, ms: {name}", BARE, find("setpoint", key, which), find("setpoint", "native", which))
                for end, which in ends.items()
                for name, key in loops.items()
            ),
        ]),
        Section("Servo bus", (*texts.BUS, *_bus_notes(parts.get("joints", NO_PART))), P50_P99, [
            _row("joint read begun to currents written, ms: flight", BARE_BUS, find("hover", "bus_cycle_ms"),
                 find("joints", "in_world", "cycle_ms"), Target(1.3)),
            _row("the same, ms: bare dynamixel-sdk, a bus of its own", "bytes on the wire", find("joints", "alone", "cycle_ms"), wire),
            _row("answers there to currents written, ms: flight", BARE_BUS, find("hover", "read_to_write_ms"),
                 find("joints", "in_world", "command_ms")),
        ]),
        Section("Computing", texts.CORE, P50_P99, [
            _row("FlightCore.step, us", "raw MuJoCo", microseconds("core", "core_ms"), raw, Target(100.0, ("p50",), ratio=False)),
            _row("the law alone, us", "raw MuJoCo", median("core", "law_us"), raw),
            _row("the law with adaptive loads, us", "without them", median("core", "law_us"), median("core", "law_without_loads_us")),
            _row("a tick of the fast closed loop, plant and all, us", "raw MuJoCo", median("core", "tick_us"), raw),
            _row("FlightCore.step in the flight, us", "the fast closed loop", microseconds("hover", "core_ms"),
                 microseconds("core", "core_ms")),
        ]),
        Section("What it costs", texts.COST, VALUE, [
            usage("CPU time of the flight process, %", "flight", cpu, "empty loop", 25.0),
            usage("the same, its worst second, %", "flight", "cpu_percent_worst", "empty loop"),
            usage("memory of the flight process (RSS, its most), MB", "flight", memory, "empty loop", 150.0),
            usage("minor page faults of the flight process, a second", "flight", "minor_faults_s", "empty loop"),
            *(usage(f"CPU time of the {role}, %", role, cpu, "flight") for role in ("recorder", "guardian", "bare loop")),
            *(usage(f"memory of the {role}, MB", role, memory, "flight") for role in ("recorder", "guardian")),
        ]),
    ]  # fmt: skip


def _row(what: str, beside: str, own: Found, other: Found = NOTHING, target: Target | None = None) -> Row:
    return Row(what, beside, own.figures, other.figures, target, own.why_not or other.why_not)


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
