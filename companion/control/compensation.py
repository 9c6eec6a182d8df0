"""Optional compensation for every control law: measured force, estimated disturbances, delay of the attitude loop, joint friction.

All laws share it, so that they can be compared with the same options.
"""

from __future__ import annotations

import math
from typing import Final

from companion.config.controller import LawConfig
from companion.config.vehicle import Vehicle
from companion.control.disturbance import DisturbanceObserver
from companion.control.types import PlantState
from companion.model.constants import GRAVITY_M_S2
from companion.model.types import Joints, Reference, Vec3

FRICTION_RATE_RAD_S: Final = 0.1
"""Joint rate below which the friction torque fades out, so that a joint at rest does not shake."""


class Compensation:
    """Computes forces and torques in addition to those of a control law.

    Args:
        config: configuration of the law.
        vehicle: the nominal vehicle.
        answered_xyz: fraction of the measured force, per world axis, that the law yields to or cancels itself; the observer does
            not estimate it.
        inertia_xy_kg: inertia along x and y that the law imposes on the base, used for the feedforward's lead.
    """

    def __init__(
        self, config: LawConfig, vehicle: Vehicle, answered_xyz: Vec3, inertia_xy_kg: tuple[float, ...]
    ) -> None:
        mass_kg = vehicle.airframe.mass_kg
        self._weight_n = mass_kg * GRAVITY_M_S2
        self._observer = DisturbanceObserver(
            mass_kg, config.disturbance_time_xyz_s, config.disturbance_lag_s, config.disturbance_max_n
        )
        self._force_share = config.force_feedforward_xyz
        self._lead_s = config.feedforward_lead_s
        self._inertia_xy_kg = inertia_xy_kg
        x, y, z = (min(1.0, fed + own) for fed, own in zip(self._force_share, answered_xyz, strict=True))
        self._accounted: Vec3 = (x, y, z)
        self._known_n: Vec3 = (0.0, 0.0, 0.0)
        """Known force on the base in the last tick: rotors, weight, and the part of the measured force that is accounted for."""
        self.friction_nm = config.arm_friction_share * vehicle.arm.joint_friction_nm
        """Friction of each joint that is fed forward."""

    def observe(self, dt_s: float, state: PlantState, learn: bool) -> None:
        """Run the disturbance observer for one tick; without `learn` its estimate does not change."""
        if self._observer.on:
            self._observer.step(dt_s, self._known_n, state.acceleration_world_m_s2, learn)

    def base_force_n(self, wanted_n: Vec3, force: Vec3, reference: Reference) -> Vec3:
        """Return `wanted_n` less the share of the measured force and the estimated disturbance, plus inertia times lead times jerk, and
        plus the push on a surface, world frame.
        """
        shares, disturbance = self._force_share, self._observer.force_n
        x, y, z = [w - (shares[i] * force[i] + disturbance[i]) for i, w in enumerate(wanted_n)]
        if self._lead_s > 0.0:
            x += self._inertia_xy_kg[0] * self._lead_s * reference.jerk_world_m_s3[0]
            y += self._inertia_xy_kg[1] * self._lead_s * reference.jerk_world_m_s3[1]
        for push in (reference.push_world_n, reference.slide_world_n):
            if push is not None:
                x, y, z = x + push[0], y + push[1], z + push[2]
        return (x, y, z)

    def joint_torque_nm(self, torque_nm: Joints, wanted_rate_rad_s: Joints) -> Joints:
        """Return the torques with friction added along the wanted joint rates. Measured rates would shake a joint at rest."""
        if self.friction_nm == 0.0:
            return torque_nm
        with_friction = []
        for joint, torque in enumerate(torque_nm):
            with_friction.append(torque + self.friction_nm * math.tanh(wanted_rate_rad_s[joint] / FRICTION_RATE_RAD_S))
        return tuple(with_friction)

    def remember(self, sent_n: Vec3, force: Vec3) -> None:
        """Store the force that was sent, and the part of the measured force that is accounted for, for the observer."""
        if not self._observer.on:
            return
        x, y, z = sent_n
        f0, f1, f2 = force
        c0, c1, c2 = self._accounted
        self._known_n = (x + c0 * f0, y + c1 * f1, z + c2 * f2 - self._weight_n)
