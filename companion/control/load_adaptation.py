"""Adaptive estimates of loads that are linear in unknown constants, which the paper's norm-bounding gains cannot cancel.

    theta' = Gamma phi' s - nu_theta theta,    each theta_i projected to its bounds

phi holds a constant for each of x, y and z (an unknown force: weight, wind, tilt, rotors that lose thrust), the levers of gravity of
both links (their first moments, payload included), and the commanded direction of motion of each joint (dry friction). tau contains the
estimated load. With V_theta = (theta - theta*)' Gamma^-1 (theta - theta*) / 2 added to the paper's Lyapunov function, the term s' phi
(theta* - theta) of V' cancels for constant theta*; leakage, projection and a load that varies leave a bounded remainder, as the leakage
of H does (eq. adaptive_law_full). s is integrated and not e: at s = 0 the target impedance holds, so a measured force still moves the
arm according to K_d and K_p.
"""

from __future__ import annotations

import math
from collections.abc import Sequence

from companion.config.controller import AdaptiveConfig, fitted
from companion.control.compensation import FRICTION_RATE_RAD_S
from companion.control.manipulator import Manipulator
from companion.control.zero_order_hold import HoldTable
from companion.model.types import Chi, Joints, Matrix, Vec3


class LoadAdaptation:
    """Load on the rows x, y, z (N) and on the joints (N m), integrated from zero with an exact zero-order hold.

    Args:
        config: rates, leakage and bounds.
        manipulator: relates the moments of the links to joint torques.
    """

    def __init__(self, config: AdaptiveConfig, manipulator: Manipulator) -> None:
        self._manipulator = manipulator
        leakage = config.load_leakage
        self._rate_xyz = config.load_rate_xyz
        count = manipulator.joint_count
        rates = fitted(config.moment_rate, count), fitted(config.friction_rate, count)
        self._rates = list(zip(range(count), *rates, strict=True))
        """Number of each joint, and the rates of its link's first moment and of its friction."""
        self._max_n, self._max_kg_m, self._max_nm = config.load_max_n, config.moment_max_kg_m, config.friction_max_nm
        self.on = sum(map(sum, (self._rate_xyz, *rates))) > 0.0

        def held(dt_s: float) -> tuple[float, ...]:
            decay = math.exp(-leakage * dt_s)
            return (decay, (1.0 - decay) / leakage if leakage > 0.0 else dt_s)

        self._held = HoldTable(held)
        self.force_n: Vec3 = (0.0, 0.0, 0.0)
        """Estimated additional force that the rotors must produce, world frame."""
        nothing: Joints = (0.0,) * count
        self.moments_kg_m: Joints = nothing
        """Estimated first moments of the links about their joints, in addition to the nominal ones."""
        self.friction_nm: Joints = nothing
        self._levers: Matrix = (nothing,) * count
        self.wanted_rate_rad_s: Sequence[float] = nothing
        """Joint rates that the target impedance requests in this tick; set before `advance`."""
        self.direction: Sequence[float] = nothing
        """Directions of these rates, tanh(rate / FRICTION_RATE_RAD_S); set before `advance`."""

    def gravity_torque_nm(self, levers_m_s2: Matrix) -> Joints:
        """Return the joint torques that hold the estimated moments against gravity.

        Args:
            levers_m_s2: joint torques of gravity per first moment of each link (`Manipulator.gravity_levers_m_s2`).
        """
        self._levers = levers_m_s2
        return self._manipulator.moment_torque_nm(levers_m_s2, self.moments_kg_m)

    def advance(self, dt_s: float, s: Chi, learn: bool) -> None:
        """Integrate one step with s held. Without `learn` the estimates do not change: on the ground and in saturation.

        The friction of a joint changes only while the joint turns in the wanted direction. At rest static friction takes any value up
        to its limit, so s contains no information about that limit, and s phi = -s tanh(s / 0.1) would only raise the estimate.
        """
        if not self.on or not learn:
            return
        decay, step = self._held[dt_s]
        x, y, z = self.force_n
        rx, ry, rz = self._rate_xyz
        most = self._max_n
        x_new = decay * x - step * rx * s[0]
        y_new = decay * y - step * ry * s[1]
        z_new = decay * z - step * rz * s[2]
        if not (-most <= x_new <= most and -most <= y_new <= most and -most <= z_new <= most):
            x_new, y_new, z_new = (
                _projected(x_new, x, -most, most),
                _projected(y_new, y, -most, most),
                _projected(z_new, z, -most, most),
            )
        self.force_n = (x_new, y_new, z_new)
        rates, directions, s_joints = self.wanted_rate_rad_s, self.direction, s[6:]
        by_moments = self._manipulator.projected_on_moments(self._levers, s_joints)
        moments, frictions = [], []
        most, most_nm = self._max_kg_m, self._max_nm
        old_moments, old_frictions = self.moments_kg_m, self.friction_nm
        for joint, rate_moment, rate_friction in self._rates:
            moment, friction = old_moments[joint], old_frictions[joint]
            error, direction = s_joints[joint], directions[joint]
            new = decay * moment - step * rate_moment * by_moments[joint]
            moments.append(new if -most <= new <= most else _projected(new, moment, -most, most))
            # The wanted rate + s is the measured rate.
            if (rates[joint] + error) * direction > FRICTION_RATE_RAD_S * abs(direction):
                new = decay * friction - step * rate_friction * (error * direction)
                friction = new if 0.0 <= new <= most_nm else _projected(new, friction, 0.0, most_nm)
            frictions.append(friction)
        self.moments_kg_m, self.friction_nm = tuple(moments), tuple(frictions)


def _projected(new: float, before: float, low: float, high: float) -> float:
    """Return the new value within its bounds, or the value before if the new one is NaN, from which an estimate could never recover."""
    return low if new < low else high if new > high else new if low <= new else before
