"""The optimisation of the target impedance in flight, fast loop: `python -m benchmarks.online [--scale 0.5] [--laboratories 50]`.

Each flight repeats the course of configs/missions/circuit.yaml in a laboratory of its own, from the gains of `recommended` with Phi and
Lambda of x, y and z times `--scale`. `--online '{...}'` gives the settings of `controller.online` (null to switch it off), `--set` any
other setting, such as `world.faults=[{kind: force_bias, size: 8, t_s: 20}]`. Prints a line for each flight and a summary.

With `--faults`, each flight draws its scale (0.5, 1 or 2), a fault of the fault campaign that needs no throw, and the fault's time, and
is graded as in that campaign. The same seeds with `--online null` show what the optimisation changed.
"""

from __future__ import annotations

import argparse
import json
import math
import random
import statistics
from collections import Counter
from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from typing import Any

from joblib import Parallel, delayed

from companion.campaigns.faults.judge import row_of
from companion.campaigns.faults.variants import VARIANTS
from companion.config.controller import AdaptiveConfig
from companion.mission.plan import Plan
from companion.model.flight_stage import SPOOL_S
from companion.model.types import PhaseKind
from companion.sitl_config.loader import SitlConfig, load_sitl
from sitl.campaigns.faults import record_of
from sitl.campaigns.flights import fly_to_end, with_world
from sitl.fast.loop import FastFlight

SCALES = (0.5, 1.0, 2.0)


@dataclass(frozen=True, slots=True)
class Flight:
    """What one flight shows."""

    seed: int
    outcome: str
    laps_mm: tuple[float, ...]
    """RMS ||e_p|| of each repetition."""
    shaking_rad_s: tuple[float, ...]
    """RMS of the rate of roll and pitch in each repetition."""
    lowest: float
    """Smallest scale of the impedance."""
    highest: float
    last: float
    """Scale at the end."""


def configured(seed: int, k: float, online: dict[str, Any] | None, repeat: int, sets: Sequence[str]) -> SitlConfig:
    """Return the configuration of a flight."""
    overrides = [f"world.seed={seed}", f"mission.repeat={repeat}", "world.payload_kg=0", *sets]
    config = load_sitl("configs/missions/circuit.yaml", preset="recommended", overrides=overrides, world="lab")
    controller = config.controller
    assert isinstance(controller, AdaptiveConfig)
    controller = controller.with_impedance_scale(k).with_gains({"online": online})
    return config.model_copy(update={"controller": controller})


def flown(seed: int, k: float, online: dict[str, Any] | None, repeat: int, sets: Sequence[str]) -> Flight:
    """Fly the course in the laboratory of a seed."""
    fast = FastFlight(configured(seed, k, online, repeat, sets))
    result = fast.run(40.0 + 15.0 * repeat)
    laps: dict[str, list[tuple[float, float]]] = {}
    scales = [1.0]
    for inputs, outputs in zip(result.inputs, result.outputs, strict=True):
        log, vehicle = outputs.control, inputs.vehicle
        if log is None or vehicle is None:
            continue
        scales.append(log.impedance_scale or 1.0)
        if outputs.phase_kind is PhaseKind.FLIGHT and outputs.action.rank < 2:
            rates, error = vehicle.angular_rate_body_rad_s, log.error
            squares = (math.hypot(*error[:3]) ** 2, math.hypot(*rates[:2]) ** 2)
            laps.setdefault(outputs.phase.split("(")[-1], []).append(squares)
    outcome = result.outputs[-1].outcome
    ended = "crashed" if result.crashed else outcome.value if outcome is not None else "lost"
    error_m, tilting = (
        tuple([math.sqrt(statistics.fmean(row[column] for row in rows)) for rows in laps.values()]) for column in (0, 1)
    )
    return Flight(seed, ended, tuple([1e3 * lap for lap in error_m]), tilting, min(scales), max(scales), scales[-1])


def flown_with_fault(seed: int, online: dict[str, Any] | None, repeat: int, sets: Sequence[str]) -> tuple[str, str]:
    """Fly the course with a fault, all drawn by the seed; return a line of text, and the outcome as in the fault campaign."""
    draw = random.Random(seed)
    k, variant = draw.choice(SCALES), draw.choice([variant for variant in VARIANTS if "line" in variant.phases])
    config = configured(seed, k, online, repeat, sets)
    t_s = round(draw.uniform(SPOOL_S, SPOOL_S + Plan.build(config.mission, config.vehicle).duration_s), 2)
    fault = {**variant.fault("line"), "phase": None, "t_s": t_s}
    fast = fly_to_end(with_world(config, {"faults": [fault]}), 40.0 + 15.0 * repeat)
    row = row_of(variant, "line", record_of(fast), config.vehicle)
    logs = [output.control for output in fast.result.outputs if output.control is not None]
    scales = [1.0, *(log.impedance_scale or 1.0 for log in logs)]
    what = f"{variant.kind} {' '.join(map(str, variant.shown))} at {t_s} s, gains {k:g}"
    text = f"{seed} {what}: {row['outcome']}, {row['action']}, scale {min(scales):.2f} to {max(scales):.2f}"
    return f"{text} {row['error'] or ''} {'; '.join(row['problems'])}".rstrip(), row["outcome"]


def counted(outcomes: Iterable[str]) -> str:
    """Return how many flights ended how."""
    return ", ".join(f"{count} {name}" for name, count in Counter(outcomes).items())


def main() -> None:
    """Fly and print."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--scale", type=float, default=0.5)
    parser.add_argument("--online", type=json.loads, default={"keep": True})
    parser.add_argument("--laboratories", type=int, default=50)
    parser.add_argument("--first-seed", type=int, default=7001)
    parser.add_argument("--repeat", type=int, default=5)
    parser.add_argument("--faults", action="store_true")
    parser.add_argument("--set", action="append", default=[])
    parser.add_argument("--jobs", type=int, default=2)
    a = parser.parse_args()
    seeds = range(a.first_seed, a.first_seed + a.laboratories)
    parallel = Parallel(a.jobs, return_as="generator")
    if a.faults:
        outcomes = []
        for text, outcome in parallel(delayed(flown_with_fault)(s, a.online, a.repeat, a.set) for s in seeds):
            outcomes.append(outcome)
            print(text, flush=True)
        print(counted(outcomes))
        return
    flights = []
    for flight in parallel(delayed(flown)(s, a.scale, a.online, a.repeat, a.set) for s in seeds):
        flights.append(flight)
        laps = " ".join(
            f"{mm:.1f} mm {rate:.2f} rad/s," for mm, rate in zip(flight.laps_mm, flight.shaking_rad_s, strict=True)
        )
        print(f"{flight.seed} {flight.outcome}: {laps} scale {flight.lowest:.2f} to {flight.highest:.2f}", flush=True)
    print(counted(flight.outcome for flight in flights))
    whole = [flight for flight in flights if flight.outcome == "completed"]
    if not whole:
        return
    for name, values in (
        ("e_p of the first repetition, mm", [flight.laps_mm[0] for flight in whole]),
        ("e_p of the last repetition, mm", [flight.laps_mm[-1] for flight in whole]),
        ("last / first", [flight.laps_mm[-1] / flight.laps_mm[0] for flight in whole]),
        ("scale at the end", [flight.last for flight in whole]),
    ):
        print(f"{name}: p50 {statistics.median(values):.3f}, {min(values):.3f} to {max(values):.3f}")


if __name__ == "__main__":
    main()
