"""Lowers the feedback of the arm while its joints swing. Pure.

A loop with too much delay for its gain swings, whatever law closes it: joint states that come late, gears softer than the model's, an
armature that is wrong. With less gain it is stable again. The torque of the law beyond the nominal gravity torques counts as feedback.
"""

from __future__ import annotations

import math
from typing import Final

from companion.model.types import Joints

SHARE_MIN: Final = 0.1
"""Least share of the feedback that is left."""
FALL_TIME_S: Final = 0.15
"""Time constant with which the share falls while a joint swings."""
RISE_TIME_S: Final = 10.0
"""Time constant with which it grows again: slowly, as the loop may swing again."""
AGE_MAX_S: Final = 0.045
"""Age of the joint state from which feedback counts as too late for this gain, swinging or not."""
WHOLE: Final = 0.995
"""Share from which on the law's torques are passed unchanged."""


class GainBackoff:
    """The share of the arm's feedback that is passed on."""

    def __init__(self) -> None:
        self.share = 1.0

    def update(self, dt_s: float, swings: bool, age_s: float) -> None:
        """Update with one tick: whether a joint swings (`companion.safety.joint_swing`), and the age of the joint state."""
        if swings or age_s > AGE_MAX_S:
            self.share = max(SHARE_MIN, self.share * math.exp(-dt_s / FALL_TIME_S))
        elif self.share < 1.0:
            self.share += (1.0 - self.share) * (1.0 - math.exp(-dt_s / RISE_TIME_S))
            if self.share > WHOLE:
                self.share = 1.0

    def torque_nm(self, torque_nm: Joints, gravity_nm: Joints) -> Joints:
        """Return the joint torques, N m, with the present share of what they add to the nominal gravity torques; a wrong number of them
        is left to the gate.
        """
        if len(torque_nm) != len(gravity_nm):
            return torque_nm
        return tuple([g + self.share * (nm - g) for nm, g in zip(torque_nm, gravity_nm, strict=True)])
