"""Checks a planned pose of the arm: joint limits, holding torques, rotors, floor, and the way to the folded pose. Pure."""

from __future__ import annotations

import math
from collections.abc import Iterator

from companion.config.vehicle import Vehicle
from companion.control.arm_model import manipulator_of
from companion.mission.arm_clearance import FOLD_STEP_RAD, ArmClearance, Fold
from companion.mission.violation import TOLERANCE, Violation
from companion.model.listing import listed
from companion.model.types import IDENTITY_QUAT, Joints, Reference, Vec3

FLOOR_GAP_M = 0.01
HOLDING_SHARE_MAX = 0.9
"""Largest fraction of a joint's torque that may hold the arm's own weight; the rest is for motion and a payload."""


class ArmCheck:
    """Checks the arm at consecutive instants of a plan."""

    def __init__(self, vehicle: Vehicle) -> None:
        self._vehicle = vehicle
        self._manipulator = manipulator_of(vehicle)
        self._torque_limits_nm = vehicle.joint_torque_limits_nm
        self._clearance = ArmClearance(vehicle)
        self._fold: Fold | None = None
        """The last checked way to the folded pose."""

    def violations(self, position: Vec3, reference: Reference) -> Iterator[Violation]:
        """Return the violations of the reference's pose at a position of the body's origin, world frame, m."""
        arm, arm_rad = self._vehicle.arm, reference.arm_rad
        for number, (angle_rad, joint) in enumerate(zip(arm_rad, arm.joints, strict=True), start=1):
            angle_deg = math.degrees(angle_rad)
            low_deg, high_deg = joint.angle_deg
            excess = max(low_deg - angle_deg, angle_deg - high_deg)
            if excess > TOLERANCE:
                what = f"drives joint {number} beyond its limit"
                detail = f"{angle_deg:.1f} deg (limits {low_deg:g} and {high_deg:g} deg)"
                yield Violation(
                    limit=f"joint {number}", excess=excess, what=what, detail=detail, advice="change arm_deg"
                )
        if not arm.joints:
            return
        gravity_nm = self._manipulator.gravity_torque_nm(arm_rad, IDENTITY_QUAT)
        for number, (torque_nm, limit_nm) in enumerate(zip(gravity_nm, self._torque_limits_nm, strict=True), start=1):
            if abs(torque_nm) > HOLDING_SHARE_MAX * limit_nm:
                yield Violation(
                    limit=f"torque {number}",
                    excess=abs(torque_nm) - HOLDING_SHARE_MAX * limit_nm,
                    what=f"overloads joint {number}",
                    detail=f"the arm's own weight needs {abs(torque_nm):.2f} N m of the {limit_nm:.2f} N m that the joint has "
                    f"(at most {HOLDING_SHARE_MAX:.0%})",
                    advice="choose a pose closer to hanging, a lighter arm or a stronger servo, or raise torque_max_nm",
                )
        contact = self._clearance.rotor_contact(arm_rad)
        if contact is not None:
            yield Violation(
                limit="rotor",
                excess=contact.depth_m,
                what=f"brings {_the(contact.part)} into a rotor",
                detail=contact.text(),
                advice="change arm_deg, or the joint limits arm.joints[].angle_deg",
            )
        drags = False
        for part, (_, _, z_m), radius_m in self._clearance.parts(arm_rad):
            lowest_m = position[2] + z_m - radius_m
            if lowest_m < FLOOR_GAP_M:
                drags = True
                what = f"drags {_the(part)} over the floor"
                detail = f"its lowest point is {lowest_m:.2f} m high (minimum {FLOOR_GAP_M:g} m)"
                yield Violation(
                    limit=f"floor {part}",
                    excess=FLOOR_GAP_M - lowest_m,
                    what=what,
                    detail=detail,
                    advice="fly higher or choose another pose of the arm",
                )
        if contact is None and not drags:
            yield from self._fold_violations(position, arm_rad, rests=not any(reference.arm_rate_rad_s))

    def _fold_violations(self, position: Vec3, arm_rad: Joints, *, rests: bool) -> Iterator[Violation]:
        """Check that the arm can be folded from here; every landing after a fault begins with that."""
        fold = self._fold
        away_rad = math.inf if fold is None else max(abs(a - b) for a, b in zip(arm_rad, fold.from_rad, strict=True))
        if fold is None or away_rad > (0.0 if rests else FOLD_STEP_RAD):
            fold = self._fold = self._clearance.fold(arm_rad)
        low_m = position[2] + fold.lowest_body_m
        if fold.contact is not None:
            limit, excess = "fold rotor", fold.contact.depth_m
            found = f"would bring {_the(fold.contact.part)} into a rotor: {fold.contact.text()}"
        elif low_m < FLOOR_GAP_M:
            limit, excess = "fold floor", FLOOR_GAP_M - low_m
            found = (
                f"would drag the arm over the floor: its lowest point is {low_m:.2f} m high (minimum {FLOOR_GAP_M:g} m)"
            )
        else:
            return
        start, worst = (listed(map(math.degrees, pose), ".0f") for pose in (fold.from_rad, fold.worst_rad))
        yield Violation(
            limit=limit,
            excess=excess,
            what="has a pose from which the arm cannot be folded",
            detail=f"every landing after a fault turns all joints together from ({start}) deg to safety.fold_arm_deg "
            f"({listed(self._vehicle.fold_arm_deg, 'g')}) deg; on the way, ({worst}) deg {found}",
            advice="change arm_deg, or safety.fold_arm_deg",
        )


def _the(part: str) -> str:
    return part if part[-1].isdigit() else f"the {part}"
