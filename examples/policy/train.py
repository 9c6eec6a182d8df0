"""Trains a residual policy by an evolution strategy (CMA-ES), whole flights at a time, on the cost of `companion tune`.

python examples/policy/train.py --minutes 20 --out policy.onnx

`policy.ipynb` beside it does the same, flies the result, and compares it with its base law in laboratories that it has not seen.
"""

from __future__ import annotations

import argparse
import os
import time
from collections.abc import Sequence
from concurrent.futures import ProcessPoolExecutor
from dataclasses import dataclass
from functools import cache
from itertools import product
from pathlib import Path
from typing import Any

import cma
import gymnasium
import numpy as np

import sitl.gym  # noqa: F401  # registers the environments
from sitl.gym.export import write_policy

MISSION = str(Path(__file__).parent / "training.yaml")
SCALES = {
    "position_error_world_m": 0.05,
    "velocity_error_world_m_s": 0.2,
    "reference_acceleration_world_m_s2": 1.0,
    "force_ext_world_n": 5.0,
    "base_force_world_n": 5.0,
}
"""Quantities that the policy uses, and their normalisation; the weights of the others are 0."""
PARAMETERS = 2 * len(SCALES)
"""x and y share their weights, because the room has no preferred direction; the joint torques stay those of the base law."""
POPULATION, FLIGHTS = 8, 3
"""Candidates of a generation, and laboratories in which each of them flies, the same for all."""
HELD_OUT = 500_000
"""Training draws laboratories below this number."""


@dataclass(frozen=True)
class Generation:
    """Costs of a generation, m."""

    minutes: float
    base: float
    """Of the base law, in the same laboratories."""
    median: float
    best: float


@cache
def environment() -> Any:
    """The environment of this process."""
    return gymnasium.make("companion/Catch-v0", mission=MISSION)


def layer(parameters: Sequence[float], names: Sequence[str], actions: int) -> tuple[Any, Any]:
    """Return weight and bias of tanh(observation / scale @ weight)."""
    weight = np.zeros((len(names), actions), np.float32)
    for k, quantity in enumerate(SCALES):
        for axis in range(3):
            weight[names.index(f"{quantity}[{axis}]"), axis] = parameters[2 * k + (axis == 2)]
    return weight, np.zeros(actions, np.float32)


def scales(names: Sequence[str]) -> tuple[float, ...]:
    """Return the normalisation of the observation."""
    return tuple([SCALES.get(name.partition("[")[0], 1.0) for name in names])


def cost(parameters: Sequence[float], laboratory: int) -> float:
    """Fly an episode and return its cost."""
    flown = environment()
    card = flown.unwrapped.card
    names = card.observations
    weight, _ = layer(parameters, names, len(card.actions))
    scale, over, info = np.array(scales(names), np.float32), False, {}
    observation, _ = flown.reset(options={"laboratory": laboratory})
    while not over:
        observation, _, over, _, info = flown.step(np.tanh(observation / scale @ weight))
    return float(info["cost"])


def train(minutes: float, out: Path, jobs: int, seed: int = 1) -> list[Generation]:
    """Search until the time is over, write the mean of the last generation, and return the costs of each."""
    generations: list[Generation] = []
    search = cma.CMAEvolutionStrategy(np.zeros(PARAMETERS), 0.25, {"popsize": POPULATION, "seed": seed, "verbose": -9})
    generator, begin_s = np.random.default_rng(seed), time.monotonic()
    with ProcessPoolExecutor(jobs) as pool:
        while not generations or generations[-1].minutes < minutes:
            candidates = [*search.ask(), np.zeros(PARAMETERS)]  # the last one is the base law
            laboratories = generator.integers(HELD_OUT, size=FLIGHTS).tolist()
            pairs = list(product(candidates, laboratories))
            costs = np.reshape(list(pool.map(cost, *zip(*pairs, strict=True))), (len(candidates), FLIGHTS)).mean(axis=1)
            search.tell(candidates[:-1], costs[:-1].tolist())
            found = Generation((time.monotonic() - begin_s) / 60.0, costs[-1], np.median(costs[:-1]), costs[:-1].min())
            generations.append(found)
            print(
                f"{found.minutes:5.1f} min: base {found.base:.4f}, median {found.median:.4f}, best {found.best:.4f}",
                flush=True,
            )
    card = environment().unwrapped.card
    card = card.model_copy(update={"observation_scale": scales(card.observations)})
    write_policy([layer(search.mean, card.observations, len(card.actions))], card, out)
    print(f"{out}: parameters {np.round(search.mean, 3).tolist()}")
    return generations


def main() -> None:
    """Parse the command line and train."""
    parser = argparse.ArgumentParser(description=__doc__.partition("\n")[0])
    parser.add_argument("--minutes", type=float, default=20.0)
    parser.add_argument("--out", type=Path, default=Path("policy.onnx"))
    parser.add_argument("--jobs", type=int, default=os.cpu_count())
    parser.add_argument("--seed", type=int, default=1)
    a = parser.parse_args()
    train(a.minutes, a.out, a.jobs, a.seed)


if __name__ == "__main__":
    main()
