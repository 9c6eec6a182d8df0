"""Adaptive estimates of loads that are linear in unknown constants, which the paper's norm-bounding gains cannot cancel.

    theta' = -Gamma Y' s - nu_theta theta,    each theta_i projected to its bounds

Y holds a constant for each of x, y and z (an unknown force: weight, wind, tilt, rotors that lose thrust), the levers of gravity of
the links (their first moments, payload included), and the commanded direction of motion of each joint (dry friction). tau contains
the estimated load Y theta. With V_theta = (theta - theta*)' Gamma^-1 (theta - theta*) / 2 added to the paper's Lyapunov function, the
term s' Y (theta - theta*) of V' cancels for constant theta*; leakage, projection and a load that varies leave a bounded remainder, as
the leakage of H does (eq. adaptive_law_full). s is integrated and not e: at s = 0 the target impedance holds, so a measured force
still moves the arm according to K_d and K_p.
"""

from __future__ import annotations

import math
from typing import Final

from companion.config.controller import AdaptiveConfig
from companion.config.gains import fitted
from companion.control.compensation import FRICTION_RATE_RAD_S
from companion.control.manipulator import Manipulator
from companion.model.types import Chi, Joints, Matrix, Vec3


class Estimate:
    """One unknown constant theta, integrated from zero with an exact zero-order hold.

    Args:
        rate: Gamma; 0 switches the estimate off.
        leakage: nu_theta, 1/s.
        low, high: bounds of theta.
    """

    def __init__(self, rate: float, leakage: float, low: float, high: float) -> None:
        self._rate: Final = rate
        self._leakage: Final = leakage
        self._low: Final = low
        self._high: Final = high
        self._dt_s, self._decay, self._growth_s = -1.0, 0.0, 0.0
        self.theta = 0.0

    def advance(self, dt_s: float, y_s: float) -> None:
        """Integrate theta' over one step with Y' s held. NaN, from which an estimate could never recover, changes nothing."""
        if dt_s != self._dt_s:  # most ticks have the same
            self._dt_s, self._decay = dt_s, math.exp(-self._leakage * dt_s)
            self._growth_s = (1.0 - self._decay) / self._leakage if self._leakage > 0.0 else dt_s
        new = self._decay * self.theta - self._growth_s * self._rate * y_s
        if self._low <= new <= self._high:
            self.theta = new
        elif new == new:
            self.theta = self._low if new < self._low else self._high


class LoadAdaptation:
    """Y theta on all rows.

    Args:
        config: rates, leakage and bounds.
        manipulator: relates the moments of the links to joint torques.
    """

    def __init__(self, config: AdaptiveConfig, manipulator: Manipulator) -> None:
        self._manipulator = manipulator
        count, leakage = manipulator.joint_count, config.load_leakage
        moment_rates, friction_rates = fitted(config.moment_rate, count), fitted(config.friction_rate, count)
        most_n, most_kg_m, most_nm = config.load_max_n, config.moment_max_kg_m, config.friction_max_nm
        self.on = sum(map(sum, (config.load_rate_xyz, moment_rates, friction_rates))) > 0.0
        self._forces = [Estimate(rate, leakage, -most_n, most_n) for rate in config.load_rate_xyz]
        self._moments = [Estimate(rate, leakage, -most_kg_m, most_kg_m) for rate in moment_rates]
        self._frictions = [Estimate(rate, leakage, 0.0, most_nm) for rate in friction_rates]
        self._nothing = [0.0] * (6 + count)
        self._levers_m_s2: Matrix = ()
        self._directions: Joints = ()

    @property
    def force_n(self) -> Vec3:
        """Return the estimated additional force that the rotors must produce, world frame."""
        x, y, z = self._forces
        return (x.theta, y.theta, z.theta)

    @property
    def moments_kg_m(self) -> Joints:
        """Return the estimated first moments of the links about their joints, in addition to those that the law knows."""
        return tuple([estimate.theta for estimate in self._moments])

    @property
    def friction_nm(self) -> Joints:
        """Return the estimated dry friction of each joint."""
        return tuple([estimate.theta for estimate in self._frictions])

    def tau(self, levers_m_s2: Matrix, rates_rad_s: Joints) -> list[float]:
        """Return Y theta for all rows: force, and torques that hold the moments against gravity and overcome friction. Y is kept.

        Args:
            levers_m_s2: joint torques of gravity per first moment of each link (`Manipulator.gravity_levers_m_s2`).
            rates_rad_s: requested rate of each joint.
        """
        if not self.on:
            return self._nothing
        self._levers_m_s2 = levers_m_s2
        self._directions = tuple([math.tanh(rate / FRICTION_RATE_RAD_S) for rate in rates_rad_s])
        tau = [*self.force_n, 0.0, 0.0, 0.0, *self._manipulator.moment_torque_nm(levers_m_s2, self.moments_kg_m)]
        for joint, direction in enumerate(self._directions):
            tau[6 + joint] += self._frictions[joint].theta * direction
        return tau

    def advance(self, dt_s: float, s: Chi, rates_rad_s: Joints) -> None:
        """Integrate theta over one step with Y of the last `tau` and s held.

        The friction of a joint changes only while the joint turns in the requested direction, faster than `FRICTION_RATE_RAD_S`. At
        rest static friction takes any value up to its limit, so s contains no information about that limit, and s Y = -s tanh(s /
        0.1) would only raise the estimate.

        Args:
            dt_s: step.
            s: all rows.
            rates_rad_s: measured rates of the joints.
        """
        if not self.on:
            return
        for i, force in enumerate(self._forces):
            force.advance(dt_s, s[i])
        y_s = self._manipulator.projected_on_moments(self._levers_m_s2, s[6:])
        for joint, direction in enumerate(self._directions):
            self._moments[joint].advance(dt_s, y_s[joint])
            if rates_rad_s[joint] * direction > FRICTION_RATE_RAD_S * abs(direction):
                self._frictions[joint].advance(dt_s, s[6 + joint] * direction)
