"""Contact of a thrown payload with the net: a hoop with a bag of elastic mesh.

The hoop lies in the x-y plane of link 2, centred on the net, and opens towards +z, which points up in the catch pose. The mesh is a
membrane in the hoop that is slack up to the bag's depth. A payload that crosses the hoop's plane inside the hoop from above is in the
bag; one that crosses it from below lifts the mesh and falls back. The taut mesh acts as a unilateral spring between the payload and a
point in the plane, the pocket, about which the payload swings. The spring has full stiffness while it is being stretched and
restitution^2 times that stiffness while it relaxes, which returns the payload with `restitution` times its speed, whatever its mass
(Walton and Braun 1986, J. Rheology 30: 949). The hoop is a ring with the same contact law.
"""

from __future__ import annotations

import math
from typing import Any, Final

import mujoco

from companion.model.constants import GRAVITY_M_S2
from companion.model.types import Vec3
from companion.sitl_config.effects.net import Net as NetConfig
from sitl.world.loads import ZERO, Bodies
from sitl.world.views import mat3_of, vec3_of

RIM_STIFFNESS_N_M = 3000.0
SETTLED_S: Final = 0.4
"""Time in the bag after which a payload counts as caught; a payload that bounces out leaves the bag within 0.2 s."""
_TURN_M_S = 0.1
"""Speed range over which the stiffness changes between its stretching and relaxing values; the transition damps a payload at rest."""
_NEAR_M2 = 1.0
"""Square of the largest distance from the vehicle's origin at which contact is computed; the arm with the bag reaches 0.65 m."""


class Bag:
    """Contact of one payload with the hoop and its mesh, in the hoop's frame (m, m/s, N)."""

    def __init__(self, config: NetConfig, hoop_radius_m: float, payload_radius_m: float) -> None:
        self._hoop_m, self._payload_m = hoop_radius_m, payload_radius_m
        self._depth_m, self._stiffness_n_m, self._pocket = config.bag_depth_m, config.bag_stiffness_n_m, config.pocket
        returned = config.restitution**2
        self._mean, self._half = 0.5 * (1.0 + returned), 0.5 * (1.0 - returned)
        # Friction divided by normal force and speed; at rest, with the weight as normal force, it gives the damping
        # ratio.
        self._friction_s_m = 2.0 * config.swing_damping_ratio / math.sqrt(GRAVITY_M_S2 * config.bag_depth_m)
        self.side = 0
        """1 if the payload is in the bag, -1 if it lifts the mesh from below, 0 if it is outside."""
        self.pivot_m = (0.0, 0.0)
        """x and y of the point about which the payload swings."""
        self.entered_s: float | None = None
        self.touched_s: float | None = None
        """Time of the first contact with hoop or mesh since the throw or the last bounce out of the bag; None before it."""
        self.bounced = False
        """Whether the payload touched the mesh and has just left the bag without being caught."""
        self._above = True

    def caught_s(self, t_s: float) -> float | None:
        """Return the time of the first contact if the payload is caught; otherwise None."""
        if self.entered_s is None or t_s - self.entered_s < SETTLED_S:
            return None
        return self.touched_s

    def force_n(self, position: Vec3, velocity: Vec3, t_s: float) -> Vec3 | None:
        """Return the force on the payload, or None without contact.

        Args:
            position: position of the payload's centre relative to the centre of the hoop.
            velocity: velocity of the payload's centre relative to the point of the net's frame that coincides with it.
        """
        x, y, z = position
        vx, vy, vz = velocity
        above = z > 0.0
        if above is not self._above:
            if self.side == 0 and abs(z) > self._hoop_m:
                self._above = above  # it crossed the plane before it came near
            else:
                self._cross(x, y, above, t_s)
        elif self.bounced:
            self.bounced = False
        fx = fy = fz = 0.0
        if self.side != 0:
            dx, dy = x - self.pivot_m[0], y - self.pivot_m[1]
            distance = math.sqrt(dx * dx + dy * dy + z * z)
            if distance > self._depth_m:
                nx, ny, nz = -dx / distance, -dy / distance, -z / distance
                fx, fy, fz = self._pressed(self._stiffness_n_m, distance - self._depth_m, nx, ny, nz, vx, vy, vz)
        if -self._payload_m < z < self._payload_m:
            rx, ry, rz = self._rim_n(position, velocity)
            fx, fy, fz = fx + rx, fy + ry, fz + rz
        if fx == fy == fz == 0.0:
            return None
        if self.touched_s is None:
            self.touched_s = t_s
        return (fx, fy, fz)

    def _rim_n(self, position: Vec3, velocity: Vec3) -> Vec3:
        x, y, z = position
        radial = math.hypot(x, y)
        to_wire = math.hypot(radial - self._hoop_m, z)
        if not 0.0 < to_wire < self._payload_m or radial == 0.0:
            return ZERO
        out = (radial - self._hoop_m) / (to_wire * radial)
        return self._pressed(RIM_STIFFNESS_N_M, self._payload_m - to_wire, out * x, out * y, z / to_wire, *velocity)

    def _cross(self, x: float, y: float, above: bool, t_s: float) -> None:
        if x * x + y * y >= self._hoop_m * self._hoop_m:
            if self.side == 0:  # next to the hoop; in the mesh it would still be held
                self._above = above
            return
        self._above = above
        if self.side == 0:
            self.side = -1 if above else 1
            self.pivot_m = (self._pocket * x, self._pocket * y)
            self.entered_s = None if above else t_s
        else:
            self.bounced = self.side > 0 and self.touched_s is not None and self.caught_s(t_s) is None
            self.side, self.entered_s, self.touched_s = 0, None, None

    def _pressed(
        self, stiffness: float, depth: float, nx: float, ny: float, nz: float, vx: float, vy: float, vz: float
    ) -> Vec3:
        """Return the force, including friction, of a surface with unit normal n that the payload has pressed in by `depth`."""
        along = vx * nx + vy * ny + vz * nz
        stretching = -along / _TURN_M_S
        stretching = 1.0 if stretching > 1.0 else -1.0 if stretching < -1.0 else stretching
        normal = stiffness * depth * (self._mean + self._half * stretching)
        slip = normal * self._friction_s_m
        push = normal + slip * along
        return (push * nx - slip * vx, push * ny - slip * vy, push * nz - slip * vz)


class Net:
    """The net of one vehicle."""

    def __init__(
        self,
        config: NetConfig,
        bodies: Bodies,
        hoop_radius_m: float,
        payload_radius_m: float,
    ) -> None:
        self._config, self._radii_m = config, (hoop_radius_m, payload_radius_m)
        self._model, data, self._loads, _ = bodies
        self._data = data
        base, link, self._net = (bodies.body(name) for name in ("base", "sensor", "net"))
        self._centre, self._axes = data.xpos[self._net], data.xmat[link]
        self._turning, self._velocity = data.cvel[self._net][:3], data.cvel[self._net][3:]
        self._com, self._net_com = data.subtree_com[base], data.xipos[self._net]
        self._bags: dict[int, tuple[Bag, Any, Any]] = {}
        self._touching: set[int] = set()

    @classmethod
    def of(
        cls,
        config: NetConfig,
        bodies: Bodies,
        hoop_radius_m: float,
        payload_radius_m: float,
    ) -> Net | None:
        """Return the net, or None if the effect is off."""
        return cls(config, bodies, hoop_radius_m, payload_radius_m) if config.on else None

    def watch(self, body: int, q: int, v: int) -> None:
        """Let the net act on a thrown payload, given its body index and its first indices in qpos and qvel."""
        self.let_go(body)
        d = self._data
        self._bags[body] = (Bag(self._config, *self._radii_m), d.qpos[q : q + 3], d.qvel[v : v + 3])

    def let_go(self, body: int) -> None:
        """Stop the net's action on a payload."""
        self._bags.pop(body, None)
        self._release(body)

    def caught_s(self, body: int, t_s: float) -> float | None:
        """Return the time of the first contact if the payload is caught; otherwise None."""
        bag = self._bags.get(body)
        return None if bag is None else bag[0].caught_s(t_s)

    def in_bag(self, body: int) -> bool:
        """Return whether the payload is in the bag, settled or not."""
        return body in self._bags and self._bags[body][0].side > 0

    def step(self, q: list[float], t_s: float) -> bool:
        """Advance MuJoCo by one step with all loads applied; return whether a payload bounces out of the bag.

        Args:
            q: qpos of the vehicle before the step.
            t_s: world time before the step.
        """
        near = [
            (body, bag, vec3_of(at), vec3_of(velocity))
            for body, (bag, at, velocity) in self._bags.items()
            if _is_near(q, vec3_of(at))
        ]
        if not near:
            self._loads.write()
            mujoco.mj_step(self._model, self._data)
            return False
        # The first half brings the net's pose and velocity up to date: forces of the previous step would add energy.
        mujoco.mj_step1(self._model, self._data)
        for body, bag, position_m, velocity_m_s in near:
            self._press(body, bag, position_m, velocity_m_s, t_s)
        self._loads.write()
        mujoco.mj_step2(self._model, self._data)
        return any(bag.bounced for _, bag, _, _ in near)

    def _press(self, body: int, bag: Bag, position_m: Vec3, velocity_m_s: Vec3, t_s: float) -> None:
        """Apply the contact force to the payload at this position and velocity (world frame), and the opposite force to the net."""
        px, py, pz = position_m
        vx, vy, vz = velocity_m_s
        cx, cy, cz = vec3_of(self._centre)
        (xx, yx, zx), (xy, yy, zy), (xz, yz, zz) = mat3_of(self._axes)
        (wx, wy, wz), (ux, uy, uz) = vec3_of(self._turning), vec3_of(self._velocity)
        ox, oy, oz = vec3_of(self._com)
        gx, gy, gz = px - cx, py - cy, pz - cz
        # MuJoCo gives the net's velocity at the vehicle's centre of mass.
        lx, ly, lz = px - ox, py - oy, pz - oz
        ux = vx - ux - wy * lz + wz * ly
        uy = vy - uy - wz * lx + wx * lz
        uz = vz - uz - wx * ly + wy * lx
        force = bag.force_n(
            (xx * gx + xy * gy + xz * gz, yx * gx + yy * gy + yz * gz, zx * gx + zy * gy + zz * gz),
            (xx * ux + xy * uy + xz * uz, yx * ux + yy * uy + yz * uz, zx * ux + zy * uy + zz * uz),
            t_s,
        )
        if force is None:
            self._release(body)
            return
        a, b, c = force
        fx, fy, fz = xx * a + yx * b + zx * c, xy * a + yy * b + zy * c, xz * a + yz * b + zz * c
        mx, my, mz = vec3_of(self._net_com)
        gx, gy, gz = px - mx, py - my, pz - mz
        self._touching.add(body)
        self._loads.set(body, "net", (fx, fy, fz))
        torque_nm = (gz * fy - gy * fz, gx * fz - gz * fx, gy * fx - gx * fy)
        self._loads.set(self._net, f"payload {body}", (-fx, -fy, -fz), torque_nm)

    def _release(self, body: int) -> None:
        if body in self._touching:
            self._touching.discard(body)
            self._loads.set(body, "net", ZERO)
            self._loads.set(self._net, f"payload {body}", ZERO)


def _is_near(q: list[float], position_m: Vec3) -> bool:
    x, y, z = position_m[0] - q[0], position_m[1] - q[1], position_m[2] - q[2]
    return x * x + y * y + z * z < _NEAR_M2
