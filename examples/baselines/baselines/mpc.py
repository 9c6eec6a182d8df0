"""Linear model-predictive control of the position, 50 solutions per second, after

    J. B. Rawlings, D. Q. Mayne, M. M. Diehl, "Model Predictive Control: Theory, Computation, and Design", 2nd ed., Nob Hill, 2017,
    chapters 1 (no offset) and 2 (terminal cost); for multirotors M. Kamel, T. Stastny, K. Alexis, R. Siegwart, "Model predictive
    control for trajectory tracking of unmanned aerial vehicles using robot operating system", Springer, 2017.

On each axis the state is x = [e, e', r], r the acceleration less the wanted one. The attitude loop (x, y) or the rotors (z) realise an
acceleration with the lag t: r' = (w - r) / t. Every 20 ms the program

    min  sum_{k<N} (q_0 e_k^2 + q_1 e'_k^2 + w_k^2) + x_N' P x_N    with    low <= x''_d - d^ + w_k <= high,  k < N,

is solved for w_0 .. w_{N-1}, and w_0 is held until the next solution. P is the cost of the infinite horizon without limits (discrete
Riccati equation). The unknown acceleration d^ comes from an observer of the velocity with both poles at -l, so that there is no offset
where it is constant. The limits are a square within the tilt limit, and the limits of the thrust. States eliminated, the program has N
variables with bounds, which DAQP solves (D. Arnström, A. Bemporad, D. Axehill, "A dual active-set solver for embedded quadratic
programming using recursive LDL' updates", IEEE T-AC 67(8), 2022) in a workspace that is kept.
"""

from math import exp, radians, sqrt, tan
from typing import ClassVar, Literal

import daqp
import numpy as np

from companion.api.laws import GRAVITY_M_S2, Positive3, TunedGain, Vehicle

from .tick import Array, Baseline, BaselineConfig, Tick

PERIOD_S = 0.02
HORIZON = 20
"""N; the terminal cost stands for what follows."""


class MpcConfig(BaselineConfig):
    """Linear model-predictive control of the position with an estimated disturbance (Rawlings, Mayne and Diehl, 2017)."""

    presets = ("tuned",)
    tuned_gains = (
        *(TunedGain("position_cost_xyz", 5.0, 2000.0, rows) for rows in ((0, 2), (2, 3))),
        *(TunedGain("velocity_cost_xyz", 0.5, 300.0, rows) for rows in ((0, 2), (2, 3))),
        *(TunedGain("observer_rad_s", 0.3, 5.0, rows) for rows in ((0, 2), (2, 3))),
        TunedGain("model_lag_xyz_s", 0.02, 0.3, (0, 2)),
        TunedGain("feedforward_lead_s", 0.01, 0.4),
    )
    law: Literal["mpc"]
    position_cost_xyz: Positive3
    """q_0, 1/s^4; the cost of the input is 1."""
    velocity_cost_xyz: Positive3
    """q_1, 1/s^2."""
    model_lag_xyz_s: Positive3
    """t: lag between commanded and actual acceleration."""
    observer_rad_s: Positive3
    """l: bandwidth of the estimate of the unknown acceleration."""


class Axis:
    """The program of one axis."""

    def __init__(self, position_cost: float, velocity_cost: float, lag_s: float) -> None:
        h, decay = PERIOD_S, exp(-PERIOD_S / lag_s)
        slow = lag_s * (1.0 - decay)
        a = np.array([[1.0, h, lag_s * (h - slow)], [0.0, 1.0, slow], [0.0, 0.0, decay]])
        b = np.array([[h * h / 2.0 - lag_s * (h - slow)], [h - slow], [1.0 - decay]])
        q = np.diag([position_cost, velocity_cost, 0.0])
        p = q
        for _ in range(1000):  # Riccati equation, 20 s ahead
            p = q + a.T @ p @ (a - b @ np.linalg.solve(1.0 + b.T @ p @ b, b.T @ p @ a))
        powers = [np.linalg.matrix_power(a, k) for k in range(HORIZON + 1)]
        free = np.vstack(powers[1:])
        forced = np.zeros((3 * HORIZON, HORIZON))
        for k in range(HORIZON):
            for j in range(k + 1):
                forced[3 * k : 3 * k + 3, j : j + 1] = powers[k - j] @ b
        cost = np.kron(np.eye(HORIZON), q)
        cost[-3:, -3:] = p
        self._linear = forced.T @ cost @ free
        """The linear term of the program is this times the state."""
        hessian = forced.T @ cost @ forced + np.eye(HORIZON)
        self._program, self._ones = daqp.Model(), np.ones(HORIZON)
        self._program.setup(
            hessian,
            np.zeros(HORIZON),
            np.zeros((0, HORIZON)),
            self._ones,
            -self._ones,
            np.zeros(HORIZON, dtype=np.int32),
        )

    def solve(self, state: Array, low: float, high: float) -> float:
        """Return w_0 for the state x and the limits of all w_k."""
        self._program.update(f=self._linear @ state, bupper=high * self._ones, blower=low * self._ones)
        return float(self._program.solve()[0][0])


class MpcLaw(Baseline):
    """The law; each flight makes one."""

    settings: ClassVar = MpcConfig

    def __init__(self, config: MpcConfig, vehicle: Vehicle, hover_thrust: float) -> None:
        super().__init__(config, vehicle, hover_thrust)
        gains = (config.position_cost_xyz, config.velocity_cost_xyz, config.model_lag_xyz_s)
        self._axes = [Axis(*of_axis) for of_axis in zip(*gains, strict=True)]
        g, airframe = GRAVITY_M_S2, vehicle.airframe
        lateral = min(g * tan(radians(airframe.tilt_max_deg)), config.lateral_force_max_n / self.mass_kg) / sqrt(2.0)
        lift = min(0.9 * airframe.thrust_max_n / self.mass_kg, 0.9 / hover_thrust * g) - g
        self._low, self._high = np.array((-lateral, -lateral, -0.7 * g)), np.array((lateral, lateral, lift))
        self._l = np.array(config.observer_rad_s)
        self._velocity, self._d = np.zeros(3), np.zeros(3)
        self._w, self._limited, self._until_next_s = np.zeros(3), False, 0.0

    def acceleration(self, tick: Tick) -> Array:
        """Return x''_d - d^ + w."""
        self._observe(tick)
        feed = tick.wanted_m_s2 - self._d
        self._until_next_s -= tick.dt_s
        if self._until_next_s < tick.dt_s / 2.0:
            self._until_next_s = max(0.0, self._until_next_s + PERIOD_S)
            low, high = self._low - feed, self._high - feed
            states = np.column_stack((tick.e, tick.e_dot, tick.known_n / self.mass_kg - feed))
            solved = [axis.solve(*of_axis) for axis, *of_axis in zip(self._axes, states, low, high, strict=True)]
            self._w = np.array(solved)
            self._limited = bool(np.any((self._w <= low + 1e-6) | (self._w >= high - 1e-6)))
        wanted: Array = feed + self._w
        return wanted

    def _observe(self, tick: Tick) -> None:
        if tick.learn and not self._limited:
            innovation = tick.velocity_m_s - self._velocity
            rate = tick.known_n / self.mass_kg + self._d + 2.0 * self._l * innovation
            self._velocity = self._velocity + tick.dt_s * rate
            self._d = self._d + tick.dt_s * self._l**2 * innovation
        else:
            self._velocity = tick.velocity_m_s
