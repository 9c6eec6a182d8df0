"""The optimisation of the target impedance in flight, fast loop: `python -m benchmarks.online [--scale 0.5] [--laboratories 50]`.

Each flight repeats the course of configs/missions/circuit.yaml in a laboratory of its own, from the gains of `recommended` with Phi and
Lambda of x, y and z times `--scale`. `--online '{...}'` gives the settings of `controller.online` (null to switch it off), `--set` any
other setting, such as `world.faults=[{kind: force_bias, size: 8, t_s: 20}]`. Prints a line for each flight and a summary.
"""

from __future__ import annotations

import argparse
import json
import math
import statistics
from collections import Counter
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

from joblib import Parallel, delayed

from companion.config.controller import AdaptiveConfig
from companion.model.types import PhaseKind
from companion.sitl_config.loader import load_sitl
from sitl.fast.loop import FastFlight


@dataclass(frozen=True, slots=True)
class Flight:
    """What one flight shows."""

    seed: int
    outcome: str
    laps_mm: tuple[float, ...]
    """RMS ||e_p|| of each repetition."""
    shaking_rad_s: tuple[float, ...]
    """RMS of the tilting rate, likewise."""
    lowest: float
    highest: float
    last: float
    """Of the scale."""


def flown(seed: int, k: float, online: dict[str, Any] | None, repeat: int, sets: Sequence[str]) -> Flight:
    """Fly the course in the laboratory of a seed."""
    overrides = [f"world.seed={seed}", f"mission.repeat={repeat}", "world.payload_kg=0", *sets]
    config = load_sitl("configs/missions/circuit.yaml", preset="recommended", overrides=overrides, world="lab")
    controller = config.controller
    assert isinstance(controller, AdaptiveConfig)
    controller = controller.with_impedance_scale(k).with_gains({"online": online})
    fast = FastFlight(config.model_copy(update={"controller": controller}))
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


def main() -> None:
    """Fly and print."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--scale", type=float, default=0.5)
    parser.add_argument("--online", type=json.loads, default={"keep": True})
    parser.add_argument("--laboratories", type=int, default=50)
    parser.add_argument("--first-seed", type=int, default=7001)
    parser.add_argument("--repeat", type=int, default=5)
    parser.add_argument("--set", action="append", default=[])
    parser.add_argument("--jobs", type=int, default=2)
    a = parser.parse_args()
    seeds = range(a.first_seed, a.first_seed + a.laboratories)
    fly = delayed(flown)
    flights = []
    for flight in Parallel(a.jobs, return_as="generator")(fly(s, a.scale, a.online, a.repeat, a.set) for s in seeds):
        flights.append(flight)
        laps = " ".join(
            f"{mm:.1f} mm {rate:.2f} rad/s," for mm, rate in zip(flight.laps_mm, flight.shaking_rad_s, strict=True)
        )
        print(f"{flight.seed} {flight.outcome}: {laps} scale {flight.lowest:.2f} to {flight.highest:.2f}", flush=True)
    print(", ".join(f"{count} {name}" for name, count in Counter(flight.outcome for flight in flights).items()))
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
