"""The governor: a reference that cannot leave the tether sphere and the room, whatever it is asked to follow. Pure.

The safe set is convex: a ball about the anchor (length less margin less lever of the attachment) and a box (the room less the rotors).
A state (p, v) of the reference is *safe* if p, and the point q at which the vehicle would come to rest after a fault
(`companion.safety.stop`), both lie in the set, and the speed is within its limit. Braking straight at a never moves q outward, and p
and q stay on the segment from the first p to the first q, which lies in a convex set with its ends: from a safe state braking is always
possible and stays safe. So it is enough to accept a step towards what is asked only if the state after it is safe, and otherwise to mix
in as much braking as that takes. No constraint needs a look-ahead, and no reference can break them.

A reference that is safe itself, and goes on from where the last one was, passes untouched: the same object. A plan that was accepted by
the mission check, which asks the same `SafeSet`, is never bent.
"""

from __future__ import annotations

import math

from companion.config.mission import Limits
from companion.config.vehicle import Vehicle
from companion.model.codec import Record
from companion.model.types import Reference, TetherState, Vec3
from companion.safety.stop import StopModel

BODY_TOP_M = 0.15
"""Rotors and markers above the body's origin."""
BELOW_STANDING_M = 0.6
"""The set reaches this far below standing height: a landing's reference goes on below the floor until touchdown is detected, and its
predicted stop lies lower still."""
JUMP_M = 0.002
"""A reference that is nowhere farther from where the last one leads goes on from it."""
CATCH_UP_PER_S = 2.5
"""Bent, the reference comes back to what is asked for with this rate. Its velocity follows four times as fast: no overshoot."""
SPEED_PER_S = 4.0 * CATCH_UP_PER_S
INSIDE_M = 0.001
"""What lies outside is followed to so far inside."""
_TOLERANCE = 1e-9
_HALVINGS = 5
_PROJECTIONS = 6


class Governed(Record, frozen=True):
    """What the controller is to follow."""

    reference: Reference
    bent_by: tuple[str, ...]
    """Why it is not what was asked for: "tether", "geofence", "speed", "acceleration" (it steps, or the governor is still on its way
    back to it). Empty: the very same object."""


class SafeSet:
    """Where the body's origin may be: ball and box.

    Args:
        vehicle: tether, room and airframe.

    Raises:
        ValueError: nothing is left of it; one line that says why.
    """

    __slots__ = ("anchor_m", "high_m", "low_m", "radius_m")

    def __init__(self, vehicle: Vehicle) -> None:
        tether, room, reach_m = vehicle.tether, vehicle.room, vehicle.airframe.radius_m
        self.anchor_m = tether.anchor_world_m
        self.radius_m = tether.length_m - tether.margin_m - math.hypot(*tether.attachment_body_m)
        lowest_m = vehicle.airframe.ground_clearance_m - BELOW_STANDING_M
        self.low_m: Vec3 = (room.x_m[0] + reach_m, room.y_m[0] + reach_m, min(room.z_m[0], 0.0) + lowest_m)
        self.high_m: Vec3 = (room.x_m[1] - reach_m, room.y_m[1] - reach_m, room.z_m[1] - BODY_TOP_M)
        for name, low, high, span in zip("xyz", self.low_m, self.high_m, (room.x_m, room.y_m, room.z_m), strict=True):
            if low > high:
                raise ValueError(
                    f"vehicle '{vehicle.name}': room.{name}_m is {span[0]:g} to {span[1]:g} m, too small for the machine; "
                    f"measure the room, or airframe.radius_m ({reach_m:g} m)"
                )
        into = math.dist(self.anchor_m, _clamped(self.anchor_m, self.low_m, self.high_m))
        if into > self.radius_m:
            raise ValueError(
                f"vehicle '{vehicle.name}': the tether reaches {max(0.0, self.radius_m):.2f} m (length_m {tether.length_m:g} less "
                f"margin_m {tether.margin_m:g} and the lever of attachment_body_m), but the room begins {into:.2f} m from the anchor; "
                "correct tether.anchor_world_m or tether.length_m"
            )

    def holds(self, p: Vec3) -> bool:
        """Return whether the point lies in ball and box."""
        return self.holds_within(p, self.radius_m, self.high_m[2])

    def holds_within(self, p: Vec3, radius_m: float, top_m: float) -> bool:
        """The same for a smaller ball and a lower ceiling."""
        low, high, (ax, ay, az) = self.low_m, self.high_m, self.anchor_m
        x, y, z = p
        return (
            low[0] - _TOLERANCE <= x <= high[0] + _TOLERANCE
            and low[1] - _TOLERANCE <= y <= high[1] + _TOLERANCE
            and low[2] - _TOLERANCE <= z <= top_m + _TOLERANCE
            and (x - ax) * (x - ax) + (y - ay) * (y - ay) + (z - az) * (z - az)
            <= (radius_m + _TOLERANCE) * (radius_m + _TOLERANCE)
        )

    def breach_walls_m(self, p: Vec3) -> float:
        """How far a point of the body's origin is outside the box, along one axis; negative: inside."""
        return max(max(low - x, x - high) for x, low, high in zip(p, self.low_m, self.high_m, strict=True))

    def breach_tether_m(self, p: Vec3) -> float:
        """How far it is outside the ball; negative: inside."""
        return math.dist(p, self.anchor_m) - self.radius_m


class Governor:
    """Bends a stream of references into the safe set.

    Args:
        vehicle: tether, room, airframe, and the speed of its emergency landing.
        limits: of the mission.

    Raises:
        ValueError: nothing is inside both the tether's reach and the room.
    """

    def __init__(self, vehicle: Vehicle, limits: Limits) -> None:
        self._set = SafeSet(vehicle)
        self.stop_deceleration_m_s2 = vehicle.tether.stop_deceleration_m_s2
        """With which it brakes."""
        self._stop = StopModel(vehicle.tether)
        self.acceleration_max_m_s2 = max(limits.acceleration_max_m_s2, self.stop_deceleration_m_s2)
        """The velocity of the governed reference never changes faster."""
        self.speed_max_m_s = max(limits.speed_max_m_s, vehicle.safety.land_speed_m_s)
        self._half_per_a = 0.5 / self.stop_deceleration_m_s2
        self._p: Vec3 | None = None
        self._v: Vec3 = (0.0, 0.0, 0.0)
        self._radius_m = self._set.radius_m
        self._top_m = self._set.high_m[2]
        self._restrained = False

    def reset(self) -> None:
        """The next reference begins a new motion: it is not held against the last one."""
        self._p = None
        self._v = (0.0, 0.0, 0.0)

    def bend(self, dt_s: float, reference: Reference, tether: TetherState | None) -> Governed:
        """One tick.

        Args:
            dt_s: since the last call.
            reference: what is asked for; finite.
            tether: as it is now; while it is taut or snagged the reference moves neither outward nor up. None: unknown.
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
        bent = Reference(
            position_world_m=self._p,
            velocity_world_m_s=self._v,
            acceleration_world_m_s2=acceleration,
            yaw_rad=reference.yaw_rad,
            yaw_rate_rad_s=reference.yaw_rate_rad_s,
            arm_rad=reference.arm_rad,
            arm_rate_rad_s=reference.arm_rate_rad_s,
            arm_acceleration_rad_s2=reference.arm_acceleration_rad_s2,
            jerk_world_m_s3=(0.0, 0.0, 0.0),
        )
        return Governed(bent, reasons)

    # -- judgement -------------------------------------------------------------------------------------------------

    def _reasons(self, dt_s: float, p: Vec3, v: Vec3) -> tuple[str, ...]:
        """Why a reference cannot pass as it is; empty: it can."""
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
                or not self._admits_restrained(p, v, speed)
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
        """The present set holds p, and the safe set the predicted stop."""
        stop = _ahead(p, v, self._stop.time_s(speed))
        return self._set.holds(stop) and self._admits_restrained(p, v, speed)

    def _admits_restrained(self, p: Vec3, v: Vec3, speed: float) -> bool:
        """Ball and ceiling as they are now hold p and the end of straight braking; without restraint the latter follows."""
        return self._admits(p) and (not self._restrained or self._admits(_ahead(p, v, speed * self._half_per_a)))

    def _admits(self, p: Vec3) -> bool:
        return self._set.holds_within(p, self._radius_m, self._top_m)

    def _safe(self, p: Vec3, v: Vec3) -> bool:
        speed = math.sqrt(v[0] * v[0] + v[1] * v[1] + v[2] * v[2])
        return speed <= self.speed_max_m_s * (1.0 + 1e-6) and self._admits_state(p, v, speed)

    # -- taut ------------------------------------------------------------------------------------------------------

    def _restrain(self, restrained: bool) -> None:
        """Begin or end the restraint: while it lasts, ball and ceiling shrink to where the reference is."""
        if restrained and not self._restrained:
            self._restrained = True
            self._tighten()
        elif not restrained and self._restrained:
            self._restrained = False
            self._radius_m, self._top_m = self._set.radius_m, self._set.high_m[2]

    def _tighten(self) -> None:
        """The set still holds p and the end of straight braking, so that braking stays possible and nothing farther is."""
        p, v = self._p, self._v
        if p is None:
            return
        q = _ahead(p, v, math.sqrt(v[0] * v[0] + v[1] * v[1] + v[2] * v[2]) * self._half_per_a)
        anchor = self._set.anchor_m
        self._radius_m = min(self._radius_m, max(math.dist(p, anchor), math.dist(q, anchor)))
        self._top_m = min(self._top_m, max(p[2], q[2]))

    # -- motion ----------------------------------------------------------------------------------------------------

    def _begin(self, p: Vec3) -> Vec3:
        """A new motion that begins with what cannot be: at rest, at the nearest place that can."""
        self._p = self._nearest(p, 0.0)
        self._v = (0.0, 0.0, 0.0)
        return (0.0, 0.0, 0.0)

    def _step(self, dt_s: float, reference: Reference, reasons: tuple[str, ...]) -> Vec3:
        """Towards the reference as far as the next state is safe, braking for the rest; returns the mean acceleration."""
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
            # What is asked for lies outward: sliding along to the place nearest to it would help nobody.
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
        """After straight braking; exact, also if it comes to rest in between."""
        assert self._p is not None
        (px, py, pz), (vx, vy, vz) = self._p, self._v
        speed = math.sqrt(vx * vx + vy * vy + vz * vz)
        loss = self.stop_deceleration_m_s2 * dt_s
        if speed <= loss:
            way = speed * self._half_per_a
            return (px + vx * way, py + vy * way, pz + vz * way), (0.0, 0.0, 0.0)
        keep = 1.0 - loss / speed
        way = 0.5 * (1.0 + keep) * dt_s
        return (px + vx * way, py + vy * way, pz + vz * way), (vx * keep, vy * keep, vz * keep)

    def _wished(self, dt_s: float, target: Vec3, follow: Vec3, feed: Vec3) -> tuple[Vec3, Vec3]:
        """After a step of catching up, within the limits of speed and acceleration."""
        assert self._p is not None
        (px, py, pz), (vx, vy, vz) = self._p, self._v
        ex, ey, ez = target[0] - px, target[1] - py, target[2] - pz
        away = math.sqrt(ex * ex + ey * ey + ez * ez)
        rate = 0.0
        if away > 0.0:
            rate = min(CATCH_UP_PER_S, math.sqrt(self.stop_deceleration_m_s2 / away))
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
        """A point of the present set close to the nearest one: alternating projections, then along the way from a point inside."""
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
    """Largest share of the way from a point inside a ball to p that stays in it; 0 to 1."""
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
