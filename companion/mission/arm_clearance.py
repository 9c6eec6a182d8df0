"""Clearance of the arm and the net from the rotors, for one pose and for the whole way on which the arm is folded. Pure."""

from __future__ import annotations

import math
from dataclasses import dataclass
from itertools import pairwise

from companion.config.arm import LINK_RADIUS_M
from companion.config.vehicle import Vehicle
from companion.control.arm_hold import towards
from companion.control.arm_model import manipulator_of
from companion.model.types import Joints, Vec3

ROTOR_GAP_M = 0.02
"""Smallest distance of the arm and the net below a rotor's disk."""
FOLD_STEP_RAD = math.radians(2.0)
"""Largest joint motion between two checked poses of a fold."""


@dataclass(frozen=True, slots=True)
class Contact:
    """A part of the arm that reaches into a rotor, or into the space above it."""

    part: str
    depth_m: float
    """Horizontal overlap with the rotor's disk."""
    at_body_m: Vec3
    """Point of the part's centre line that is nearest to the rotor's axis."""
    rotor: int
    """Number of the rotor, counted from 1."""

    def text(self) -> str:
        """Return where the contact is."""
        x_m, y_m, z_m = self.at_body_m
        return f"at ({x_m:.2f}, {y_m:.2f}, {z_m:.2f}) m in the body frame, it is at rotor {self.rotor}"


@dataclass(frozen=True, slots=True)
class Fold:
    """The way on which the arm is folded from a pose."""

    from_rad: Joints
    contact: Contact | None
    """First contact with a rotor on the way, or None."""
    worst_rad: Joints
    """Pose of the contact or, without one, the pose on the way in which the arm reaches lowest."""
    lowest_body_m: float
    """Lowest point of the arm on the way, in the body frame; infinite if the arm is folded already."""


class ArmClearance:
    """Models the links as rods of radius `LINK_RADIUS_M`, the tip as a ball, and each rotor as the space above its disk."""

    def __init__(self, vehicle: Vehicle) -> None:
        self._rotors_body_m = vehicle.airframe.rotor_layout.positions_body_m
        self._disk_m = vehicle.airframe.disk_radius_m
        self._lowest_m = vehicle.airframe.rotor_layout.height_m - ROTOR_GAP_M
        self._manipulator = manipulator_of(vehicle)
        self._joints = len(vehicle.arm.joints)
        self._tip_radius_m = vehicle.tip_radius_m
        self._tip = vehicle.tip_name
        self._fold_rad: Joints = tuple(map(math.radians, vehicle.fold_arm_deg))

    def parts(self, arm_rad: Joints) -> list[tuple[str, Vec3, float]]:
        """Return name, centre in the body frame and radius of the tip and of every joint but the first."""
        found = [(self._tip, self._manipulator.net_body_m(arm_rad), self._tip_radius_m)]
        for number, joint_m in enumerate(self._manipulator.joints_body_m(arm_rad)[1:], start=2):
            found.append(("elbow" if self._joints == 2 else f"joint {number}", joint_m, LINK_RADIUS_M))
        return found

    def rotor_contact(self, arm_rad: Joints) -> Contact | None:
        """Return the deepest contact of the arm with a rotor in a pose, or None."""
        tip_m = self._manipulator.net_body_m(arm_rad)
        points = (*self._manipulator.joints_body_m(arm_rad), tip_m)
        if max(z_m for _, _, z_m in points) + max(LINK_RADIUS_M, self._tip_radius_m) <= self._lowest_m:
            return None
        rods = [(f"link {number}", *ends, LINK_RADIUS_M) for number, ends in enumerate(pairwise(points), start=1)]
        rods.append((self._tip, tip_m, tip_m, self._tip_radius_m))
        contacts = [
            contact
            for part, from_m, to_m, radius_m in rods
            for number in range(len(self._rotors_body_m))
            if (contact := self._contact(part, from_m, to_m, radius_m, number)) is not None
        ]
        return max(contacts, key=lambda contact: contact.depth_m, default=None)

    def _contact(self, part: str, from_m: Vec3, to_m: Vec3, radius_m: float, number: int) -> Contact | None:
        rotor_x_m, rotor_y_m, rotor_z_m = self._rotors_body_m[number]
        low_m = rotor_z_m - ROTOR_GAP_M - radius_m
        low, high = sorted((from_m, to_m), key=lambda point: point[2])
        if high[2] <= low_m:
            return None
        if low[2] < low_m:
            low = _between(low, high, (low_m - low[2]) / (high[2] - low[2]))
        dx_m, dy_m = high[0] - low[0], high[1] - low[1]
        flat_2 = dx_m * dx_m + dy_m * dy_m
        share = ((rotor_x_m - low[0]) * dx_m + (rotor_y_m - low[1]) * dy_m) / flat_2 if flat_2 > 0.0 else 1.0
        at_m = _between(low, high, min(1.0, max(0.0, share)))
        depth_m = self._disk_m + radius_m - math.hypot(at_m[0] - rotor_x_m, at_m[1] - rotor_y_m)
        return Contact(part, depth_m, at_m, number + 1) if depth_m > 0.0 else None

    def fold(self, arm_rad: Joints) -> Fold:
        """Return the way on which a landing after a fault folds the arm from a pose: straight in joint space, all joints together."""
        from_rad, lowest_m, lowest_rad = arm_rad, math.inf, arm_rad
        while arm_rad != self._fold_rad:
            arm_rad = towards(arm_rad, self._fold_rad, FOLD_STEP_RAD)
            contact = self.rotor_contact(arm_rad)
            if contact is not None:
                return Fold(from_rad, contact, arm_rad, lowest_m)
            low_m = min(centre_m[2] - radius_m for _, centre_m, radius_m in self.parts(arm_rad))
            if low_m < lowest_m:
                lowest_m, lowest_rad = low_m, arm_rad
        return Fold(from_rad, None, lowest_rad, lowest_m)


def _between(start: Vec3, end: Vec3, share: float) -> Vec3:
    x, y, z = (a + share * (b - a) for a, b in zip(start, end, strict=True))
    return (x, y, z)
