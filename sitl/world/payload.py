"""Throws a payload that meets the net with the configured velocity, stays in the net and can be thrown again."""

from __future__ import annotations

from typing import Final, NamedTuple

import mujoco
import numpy as np

from companion.config.vehicle import Vehicle
from companion.model.constants import GRAVITY_M_S2
from companion.sitl_config.world import World as WorldConfig
from sitl.world.effects.net import Net
from sitl.world.effects.thrower import Thrower
from sitl.world.loads import Bodies
from sitl.world.machine import Machine
from sitl.world.state import PAYLOAD_RADIUS_M, Events

THROW_LEAD_S: Final = 0.45
"""Time from the throw to the catch."""
_THROW_BESIDE_M: Final = 0.5
"""Largest lateral distance from `catch_at_m` at which a payload is thrown to a passing vehicle."""


class Ball(NamedTuple):
    """Indices of a ball: its body, its first elements in qpos and qvel, and the constraint that holds it in the net."""

    body: int
    q: int
    v: int
    catch: int

    @classmethod
    def of(cls, model: mujoco.MjModel, name: str, catch: str) -> Ball:
        """Return the indices of the ball with these names of body and constraint."""
        joint = model.joint(name).id
        return cls(
            model.body(name).id, int(model.jnt_qposadr[joint]), int(model.jnt_dofadr[joint]), model.equality(catch).id
        )


class Payload:
    """The payload and the net that catches it; call `step` once per physics step.

    Args:
        machine: the machine with the net.
        bodies: the model of the scene, as that machine sees it.
        vehicle: vehicle file of that machine.
        config: configuration of the world.
        events: where throws and catches are reported.
    """

    def __init__(self, machine: Machine, bodies: Bodies, vehicle: Vehicle, config: WorldConfig, events: Events) -> None:
        self._machine, self._config, self._events = machine, config, events
        model, self._data = bodies.model, bodies.data
        self._model = model
        self._net = bodies.body("net")
        self._net_radius_m = vehicle.tip_radius_m
        self._thrower = Thrower.of(config.thrower, config.seed)
        self.bag = Net.of(config.net, bodies, self._net_radius_m, PAYLOAD_RADIUS_M) if vehicle.has_net else None
        """The bag of the net, or None if its effect is off or there is no net."""
        self.ball = Ball.of(model, "payload", "catch") if vehicle.has_net and config.payload_kg > 0 else None
        """Indices of the payload; None if no payload is configured, or the vehicle has no net to throw it into."""
        self.aside_m = 0.0
        """Distance by which the throw misses the net."""
        self.thrown_t_s: float | None = None
        self.caught_t_s: float | None = None
        self.missed = False
        """Whether the first throw missed the net."""
        self.throws = self.catches = 0
        """Number of throws and of catches so far."""
        self._flies_since_s: float | None = None
        """Time of the throw in flight, None without one; a throw that missed the net may still be caught."""
        self._kept_since_s: float | None = None
        """Time at which the payload in the net was caught; None if the net is empty."""
        self._missed = False
        """Whether the throw in flight has missed the net."""
        self._last_x = 0.0
        self.await_pass()

    def step(self, t_s: float, airborne: bool) -> None:
        """Throw, catch or remove the payload if that is due in this step.

        Args:
            t_s: world time.
            airborne: whether a payload may be thrown.
        """
        ball, kept_since_s = self.ball, self._kept_since_s
        if ball is None or (kept_since_s is not None and self.throws == self._config.throws):
            return
        if kept_since_s is not None:
            if t_s - kept_since_s >= self._config.keep_s:
                self._take_out(ball, t_s)
            return
        if self._flies_since_s is None:
            q, vx = self._machine.q, self._machine.v[0]
            ahead = q[0] + vx * THROW_LEAD_S
            at_x, at_y = self._config.catch_at_m
            if airborne and vx > 0.05 and self._last_x < at_x <= ahead and abs(q[1] - at_y) <= _THROW_BESIDE_M:
                self._throw_payload(ball, t_s)
            self._last_x = ahead
            return
        caught_s = self._caught_s(ball, t_s)
        if caught_s is not None:
            self.catches += 1
            if self.throws == 1:
                self.caught_t_s = caught_s
            self._flies_since_s, self._kept_since_s = None, caught_s
            self._events.report(t_s, "caught")
        elif (
            not self._missed
            and t_s - self._flies_since_s > 2 * THROW_LEAD_S
            and not (self.bag is not None and self.bag.in_bag(ball.body))
        ):
            self._missed = True
            self.missed = self.missed or self.throws == 1
            self._events.report(t_s, "missed")
            if self.throws < self._config.throws:
                self._flies_since_s = None
                self.await_pass()

    def _throw_payload(self, ball: Ball, t_s: float) -> None:
        if self.throws == 0:
            self.thrown_t_s = t_s
        self.throws += 1
        self._flies_since_s, self._missed = t_s, False
        self.throw(ball, self.aside_m)
        self._events.report(t_s, "thrown")

    def _take_out(self, ball: Ball, t_s: float) -> None:
        """Take the payload out of the net, so that it can be thrown again."""
        d = self._data
        self.drop()
        self._kept_since_s = None
        d.qpos[ball.q : ball.q + 7] = self._model.qpos0[ball.q : ball.q + 7]
        d.qvel[ball.v : ball.v + 6] = 0.0
        self.await_pass()
        self._events.report(t_s, "taken")

    def await_pass(self) -> None:
        """Delay the next throw until the vehicle passes `catch_at_m` again."""
        self._last_x = self._machine.q[0] + self._machine.v[0] * THROW_LEAD_S

    def throw(self, ball: Ball, aside_m: float = 0.0) -> None:
        """Launch a ball at a point `aside_m` to the left (world y) of the net, with the errors of the thrower."""
        d, thrower = self._data, self._thrower
        lead_s = THROW_LEAD_S if thrower is None else THROW_LEAD_S + thrower.prediction_error_s()
        target = d.xpos[self._net] + np.array(self._machine.v[0:3]) * lead_s + np.array([0.0, aside_m, 0.0])
        arrival = np.array(self._config.throw_velocity_m_s)
        gravity = np.array([0.0, 0.0, -GRAVITY_M_S2])
        velocity = arrival - gravity * THROW_LEAD_S
        point = target - velocity * THROW_LEAD_S - 0.5 * gravity * THROW_LEAD_S**2
        q, v = ball.q, ball.v
        if thrower is None:
            d.qpos[q : q + 3], d.qvel[v : v + 3] = point, velocity
        else:
            d.qpos[q : q + 3], d.qvel[v : v + 3] = thrower.release(
                tuple(point.tolist()), tuple(velocity.tolist()), THROW_LEAD_S
            )
        d.qpos[q + 3 : q + 7] = (1, 0, 0, 0)
        d.qvel[v + 3 : v + 6] = 0.0
        if self.bag is not None:
            self.bag.watch(ball.body, ball.q, ball.v)

    def catch(self, ball: Ball, t_s: float) -> bool:
        """Return whether the ball is caught: with a bag, once it has settled in the bag; without, once it touches the net, to which
        this call attaches it.

        Args:
            ball: indices of the ball.
            t_s: world time.
        """
        return self._caught_s(ball, t_s) is not None

    def _caught_s(self, ball: Ball, t_s: float) -> float | None:
        """Return the time of the catch if the ball is caught; otherwise None."""
        if self.bag is not None:
            return self.bag.caught_s(ball.body, t_s)
        return t_s if self._attach(ball) else None

    def _attach(self, ball: Ball) -> bool:
        """Attach the ball to the net if it touches the net; return whether it does."""
        d = self._data
        gap = d.xpos[ball.body] - d.xpos[self._net]
        if float(gap @ gap) > self._net_radius_m**2:
            return False
        rotation = d.xmat[self._net].reshape(3, 3)
        self._model.eq_data[ball.catch, 0:3] = rotation.T @ gap
        self._model.eq_data[ball.catch, 3:6] = 0.0
        d.eq_active[ball.catch] = 1
        return True

    def drop(self) -> None:
        """Let the payload fall out of the net, if it is there."""
        if self.ball is not None and self._kept_since_s is not None:
            self._data.eq_active[self.ball.catch] = 0
            if self.bag is not None:
                self.bag.let_go(self.ball.body)
