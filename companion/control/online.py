"""Slow optimisation of the target impedance in flight: one scale of Phi and Lambda on x, y and z (docs/internals/tune.md, In the air).

With the scale k, Phi = k Phi_0 and Lambda = k Lambda_0: the bandwidth of the position is k times that of the mission's gains, its
stiffness Lambda Phi k^2 times. M_d and D stay, so that K_d = D + M_d Phi and K_p = D Phi follow, as in `AdaptiveConfig.with_gains`:
gain_new and gain_cond hold for every k > 0, and gamma does not depend on k.

k rises while the position error is slow, and falls while the vehicle shakes. With a force F = m g tilt, an error of frequency w has the
tilting rate w^3 / g times the error; so RMS(tilting rate) g against w_shake^3 RMS(error) tells on which side of w_shake it is. k stays
within [1/bound, bound], moves at most at `rate_1_s`, and rises only as far as the energy goes that damping has put into a tank.
"""

from __future__ import annotations

import math
from collections.abc import Sequence

from companion.config.controller import OnlineConfig
from companion.control.types import Tuning
from companion.model.constants import GRAVITY_M_S2
from companion.model.types import Chi, Vec3

WINDOW_S = 1.0
"""Time over which error and shaking are averaged; the result is the slope of the scale in the next window."""
QUIET_S = 1.0
"""Time without a disturbance before a window begins."""
BLOW_N = 1.0
"""Difference of the measured force from its mean over `BLOW_TIME_S` that counts as a blow, such as a catch."""
BLOW_TIME_S = 0.5
DT_MAX_S = 0.02
"""Longest time between two ticks with which the optimisation goes on; a longer one means that ticks are missing."""
RATE_LOWPASS_RAD_S = 20.0
"""Of the tilting rate: gyroscopes measure the rotors' vibration, too."""
TANK_SHARE, TANK_MAX_J = 0.5, 0.05
"""Share of the power of damping that enters the tank, and its capacity."""
SHAKES, FALL_FACTOR = -0.5, 10.0
"""Direction below which the vehicle shakes in earnest (three times the error), and how much faster the scale falls then: before the
supervisor has to act. Softer gains release energy, so that no tank limits this.
"""
ERROR_MAX_M2 = 0.06**2
"""Mean square of the position error above which a larger one does not stiffen any more: a gust or a wrong sensor can make the error as
large as it likes, but the scale rises only while the vehicle shakes by less than that.
"""
UNDO_RATE_1_S = 0.3
REPORTED = 0.05
"""Change of the logarithm of the scale that is reported."""


class OnlineImpedance:
    """The scale and its state, from 1 in every flight.

    Args:
        config: bound, rate and shaking frequency.
        inertia: M_d of x, y and z.
        lambda_gain: Lambda of the mission's controller file.
        phi: Phi of the mission's controller file.
    """

    def __init__(
        self, config: OnlineConfig, inertia: Sequence[float], lambda_gain: Sequence[float], phi: Sequence[float]
    ) -> None:
        rows = list(zip(inertia, lambda_gain, phi, strict=True))
        self._damping_n_s_m = [lam + m * p for m, lam, p in rows]
        self._stiffness_n_m = [lam * p for _, lam, p in rows]
        self._most, self._keep = math.log(config.bound), config.keep
        self._rate_1_s = config.rate_1_s
        self._weight_m2_s2 = (GRAVITY_M_S2 / config.shake_rad_s**3) ** 2
        self._log_scale = self._slope_1_s = self._reported = 0.0
        self.scale = 1.0
        """k of the next tick."""
        self.tank_j = 0.0
        self._quiet_s = self._window_s = self._error_m2_s = self._shaking_m2_s = 0.0
        self._clipped = False
        """Whether anything was saturated in this window."""
        self._tilting_rad_s = (0.0, 0.0)
        self._mean_force_n: Vec3 | None = None
        self._report: str | None = None

    def take_report(self) -> str | None:
        """Return the text of a change that has not been reported yet; None if there is none."""
        report, self._report = self._report, None
        return report

    def step(
        self,
        dt_s: float,
        error: Chi,
        error_rate: Chi,
        rate_body_rad_s: Vec3,
        force_n: Vec3,
        clipped: bool,
        tuning: Tuning,
    ) -> bool:
        """Run one tick, and return whether the scale has changed.

        Args:
            dt_s: time since the last tick.
            error: e of the law.
            error_rate: e' of the law.
            rate_body_rad_s: angular rates of the vehicle.
            force_n: measured force on the tool.
            clipped: whether thrust, lateral force or a joint's torque are saturated.
            tuning: what the state of the flight permits.
        """
        shaking_m2 = self._observe(dt_s, error_rate, rate_body_rad_s)
        blow = self._is_blow(dt_s, force_n)
        if tuning is Tuning.UNDO and not self._keep:
            self._restart()
            return self._undo(dt_s, error)
        if tuning is not Tuning.RUN or blow or dt_s > DT_MAX_S:
            self._restart()
            return False
        self._quiet_s += dt_s
        if self._quiet_s < QUIET_S:
            return False
        self._window_s += dt_s
        self._error_m2_s += dt_s * (error[0] ** 2 + error[1] ** 2 + error[2] ** 2)
        self._shaking_m2_s += dt_s * shaking_m2
        self._clipped |= clipped
        if self._window_s >= WINDOW_S:
            self._end_window()
        # A vehicle that shakes saturates in every swing: it may become softer, but not stiffer.
        if clipped and self._slope_1_s > 0.0:
            return False
        return self._move(self._slope_1_s * dt_s, error)

    def _observe(self, dt_s: float, error_rate: Chi, rate_body_rad_s: Vec3) -> float:
        """Fill the tank with a share of the power of damping, and return the shaking."""
        x, y, z = self._damping_n_s_m
        power_w = self.scale * (x * error_rate[0] ** 2 + y * error_rate[1] ** 2 + z * error_rate[2] ** 2)
        self.tank_j = min(TANK_MAX_J, self.tank_j + TANK_SHARE * power_w * dt_s)
        k = 1.0 - math.exp(-RATE_LOWPASS_RAD_S * dt_s)
        roll, pitch = self._tilting_rad_s
        roll, pitch = roll + k * (rate_body_rad_s[0] - roll), pitch + k * (rate_body_rad_s[1] - pitch)
        self._tilting_rad_s = (roll, pitch)
        return self._weight_m2_s2 * (roll * roll + pitch * pitch)

    def _is_blow(self, dt_s: float, force_n: Vec3) -> bool:
        mx, my, mz = self._mean_force_n or force_n
        dx, dy, dz = force_n[0] - mx, force_n[1] - my, force_n[2] - mz
        k = 1.0 - math.exp(-dt_s / BLOW_TIME_S)
        self._mean_force_n = (mx + k * dx, my + k * dy, mz + k * dz)
        return dx * dx + dy * dy + dz * dz > BLOW_N**2

    def _restart(self) -> None:
        self._quiet_s = self._window_s = self._error_m2_s = self._shaking_m2_s = self._slope_1_s = 0.0
        self._clipped = False

    def _end_window(self) -> None:
        """Set the slope of the next window: 1 if the error is slow only, -1 if the vehicle shakes only, times the rates."""
        error_m2, shaking_m2 = self._error_m2_s / self._window_s, self._shaking_m2_s / self._window_s
        self._window_s = self._error_m2_s = self._shaking_m2_s = 0.0
        known_m2 = min(error_m2, ERROR_MAX_M2)
        whole = known_m2 + shaking_m2
        direction = (known_m2 - shaking_m2) / whole if whole > 0.0 else 0.0
        if self._clipped:
            direction, self._clipped = min(direction, 0.0), False
        self._slope_1_s = self._rate_1_s * direction * (1.0 if direction > SHAKES else FALL_FACTOR)
        if abs(self._log_scale - self._reported) >= REPORTED:
            self._say(f"error {1e3 * math.sqrt(error_m2):.1f} mm, shaking {1e3 * math.sqrt(shaking_m2):.1f} mm")

    def _say(self, why: str) -> None:
        self._reported = self._log_scale
        self._report = (
            f"target impedance: Lambda and Phi of x, y and z are {self.scale:.3f} times the mission's ({why})"
        )

    def _move(self, change: float, error: Chi) -> bool:
        """Change the logarithm of the scale within the bounds and what the tank holds; return whether it has changed."""
        before = self._log_scale
        after = max(-self._most, min(self._most, before + change))
        if after == before:
            return False
        if after > before:
            x, y, z = self._stiffness_n_m
            needed_j = 0.5 * (x * error[0] ** 2 + y * error[1] ** 2 + z * error[2] ** 2)
            needed_j *= math.exp(2.0 * after) - math.exp(2.0 * before)
            if not needed_j <= self.tank_j:
                return False
            self.tank_j -= needed_j
        self._log_scale = after
        self.scale = math.exp(after)
        return True

    def _undo(self, dt_s: float, error: Chi) -> bool:
        before, most = self._log_scale, UNDO_RATE_1_S * dt_s
        if not before:
            return False
        changed = self._move(-before if abs(before) <= most else math.copysign(most, -before), error)
        if not self._log_scale and self._reported:
            self._say("undone for the landing")
        return changed
