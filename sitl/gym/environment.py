"""The environment: one flight in the fast loop, whose control law adds the agent's action to a base law."""

from __future__ import annotations

import math
from collections.abc import Iterator, Sequence
from typing import Any

import gymnasium
import mujoco
import numpy as np
import numpy.typing as npt

from companion.campaigns.cost import TERMS, flight_cost
from companion.config.controller import ControllerConfig
from companion.config.policy import PolicyAction, PolicyCard
from companion.config.vehicle import Vehicle
from companion.control.policy import SteeredLaw, action_names, observation_bounds
from companion.control.types import Law
from companion.model.constants import TICK_PERIOD_S
from companion.model.outputs import Outputs
from companion.sitl_config.loader import load_sitl
from sitl.campaigns.flights import Flown, with_world
from sitl.campaigns.tune import graded
from sitl.fast.loop import FastFlight
from sitl.fast.result import FastResult
from sitl.gym.picture import picture

Vector = npt.NDArray[np.float32]
RESIDUAL_N, RESIDUAL_NM = (3.0, 3.0, 4.0), 0.5
"""Default force of an action of 1 on x, y and z, and joint torque, if the action is a residual."""
WRENCH_N = (12.0, 12.0, 15.0)
"""The same if it is the whole wrench; the torque is the joint's limit."""
_WEIGHTS = {term.key: term.weight for term in TERMS}
_RMS_WEIGHT = _WEIGHTS["rms.pre.e_p_m"] + _WEIGHTS["rms.post.e_p_m"]
_PEAK_WEIGHT = _WEIGHTS["peak_e_p_m"]


class FlightEnvironment(gymnasium.Env[Vector, Vector]):
    """One flight of a mission. The action acts once the rotors carry the vehicle, through governor, gate and supervisor.

    The observation is that of `companion.control.policy.observation_bounds`, in its units. The action, -1 to 1 for each element of
    `action_names`, is multiplied by `action_scale` and held for `period_ticks` ticks of 5 ms. The rewards of an episode add up to the
    negative cost of `companion tune`: during the flight, each is the decrease of its terms of the position error, as the law sees them;
    the last one is the rest. An episode terminates when the flight ends, however it ends.

    Args:
        mission, vehicle, controller, preset, overrides, world: as for `companion.sitl_config.loader.load_sitl`; the controller is the
            base law.
        action: whether the action is added to the base law's wrench, or replaces it, the force without the weight.
        period_ticks: number of ticks for which an action is held.
        action_scale: force, N, and joint torques, N m, of an action of 1; None for the default.
        render_mode: "rgb_array" or None.

    Raises:
        ConfigError, PluginError: the configuration is invalid.
    """

    metadata = {"render_modes": ["rgb_array"], "render_fps": 50}  # noqa: RUF012  # as in the base class

    def __init__(
        self,
        mission: str,
        world: str = "lab",
        vehicle: str | None = None,
        controller: str | None = None,
        preset: str | None = None,
        overrides: Sequence[str] = (),
        action: PolicyAction = "residual",
        period_ticks: int = 4,
        action_scale: Sequence[float] | None = None,
        render_mode: str | None = None,
    ) -> None:
        self.render_mode = render_mode
        self._config = load_sitl(mission, vehicle, controller, preset, overrides, world=world)
        machine = self._config.vehicle
        joints = machine.arm.joints
        bounds = observation_bounds(len(joints))
        if action_scale is None and action == "residual":
            action_scale = (*RESIDUAL_N, *(RESIDUAL_NM for _ in joints))
        elif action_scale is None:
            action_scale = (*WRENCH_N, *machine.joint_torque_limits_nm)
        self.card = PolicyCard(
            vehicle=machine.name,
            mass_kg=machine.airframe.mass_kg,
            action=action,
            base=self._config.controller,
            period_ticks=period_ticks,
            observations=tuple(bounds),
            observation_offset=(0.0,) * len(bounds),
            observation_scale=(1.0,) * len(bounds),
            actions=action_names(len(joints)),
            action_scale=tuple(action_scale),
        )
        """What the file of a policy trained here states (`sitl.gym.export`)."""
        self.metadata = {**self.metadata, "render_fps": round(1.0 / (period_ticks * TICK_PERIOD_S))}
        high = np.array(list(bounds.values()), np.float32)
        self.observation_space = gymnasium.spaces.Box(-high, high, dtype=np.float32)
        self.action_space = gymnasium.spaces.Box(-1.0, 1.0, (len(action_scale),), np.float32)
        self._renderer: mujoco.Renderer | None = None

    def reset(self, *, seed: int | None = None, options: dict[str, Any] | None = None) -> tuple[Vector, dict[str, Any]]:
        """Begin a flight in another laboratory and fly to the first observation; its number is in `info["laboratory"]`.

        Args:
            seed: seed of the series of laboratories.
            options: {"laboratory": N} for the laboratory of `--seed N`.
        """
        super().reset(seed=seed)
        self.close()
        drawn = int(self.np_random.integers(1_000_000_000))
        laboratory = int((options or {}).get("laboratory", drawn))
        self._flight = FastFlight(with_world(self._config, {"seed": laboratory}), make_law=self._make_law)
        self._result = FastResult()
        self._ticks: Iterator[Outputs] = self._flight.ticks(self._result)
        self._squares_m2, self._count, self._peak_m, self._cost_m = 0.0, 0, 0.0, 0.0
        self._observation = np.zeros(len(self.card.observations), np.float32)
        self._advance()
        return self._observation, {"laboratory": laboratory}

    def step(self, action: Vector) -> tuple[Vector, float, bool, bool, dict[str, Any]]:
        """Fly with an action up to the next observation, or to the end of the flight, whose `info` has `cost` and the `row` graded."""
        self._law.set_action(action.tolist())
        flies = self._advance()
        info: dict[str, Any] = {}
        cost_m = _RMS_WEIGHT * math.sqrt(self._squares_m2 / max(1, self._count)) + _PEAK_WEIGHT * self._peak_m
        if not flies:
            row = graded(Flown(self._flight.config, self._flight, self._result, None), cut=False)
            cost_m = flight_cost(row)
            info = {"cost": cost_m, "row": row}
        reward, self._cost_m = self._cost_m - cost_m, cost_m
        return self._observation, reward, not flies, False, info

    def render(self) -> Any:
        """Return a picture of the vehicle by MuJoCo's renderer (MUJOCO_GL=egl without a screen), or None without a render mode."""
        if self.render_mode is None:
            return None
        scene = self._flight.plant.scene
        if self._renderer is None:
            self._renderer = mujoco.Renderer(scene.model, 240, 320)
        return picture(self._renderer, scene.model, scene.data)

    def close(self) -> None:
        """Release the renderer."""
        if self._renderer is not None:
            self._renderer.close()
            self._renderer = None

    def _make_law(self, _: ControllerConfig, vehicle: Vehicle, hover_thrust: float) -> Law:
        self._law = SteeredLaw(self.card, vehicle, hover_thrust, self._decide)
        return self._law

    def _decide(self, observation: Sequence[float]) -> Sequence[float]:
        self._observation, self._decides = np.array(observation, np.float32), True
        return (0.0,) * len(self.card.actions)

    def _advance(self) -> bool:
        """Fly to the next observation; return False if the flight has ended before it."""
        self._decides = False
        for outputs in self._ticks:
            if outputs.control is not None:
                x, y, z, *_ = outputs.control.error
                square_m2 = x * x + y * y + z * z
                self._squares_m2, self._count = self._squares_m2 + square_m2, self._count + 1
                self._peak_m = max(self._peak_m, math.sqrt(square_m2))
            if self._decides:
                return True
        return False
