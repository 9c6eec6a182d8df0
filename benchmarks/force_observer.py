"""Flies laboratories with the momentum observer and the force sensor side by side, and prints the observer's error and its catches.

python -m benchmarks.force_observer --seeds 10
"""

from __future__ import annotations

import argparse
from collections.abc import Sequence
from pathlib import Path

import numpy as np
import numpy.typing as npt

from companion.model.types import PhaseKind
from companion.sitl_config.loader import load_sitl
from sitl.fast.loop import FastFlight
from sitl.fast.result import FastResult

MISSIONS = Path(__file__).parents[1] / "configs" / "missions"
FLIGHTS = (("hover", 0.0), ("circuit", 0.0), ("catch", 0.0), ("catch", 0.1), ("catch", 0.2), ("catch", 0.3))
"""Mission and payload, kg."""
IMPACT_S = 0.5
Array = npt.NDArray[np.float64]


def errors(result: FastResult, caught_s: float) -> tuple[Array, Array, Array]:
    """Return observed minus measured force, world frame, N: without a payload, within 0.5 s after the impact, and later."""
    rows = [
        (o.t_s, *np.subtract(c.force_observed_world_n, c.force_measured_world_n))
        for o in result.outputs
        if o.phase_kind is PhaseKind.FLIGHT and (c := o.control) is not None
        if c.force_observed_world_n is not None and c.force_measured_world_n is not None
    ]
    found = np.array(rows, dtype=np.float64).reshape(-1, 4)
    since_s, error = found[:, 0] - caught_s, found[:, 1:]
    return error[since_s < 0.0], error[(since_s >= 0.0) & (since_s < IMPACT_S)], error[since_s >= IMPACT_S]


def main(argv: Sequence[str] | None = None) -> int:
    """Fly, and print one row per mission and payload."""
    parser = argparse.ArgumentParser(prog="python -m benchmarks.force_observer")
    parser.add_argument("--seeds", type=int, default=10)
    parser.add_argument("--first-seed", type=int, default=1)
    parser.add_argument("--set", nargs="+", default=[], metavar="KEY=VALUE")
    options = parser.parse_args(argv)
    print(
        "| flight | completed | thrown into the net | catches reported | part | RMS x, y, z [N] | largest x, y, z [N] |"
    )
    print("|---|---|---|---|---|---|---|")
    for mission, payload_kg in FLIGHTS:
        parts: tuple[list[Array], list[Array], list[Array]] = ([], [], [])
        completed = thrown = reported = 0
        for seed in range(options.first_seed, options.first_seed + options.seeds):
            changes = [f"world.seed={seed}", f"world.payload_kg={payload_kg}", "vehicle.force_source=observer"]
            flight = FastFlight(load_sitl(MISSIONS / f"{mission}.yaml", overrides=[*changes, *options.set]))
            result = flight.run()
            caught_s = flight.plant.scene.payload.caught_t_s
            for part, error in zip(parts, errors(result, np.inf if caught_s is None else caught_s), strict=True):
                part.append(error)
            outcome = result.outputs[-1].outcome
            completed += outcome is not None and outcome.value == "completed"
            thrown += caught_s is not None
            reported += sum(event.id == "catch" for o in result.outputs for event in o.events)
        name = f"{mission}, {payload_kg:g} kg" if payload_kg else mission
        for label, part in zip(("no payload", "0.5 s after the impact", "later"), parts, strict=True):
            error = np.concatenate(part)
            if len(error):
                rms = ", ".join(f"{value:.2f}" for value in np.sqrt(np.mean(error**2, axis=0)))
                most = ", ".join(f"{value:.1f}" for value in np.abs(error).max(axis=0))
                print(f"| {name} | {completed} | {thrown} | {reported} | {label} | {rms} | {most} |", flush=True)
    return 0


if __name__ == "__main__":
    raise SystemExit(main())
