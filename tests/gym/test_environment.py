"""The environments: what Gymnasium demands, the cost as the reward, and the flights of the base law."""

from __future__ import annotations

import math
import os
import subprocess
import sys
from typing import Any

import gymnasium
import numpy as np
import pytest
from gymnasium.utils.env_checker import check_env

import sitl.gym  # noqa: F401  # registers the environments
from companion.campaigns.cost import flight_cost
from companion.model.types import Outcome
from companion.sitl_config.loader import load_sitl
from sitl.fast.loop import FastFlight
from sitl.gym.environment import FlightEnvironment
from tests.support import SHORT_CATCH

pytestmark = pytest.mark.usefixtures("short_start")  # every reset flies it


def made(name: str, **settings: Any) -> FlightEnvironment:
    environment = gymnasium.make(name, **settings).unwrapped
    assert isinstance(environment, FlightEnvironment)
    return environment


def test_the_environment_keeps_the_rules_of_gymnasium() -> None:
    check_env(made("companion/Hover-v0", world="ideal"), skip_render_check=True)


@pytest.mark.parametrize("name", ["Catch", "Press", "Intercept"])
def test_a_step_of_every_environment_passes_the_checks_of_gymnasium(name: str) -> None:
    """With Gymnasium's own checks of every call."""
    environment = gymnasium.make(f"companion/{name}-v0")
    environment.reset(seed=1)
    assert environment.step(environment.action_space.sample())[2:4] == (False, False)


def test_without_an_action_the_base_law_flies_and_the_rewards_are_its_cost() -> None:
    environment = made("companion/Catch-v0", mission=str(SHORT_CATCH))
    environment.reset(options={"laboratory": 3})
    still, rewards, over = np.zeros(5, np.float32), [], False
    while not over:
        _, reward, over, _, info = environment.step(still)
        rewards.append(reward)
    assert math.isclose(-sum(rewards), info["cost"], rel_tol=1e-9)
    assert info["cost"] == flight_cost(info["row"]) < 0.5
    assert max(map(abs, rewards)) > 1e-4
    flown = FastFlight(load_sitl(SHORT_CATCH, world="lab", overrides=["world.seed=3"])).run()
    assert [o.arm_torque_nm for o in environment._result.outputs] == [o.arm_torque_nm for o in flown.outputs]
    assert [o.attitude for o in environment._result.outputs] == [o.attitude for o in flown.outputs]


def test_a_random_wrench_meets_the_supervisor_and_costs_more_than_any_completed_flight() -> None:
    environment = made("companion/Hover-v0", action="wrench", mission=str(SHORT_CATCH))
    environment.reset(seed=1)
    generator, over = np.random.default_rng(1), False
    while not over:
        _, _, over, _, info = environment.step(generator.uniform(-1.0, 1.0, 5).astype(np.float32))
    assert info["row"]["outcome"] != Outcome.COMPLETED.value
    assert info["cost"] >= 1.0


def test_an_action_that_is_not_finite_is_not_sent_and_the_vehicle_lands() -> None:
    environment = made("companion/Hover-v0")
    environment.reset(seed=1)
    for _ in range(50):
        environment.step(np.zeros(5, np.float32))
    _, _, over, _, info = environment.step(np.full(5, np.nan, np.float32))
    last = environment._result.outputs[-1]
    assert (last.attitude, last.arm_torque_nm) == (None, None)
    while not over:
        _, _, over, _, info = environment.step(np.zeros(5, np.float32))
    assert info["row"]["outcome"] == Outcome.ABORTED.value


def test_environments_fly_in_several_processes_each_in_a_laboratory_of_its_own() -> None:
    environments = gymnasium.make_vec("companion/Hover-v0", num_envs=2, vectorization_mode="async")
    try:
        observations, info = environments.reset(seed=1)
        assert len(set(info["laboratory"])) == 2
        assert (observations[0] != observations[1]).any()
        assert environments.step(environments.action_space.sample())[0].shape == (2, 32)
    finally:
        environments.close()


PICTURE = """
try:
    import mujoco
    mujoco.Renderer(mujoco.MjModel.from_xml_string("<mujoco/>")).close()
except Exception:  # of the loader, of PyOpenGL or of MuJoCo, which have no common class
    raise SystemExit(77)
import gymnasium, sitl.gym
environment = gymnasium.make("companion/Hover-v0", render_mode="rgb_array")
environment.reset(seed=1)
picture = environment.render()
environment.close()
print(picture.shape, picture.std() > 5.0)
"""


def test_the_environment_draws_a_picture_without_a_screen() -> None:
    done = subprocess.run(
        [sys.executable, "-c", PICTURE], env={**os.environ, "MUJOCO_GL": "egl"}, capture_output=True, text=True
    )
    if done.returncode == 77:
        pytest.skip("no EGL here")
    assert done.stdout == "(240, 320, 3) True\n", done.stderr
