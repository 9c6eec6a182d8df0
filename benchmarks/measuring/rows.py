"""The tables of the page: each figure with its reference and its target."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

from benchmarks.measuring import texts
from benchmarks.measuring.figures import P50_P99, Row, Section, Target

Figures = Mapping[str, Any]
LATENESS = ("p50", "p99", "p99.9", "max")
VALUE = ("value",)
NO_PART = {"not_measured": "that part was not run"}


def sections(parts: Mapping[str, Figures]) -> list[Section]:
    """Return all tables.

    Args:
        parts: figures by part, as the parts return them; `{"not_measured": why}` of one that failed, missing: not run.
    """
    hover, setpoint, joints, core = (parts.get(name, NO_PART) for name in ("hover", "setpoint", "joints", "core"))
    return [
        _lateness(hover),
        _late(hover),
        _setpoints(hover, setpoint),
        _joints(hover, joints),
        _core(hover, core),
        _cost(hover),
    ]


def _spread(found: Any) -> dict[str, float]:
    """Return the statistics of a saved `Latency`."""
    if not isinstance(found, Mapping):
        return {}
    names = {"p50": "p50", "p99": "p99", "p99.9": "p999", "max": "max"}
    return {name: float(found[key]) for name, key in names.items() if found.get(key) is not None}


def _at(found: Any, *keys: str) -> Any:
    """Return a nested figure, or None if it is missing."""
    for key in keys:
        found = found.get(key) if isinstance(found, Mapping) else None
    return found


def _value(found: Any) -> dict[str, float]:
    return {} if found is None else {"value": float(found)}


def _why(*found: Any) -> str:
    """Return the first reason why one of them was not measured."""
    return next((str(f["not_measured"]) for f in found if isinstance(f, Mapping) and "not_measured" in f), "")


def _lateness(hover: Figures) -> Section:
    rows = [
        Row(
            what="lateness of a tick, ms",
            beside=beside,
            figures=_spread(_at(hover, "flight", "lateness_ms")),
            beside_figures=_spread(_at(hover, key, "lateness_ms")),
            target=target,
            why_not=_why(hover),
        )
        for beside, key, target in (
            ("empty asyncio loop", "plain", Target(1.5, ("p99",))),
            ("empty loop", "empty", None),
        )
    ]
    return Section("Ticks", texts.TICKS, LATENESS, rows)


def _late(hover: Figures) -> Section:
    why = _why(hover)
    alone = _at(hover, "late_alone")
    own = Row(
        what="later than two periods while the empty loop was not late",
        beside="",
        figures=_value(None if alone is None else len(alone)),
        beside_figures={},
        target=Target(0.0, VALUE, ratio=False),
        why_not=why,
    )
    counted = [
        Row(
            what=what,
            beside="empty loop",
            figures=_value(_at(hover, "flight", key)),
            beside_figures=_value(_at(hover, "empty", key)),
            target=None,
            why_not=why,
        )
        for what, key in (
            ("ticks", "ticks"),
            ("later than one period", "later_than_one"),
            ("later than two periods", "later_than_two"),
            ("deadlines without a tick", "skipped"),
        )
    ]
    return Section("Late ticks", texts.LATE, VALUE, [own, *counted])


def _setpoints(hover: Figures, loops: Figures) -> Section:
    bare, grpc, native = _at(hover, "bare"), _at(loops, "grpc") or loops, _at(loops, "native") or loops
    flight = _spread(_at(hover, "setpoint_ms"))
    what = "mocap to setpoint, ms: flight"
    rows = [
        Row(
            what=what,
            beside="bare loop on native MAVSDK, in the same minutes",
            figures=flight,
            beside_figures=_spread(_at(bare, "inside")),
            target=Target(1.5),
            why_not=_why(hover, bare),
        ),
        Row(
            what=what,
            beside="bare loop over gRPC",
            figures=flight,
            beside_figures=_spread(_at(grpc, "wire")),
            target=Target(0.2),
            why_not=_why(hover, loops, grpc),
        ),
        Row(
            what="tick begun to setpoint, ms: flight",
            beside="bare loop on native MAVSDK, in the same minutes",
            figures=_spread(_at(hover, "start_to_setpoint_ms")),
            beside_figures=_spread(_at(bare, "inside")),
            target=None,
            why_not=_why(hover, bare),
        ),
    ]
    for which, end in (("inside", "to setpoint"), ("wire", "to setpoint, wire to wire")):
        for name, key in (
            ("the companion's edge alone", "edge"),
            ("pymavlink echo", "pymavlink"),
            ("bare loop over gRPC", "grpc"),
        ):
            loop = _at(loops, key) or loops
            rows.append(
                Row(
                    what=f"mocap {end}, ms: {name}",
                    beside="bare loop on native MAVSDK",
                    figures=_spread(_at(loop, which)),
                    beside_figures=_spread(_at(native, which)),
                    target=None,
                    why_not=_why(loops, loop, native),
                )
            )
    return Section("Motion capture to setpoint", texts.SETPOINT, P50_P99, rows)


def _joints(hover: Figures, joints: Figures) -> Section:
    alone, in_world = (_at(joints, name) or joints for name in ("alone", "in_world"))
    wire_ms = _at(alone, "wire_ms")
    limit = {} if wire_ms is None else dict.fromkeys(P50_P99, float(wire_ms))
    bare = "bare dynamixel-sdk, the world's bus"
    rows = [
        Row(
            what="joint read begun to currents written, ms: flight",
            beside=bare,
            figures=_spread(_at(hover, "bus_cycle_ms")),
            beside_figures=_spread(_at(in_world, "cycle_ms")),
            target=Target(1.3),
            why_not=_why(hover, joints, in_world),
        ),
        Row(
            what="the same, ms: bare dynamixel-sdk, a bus of its own",
            beside="bytes on the wire",
            figures=_spread(_at(alone, "cycle_ms")),
            beside_figures=limit,
            target=None,
            why_not=_why(joints, alone),
        ),
        Row(
            what="answers there to currents written, ms: flight",
            beside=bare,
            figures=_spread(_at(hover, "read_to_write_ms")),
            beside_figures=_spread(_at(in_world, "command_ms")),
            target=None,
            why_not=_why(hover, joints, in_world),
        ),
    ]
    failed = [
        f"{found['failed']} cycles of the bare loop on {where} found no answer and do not count."
        for found, where in ((alone, "a bus of its own"), (in_world, "the world's bus"))
        if found.get("failed")
    ]
    return Section("Servo bus", (*texts.BUS, *_bytes(alone), *failed), P50_P99, rows)


def _bytes(found: Figures) -> list[str]:
    if "wire_ms" not in found:
        return []
    counts = f"{found['request_bytes']} of the read, {found['answer_bytes']} of both answers, {found['write_bytes']} of the currents"
    baud = f"{found['baud_bps'] / 1e6:g} Mbaud"
    return [f"Bytes on the wire: {counts}; 10 bits each at {baud}: {found['wire_ms']:.3g} ms."]


def _us(found: Any) -> dict[str, float]:
    return {name: 1e3 * value for name, value in _spread(found).items() if name in P50_P99}


def _core(hover: Figures, core: Figures) -> Section:
    raw = _at(core, "raw_tick_us")
    raw_us = {} if raw is None else {"p50": float(raw)}
    why = _why(core)
    tick = _us(_at(core, "core_ms"))
    law, whole = _at(core, "law_us"), _at(core, "tick_us")
    plain = _at(core, "law_without_loads_us")
    rows = [
        Row(
            what="FlightCore.step, us",
            beside="raw MuJoCo",
            figures=tick,
            beside_figures=raw_us,
            target=Target(100.0, ("p50",), ratio=False),
            why_not=why,
        ),
        Row(
            what="the law alone, us",
            beside="raw MuJoCo",
            figures={} if law is None else {"p50": law},
            beside_figures=raw_us,
            target=None,
            why_not=why,
        ),
        Row(
            what="the law with adaptive loads, us",
            beside="without them",
            figures={} if law is None else {"p50": law},
            beside_figures={} if plain is None else {"p50": plain},
            target=None,
            why_not=why,
        ),
        Row(
            what="a tick of the fast closed loop, plant and all, us",
            beside="raw MuJoCo",
            figures={} if whole is None else {"p50": whole},
            beside_figures=raw_us,
            target=None,
            why_not=why,
        ),
        Row(
            what="FlightCore.step in the flight, us",
            beside="the fast closed loop",
            figures=_us(_at(hover, "core_ms")),
            beside_figures=tick,
            target=None,
            why_not=_why(hover, core),
        ),
    ]
    return Section("Computing", texts.CORE, P50_P99, rows)


def _cost(hover: Figures) -> Section:
    why = _why(hover)

    def of(role: str, key: str) -> dict[str, float]:
        return _value(_at(hover, "processes", role, key))

    rows = []
    for what, key, at_most in (
        ("CPU time of the flight process, %", "cpu_percent", 25.0),
        ("the same, its worst second, %", "cpu_percent_worst", None),
        ("memory of the flight process (RSS, its most), MB", "rss_mb", 150.0),
        ("minor page faults of the flight process, a second", "minor_faults_s", None),
    ):
        target = None if at_most is None else Target(at_most, VALUE, ratio=False)
        rows.append(
            Row(
                what=what,
                beside="empty loop",
                figures=of("flight", key),
                beside_figures=of("empty loop", key),
                target=target,
                why_not=why,
            )
        )
    for role in ("recorder", "guardian", "bare loop"):
        rows.append(
            Row(
                what=f"CPU time of the {role}, %",
                beside="flight",
                figures=of(role, "cpu_percent"),
                beside_figures=of("flight", "cpu_percent"),
                target=None,
                why_not=why,
            )
        )
    for role in ("recorder", "guardian"):
        rows.append(
            Row(
                what=f"memory of the {role}, MB",
                beside="flight",
                figures=of(role, "rss_mb"),
                beside_figures=of("flight", "rss_mb"),
                target=None,
                why_not=why,
            )
        )
    return Section("What it costs", texts.COST, VALUE, rows)
