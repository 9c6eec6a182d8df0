"""Joint angles and rates at the time of the tick, from a joint state that is late. Pure.

A servo measures when it is asked; adapters, a busy bus and a busy computer deliver the answer milliseconds later. A control law that
took it for the present would lose the phase margin of its damping: from 8 ms on the arm swings at 16 Hz (docs/internals/control-law.md,
section Late joint states).
"""

from __future__ import annotations

import math
from collections import deque
from typing import Final

from companion.config.vehicle import Vehicle
from companion.model.types import ArmState, Joints

AGE_MAX_S: Final = 0.02
"""Longest time over which a joint state is predicted."""
MEAN_TIME_S: Final = 0.05
"""Time constant of the mean torque. It carries the load of the joint and does not accelerate it; what differs from it does."""
_KEPT: Final = 32


class JointPrediction:
    """Adds to a joint state what the commanded torques have changed since it was measured.

    Within milliseconds a torque turns the rotor and the gears, the joint's armature J, before the links follow: alpha' grows by the
    impulse of the torque beyond its mean, divided by J.

    Args:
        vehicle: vehicle file with the armatures.
    """

    def __init__(self, vehicle: Vehicle) -> None:
        self._armatures_kg_m2 = vehicle.arm.armatures_kg_m2
        self._mean_nm: Joints | None = None
        self._sent: deque[tuple[float, Joints, Joints]] = deque(maxlen=_KEPT)
        """Time of each command, the impulse of all commands before it, N m s, and its torque beyond the mean, N m."""

    def now(self, t_s: float, arm: ArmState) -> tuple[Joints, Joints]:
        """Return angles and rates at time `t_s` on the flight clock."""
        age_s = min(t_s - arm.measured_s, AGE_MAX_S)
        if not (age_s > 0.0 and self._sent):
            return arm.angle_rad, arm.velocity_rad_s
        before, after = self._impulse_nms(t_s - age_s), self._impulse_nms(t_s)
        angles, rates = [], []
        for joint, armature_kg_m2 in enumerate(self._armatures_kg_m2):
            rate = arm.velocity_rad_s[joint]
            change = (after[joint] - before[joint]) / armature_kg_m2 if armature_kg_m2 > 0.0 else 0.0
            angles.append(arm.angle_rad[joint] + (rate + 0.5 * change) * age_s)
            rates.append(rate + change)
        return tuple(angles), tuple(rates)

    def sent(self, t_s: float, torque_nm: Joints | None) -> None:
        """Remember the torques commanded at time `t_s`; None if the arm gets none. These and unusable ones
        end all knowledge of what was commanded.
        """
        if torque_nm is None or len(torque_nm) != len(self._armatures_kg_m2) or not math.isfinite(sum(torque_nm)):
            self._sent.clear()
            self._mean_nm = None
            return
        mean, impulse = self._mean_nm, (0.0,) * len(torque_nm)
        if mean is None or not self._sent:
            mean = torque_nm
        else:
            k = 1.0 - math.exp((self._sent[-1][0] - t_s) / MEAN_TIME_S)
            mean = tuple([m + k * (nm - m) for m, nm in zip(mean, torque_nm, strict=True)])
            impulse = self._impulse_nms(t_s)
        self._mean_nm = mean
        self._sent.append((t_s, impulse, tuple([nm - m for nm, m in zip(torque_nm, mean, strict=True)])))

    def _impulse_nms(self, t_s: float) -> Joints:
        """Return the impulse of the torques beyond their mean until `t_s`."""
        for sent_s, impulse, beyond in reversed(self._sent):
            if sent_s <= t_s:
                return tuple([j + nm * (t_s - sent_s) for j, nm in zip(impulse, beyond, strict=True)])
        return self._sent[0][1]
