"""Throws a payload that meets the net with the configured velocity, stays in the net and can be thrown again."""

from __future__ import annotations

import math
from typing import Final, NamedTuple

import mujoco
import numpy as np

from companion.config.vehicle import Vehicle
from companion.model.algebra import vec_mat
from companion.model.constants import GRAVITY_M_S2
from companion.model.types import Vec3
from companion.sitl_config.world import World as WorldConfig
from sitl.world.effects.net import Net
from sitl.world.effects.thrower import Thrower
from sitl.world.loads import ZERO, Bodies
from sitl.world.machine import Machine
from sitl.world.model import CATCH, PAYLOAD
from sitl.world.state import Events
from sitl.world.throws import PASSES_M_S, THROW_BESIDE_M
from sitl.world.views import mat3_of, vec3_of

_HOVERS_WITHIN_M: Final = 0.2
"""Largest distance from `catch_at_m` at which a payload is thrown to a hovering vehicle."""
_HOVERS_ABOVE_M: Final = 0.1
"""Smallest height of the landing gear above the floor at which a vehicle hovers."""
_NET_AT_REST_M: Final = 0.15
"""A net that stays this near to one place is at rest: the vehicle hovers, and the arm has unfolded."""
_PEOPLE = 29
"""Second part of the seed of the choice between the people."""
_AIR_DENSITY_KG_M3: Final = 1.2


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
        events: where throws and catches are reported.
    """

    def __init__(self, machine: Machine, bodies: Bodies, vehicle: Vehicle, config: WorldConfig, events: Events) -> None:
        self._machine, self._config, self._events = machine, config, events
        model, self._data = bodies.model, bodies.data
        self._model = model
        self._net = bodies.body("net")
        self._net_radius_m = vehicle.tip_radius_m
        self._thrower = Thrower.of(config.thrower, config.seed)
        self._people_rng = np.random.default_rng((config.seed, _PEOPLE))
        self._loads, self._high_m = bodies.loads, vehicle.airframe.ground_clearance_m + _HOVERS_ABOVE_M
        self._net_at, self._hoop_axes = self._data.xpos[self._net], self._data.xmat[bodies.body("sensor")]
        area_m2 = math.pi * config.payload_radius_m**2
        self._drag_n_s2_m2 = 0.5 * _AIR_DENSITY_KG_M3 * config.payload_drag_coefficient * area_m2
        self.bag = Net.of(config.net, bodies, self._net_radius_m, config.payload_radius_m) if vehicle.has_net else None
        """The bag of the net, or None if its effect is off or there is no net."""
        self.ball = Ball.of(model, PAYLOAD, CATCH) if vehicle.has_net and config.payload_kg > 0 else None
        """Indices of the payload; None if no payload is configured, or the vehicle has no net to throw it into."""
        self.aside_m = 0.0
        """Distance by which the throw misses the net."""
        self.thrown_t_s: float | None = None
        self.caught_t_s: float | None = None
        self.missed = False
        """Whether the first throw missed the net."""
        self._nearest_m, self._crossed_m = math.inf, math.inf
        """Smallest distances of the first throw from the net's centre: in space, and where it fell through the plane of the opening."""
        self._ahead_m = math.inf
        """Distance from the net's centre at which it will fall through that plane if it goes on as it does now."""
        self._before_m: Vec3 | None = None
        """The first throw in the hoop's frame one step ago; None before the throw, and once it has reached net or floor."""
        self._hovers_since: tuple[float, Vec3] | None = None
        """Since when the net has been at rest, and where; None while the vehicle is elsewhere."""
        self.throws = self.catches = 0
        """Number of throws and of catches so far."""
        self._flies_since_s: float | None = None
        """Time of the throw in flight, None without one; a throw that missed the net may still be caught."""
        self._kept_since_s: float | None = None
        """Time at which the payload in the net was caught; None if the net is empty."""
        self._missed = False
        """Whether the throw in flight has missed the net."""
        self._last_x = 0.0
        self._await_throw()

    def step(self, t_s: float, airborne: bool) -> None:
        """Throw, catch or remove the payload if that is due in this step.

        Args:
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
            if airborne and self._is_due(t_s):
                self._throw_payload(ball, t_s)
            return
        self._fly(ball)
        caught_s = self._caught_s(ball, t_s)
        if caught_s is not None:
            self.catches += 1
            if self.throws == 1:
                self.caught_t_s = caught_s
            if self._before_m is not None and self._crossed_m == math.inf:  # caught at the rim, above the plane
                self._crossed_m = self._ahead_m
            self._flies_since_s, self._kept_since_s, self._before_m = None, caught_s, None
            if self._drag_n_s2_m2 > 0.0:
                self._loads.set(ball.body, "air", ZERO)
            self._events.report(t_s, "caught")
        elif (
            not self._missed
            and t_s - self._flies_since_s > 2 * self._flight_s
            and not (self.bag is not None and self.bag.in_bag(ball.body))
        ):
            self._missed = True
            self.missed = self.missed or self.throws == 1
            self._events.report(t_s, "missed")
            if self.throws < self._config.throws:
                self._flies_since_s = None
                self._await_throw()

    def _is_due(self, t_s: float) -> bool:
        q, (at_x, at_y) = self._machine.q, self._config.catch_at_m
        if self._config.throw_to == "hovering":
            near = q[2] > self._high_m and math.hypot(q[0] - at_x, q[1] - at_y) <= _HOVERS_WITHIN_M
            net_m, since = vec3_of(self._net_at), self._hovers_since
            if not near or since is None or math.dist(net_m, since[1]) > _NET_AT_REST_M:
                self._hovers_since = (t_s, net_m) if near else None
                return False
            return t_s - since[0] >= self._config.throw_after_s
        vx, last_x = self._machine.v[0], self._last_x
        self._last_x = ahead = q[0] + vx * self._flight_s
        return vx > PASSES_M_S and last_x < at_x <= ahead and abs(q[1] - at_y) <= THROW_BESIDE_M

    def _fly(self, ball: Ball) -> None:
        """Let the air brake a payload in flight, and note how near the first throw comes to the net's centre."""
        d = self._data
        if self._drag_n_s2_m2 > 0.0:
            x, y, z = vec3_of(d.qvel[ball.v : ball.v + 3])
            k = -self._drag_n_s2_m2 * math.hypot(x, y, z)
            self._loads.set(ball.body, "air", (k * x, k * y, k * z))
        if self._before_m is None:
            return
        ax, ay, az = self._before_m
        x, y, z = self._in_hoop_m(ball)
        self._nearest_m = min(self._nearest_m, math.hypot(x, y, z))
        if az > 0.0 and az > z:
            share = az / (az - z)
            self._ahead_m = math.hypot(ax + share * (x - ax), ay + share * (y - ay))
            if z <= 0.0:
                self._crossed_m = min(self._crossed_m, self._ahead_m)
        on_floor = d.qpos[ball.q + 2] < 2.0 * self._config.payload_radius_m
        self._before_m = None if on_floor else (x, y, z)

    def _in_hoop_m(self, ball: Ball) -> Vec3:
        (nx, ny, nz), (bx, by, bz) = vec3_of(self._net_at), vec3_of(self._data.xpos[ball.body])
        return vec_mat((bx - nx, by - ny, bz - nz), mat3_of(self._hoop_axes))

    @property
    def flying(self) -> tuple[Vec3, float] | None:
        """Centre (world frame) and radius of the payload while it is neither in a hand nor caught, m; None otherwise."""
        if self.ball is None or self._flies_since_s is None:
            return None
        return vec3_of(self._data.xpos[self.ball.body]), self._config.payload_radius_m

    @property
    def miss_m(self) -> float | None:
        """Distance of the first throw from the net's centre where it fell through the plane of the opening before it reached the floor;
        if it never did, its smallest distance from the centre. None before the throw.
        """
        miss_m = self._nearest_m if self._crossed_m == math.inf else self._crossed_m
        return miss_m if miss_m < math.inf else None

    def _throw_payload(self, ball: Ball, t_s: float) -> None:
        if self.throws == 0:
            self.thrown_t_s = t_s
        self.throws += 1
        self._flies_since_s, self._missed = t_s, False
        self.throw(ball, self.aside_m)
        self._before_m = (0.0, 0.0, -math.inf) if self.throws == 1 else None
        self._events.report(t_s, "thrown")

    def _take_out(self, ball: Ball, t_s: float) -> None:
        d = self._data
        self.drop()
        self._kept_since_s = None
        d.qpos[ball.q : ball.q + 7] = self._model.qpos0[ball.q : ball.q + 7]
        d.qvel[ball.v : ball.v + 6] = 0.0
        self._await_throw()
        self._events.report(t_s, "taken")

    def _await_throw(self) -> None:
        """Choose who throws next, and delay the throw until the vehicle passes `catch_at_m` or hovers there again."""
        people = self._config.people
        self._person = people[int(self._people_rng.integers(len(people)))] if people else None
        self._flight_s = self._config.throw_flight_s if self._person is None else self._person.flight_s
        self._last_x, self._hovers_since = self._machine.q[0] + self._machine.v[0] * self._flight_s, None

    def throw(self, ball: Ball, aside_m: float = 0.0) -> None:
        """Launch a ball at a point `aside_m` to the left (world y) of the net, with the errors of the thrower."""
        d, thrower, flight_s = self._data, self._thrower, self._flight_s
        lead_s = flight_s if thrower is None else flight_s + thrower.prediction_error_s()
        if self._config.throw_to == "hovering":
            lead_s = 0.0
        target = d.xpos[self._net] + np.array(self._machine.v[0:3]) * lead_s + np.array([0.0, aside_m, 0.0])
        arrival = np.array(self._config.throw_velocity_m_s)
        gravity = np.array([0.0, 0.0, -GRAVITY_M_S2])
        velocity = arrival - gravity * flight_s
        point = target - velocity * flight_s - 0.5 * gravity * flight_s**2
        if self._person is not None:
            point, target = np.array(self._person.from_m), target + np.array(self._person.aims_m)
            mean = (target - point) / flight_s
            # A person allows for the drag: for its displacement at the mean velocity.
            drag_s_1 = self._drag_n_s2_m2 * float(np.linalg.norm(mean)) / self._config.payload_kg
            velocity = (1.0 + 0.5 * drag_s_1 * flight_s) * mean - 0.5 * gravity * flight_s
        q, v = ball.q, ball.v
        if thrower is None:
            d.qpos[q : q + 3], d.qvel[v : v + 3] = point, velocity
        else:
            d.qpos[q : q + 3], d.qvel[v : v + 3] = thrower.release(
                tuple(point.tolist()), tuple(velocity.tolist()), flight_s
            )
        d.qpos[q + 3 : q + 7] = (1, 0, 0, 0)
        d.qvel[v + 3 : v + 6] = 0.0
        if self.bag is not None:
            self.bag.watch(ball.body, ball.q, ball.v)

    def catch(self, ball: Ball, t_s: float) -> bool:
        """Return whether the ball is caught: with a bag, once it has settled in the bag; without, once it touches the net, to which
        this call attaches it.
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
