"""Moves the tip along the surface: a phase `slide`. Pure.

The reference moves straight, once the force is reached, and the tip's path begins where the tip is. Against friction, the weak springs
of base and arm would leave the tip far behind: a force along the way, in proportion to the tip's lag and to its integral, acts on base
and arm (`slide_world_n`). It is limited by the largest friction that the mission allows, and ends with the slide. A turn of the yaw
setpoint steers the tip towards its path (`steer_rad`).

Friction across the tool is a torque at the sensor, and its cross-talk reads as force along the tool: up to half of the wanted one. The
vehicle's motion shows the true force, with gusts. What it shows in excess of the measured force, averaged, is added to that one.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

from msgspec.structs import replace

from companion.mission.air import Air
from companion.model.contact import ContactMode, ContactState
from companion.model.types import Vec2, Vec3
from companion.phases.contact import force as c
from companion.phases.contact.points import ahead_m
from companion.phases.contact.surface import axes

LAG_N_M, LAG_N_MS = 30.0, 40.0
"""Force along the way per lag of the tip, and its rate. With twice as much, the tip sticks and slips."""
BEYOND_FRICTION_N = 0.5
"""Largest force along the way beyond the largest friction."""
STEER_RAD_M, STEER_MAX_RAD = 10.0, math.radians(12.0)
"""Turn of the yaw setpoint per distance of the tip beside its path, and its bound. PX4's yaw is soft: 10 deg make some 0.07 N m."""
STEERED_S = 0.3
"""Time constant with which the turn of the yaw setpoint decays after a slide."""
UNSEEN_S, UNSEEN_SHARE, UNSEEN_MAX_N = 1.5, 0.9, 2.0
"""Time over which the force that the sensor does not measure is averaged, fraction of it that is believed, and its bound."""
STUCK_M, STUCK_S = 0.05, 0.5
"""Lag of the tip from which it is stuck, and for how long."""
RELEASE_N_S = 3.0
"""Rate at which the force along the way ends after a slide."""
_ENDED: Vec3 = (0.0, 0.0, 0.0)


@dataclass(frozen=True, slots=True)
class Stroke:
    """The keys of a slide."""

    force_n: float
    displacement_m: Vec2
    speed_m_s: float
    friction_max: float

    @property
    def most_n(self) -> float:
        """Return the largest force along the surface: the largest friction, and a little more."""
        return self.friction_max * self.force_n + BEYOND_FRICTION_N


def begun(contact: ContactState, stroke: Stroke) -> ContactState:
    """Return the state with the way of a slide planned; the tip stays until the force is reached."""
    (r, u), (right, up) = stroke.displacement_m, axes(contact.direction_world)
    rest = c.shift_to(contact, contact.shift.to_m, contact.shift.to_yaw_rad, contact.shift.to_tool_rad).from_m
    x, y, z = (p + r * a + u * b for p, a, b in zip(rest, right, up, strict=True))
    shift = c.shift_to(contact, (x, y, z), contact.shift.to_yaw_rad, contact.shift.to_tool_rad)
    return replace(contact, shift=shift, mode=ContactMode.PRESS, lag_m=0.0, lag_integral_n=0.0, stuck_s=0.0)


def slid(air: Air, contact: ContactState, stroke: Stroke, touch_n: float) -> ContactState:
    """Return the state after one tick of a slide."""
    dt_s = air.dt_s
    contact = c.pressed(contact, dt_s, touch_n, stroke.force_n)
    slides = contact.mode is ContactMode.SLIDE
    if not slides and contact.wanted_n != stroke.force_n:
        return contact
    felt = c.touches(contact, touch_n)
    if slides:
        contact = c.shifted(contact, dt_s, stroke.speed_m_s if felt else 0.0)
    beside_m = _beside_m(air, contact)
    if beside_m is None:
        return contact
    if not felt:  # nothing rubs: the force would move the tip away
        return replace(contact, lag_integral_n=0.0, slide_world_n=_ENDED)
    most_n = stroke.most_n
    if not slides:
        contact = replace(contact, mode=ContactMode.SLIDE, since_s=air.t_s, beside_m=beside_m)
    lag_m = _along(contact, contact.beside_m) - _along(contact, beside_m)
    integral_n = min(most_n, max(-most_n, contact.lag_integral_n + LAG_N_MS * dt_s * lag_m))
    unseen_n = contact.unseen_n + dt_s / UNSEEN_S * (UNSEEN_SHARE * contact.disagreement_n - contact.unseen_n)
    nx, ny, _ = contact.direction_world  # left of it is (-ny, nx); nothing on a floor, where no yaw moves the tip alone
    left_m = nx * (beside_m[1] - contact.beside_m[1]) - ny * (beside_m[0] - contact.beside_m[0])
    contact = replace(
        contact,
        steer_rad=min(STEER_MAX_RAD, max(-STEER_MAX_RAD, -STEER_RAD_M * left_m)),
        unseen_n=min(UNSEEN_MAX_N, max(-UNSEEN_MAX_N, unseen_n)),
        lag_m=lag_m,
        lag_integral_n=integral_n,
        stuck_s=contact.stuck_s + dt_s if abs(lag_m) > STUCK_M else 0.0,
    )
    return _driven(contact, min(most_n, max(-most_n, integral_n + LAG_N_M * lag_m)))


def _driven(contact: ContactState, force_n: float) -> ContactState:
    x, y, z = way(contact)
    return replace(contact, slide_world_n=(force_n * x, force_n * y, force_n * z))


def _along(contact: ContactState, vector: Vec3) -> float:
    (nx, ny, nz), (x, y, z) = way(contact), vector
    return nx * x + ny * y + nz * z


def released(contact: ContactState, dt_s: float) -> ContactState:
    """Return the state with less force along the surface, because the tip does not slide; its friction, of which the sensor's error
    came, ends as well.
    """
    if contact.steer_rad != 0.0:
        contact = replace(contact, steer_rad=(1.0 - dt_s / STEERED_S) * contact.steer_rad)
    if contact.slide_world_n == _ENDED:
        return contact if contact.unseen_n == 0.0 else replace(contact, unseen_n=0.0)
    x, y, z = contact.slide_world_n
    size_n = math.hypot(x, y, z)
    k = max(0.0, 1.0 - RELEASE_N_S * dt_s / size_n)
    return replace(contact, slide_world_n=(k * x, k * y, k * z) if k > 0.0 else _ENDED, unseen_n=k * contact.unseen_n)


def way(contact: ContactState) -> Vec3:
    """Return the direction of a slide, a unit vector."""
    (fx, fy, fz), (tx, ty, tz), length_m = contact.shift.from_m, contact.shift.to_m, contact.shift.length_m
    return ((tx - fx) / length_m, (ty - fy) / length_m, (tz - fz) / length_m)


def _beside_m(air: Air, contact: ContactState) -> Vec3 | None:
    """Return the place of the tip minus that of its reference; None if it is unknown."""
    tip, shift = air.tip_world_m(), contact.shift
    if tip is None:
        return None
    (px, py, pz), (ax, ay, az) = (
        air.plan_reference().position_world_m,
        ahead_m(air, shift.to_yaw_rad, shift.to_tool_rad),
    )
    (fx, fy, fz), (tx, ty, tz), share = shift.from_m, shift.to_m, shift.way_m / shift.length_m
    x, y, z = tip
    return (
        x - px - ax - fx - share * (tx - fx),
        y - py - ay - fy - share * (ty - fy),
        z - pz - az - fz - share * (tz - fz),
    )
