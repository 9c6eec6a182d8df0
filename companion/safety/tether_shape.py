"""Clearance between the hanging tether and the vehicle's rotors and arm.

A line that hangs still lies in the vertical plane through its two ends, below their chord, and above its own tangent at the vehicle: a
hanging line is convex. It is therefore bounded by two rays from the attachment, the chord and the steepest tangent that its slack
allows; its shape beyond a metre from the vehicle does not affect the rotors and the arm. The tangent is taken from the parabola of the
same length, which with much slack goes straight down, as the line does. `clearance_min_m` covers wind and rotor wash on the line.
"""

from __future__ import annotations

import math
from typing import Final

from companion.config.arm_chain import chain_of
from companion.config.tether import Tether
from companion.config.vehicle import Vehicle
from companion.model.arm_skeleton import skeleton_of
from companion.model.types import Joints, Vec2, Vec3

_NEVER: Final = 1.0
"""Length, m, over which a line that does not leave the disk is followed."""


def steepest_slope(level_m: float, drop_m: float, chord_m: float, slack_m: float) -> Vec2:
    """Return the unit direction (towards the anchor's vertical, up) of the hanging line at the vehicle.

    A parabola over the horizontal span h with the sag s has the length c + 8/3 s^2 h^2 / c^3 (c is the chord; the parabola is
    assumed to be flat), so s = sqrt(3/8 slack c^3) / h, and the slope at its end is that of the chord minus 4 s / h.

    Args:
        level_m: horizontal distance to the anchor, h.
        drop_m: height of the anchor above the attachment (negative: below).
        chord_m: straight distance, c.
        slack_m: length minus chord, not negative.
    """
    along = level_m * level_m
    up = drop_m * level_m - 4.0 * chord_m * math.sqrt(0.375 * slack_m * chord_m)
    norm = math.sqrt(along * along + up * up)
    return (along / norm, up / norm) if norm > 0.0 else (0.0, -1.0)


class Clearance:
    """Models the rotors as a ring in the plane through the body's origin, and the arm as a slab about its plane or, if it leaves that
    plane, as a ball.

    Args:
        vehicle: airframe, arm and tool.
        tether: its attachment.
    """

    def __init__(self, vehicle: Vehicle, tether: Tether) -> None:
        self._p = tether.attachment_body_m
        self._inner_m = tether.rotor_inner_radius_m
        self._outer_m = max(vehicle.airframe.radius_m, self._inner_m)
        self._off_axis_m = math.hypot(self._p[0], self._p[1])
        self._off_m2 = self._p[0] * self._p[0] + self._p[1] * self._p[1]
        self._past_inner_m2 = self._off_m2 - self._inner_m * self._inner_m
        self._past_outer_m2 = self._off_m2 - self._outer_m * self._outer_m
        """Squared distance of the attachment from the ring's axis, minus the squared radii of the ring."""
        self._to_edge_m = math.hypot(self._inner_m - self._off_axis_m, self._p[2])
        self._below = self._p[2] <= 0.0
        arm = skeleton_of(chain_of(vehicle))
        self._shoulder = arm.shoulder_body_m
        self._links_m = tuple(math.hypot(*link) for link in arm.links_body_m)
        self._net_m = vehicle.tip_radius_m
        self._reach_m = arm.reach_m + self._net_m
        self.arm_is_planar = arm.is_in_xz_plane
        """Whether the arm moves in a plane parallel to the body's x-z plane."""
        self._is_2r = (
            self.arm_is_planar and len(self._links_m) == 2 and all(x > 0.0 and z == 0.0 for x, _, z in arm.links_body_m)
        )
        aside_m = abs(self._p[1] - self._shoulder[1]) - self._net_m
        self._aside_m = aside_m if self.arm_is_planar else math.dist(self._p, self._shoulder) - self._reach_m
        self.judges_arm = bool(self._links_m) and self._aside_m > 0.0
        """False if there is no arm, or if the tether is attached in the arm's own plane or, for an arm that is not planar, within its
        reach: there it sags into the arm's sweep in every flight."""
        self.needs_hanging = self.judges_arm or not self._below
        """False if `least_m` does not use the hanging direction."""

    def least_m(self, straight_body: Vec3, hanging_body: Vec3 | None, arm_rad: Joints | None) -> float:
        """Return the smallest distance, m; negative if the line touches.

        Args:
            straight_body: unit direction from the attachment to the anchor.
            hanging_body: unit direction in which the line leaves when it hangs deepest; None if it is straight.
            arm_rad: the paper's angles; if None, the arm is assumed to be anywhere within its reach.
        """
        # A line tied below the rotors comes nearest when it is straight, one tied above them when it hangs deepest.
        nearest = straight_body if self._below or hanging_body is None else hanging_body
        least = self._rotors_m(nearest)
        if self.judges_arm:
            reach_m = self._reach_m if arm_rad is None else self._arm_reach_m(arm_rad)
            least = min(least, self._arm_m(straight_body, reach_m))
            if hanging_body is not None:
                least = min(least, self._arm_m(hanging_body, reach_m))
        return least

    def _rotors_m(self, d: Vec3) -> float:
        px, py, pz = self._p
        dx, dy, dz = d
        if not self._below:
            pz, dz = -pz, -dz
        flat_2 = dx * dx + dy * dy
        inner, outer, off = self._inner_m, self._outer_m, self._off_axis_m
        b, past_outer = px * dx + py * dy, self._past_outer_m2
        if off > outer:
            if b >= 0.0 or flat_2 <= 0.0:
                return off - outer  # leads away from the disk
            passes_2 = self._off_m2 - b * b / flat_2
            if passes_2 >= outer * outer:
                return math.sqrt(passes_2) - outer
        out_s = (math.sqrt(max(0.0, b * b - flat_2 * past_outer)) - b) / flat_2 if flat_2 > 1e-12 else _NEVER
        if off >= inner:
            at_s = 0.0 if off <= outer else (-b - math.sqrt(b * b - flat_2 * past_outer)) / flat_2
            return -pz - max(at_s * dz, out_s * dz)
        # Through the middle, where there are no blades: the distance depends on how steeply it passes the ring's inner edge.
        flat = math.sqrt(flat_2)
        if flat < 1e-6:
            return off - outer if dz > 0.0 else inner - off
        in_s = (math.sqrt(b * b - flat_2 * self._past_inner_m2) - b) / flat_2
        return min(self._to_edge_m, (-pz - max(in_s * dz, out_s * dz)) * flat)

    def _arm_reach_m(self, arm_rad: Joints) -> float:
        """Return the distance of the farthest point of the arm and the net from the shoulder, m; for other arms than two rods in
        a plane, that of the stretched arm.
        """
        if not self._is_2r:
            return self._reach_m
        l1, l2 = self._links_m
        net_m = math.sqrt(max(0.0, l1 * l1 + l2 * l2 + 2.0 * l1 * l2 * math.cos(arm_rad[1])))
        return max(l1, net_m + self._net_m)

    def _arm_m(self, d: Vec3, reach_m: float) -> float:
        """Return the distance, in the arm's plane, of a ray from the arm: a slab |y - y_shoulder| <= net radius within `reach_m` of
        the shoulder, or a ball of that radius for an arm that leaves its plane.
        """
        px, py, pz = self._p
        sx, sy, sz = self._shoulder
        dx, dy, dz = d
        x, y, z = px - sx, py - sy, pz - sz
        if not self.arm_is_planar:
            at_s = max(0.0, -(x * dx + y * dy + z * dz))
            return math.hypot(x + at_s * dx, y + at_s * dy, z + at_s * dz) - reach_m
        if y < 0.0:
            y, dy = -y, -dy
        aside = self._aside_m
        if dy >= 0.0:
            return max(aside, math.hypot(x, z) - reach_m)
        enter_s = aside / -dy
        leave_s = (y + self._net_m) / -dy
        flat_2 = dx * dx + dz * dz
        nearest_s = max(enter_s, min(leave_s, -(x * dx + z * dz) / flat_2)) if flat_2 > 1e-12 else enter_s
        return math.hypot(x + nearest_s * dx, z + nearest_s * dz) - reach_m
