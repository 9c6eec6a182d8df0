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

from companion.config.controller import AdaptiveConfig
from companion.control.compensation import FRICTION_RATE_RAD_S
from companion.control.manipulator import Manipulator
from companion.control.zero_order_hold import HoldTable
from companion.model.types import Joints, Matrix, Vec3

Rows = tuple[float, float, float, float, float]


class LoadAdaptation:
    """Load on the rows x, y, z (N) and on both joints (N m), integrated from zero with an exact zero-order hold.

    Args:
        config: rates, leakage and bounds.
        manipulator: relates the moments of the links to joint torques.
    """

    def __init__(self, config: AdaptiveConfig, manipulator: Manipulator) -> None:
        self._manipulator = manipulator
        leakage = config.load_leakage
        self._rate_xyz = config.load_rate_xyz
        self._rate_moment, self._rate_friction = config.moment_rate, config.friction_rate
        self._max_n, self._max_kg_m, self._max_nm = config.load_max_n, config.moment_max_kg_m, config.friction_max_nm
        self.on = self._rate_moment + self._rate_friction + sum(self._rate_xyz) > 0.0

        def held(dt_s: float) -> tuple[float, ...]:
            decay = math.exp(-leakage * dt_s)
            return (decay, (1.0 - decay) / leakage if leakage > 0.0 else dt_s)

        self._held = HoldTable(held)
        self.force_n: Vec3 = (0.0, 0.0, 0.0)
        """Estimated additional force that the rotors must produce, world frame."""
        self.moments_kg_m: Joints = (0.0, 0.0)
        """Estimated first moments of the links about their joints, in addition to the nominal ones."""
        self.friction_nm: Joints = (0.0, 0.0)
        self._levers: Matrix = ((0.0, 0.0), (0.0, 0.0))
        self._turning: Joints = (0.0, 0.0)
        self._wanted_rate_rad_s: Joints = (0.0, 0.0)

    def joint_torque_nm(self, levers_m_s2: Matrix, wanted_rate_rad_s: Joints) -> Joints:
        """Return the torque of the estimated gravity and friction.

        Args:
            levers_m_s2: joint torques of gravity per first moment of each link (`Manipulator.gravity_levers_m_s2`).
            wanted_rate_rad_s: joint rates that the target impedance requests.
        """
        if not self.on:
            return (0.0, 0.0)
        (f1, f2), (r1, r2) = self.friction_nm, wanted_rate_rad_s
        g1, g2 = self._manipulator.moment_torque_nm(levers_m_s2, self.moments_kg_m)
        t1, t2 = self._turning = (math.tanh(r1 / FRICTION_RATE_RAD_S), math.tanh(r2 / FRICTION_RATE_RAD_S))
        self._levers, self._wanted_rate_rad_s = levers_m_s2, wanted_rate_rad_s
        return (g1 + f1 * t1, g2 + f2 * t2)

    def advance(self, dt_s: float, s: Rows, learn: bool) -> None:
        """Integrate one step with s held. Without `learn` the estimates do not change: on the ground and in saturation.

        The friction of a joint changes only while the joint turns in the wanted direction. At rest static friction takes any value up
        to its limit, so s contains no information about that limit, and s phi = -s tanh(s / 0.1) would only raise the estimate.
        """
        if not self.on or not learn:
            return
        decay, step = self._held[dt_s]
        s0, s1, s2, s6, s7 = s
        t1, t2 = self._turning

        def updated(value: float, rate: float, error: float, low: float, high: float) -> float:
            new = decay * value - step * rate * error
            # NaN fails every comparison and leaves the value unchanged: an estimate could never recover from NaN.
            return new if low <= new <= high else low if new < low else high if new > high else value

        (x, y, z), (rx, ry, rz), n = self.force_n, self._rate_xyz, self._max_n
        self.force_n = (updated(x, rx, s0, -n, n), updated(y, ry, s1, -n, n), updated(z, rz, s2, -n, n))
        (m1, m2), rate, most = self.moments_kg_m, self._rate_moment, self._max_kg_m
        p1, p2 = self._manipulator.projected_on_moments(self._levers, (s6, s7))
        self.moments_kg_m = (updated(m1, rate, p1, -most, most), updated(m2, rate, p2, -most, most))
        (f1, f2), (r1, r2), rate, most = self.friction_nm, self._wanted_rate_rad_s, self._rate_friction, self._max_nm
        if (r1 + s6) * t1 > FRICTION_RATE_RAD_S * abs(t1):  # r + s is the measured rate
            f1 = updated(f1, rate, s6 * t1, 0.0, most)
        if (r2 + s7) * t2 > FRICTION_RATE_RAD_S * abs(t2):
            f2 = updated(f2, rate, s7 * t2, 0.0, most)
        self.friction_nm = (f1, f2)
