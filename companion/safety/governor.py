"""The governor constrains references so that they cannot leave the tether sphere and the room, whatever the input reference. Pure.

The safe set is convex: a ball about the anchor (its radius is the tether's length minus the margin and the lever of the attachment;
infinite without a tether) and a box (the room minus the space for the rotors). A state (p, v) of the reference is *safe* if p, and the
point q at which the vehicle would come to rest after a fault (`companion.safety.stop`), both lie in the set, and the speed is within
its limit. Straight braking never moves q beyond its first position, and p and q stay on the segment from the first p to the first q,
which lies in the convex set because its ends do: from a safe state braking is always possible and stays safe. It is therefore enough
to accept a step towards the input reference only if the state after it is safe, and otherwise to blend in as much braking as that
requires. No constraint needs a look-ahead, and no reference can violate one.

A safe reference that continues the previous one passes unchanged, as the same object. The mission check uses the same `SafeSet`, so an
accepted plan is never constrained.
"""

from __future__ import annotations

import math
from typing import Final

import msgspec

from companion.config.mission import Limits
from companion.config.vehicle import Vehicle
from companion.model.codec import Record
from companion.model.outputs import TetherState
from companion.model.types import Reference, Vec3
from companion.safety.stop import StopModel

BODY_TOP_M: Final = 0.15
"""Height of the rotors and the markers above the body's origin."""
BELOW_STANDING_M = 0.75
"""The set reaches this far below standing height: a landing's reference continues below the floor until touchdown is detected, and its
predicted stop lies lower still."""
JUMP_M: Final = 0.002
"""A reference continues the previous one if its position is within this distance of the extrapolated one."""
RETURN_PER_S = 2.5
"""Rate at which a constrained reference returns to the input reference. Its velocity follows four times as fast, so that it does not
overshoot."""
SPEED_PER_S = 4.0 * RETURN_PER_S
INSIDE_M = 0.001
"""A target outside the set is replaced by the nearest point this far inside it."""
_TOLERANCE: Final = 1e-9
_HALVINGS = 5
_PROJECTIONS = 6


class Governed(Record, frozen=True):
    """The governor's output: the reference that the controller follows."""

    reference: Reference
    limited_by: tuple[str, ...]
    """Reasons for a constraint: "tether", "geofence", "speed", "acceleration" (the input jumps, or the governor is still returning to
    it). Empty if the reference is the unchanged input object.
    """


class SafeSet:
    """Set of permitted positions of the body's origin: the intersection of a ball and a box.

    Args:
        vehicle: tether, room and airframe.

    Raises:
        ValueError: the set is empty; the message is one line with the cause.
    """

    __slots__ = ("_least_m", "_most_m", "anchor_m", "high_m", "low_m", "radius_m")

    def __init__(self, vehicle: Vehicle) -> None:
        tether, room, reach_m = vehicle.tether, vehicle.room, vehicle.airframe.radius_m
        self.anchor_m: Vec3 = (0.0, 0.0, 0.0)
        self.radius_m = math.inf
        if tether is not None:
            self.anchor_m = tether.anchor_world_m
            self.radius_m = tether.length_m - tether.margin_m - math.hypot(*tether.attachment_body_m)
        lowest_m = vehicle.airframe.ground_clearance_m - BELOW_STANDING_M
        self.low_m: Vec3 = (room.x_m[0] + reach_m, room.y_m[0] + reach_m, min(room.z_m[0], 0.0) + lowest_m)
        self.high_m: Vec3 = (room.x_m[1] - reach_m, room.y_m[1] - reach_m, room.z_m[1] - BODY_TOP_M)
        for name, low, high, span in zip("xyz", self.low_m, self.high_m, (room.x_m, room.y_m, room.z_m), strict=True):
            if low > high:
                raise ValueError(
                    f"vehicle '{vehicle.name}': room.{name}_m is {span[0]:g} to {span[1]:g} m, too "
                    f"small for the vehicle; measure the room, or airframe.radius_m ({reach_m:g} m)"
                )
        x, y, z = self.low_m
        x_high, y_high, _ = self.high_m
        self._least_m, self._most_m = (
            (x - _TOLERANCE, y - _TOLERANCE, z - _TOLERANCE),
            (x_high + _TOLERANCE, y_high + _TOLERANCE),
        )
        """Walls and floor of the box with the tolerance."""
        into = math.dist(self.anchor_m, _clamped(self.anchor_m, self.low_m, self.high_m))
        if tether is not None and into > self.radius_m:
            raise ValueError(
                f"vehicle '{vehicle.name}': the tether reaches {max(0.0, self.radius_m):.2f} m (length_m {tether.length_m:g} minus "
                f"margin_m {tether.margin_m:g} and the lever of attachment_body_m), but the room begins {into:.2f} m from the anchor; "
                "correct tether.anchor_world_m or tether.length_m"
            )

    def holds(self, p: Vec3) -> bool:
        """Return whether the point is inside both the ball and the box."""
        return self.holds_within(p, self.radius_m, self.high_m[2])

    def holds_all(self, low: Vec3, high: Vec3) -> bool:
        """Return whether each point between two opposite corners is inside both the ball and the box."""
        (x, y, z), (ax, ay, az) = low, self.anchor_m
        u, v, w = high
        farthest = (u if u - ax > ax - x else x, v if v - ay > ay - y else y, w if w - az > az - z else z)
        return self.holds(low) and self.holds(high) and self.holds(farthest)

    def holds_within(self, p: Vec3, radius_m: float, top_m: float) -> bool:
        """Return whether the point is within this distance of the anchor and inside the box with this ceiling."""
        x_low, y_low, z_low = self._least_m
        x_high, y_high = self._most_m
        ax, ay, az = self.anchor_m
        x, y, z = p
        return (
            x_low <= x <= x_high
            and y_low <= y <= y_high
            and z_low <= z <= top_m + _TOLERANCE
            and (x - ax) * (x - ax) + (y - ay) * (y - ay) + (z - az) * (z - az)
            <= (radius_m + _TOLERANCE) * (radius_m + _TOLERANCE)
        )

    def breach_walls_m(self, p: Vec3) -> float:
        """Return the largest distance along one axis by which a position is outside the box; negative inside it."""
        return max(max(low - x, x - high) for x, low, high in zip(p, self.low_m, self.high_m, strict=True))

    def breach_tether_m(self, p: Vec3) -> float:
        """Return the distance by which a position is outside the ball; negative inside it, -inf without a tether."""
        return math.dist(p, self.anchor_m) - self.radius_m


class Governor:
    """Constrains a stream of references to the safe set.

    Args:
        vehicle: tether, room, airframe, and the speed of its emergency landing.
        limits: speed and acceleration limits of the mission.

    Raises:
        ValueError: nothing is inside both the tether's reach and the room.
    """

    def __init__(self, vehicle: Vehicle, limits: Limits) -> None:
        self._set = SafeSet(vehicle)
        self._stop = StopModel(vehicle.safety)
        self.stop_deceleration_m_s2 = self._stop.deceleration_m_s2
        self.acceleration_max_m_s2 = max(limits.acceleration_max_m_s2, self.stop_deceleration_m_s2)
        self.speed_max_m_s = max(limits.speed_max_m_s, vehicle.safety.land_speed_m_s)
        self._half_per_a = 0.5 / self.stop_deceleration_m_s2
        self._p: Vec3 | None = None
        self._v: Vec3 = (0.0, 0.0, 0.0)
        self._radius_m = self._set.radius_m
        self._top_m = self._set.high_m[2]
        self._restrained = False

    def reset(self) -> None:
        """Begin a new motion with the next reference, without comparing it with the previous one."""
        self._p = None
        self._v = (0.0, 0.0, 0.0)

    def constrain(self, dt_s: float, reference: Reference, tether: TetherState | None) -> Governed:
        """Return the reference of this tick, constrained to the safe set.

        Args:
            dt_s: time since the previous call.
            reference: input reference, with finite values.
            tether: present state, None if unknown. While the tether is taut or snagged the reference moves neither outward nor up.
        """
        self._restrain(tether is not None and (tether.taut or tether.snagged))
        p, v = reference.position_world_m, reference.velocity_world_m_s
        reasons = self._reasons(dt_s, p, v)
        if not reasons:
            self._p, self._v = p, v
            if self._restrained:
                self._tighten()
            return Governed(reference, ())
        acceleration = self._begin(p) if self._p is None else self._step(dt_s, reference, reasons)
        if self._restrained:
            self._tighten()
        assert self._p is not None
        constrained = msgspec.structs.replace(
            reference,
            position_world_m=self._p,
            velocity_world_m_s=self._v,
            acceleration_world_m_s2=acceleration,
            jerk_world_m_s3=(0.0, 0.0, 0.0),
        )
        return Governed(constrained, reasons)

    # -- judgement -------------------------------------------------------------------------------------------------

    def _reasons(self, dt_s: float, p: Vec3, v: Vec3) -> tuple[str, ...]:
        """Return why a reference must be constrained; empty if it may pass unchanged."""
        px, py, pz = p
        vx, vy, vz = v
        speed = math.sqrt(vx * vx + vy * vy + vz * vz)
        safe = self._admits_state(p, v, speed)
        fast = speed > self.speed_max_m_s * (1.0 + 1e-6)
        last = self._p
        if last is None:
            stepped = False
        else:
            wx, wy, wz = self._v
            dx, dy, dz = vx - wx, vy - wy, vz - wz
            most = self.acceleration_max_m_s2 * dt_s
            half = 0.5 * dt_s
            ex, ey, ez = (
                px - last[0] - half * (vx + wx),
                py - last[1] - half * (vy + wy),
                pz - last[2] - half * (vz + wz),
            )
            stepped = dx * dx + dy * dy + dz * dz > most * most * (1.0 + 1e-6) or (
                ex * ex + ey * ey + ez * ez > JUMP_M * JUMP_M
            )
        if safe and not fast and not stepped:
            return ()
        reasons = []
        if not safe:
            stop = _ahead(p, v, self._stop.time_s(speed))
            if (
                self._set.breach_tether_m(p) > _TOLERANCE
                or self._set.breach_tether_m(stop) > _TOLERANCE
                or (self._restrained and not self._admits_restrained(p, v, speed))
            ):
                reasons.append("tether")
            if any(self._set.breach_walls_m(end) > _TOLERANCE for end in (p, stop)):
                reasons.append("geofence")
        if fast:
            reasons.append("speed")
        if stepped:
            reasons.append("acceleration")
        return tuple(reasons)

    def _admits_state(self, p: Vec3, v: Vec3, speed: float) -> bool:
        """Return whether p lies in the present set and the predicted stop in the safe set."""
        stop = _ahead(p, v, self._stop.time_s(speed))
        return self._set.holds(stop) and self._admits_restrained(p, v, speed)

    def _admits_restrained(self, p: Vec3, v: Vec3, speed: float) -> bool:
        """Return whether p and the end of straight braking lie in the present set; without restraint it is enough that p lies in
        it.
        """
        return self._admits(p) and (not self._restrained or self._admits(_ahead(p, v, speed * self._half_per_a)))

    def _admits(self, p: Vec3) -> bool:
        return self._set.holds_within(p, self._radius_m, self._top_m)

    def _safe(self, p: Vec3, v: Vec3) -> bool:
        speed = math.sqrt(v[0] * v[0] + v[1] * v[1] + v[2] * v[2])
        return speed <= self.speed_max_m_s * (1.0 + 1e-6) and self._admits_state(p, v, speed)

    # -- taut ------------------------------------------------------------------------------------------------------

    def _restrain(self, restrained: bool) -> None:
        """Begin or end the restraint, during which ball and ceiling shrink to the reference's position."""
        if restrained and not self._restrained:
            self._restrained = True
            self._tighten()
        elif not restrained and self._restrained:
            self._restrained = False
            self._radius_m, self._top_m = self._set.radius_m, self._set.high_m[2]

    def _tighten(self) -> None:
        """Shrink the set to just hold p and the end of straight braking: the reference can brake, but not move farther out."""
        p, v = self._p, self._v
        if p is None:
            return
        q = _ahead(p, v, math.sqrt(v[0] * v[0] + v[1] * v[1] + v[2] * v[2]) * self._half_per_a)
        anchor = self._set.anchor_m
        self._radius_m = min(self._radius_m, max(math.dist(p, anchor), math.dist(q, anchor)))
        self._top_m = min(self._top_m, max(p[2], q[2]))

    # -- motion ----------------------------------------------------------------------------------------------------

    def _begin(self, p: Vec3) -> Vec3:
        """Begin a motion at rest at the nearest permitted position; return the acceleration."""
        self._p = self._nearest(p, 0.0)
        self._v = (0.0, 0.0, 0.0)
        return (0.0, 0.0, 0.0)

    def _step(self, dt_s: float, reference: Reference, reasons: tuple[str, ...]) -> Vec3:
        """Move towards the reference as far as the next state is safe, brake otherwise; return the mean acceleration."""
        assert self._p is not None
        v = self._v
        brake_p, brake_v = self._braked(dt_s)
        target, follow = reference.position_world_m, reference.velocity_world_m_s
        feed = reference.acceleration_world_m_s2
        if "tether" in reasons or "geofence" in reasons:
            follow = feed = (0.0, 0.0, 0.0)
            if not self._restrained:
                target = self._nearest(target, INSIDE_M)
        if self._restrained and not self._admits(target):
            # The target lies outward: sliding along the boundary to the nearest point is of no use.
            wish_p, wish_v = brake_p, brake_v
        else:
            wish_p, wish_v = self._wished(dt_s, target, follow, feed)
        share = 1.0
        if not self._safe(wish_p, wish_v):
            low, high = 0.0, 1.0
            for _ in range(_HALVINGS):
                share = 0.5 * (low + high)
                if self._safe(_mixed(brake_p, wish_p, share), _mixed(brake_v, wish_v, share)):
                    low = share
                else:
                    high = share
            share = low
        self._p = _mixed(brake_p, wish_p, share)
        self._v = _mixed(brake_v, wish_v, share)
        return ((self._v[0] - v[0]) / dt_s, (self._v[1] - v[1]) / dt_s, (self._v[2] - v[2]) / dt_s)

    def _braked(self, dt_s: float) -> tuple[Vec3, Vec3]:
        """Return the position and the velocity after straight braking; exact even if the reference comes to rest within the step."""
        assert self._p is not None
        px, py, pz = self._p
        vx, vy, vz = self._v
        speed = math.sqrt(vx * vx + vy * vy + vz * vz)
        loss = self.stop_deceleration_m_s2 * dt_s
        if speed <= loss:
            way = speed * self._half_per_a
            return (px + vx * way, py + vy * way, pz + vz * way), (0.0, 0.0, 0.0)
        keep = 1.0 - loss / speed
        way = 0.5 * (1.0 + keep) * dt_s
        return (px + vx * way, py + vy * way, pz + vz * way), (vx * keep, vy * keep, vz * keep)

    def _wished(self, dt_s: float, target: Vec3, follow: Vec3, feed: Vec3) -> tuple[Vec3, Vec3]:
        """Return the position and the velocity after a step towards the target, within the speed and acceleration limits."""
        assert self._p is not None
        px, py, pz = self._p
        vx, vy, vz = self._v
        ex, ey, ez = target[0] - px, target[1] - py, target[2] - pz
        away = math.sqrt(ex * ex + ey * ey + ez * ez)
        rate = 0.0
        if away > 0.0:
            rate = min(RETURN_PER_S, math.sqrt(self.stop_deceleration_m_s2 / away))
        wx, wy, wz = _limited((follow[0] + rate * ex, follow[1] + rate * ey, follow[2] + rate * ez), self.speed_max_m_s)
        gain = min(SPEED_PER_S, 1.0 / dt_s)
        ax, ay, az = _limited(
            (feed[0] + gain * (wx - vx), feed[1] + gain * (wy - vy), feed[2] + gain * (wz - vz)),
            self.acceleration_max_m_s2,
        )
        nx, ny, nz = vx + ax * dt_s, vy + ay * dt_s, vz + az * dt_s
        half = 0.5 * dt_s
        return (px + half * (vx + nx), py + half * (vy + ny), pz + half * (vz + nz)), (nx, ny, nz)

    def _nearest(self, p: Vec3, inside_m: float) -> Vec3:
        """Return a point of the present set close to the one nearest to p: alternating projections, then a step from a point
        inside.
        """
        low, anchor = self._set.low_m, self._set.anchor_m
        high = (self._set.high_m[0], self._set.high_m[1], self._top_m)
        radius = max(0.0, self._radius_m - inside_m)
        for _ in range(_PROJECTIONS):
            p = _clamped(p, low, high)
            away = math.dist(p, anchor)
            if away <= radius:
                return p
            p = _mixed(anchor, p, radius / away)
        p = _clamped(p, low, high)
        inside = self._p if self._p is not None else _clamped(anchor, low, high)
        return _mixed(inside, p, _share_within(inside, p, anchor, radius))


def _share_within(inside: Vec3, p: Vec3, centre: Vec3, radius_m: float) -> float:
    """Return the largest fraction, 0 to 1, of the segment from a point inside a ball to p that stays in the ball."""
    dx, dy, dz = p[0] - inside[0], p[1] - inside[1], p[2] - inside[2]
    cx, cy, cz = inside[0] - centre[0], inside[1] - centre[1], inside[2] - centre[2]
    a = dx * dx + dy * dy + dz * dz
    b = dx * cx + dy * cy + dz * cz
    c = cx * cx + cy * cy + cz * cz - radius_m * radius_m
    if a <= 0.0 or c > 0.0 or (c == 0.0 and b >= 0.0):
        return 0.0
    return min(1.0, (math.sqrt(b * b - a * c) - b) / a)


def _ahead(p: Vec3, v: Vec3, time_s: float) -> Vec3:
    return (p[0] + v[0] * time_s, p[1] + v[1] * time_s, p[2] + v[2] * time_s)


def _clamped(p: Vec3, low: Vec3, high: Vec3) -> Vec3:
    return (
        max(low[0], min(high[0], p[0])),
        max(low[1], min(high[1], p[1])),
        max(low[2], min(high[2], p[2])),
    )


def _limited(v: Vec3, most: float) -> Vec3:
    size = math.sqrt(v[0] * v[0] + v[1] * v[1] + v[2] * v[2])
    if size <= most:
        return v
    share = most / size
    return (v[0] * share, v[1] * share, v[2] * share)


def _mixed(a: Vec3, b: Vec3, share: float) -> Vec3:
    return (a[0] + share * (b[0] - a[0]), a[1] + share * (b[1] - a[1]), a[2] + share * (b[2] - a[2]))
