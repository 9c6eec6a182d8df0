"""Flies interceptions that something else than a ball of the plan disturbs: are they safe, and does the vehicle stay in its box?

    python -m benchmarks.intercept_disturbed --draws 40 --seed 601

The flights are those of `companion robustness intercept --world careless`, each with one disturbance that is drawn for it.
"""

from __future__ import annotations

import argparse
import math
import sys
from collections import Counter
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

import numpy as np
from rich.console import Console

from benchmarks.report import print_table, write_json
from companion.phases.intercept.phase import Intercept
from companion.recorder.versions import versions
from companion.sitl_config.loader import SitlConfig, load_sitl
from sitl.campaigns.flights import fly_to_end, row_of, with_world
from sitl.campaigns.robustness import prepare

Row = dict[str, Any]


def _reflections(draw: np.random.Generator) -> list[str]:
    return [
        f"world.markers.stray_per_s={draw.uniform(20, 60):.1f}",
        f"world.markers.stray_s={draw.uniform(0.03, 0.3):.3f}",
    ]


def _second_ball(draw: np.random.Generator) -> list[str]:
    fault = (
        f"{{kind: payload_double, after: throw, t_s: {draw.uniform(0, 0.6):.3f}, size: {draw.uniform(0.05, 0.3):.3f}}}"
    )
    return [f"world.faults=[{fault}]"]


def _wand(draw: np.random.Generator) -> list[str]:
    x, y, z = draw.uniform((0.2, -1.2, 0.6), (1.8, 1.0, 1.6)).tolist()
    return [f"world.markers.wand_at_m=[{x:.3f}, {y:.3f}, {z:.3f}]"]


def _at_the_rotors(draw: np.random.Generator) -> list[str]:
    """Aim at a point of the rotors, which are above and behind the net."""
    x, y, z = draw.uniform((-0.5, -0.35, 0.4), (0.1, 0.35, 0.5)).tolist()
    return [f"world.people[{n}].aims_m=[{x:.3f}, {y:.3f}, {z:.3f}]" for n in range(2)]


def _lost_frames(draw: np.random.Generator) -> list[str]:
    return [f"world.faults=[{{kind: mocap_loss, after: throw, t_s: {draw.uniform(0, 0.8):.3f}, duration_s: 0.05}}]"]


DISTURBANCES: dict[str, Callable[[np.random.Generator], list[str]]] = {
    "reflections": _reflections,
    "second ball": _second_ball,
    "wand": _wand,
    "at the rotors": _at_the_rotors,
    "lost frames": _lost_frames,
}


def fly(config: SitlConfig) -> Row:
    """Fly one laboratory; return its outcome, and how far reference and body came beyond the phase's box (negative: inside)."""
    flown = fly_to_end(config)
    row, _ = row_of(flown.config.flight, flown.result, flown.caught_t_s, flown.error)
    (phase,) = [phase for phase in config.mission.phases if isinstance(phase, Intercept)]
    outputs = flown.result.outputs
    ticks = [
        (output.reference.position_world_m, truth.position_world_m)
        for output, truth in zip(outputs, flown.result.truth, strict=True)
        if output.phase == phase.description and output.reference is not None
    ]
    beyond_m = [math.nan, math.nan]
    if ticks:
        away_m = np.abs(np.array(ticks) - ticks[0][0]) - phase.box_m
        beyond_m = away_m.max(axis=(0, 2)).tolist()
    return {
        "seed": flown.config.world.seed, "outcome": row["outcome"], "error": row["error"], "caught": row["caught"],
        "reference_beyond_m": beyond_m[0], "body_beyond_m": beyond_m[1],
        "events": [f"{event.t_s:.2f} {event.id}: {event.text}" for output in outputs for event in output.events],
    }  # fmt: skip


def counts(disturbance: str, rows: Sequence[Row]) -> dict[str, str]:
    """Return the line of the table of one disturbance."""
    outcomes = Counter(row["outcome"] for row in rows)
    return {
        "disturbance": disturbance,
        "flights": str(len(rows)),
        "caught": str(sum(row["caught"] for row in rows)),
        **{outcome: str(outcomes[outcome]) for outcome in ("completed", "aborted", "crashed")},
        "other": str(outcomes.total() - sum(outcomes[outcome] for outcome in ("completed", "aborted", "crashed"))),
        "no chase": str(sum("meeting_planned" not in "".join(row["events"]) for row in rows)),
        "reference beyond, mm": f"{1e3 * max(row['reference_beyond_m'] for row in rows):.0f}",
        "body beyond, mm": f"{1e3 * max(row['body_beyond_m'] for row in rows):.0f}",
        "bodies beyond": str(sum(row["body_beyond_m"] > 0.0 for row in rows)),
    }


def main(arguments: Sequence[str] | None = None) -> int:
    """Return 0."""
    parser = argparse.ArgumentParser(prog="python -m benchmarks.intercept_disturbed")
    parser.add_argument("--draws", type=int, default=40, help="flights per disturbance (%(default)s)")
    parser.add_argument("--seed", type=int, default=601, help="seed of the draws (%(default)s)")
    parser.add_argument("--only", choices=tuple(DISTURBANCES), action="append", help="a disturbance (default: all)")
    parser.add_argument("--json", type=Path, metavar="FILE", help="write each flight to FILE")
    a = parser.parse_args(arguments)
    flown: dict[str, list[Row]] = {}
    flights = [{"number": number, "world": None} for number in range(a.draws)]
    for disturbance in a.only or DISTURBANCES:
        draw, flown[disturbance] = np.random.default_rng((a.seed, *disturbance.encode())), []
        for flight in flights:
            config = load_sitl("intercept", overrides=DISTURBANCES[disturbance](draw), world="careless")
            (job,) = prepare({"flights": [flight], "seed": a.seed, "fixed": []}, [config])
            flown[disturbance].append(fly(with_world(config, job["world"])))
    print_table("Disturbed interceptions", [counts(*each) for each in flown.items()], Console(width=160))
    write_json(a.json, flown)
    print(f"Flown at commit {versions().get('git', 'unknown')[:10]}.")
    return 0


if __name__ == "__main__":
    sys.exit(main())
