"""Single markers of motion capture: the balls, with what hides them, and what only looks like a ball."""

from __future__ import annotations

import math
from collections.abc import Iterator

import numpy as np

from companion.model.types import Vec3
from companion.sitl_config.world import World
from sitl.world.model import CATCH, PAYLOAD, SECOND, SECOND_CATCH
from sitl.world.payload import Ball
from sitl.world.scene import Scene
from sitl.world.views import vec3_of

_STREAM = 23
"""Second part of the seed of this effect's random numbers."""
_STRAY_BOX_M = (1.5, 1.5, 0.8)
"""Half of the size of the box around the vehicle in which reflections appear."""
_WAND_M, _WAND_RAD_S = 0.4, 2.0 * math.pi


class BallMarkers:
    """The markers of each frame that belong to no rigid body; call `frame` once per frame.

    Args:
        scene: the scene with the balls; its first machine has the net.
    """

    def __init__(self, config: World, scene: Scene) -> None:
        self._config, self._all = config.markers, config
        model, data = scene.model, scene.data
        self._net, self._base = (data.xpos[model.body(name).id] for name in ("net", "base"))
        names = {model.body(k).name for k in range(model.nbody)}
        balls = [Ball.of(model, *each) for each in ((PAYLOAD, CATCH), (SECOND, SECOND_CATCH)) if each[0] in names]
        self._at = [(data.qpos[ball.q : ball.q + 3], data.qvel[ball.v : ball.v + 3]) for ball in balls]
        self.restart(0.0)

    def restart(self, t_s: float) -> None:
        """Restart the random sequence at world time `t_s`."""
        self._rng = np.random.default_rng((self._all.seed, _STREAM))
        self._lost = [False] * len(self._at)
        self._changes_s = [t_s + self._after(self._tracked_s) for _ in self._at]
        self._strays: list[tuple[float, Vec3]] = []
        """End and place of each reflection that is seen."""
        self._stray_s = t_s + self._after(self._stray_every_s)

    @property
    def _tracked_s(self) -> float:
        share = self._config.lost_share
        return self._config.lost_burst_s * (1.0 - share) / share if share > 0.0 else math.inf

    @property
    def _stray_every_s(self) -> float:
        return 1.0 / self._config.stray_per_s if self._config.stray_per_s > 0.0 else math.inf

    def _after(self, mean_s: float) -> float:
        return float(self._rng.exponential(mean_s)) if math.isfinite(mean_s) else math.inf

    def _noisy(self, point: Vec3, sigma_m: float) -> Vec3:
        x, y, z = (p + sigma_m * n for p, n in zip(point, self._rng.standard_normal(3).tolist(), strict=True))
        return (x, y, z)

    def _balls(self, t_s: float, since_s: float) -> list[Vec3]:
        config, noise_m, found = self._config, self._all.mocap_noise_m, []
        if config.on:
            noise_m = math.hypot(noise_m, config.noise_m)
        for number, (at, velocity) in enumerate(self._at):
            x, y, z = (p - since_s * v for p, v in zip(vec3_of(at), vec3_of(velocity), strict=True))
            while t_s >= self._changes_s[number]:
                self._lost[number] = not self._lost[number]
                mean_s = config.lost_burst_s if self._lost[number] else self._tracked_s
                self._changes_s[number] += self._after(mean_s)
            seen = self._noisy((x, y, z), noise_m)
            hidden = config.on and (
                self._lost[number]
                or math.dist((x, y, z), vec3_of(self._net)) < config.hidden_near_m
                or math.dist((x, y, z), vec3_of(self._base)) < config.hidden_behind_m
            )
            if not hidden and math.hypot(x, y) <= config.range_m:
                found.append(seen)
        return found

    def frame(self, t_s: float, since_s: float, *, ball_is_body: bool) -> tuple[Vec3, ...]:
        """Return all single markers of a frame in a random order.

        Args:
            t_s: world time of the exposure.
            since_s: time since the exposure.
            ball_is_body: whether the payload is a rigid body: only this ball is then returned, if it is tracked.
        """
        found = self._balls(t_s, since_s)
        if ball_is_body:
            return tuple(found[:1])
        if self._config.on:
            found += [self._noisy(point, self._all.mocap_noise_m) for point in self._others(t_s)]
        return tuple(found[index] for index in self._rng.permutation(len(found)).tolist())

    def _others(self, t_s: float) -> Iterator[Vec3]:
        config = self._config
        yield from config.fixed_m
        if config.wand_at_m is not None:
            x, y, z = config.wand_at_m
            yield (x + _WAND_M * math.cos(_WAND_RAD_S * t_s), y, z + _WAND_M * math.sin(_WAND_RAD_S * t_s))
        while t_s >= self._stray_s:
            x, y, z = vec3_of(self._base)
            a, b, c = (half_m * u for half_m, u in zip(_STRAY_BOX_M, self._rng.uniform(-1, 1, 3).tolist(), strict=True))
            self._strays.append((self._stray_s + self._after(config.stray_s), (x + a, y + b, z + c)))
            self._stray_s += self._after(self._stray_every_s)
        self._strays = [stray for stray in self._strays if stray[0] > t_s]
        yield from (point for _, point in self._strays)
