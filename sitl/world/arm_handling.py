"""A simulated user who holds the arm while it is limp and moves it through the poses of `companion arm zero`."""

from __future__ import annotations

from typing import Final

from companion.commissioning.arm.poses import steps_of
from companion.config.arm import Arm
from companion.model.types import Joints

MOVE_S: Final = 2.0
FORGET_S: Final = 1.5
"""Time without a lit LED after which the sequence of poses restarts."""


class ArmHandling:
    """Computes the angles at which the joints are held.

    Args:
        arm: arm of the vehicle file; its joint limits define the poses.
    """

    def __init__(self, arm: Arm, angle_rad: Joints) -> None:
        self._poses = [step.hand_rad for step in steps_of(arm)]
        self._from = self._to = self._at = angle_rad
        self._moved_s = -MOVE_S
        self._lit_s = -FORGET_S
        self._seen = self._next = 0
        self._limp = True

    def angles_rad(self, t_s: float, limp: bool, angle_rad: Joints, lights: int, lit: bool) -> Joints | None:
        """Return the joint angles to hold now, or None while the servos hold the arm.

        Args:
            limp: whether torque is off on all servos.
            lights: number of times that an LED was switched on; each time, the arm is moved to the next pose.
        """
        if limp and not self._limp:
            self._from = self._to = self._at = angle_rad
        self._limp = limp
        if not limp:
            return None
        if lights != self._seen:
            if t_s - self._lit_s > FORGET_S:
                self._next = 0
            self._seen = lights
            self._from, self._to, self._moved_s = self._at, self._poses[self._next], t_s
            self._next = (self._next + 1) % len(self._poses)
        if lit:
            self._lit_s = t_s
        s = min(1.0, (t_s - self._moved_s) / MOVE_S)
        s = s * s * s * (10.0 - 15.0 * s + 6.0 * s * s)
        self._at = tuple(a + s * (b - a) for a, b in zip(self._from, self._to, strict=True))
        return self._at
