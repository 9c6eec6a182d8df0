"""Flies the Gymnasium environments with a random agent: exceptions, memory and steps a second; other simulators beside it.

    python -m benchmarks.gym --steps 1000000 --jobs 2
    python -m benchmarks.gym --beside            # steps a second beside RotorPy and Crazyflow, as far as they are installed

An action is held for 1 to 25 steps, drawn anew for each episode, so that some agents tremble and others push. Half of the processes add
it to the base law's wrench, the others replace that. Every observation must lie in its space and every reward be finite. The memory is
the largest resident memory of a process at a reset in the first half of its steps, and in the second.
"""

from __future__ import annotations

import argparse
import math
import os
import sys
import time
from collections import Counter
from collections.abc import Callable
from concurrent.futures import ProcessPoolExecutor
from dataclasses import dataclass
from importlib import import_module
from itertools import product

import gymnasium
import numpy as np

import sitl.gym  # noqa: F401  # registers the environments
from companion.recorder.versions import versions

NAMES, ACTIONS = ("Catch", "Hover", "Press", "Intercept"), ("residual", "wrench")
HOLD_MAX = 25
MIB = 2**20


@dataclass(frozen=True)
class Flown:
    """What one process flew."""

    name: str
    steps: int
    outcomes: Counter[str]
    cpu_s: float
    half_mib: tuple[float, float]
    """Largest resident memory at a reset in each half of the steps."""
    files: int
    """Open files at the end, less those at the beginning."""


def resident_mib() -> float:
    """Return the resident memory of this process."""
    with open("/proc/self/statm", encoding="ascii") as file:
        return int(file.read().split()[1]) * os.sysconf("SC_PAGE_SIZE") / MIB


def fly(name: str, action: str, steps: int, seed: int) -> Flown:
    """Fly episodes with a random agent until it has taken this many steps.

    Raises:
        ValueError: an observation lies outside its space, or a reward is not finite.
    """
    environment = gymnasium.make(f"companion/{name}-v0", action=action)
    generator, outcomes = np.random.default_rng(seed), Counter[str]()
    files, resident, count, cpu_s = len(os.listdir("/proc/self/fd")), ([0.0], [0.0]), 0, time.process_time()
    environment.reset(seed=seed)
    while count < steps:
        over, held, hold = False, np.zeros(0), int(generator.integers(1, HOLD_MAX, endpoint=True))
        while not over and count < steps:
            if count % hold == 0 or held.size == 0:
                held = generator.uniform(-1.0, 1.0, environment.action_space.shape).astype(np.float32)
            observation, reward, over, _, info = environment.step(held)
            if not environment.observation_space.contains(observation) or not math.isfinite(float(reward)):
                raise ValueError(f"{name}: observation {observation}, reward {reward}")
            count += 1
        resident[2 * count > steps].append(resident_mib())
        if over:
            outcomes[info["row"]["outcome"]] += 1
            environment.reset()
    cpu_s = time.process_time() - cpu_s
    environment.close()
    opened = len(os.listdir("/proc/self/fd")) - files
    return Flown(f"{name}, {action}", count, outcomes, cpu_s, (max(resident[0]), max(resident[1])), opened)


def companion() -> tuple[str, int, Callable[[], object]]:
    """A step of `companion/Catch-v0`: 4 ticks of 5 ms, 10 steps of the physics."""
    environment = gymnasium.make("companion/Catch-v0")
    still = np.zeros(5, np.float32)
    environment.reset(seed=1)

    def step() -> None:
        if environment.step(still)[2]:
            environment.reset()

    return "companion/Catch-v0", 1, step


def rotorpy(number: int) -> tuple[str, int, Callable[[], object]]:
    """A step of RotorPy's quadrotor in PyTorch: 10 ms of a rigid body with rotor lag and drag, by RK4; it commands thrust and rates."""
    torch = import_module("torch")
    learning = import_module("rotorpy.learning.quadrotor_environments")
    parameters = import_module("rotorpy.vehicles.crazyflie_params").quad_params
    torch.set_num_threads(1)
    zeros = {key: torch.zeros(number, 3).double() for key in ("x", "v", "w", "wind")}
    level = torch.tensor([0.0, 0.0, 0.0, 1.0]).repeat(number, 1).double()
    speeds = torch.full((number, 4), 1788.53).double()
    begin = {**zeros, "q": level, "rotor_speeds": speeds}
    environment = learning.QuadrotorEnv(number, begin, control_mode="cmd_ctbr", quad_params=parameters)
    environment.reset()
    actions = np.zeros((number, 4))
    return f"RotorPy, {number}", number, lambda: environment.step(actions)


def crazyflow(number: int) -> tuple[str, int, Callable[[], object]]:
    """A step of Crazyflow's hover in JAX: 2 ms of a fitted attitude response without rotors, 500 Hz."""
    jax = import_module("jax")
    environment = import_module("crazyflow.envs.reach_pos_env").ReachPosEnv(num_envs=number)
    environment.reset(seed=1)
    actions = np.zeros((number, 4), np.float32)
    return f"Crazyflow, {number}", number, lambda: jax.block_until_ready(environment.step(actions)[0]["pos"])


def steps_a_second(step: Callable[[], object], seconds: float) -> float:
    """Return the calls in a second of processor time of all threads of this process, after a first second that is not counted."""
    for duration_s in (1.0, seconds):
        count, begin_s = 0, time.process_time()
        while (used_s := time.process_time() - begin_s) < duration_s:
            step()
            count += 1
    return count / used_s


def beside(seconds: float) -> None:
    """Print steps a second of processor time of this and other simulators, in turn, three times each."""
    found = [companion()]
    for make, number in product((rotorpy, crazyflow), (1, 100)):
        try:
            found.append(make(number))
        except ImportError as error:
            print(f"{make.__name__} is not installed: {error}", file=sys.stderr)
    rates = [[number * steps_a_second(step, seconds) for _, number, step in found] for _ in range(3)]
    for (name, _, _), rate in zip(found, np.median(rates, axis=0), strict=True):
        print(f"{name:24} {rate:12,.0f} steps per second of processor time")


def main() -> None:
    """Parse the command line, fly, and print a line for each process."""
    parser = argparse.ArgumentParser(description=__doc__.partition("\n")[0])
    parser.add_argument("--steps", type=int, default=8000, help="of all environments together (default: %(default)s)")
    parser.add_argument("--jobs", type=int, default=2, help="processes at once (default: %(default)s)")
    parser.add_argument("--seed", type=int, default=1)
    parser.add_argument("--beside", action="store_true", help="measure steps a second beside other simulators")
    parser.add_argument("--seconds", type=float, default=10.0, help="with --beside: length of a measurement")
    a = parser.parse_args()
    print(f"companion {versions()['companion']}")
    if a.beside:
        beside(a.seconds)
        return
    cases = list(product(NAMES, ACTIONS))
    arguments = [(*case, a.steps // len(cases), a.seed + number) for number, case in enumerate(cases)]
    with ProcessPoolExecutor(a.jobs, max_tasks_per_child=1) as pool:
        for flown in pool.map(fly, *zip(*arguments, strict=True)):
            memory = "{:.0f}, {:.0f} MiB, {:+d} files".format(*flown.half_mib, flown.files)
            rate = flown.steps / flown.cpu_s
            print(f"{flown.name:20} {flown.steps:8d} steps {rate:6.0f} /s {memory}  {dict(flown.outcomes)}", flush=True)


if __name__ == "__main__":
    main()
