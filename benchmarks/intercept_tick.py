"""Times the flight core's tick while a ball flies and is met, against that of a vehicle that waits without one.

    python -m benchmarks.intercept_tick --draws 5 --seed 601

Both are CPU time of `FlightCore.step` on recorded inputs, measured in turn in one process: with a ball from `ball_seen` to the planned
meeting, without one at the same time after the start of the phase.
"""

from __future__ import annotations

import argparse
import sys
import time
from collections.abc import Sequence
from statistics import median

from companion.core.flight_core import FlightCore
from companion.model.types import Inputs
from companion.recorder.versions import versions
from companion.sitl_config.loader import SitlConfig, load_sitl
from sitl.campaigns.flights import with_world
from sitl.campaigns.robustness import prepare
from sitl.fast.loop import FastFlight

FLIES_S = 40.0
REPEATS = 9


def tick_us(config: SitlConfig, inputs: Sequence[Inputs], begin: int, end: int) -> float:
    """Return the CPU time per tick of the ticks from `begin` to `end`."""
    core = FlightCore(config)
    for given in inputs[:begin]:
        core.step(given)
    begun_s = time.process_time()
    for given in inputs[begin:end]:
        core.step(given)
    return (time.process_time() - begun_s) / (end - begin) * 1e6


def compared(config: SitlConfig) -> tuple[float, float] | None:
    """Return the time per tick with a ball in flight and without one in the same laboratory; None if no ball was met."""
    flight = FastFlight(config)
    result = flight.run(FLIES_S, until=lambda outputs: outputs.chase is not None and outputs.ball is None)
    chased = [k for k, outputs in enumerate(result.outputs) if outputs.ball is not None]
    if not any(outputs.chase is not None for outputs in result.outputs):
        return None
    calm = FastFlight(config.model_copy(update={"world": config.world.model_copy(update={"payload_kg": 0.0})}))
    without = calm.run(result.outputs[-1].t_s + 0.1)
    begin, end, times_us = chased[0], chased[-1] + 1, []
    for _ in range(REPEATS):
        times_us.append(
            [tick_us(run.config, each.inputs, begin, end) for run, each in ((flight, result), (calm, without))]
        )
    with_us, without_us = (median(column) for column in zip(*times_us, strict=True))
    return with_us, without_us


def main(arguments: Sequence[str] | None = None) -> int:
    """Return 0."""
    parser = argparse.ArgumentParser(prog="python -m benchmarks.intercept_tick")
    parser.add_argument("--draws", type=int, default=5, help="laboratories (%(default)s)")
    parser.add_argument("--seed", type=int, default=601, help="seed of the draws (%(default)s)")
    a = parser.parse_args(arguments)
    config = load_sitl("intercept", world="careless")
    flights = [{"number": number, "world": None} for number in range(a.draws)]
    found = [
        compared(with_world(config, each["world"]))
        for each in prepare({"flights": flights, "seed": a.seed, "fixed": []}, [config])
    ]
    ratios = []
    for pair in found:
        if pair is not None:
            ratios.append(pair[0] / pair[1])
            print(f"{pair[0]:.0f} us with a ball, {pair[1]:.0f} us without, ratio {ratios[-1]:.2f}")
    print(f"median ratio {median(ratios):.2f}; at commit {versions().get('git', 'unknown')[:10]}")
    return 0


if __name__ == "__main__":
    sys.exit(main())
