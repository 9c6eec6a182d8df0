"""Nominal dynamics of the arm in closed form: inertia and Coriolis torque of a 2R arm on a fixed base.

The values equal those of `Dynamics.arm_terms` (a test compares them) at a tenth of the cost. With beta = alpha_2,

    M = [[A + B + 2 C cos beta, -(B + C cos beta)], [., B]] + armature
    Coriolis = C sin beta [alpha_2' (alpha_2' - 2 alpha_1'), alpha_1'^2]
"""

from __future__ import annotations

import math

from companion.config.vehicle import Vehicle
from companion.control.dynamics import Dynamics
from companion.model.types import Joints


class ArmInertia:
    """Inverse dynamics of the arm without gravity."""

    def __init__(self, vehicle: Vehicle) -> None:
        dynamics, armature = Dynamics(vehicle), vehicle.arm.joint_armature_kg_m2
        at_rest: Joints = (0.0, 0.0)
        stretched, bent = (dynamics.arm_terms((0.0, beta), at_rest).mass for beta in (0.0, math.pi / 2))
        self._outer = stretched[1][1] - armature
        self._cross = -stretched[0][1] - self._outer
        self._inner = bent[0][0] - armature - self._outer
        self._armature = armature

    def torque_nm(self, angle_rad: Joints, rate_rad_s: Joints, acceleration_rad_s2: Joints) -> Joints:
        """Return M alpha'' + C alpha', N m."""
        beta = angle_rad[1]
        v1, v2 = rate_rad_s
        a1, a2 = acceleration_rad_s2
        cross, coriolis = self._cross * math.cos(beta), self._cross * math.sin(beta)
        m12 = -(self._outer + cross)
        m11 = self._inner + self._outer + 2.0 * cross + self._armature
        return (
            m11 * a1 + m12 * a2 + coriolis * v2 * (v2 - 2.0 * v1),
            m12 * a1 + (self._outer + self._armature) * a2 + coriolis * v1 * v1,
        )
