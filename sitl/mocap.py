"""Motion capture of the simulated world: exposes one machine, with errors and noise, and holds each frame until it has arrived."""

from __future__ import annotations

import math
from collections import deque
from typing import NamedTuple

from companion.config.devices import TrackedBall
from companion.model.frames import quat_from_euler_zyx, quat_multiply, quat_normalize
from companion.model.types import Quat, Vec3
from companion.sitl_config.world import World as WorldConfig
from sitl.faults.injector import Faults
from sitl.world.ball_markers import BallMarkers
from sitl.world.effects.mocap import MocapErrors
from sitl.world.machine import Machine
from sitl.world.mocap_misalignment import MocapMisalignment
from sitl.world.noise import noise
from sitl.world.scene import Scene

_STREAM, _BAR_STREAM = 0, 12
"""Second part of the seed of the noise of the machine's and the bar's pose."""


class MocapFrame(NamedTuple):
    """One motion-capture frame, which the server sends `mocap_latency_s` after its exposure."""

    number: int
    exposure_t_s: float
    position_world_m: Vec3
    attitude_wxyz: Quat
    valid: bool
    network_s: float
    """Time for which the network holds the frame after its transmission."""
    markers: tuple[Vec3, ...] = ()
    """Markers that belong to no rigid body, in any order; if the ball is a rigid body, that body alone while it is tracked."""
    bar: tuple[Vec3, Quat] | None = None
    """Pose of the bar that two vehicles carry; None without one."""


class Mocap:
    """Motion capture of one machine.

    Args:
        ball: how the thrown ball is seen; None if no marker is streamed.
        between_steps: whether exposures are at the exact time between physics steps instead of at the end of a step.
    """

    def __init__(
        self, config: WorldConfig, ball: TrackedBall | None, scene: Scene, machine: Machine, *, between_steps: bool
    ) -> None:
        self._config, self._scene, self._machine, self._between_steps = config, scene, machine, between_steps
        self._errors = MocapErrors(config.mocap, config.seed) if config.mocap.on else None
        self._misalignment = MocapMisalignment.of(config)
        self._ball_is_body = ball is not None and ball.kind == "body"
        self._markers = None if ball is None else BallMarkers(config, scene)
        self._noise_rad = math.radians(config.mocap_noise_deg)
        self._seed_noise()
        self.faults: Faults | None = None
        self._queue: deque[tuple[float, MocapFrame]] = deque()
        """Frames on their way, each with the world time at which it arrives."""
        self._next_s = 0.0
        self._number = 0
        self._arrives_s = 0.0
        """World time at which the newest frame arrives."""

    def _seed_noise(self) -> None:
        seed = self._config.seed
        self._noise, self._bar_noise = noise(seed, _STREAM), noise(seed, _BAR_STREAM)

    def restart(self, t_s: float) -> None:
        """Restart the noise and the random sequences of the errors at world time `t_s`."""
        self._seed_noise()
        if self._errors is not None:
            self._errors.restart(t_s)
        if self._markers is not None:
            self._markers.restart(t_s)

    def sense(self) -> None:
        """Expose a frame after a step of the scene, if one is due."""
        t_s = self._scene.t_s
        if t_s >= self._next_s - 1e-9:
            self._expose(min(t_s, self._next_s) if self._between_steps else t_s)

    def _expose(self, t_s: float) -> None:
        config, machine = self._config, self._machine
        faults, period_s, latency_s, valid = self.faults, 1.0 / config.mocap_rate_hz, config.mocap_latency_s, True
        if faults is not None:
            period_s = faults.mocap_period_s(period_s)
            latency_s += faults.size("mocap_latency")
        self._next_s += period_s
        self._number += 1
        x, y, z, qw, qx, qy, qz = machine.q[0:7]
        since_s = self._scene.t_s - t_s
        if since_s > 0.0:  # at most a step
            vx, vy, vz, wx, wy, wz = machine.v[0:6]
            x, y, z = x - since_s * vx, y - since_s * vy, z - since_s * vz
            back = (1.0, -0.5 * since_s * wx, -0.5 * since_s * wy, -0.5 * since_s * wz)
            qw, qx, qy, qz = quat_normalize(quat_multiply((qw, qx, qy, qz), back))
        if self._errors is not None:
            (x, y, z), (qw, qx, qy, qz), valid = self._errors.pose(t_s, (x, y, z), (qw, qx, qy, qz))
        noise_m, noise_rad = config.mocap_noise_m, self._noise_rad
        nx, ny, nz = next(self._noise)
        roll, pitch, yaw = next(self._noise)
        turned = quat_from_euler_zyx(noise_rad * roll, noise_rad * pitch, noise_rad * yaw)
        position: Vec3 = (x + noise_m * nx, y + noise_m * ny, z + noise_m * nz)
        attitude = quat_multiply((qw, qx, qy, qz), turned)
        if faults is not None:
            position, attitude, visible = faults.pose(position, attitude)
            valid = valid and visible
        if self._misalignment is not None:
            position, attitude = self._misalignment.pose(position, attitude)
        sent_s = t_s + latency_s
        if self._errors is not None:
            sent_s = self._errors.sent_s(sent_s)
        arrives_s = sent_s
        if faults is not None:  # the network keeps their order
            arrives_s = self._arrives_s = max(sent_s + faults.size("mocap_network"), self._arrives_s)
        markers: tuple[Vec3, ...] = ()
        if self._markers is not None:
            markers = self._markers.frame(t_s, since_s, ball_is_body=self._ball_is_body)
            if self._misalignment is not None:
                markers = tuple([self._misalignment.position(marker) for marker in markers])
        bar = None if self._scene.bar is None else self._scene.bar.streamed(noise_m, next(self._bar_noise))
        frame = MocapFrame(self._number, t_s, position, attitude, valid, arrives_s - sent_s, markers, bar)
        self._queue.append((arrives_s, frame))

    def take(self) -> list[MocapFrame]:
        """Return and remove the frames that have arrived by now."""
        return [frame for _, frame in self.take_until(self._scene.t_s)]

    def take_until(self, until_s: float) -> list[tuple[float, MocapFrame]]:
        """Return and remove the frames that arrive until world time `until_s`, each with its time of arrival."""
        queue, until_s = self._queue, until_s + 1e-9
        if not queue or queue[0][0] > until_s:
            return []
        frames = []
        while queue and queue[0][0] <= until_s:
            frames.append(queue.popleft())
        return [] if self._is_lost() else frames

    def take_exposed_at(self, exposure_t_s: float) -> MocapFrame | None:
        """Return and remove the frame that was exposed at this time, and remove older ones; None while motion capture is lost."""
        queue, found = self._queue, None
        while queue and queue[0][1].exposure_t_s <= exposure_t_s + 1e-9:
            found = queue.popleft()[1]
        return None if self._is_lost() else found

    def _is_lost(self) -> bool:
        return self.faults is not None and "mocap_loss" in self.faults.active
