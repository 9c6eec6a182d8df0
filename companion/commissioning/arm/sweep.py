"""Straight motions of one joint after the other: a jog to an angle, and the sweeps that measure friction. No I/O."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Final

from companion.commissioning.arm.motion import Motion, Moved, limits_deg
from companion.config.document import ConfigError
from companion.config.vehicle import Vehicle
from companion.control.arm_model import manipulator_of
from companion.model.types import IDENTITY_QUAT, ArmState, Joints

SPEEDS_DEG_S: Final = (9.0, 18.0)
REACH_DEG: Final = ((-30.0, 30.0), (-5.0, 70.0))
"""Sweep of the first joint and of every other one about the hanging pose, within its limits."""
REACH_MIN_DEG: Final = 20.0
SETTLED_S: Final = 0.4
"""Time at constant speed before a sample counts."""
HELD_UP_S: Final = 0.1
"""Gap between two samples after which the joint has to settle again."""
_SEARCHES: Final = 100
_WEIGHTLESS_NM: Final = 1e-9
_FOUND_RAD: Final = 1e-6


@dataclass(frozen=True, slots=True)
class Leg:
    """One straight motion."""

    joint: int
    goal_deg: float
    speed_deg_s: float
    counts: bool = False
    """Whether its samples are used for the fit."""


@dataclass(frozen=True, slots=True)
class Sample:
    """One sample of a joint at constant speed."""

    leg: int
    joint: int
    direction: int
    t_s: float
    angle_rad: Joints
    velocity_rad_s: float
    current_a: float
    """Motor current, positive in the direction of the joint angle."""


def hanging_deg(vehicle: Vehicle) -> Joints:
    """Return the pose in which the arm hangs freely, deg, within the joint limits minus a margin.

    Along one joint the potential energy is a sine, whose minimum follows from the gravity torque here and 90 deg further. This is
    repeated joint by joint until no joint moves. A joint without weight, such as one with a vertical axis, stays at 0.
    """
    manipulator, count = manipulator_of(vehicle), len(vehicle.arm.joints)
    limits = [tuple(map(math.radians, limits_deg(vehicle.arm, joint))) for joint in range(count)]
    pose = [max(low, min(high, 0.0)) for low, high in limits]
    for _ in range(_SEARCHES):
        moved_rad = 0.0
        for joint, (low, high) in enumerate(limits):
            here, further = list(pose), list(pose)
            further[joint] += math.pi / 2.0
            p = manipulator.gravity_torque_nm(tuple(here), IDENTITY_QUAT)[joint]
            q = manipulator.gravity_torque_nm(tuple(further), IDENTITY_QUAT)[joint]
            if math.hypot(p, q) > _WEIGHTLESS_NM:
                pose[joint] = max(low, min(high, pose[joint] + math.atan2(-p, q)))
                moved_rad = max(moved_rad, abs(pose[joint] - here[joint]))
        if moved_rad < _FOUND_RAD:
            break
    return tuple(round(math.degrees(angle), 6) + 0.0 for angle in pose)


def legs_of(vehicle: Vehicle) -> tuple[Leg, ...]:
    """Return the sweeps: to the hanging pose, each joint back and forth at each speed, then to the hanging pose, to go limp.

    Raises:
        ConfigError: the joint limits leave too small a range.
    """
    home, fast = hanging_deg(vehicle), SPEEDS_DEG_S[-1]
    legs = [Leg(joint, angle_deg, fast) for joint, angle_deg in enumerate(home)]
    for joint, angle_deg in enumerate(home):
        (low, high), (down, up) = limits_deg(vehicle.arm, joint), REACH_DEG[min(joint, 1)]
        begin, end = max(low, angle_deg + down), min(high, angle_deg + up)
        if end - begin < REACH_MIN_DEG:
            room = f"about the hanging pose and within its limits joint {joint + 1} can turn {max(0.0, end - begin):.0f} deg"
            why = f"at least {REACH_MIN_DEG:g} deg are needed to separate gravity from friction"
            raise ConfigError(f"arm.joints[{joint}].angle_deg: {room}; {why}")
        legs.append(Leg(joint, begin, fast))
        for speed in SPEEDS_DEG_S:
            legs += [Leg(joint, end, speed, True), Leg(joint, begin, speed, True)]
        legs.append(Leg(joint, angle_deg, fast))
    return tuple(legs)


def duration_s(legs: Sequence[Leg], start_deg: Joints) -> float:
    """Return the approximate duration of the legs, s."""
    at = list(start_deg)
    total = 0.0
    for leg in legs:
        total += abs(leg.goal_deg - at[leg.joint]) / leg.speed_deg_s + 0.5
        at[leg.joint] = leg.goal_deg
    return total


class Sweeper:
    """Leader that moves the arm through the legs and keeps the samples for the fit.

    Args:
        torque_constants_nm_a: the constant of each joint by which the arm's driver converts currents to torques.
    """

    def __init__(self, legs: Sequence[Leg], torque_constants_nm_a: Sequence[float]) -> None:
        self.legs = legs
        self._nm_a = torque_constants_nm_a
        self.samples: list[Sample] = []
        self._leg = -1
        self._steady_since_s: float | None = None
        self._stamp_s = 0.0

    def begin(self, state: ArmState) -> list[Joints]:
        """Return every pose from here to the end of the last leg."""
        at, poses = list(state.angle_rad), [state.angle_rad]
        for leg in self.legs:
            at[leg.joint] = math.radians(leg.goal_deg)
            poses.append(tuple(at))
        return poses

    def update(self, motion: Motion, moved: Moved | None, state: ArmState) -> bool:
        """Store the sample, and begin the next leg when one ends. Return True after the last leg."""
        if moved is not None and 0 <= self._leg < len(self.legs):
            self._note(moved, state)
        if self._leg < 0 or (moved is not None and moved.reached):
            self._leg += 1
            self._steady_since_s = None
            if self._leg < len(self.legs):
                leg = self.legs[self._leg]
                motion.go(leg.joint, math.radians(leg.goal_deg), math.radians(leg.speed_deg_s))
        return self._leg >= len(self.legs)

    def status(self) -> str:
        """Return the current motion for display."""
        if not 0 <= self._leg < len(self.legs):
            return ""
        leg = self.legs[self._leg]
        how = f"at {leg.speed_deg_s:g} deg/s" if leg.counts else "on the way"
        return f"{self._leg + 1}/{len(self.legs)}  joint {leg.joint + 1} to {leg.goal_deg:.0f} deg, {how}"

    def _note(self, moved: Moved, state: ArmState) -> None:
        leg = self.legs[self._leg]
        rate = moved.reference_rate_rad_s[leg.joint]
        if not leg.counts or abs(abs(rate) - math.radians(leg.speed_deg_s)) > 1e-9:
            self._steady_since_s = None
            return
        if self._steady_since_s is None or state.stamp_s - self._stamp_s > HELD_UP_S:
            self._steady_since_s = state.stamp_s
        self._stamp_s = state.stamp_s
        if state.stamp_s - self._steady_since_s < SETTLED_S:
            return
        if self.samples and self.samples[-1].t_s == state.stamp_s:
            return
        self.samples.append(
            Sample(
                leg=self._leg,
                joint=leg.joint,
                direction=1 if rate > 0.0 else -1,
                t_s=state.stamp_s,
                angle_rad=state.angle_rad,
                velocity_rad_s=state.velocity_rad_s[leg.joint],
                current_a=state.torque_nm[leg.joint] / self._nm_a[leg.joint],
            )
        )
