"""Trains a residual policy by an evolution strategy (CMA-ES) and compares it with its base law in laboratories that it has not seen.

python examples/policy/train.py --minutes 20 --out policy.onnx
python examples/policy/train.py --compare policy.onnx --laboratories 40
"""

from __future__ import annotations

import argparse
import time
from collections.abc import Sequence
from concurrent.futures import ProcessPoolExecutor
from functools import cache
from itertools import product
from pathlib import Path
from typing import Any

import cma
import gymnasium
import numpy as np

import sitl.gym  # noqa: F401  # registers the environments
from companion.campaigns.cost import flight_cost
from companion.sitl_config.loader import load_sitl
from sitl.campaigns.flights import fly_to_end
from sitl.campaigns.tune import graded
from sitl.gym.export import write_policy

MISSION = str(Path(__file__).parent / "training.yaml")
SCALES = {
    "position_error_world_m": 0.05,
    "velocity_error_world_m_s": 0.2,
    "force_ext_world_n": 5.0,
    "base_force_world_n": 5.0,
}
"""Quantities that the policy uses, and their normalisation; the weights of the others are 0."""
PARAMETERS = 2 * len(SCALES)
"""x and y share their weights, because the room has no preferred direction; the joint torques stay those of the base law."""
STEPS_MAX = 260
"""Length of an episode in training, 5.2 s in the air: until 1.5 s after the catch."""
POPULATION, FLIGHTS, HELD_OUT = 8, 2, 500_000
"""Candidates of a generation, laboratories in which each flies, first laboratory of the comparison."""


@cache
def environment() -> Any:
    """The environment of this process."""
    return gymnasium.make("companion/Catch-v0", mission=MISSION, max_episode_steps=STEPS_MAX)


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
    """Fly an episode and return the negative sum of its rewards: the position error's part of the cost, or 1 or more for a failure."""
    flown = environment()
    card = flown.unwrapped.card
    names = card.observations
    weight, _ = layer(parameters, names, len(card.actions))
    scale, total, over = np.array(scales(names), np.float32), 0.0, False
    observation, _ = flown.reset(options={"laboratory": laboratory})
    while not over:
        observation, reward, terminated, truncated, _ = flown.step(np.tanh(observation / scale @ weight))
        total, over = total + reward, terminated or truncated
    return -total


def train(minutes: float, out: Path, jobs: int, seed: int) -> None:
    """Search until the time is over, and write the mean of the last generation."""
    search = cma.CMAEvolutionStrategy(np.zeros(PARAMETERS), 0.25, {"popsize": POPULATION, "seed": seed, "verbose": -9})
    generator, begin_s = np.random.default_rng(seed), time.monotonic()
    with ProcessPoolExecutor(jobs) as pool:
        while time.monotonic() - begin_s < 60.0 * minutes:
            candidates = [*search.ask(), np.zeros(PARAMETERS)]  # the last one is the base law
            laboratories = generator.integers(HELD_OUT, size=FLIGHTS).tolist()
            pairs = list(product(candidates, laboratories))
            costs = np.reshape(list(pool.map(cost, *zip(*pairs, strict=True))), (len(candidates), FLIGHTS)).mean(axis=1)
            search.tell(candidates[:-1], costs[:-1].tolist())
            took = (time.monotonic() - begin_s) / 60.0
            print(f"{took:5.1f} min, {search.countevals} candidates: base {costs[-1]:.4f}, "
                  f"median {np.median(costs[:-1]):.4f}, best {costs[:-1].min():.4f}", flush=True)  # fmt: skip
    card = environment().unwrapped.card
    card = card.model_copy(update={"observation_scale": scales(card.observations)})
    write_policy([layer(search.mean, card.observations, len(card.actions))], card, out)
    print(f"{out}: parameters {np.round(search.mean, 3).tolist()}")


def row(controller: str | None, laboratory: int) -> dict[str, Any]:
    """Fly the shipped catch and return its graded row."""
    config = load_sitl("catch", None, controller, world="lab", overrides=[f"world.seed={laboratory}"])
    return graded(fly_to_end(config), cut=False)


def compare(policy: Path, laboratories: int, jobs: int) -> None:
    """Print the paired differences, policy minus base law, with 95 % confidence intervals."""
    seeds = [HELD_OUT + number for number in range(laboratories)]
    with ProcessPoolExecutor(jobs) as pool:
        rows = list(pool.map(row, [None] * laboratories + [str(policy)] * laboratories, seeds * 2))
    base, learned = rows[:laboratories], rows[laboratories:]
    print(f"completed with the payload: base {caught(base)}, policy {caught(learned)} of {laboratories}")
    for name, value in (
        ("cost, m", flight_cost),
        ("e_p after the catch, m", lambda row: row["rms"]["post"]["e_p_m"]),
        ("e_p before the catch, m", lambda row: row["rms"]["pre"]["e_p_m"]),
        ("torque activity, N m", lambda row: row["torque_activity_nm"]),
    ):
        pairs = [(value(one), value(other)) for one, other in zip(base, learned, strict=True)]
        pairs = [(one, other) for one, other in pairs if one is not None and other is not None]
        one, other = np.mean(pairs, axis=0)
        differences = np.diff(pairs, axis=1)
        error = 1.96 * differences.std(ddof=1) / np.sqrt(len(pairs))
        print(f"{name}: base {one:.4f}, policy {other:.4f}, difference {differences.mean():+.4f} +- {error:.4f}")


def caught(rows: Sequence[dict[str, Any]]) -> int:
    """Return the number of completed flights that caught the payload."""
    return sum(row["outcome"] == "completed" and row["caught"] for row in rows)


def main() -> None:
    """Parse the command line and train or compare."""
    parser = argparse.ArgumentParser(description=__doc__.partition("\n")[0])
    parser.add_argument("--minutes", type=float, default=20.0)
    parser.add_argument("--out", type=Path, default=Path("policy.onnx"))
    parser.add_argument("--compare", type=Path, metavar="POLICY")
    parser.add_argument("--laboratories", type=int, default=40)
    parser.add_argument("--jobs", type=int, default=2)
    parser.add_argument("--seed", type=int, default=1)
    a = parser.parse_args()
    if a.compare is not None:
        compare(a.compare, a.laboratories, a.jobs)
    else:
        train(a.minutes, a.out, a.jobs, a.seed)


if __name__ == "__main__":
    main()
