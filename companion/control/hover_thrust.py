"""Estimator of the hover thrust in flight: the normalised thrust that carries the vehicle without payload. Pure; time is an argument.

The balance along body z, with the vehicle as one mass, is (m g / h) u = m f_z - F_z, where u is the thrust that the rotors produce now
(the commanded thrust after delay and rotor lag), h the hover thrust, f_z the specific force along body z (IMU) and F_z the measured
force on the net. A caught payload acts on the sensor and does not change h. The remaining changes of h come from battery, propellers,
air density and the true mass.
"""

from __future__ import annotations

import math
from typing import Final

from companion.control.types import PlantState
from companion.model.constants import GRAVITY_M_S2
from companion.model.frames import body_z_component
from companion.model.types import Inputs, LandedState, Quat, Vec3

SHARE_MAX = 0.25
"""Largest relative deviation of the estimate from its start value. It keeps a faulty accelerometer from making the vehicle sink."""
AIRBORNE_M: Final = 0.10
"""Height above standing height at which the ground no longer carries the vehicle, m."""
_LAG_S: Final = 0.05
"""Lag from command to thrust: transmission and rotors. Its exact value does not matter because the estimator's time constants are
seconds.
"""
_TIME_MIN_S: Final = 1.0
_TIME_MAX_S: Final = 6.0
"""Minimum and maximum averaging time. The estimate is a running mean over the time in the air, limited to this range."""
_TILT_COS_MIN: Final = math.cos(math.radians(15.0))
_ACCELERATION_MAX_M_S2: Final = 1.5
_ACCELERATION_LOWPASS_S: Final = 0.05


class Balance:
    """Thrust and load of each tick in which the balance is valid."""

    def __init__(self, mass_kg: float) -> None:
        self._mass_kg = mass_kg
        self._thrust: float | None = None
        self._acceleration_z_m_s2 = 0.0

    def step(
        self, dt_s: float, thrust_sent: float, acceleration_world_m_s2: Vec3, force_world_n: Vec3, attitude_wxyz: Quat
    ) -> tuple[float, float] | None:
        """Return the normalised thrust that the rotors produce now, and the load divided by the weight (1 in hover without payload).

        Return None while the vehicle is tilted or accelerates strongly, or the command is at its limits.
        """
        before = thrust_sent if self._thrust is None else self._thrust
        self._thrust = before + (1.0 - math.exp(-dt_s / _LAG_S)) * (thrust_sent - before)
        ax, ay, az = acceleration_world_m_s2
        jerked = self._acceleration_z_m_s2
        jerked += (1.0 - math.exp(-dt_s / _ACCELERATION_LOWPASS_S)) * (az - jerked)
        self._acceleration_z_m_s2 = jerked
        _, qx, qy, _ = attitude_wxyz
        leaning = 1.0 - 2.0 * (qx * qx + qy * qy) < _TILT_COS_MIN
        if leaning or abs(jerked) > _ACCELERATION_MAX_M_S2 or not 0.0 < thrust_sent < 1.0:
            return None
        m, g = self._mass_kg, GRAVITY_M_S2
        fx, fy, fz = force_world_n
        carried_m_s2 = body_z_component(attitude_wxyz, (ax - fx / m, ay - fy / m, az + g - fz / m))
        return self._thrust, carried_m_s2 / g


class HoverThrust:
    """Estimator of the hover thrust.

    Args:
        start: initial hover thrust (PX4's MPC_THR_HOVER or the vehicle file), 0 to 1.
        mass_kg: nominal mass of the whole vehicle without payload.
    """

    def __init__(self, start: float, mass_kg: float) -> None:
        self._balance = Balance(mass_kg)
        self._low, self._high = (1.0 - SHARE_MAX) * start, (1.0 + SHARE_MAX) * start
        self._learnt_s = 0.0
        self.value = start

    def step(self, dt_s: float, thrust_sent: float, state: PlantState, airborne: bool, carrying: bool) -> float:
        """Run one tick and return the estimate, 0 to 1.

        Args:
            dt_s: time since the last step.
            thrust_sent: normalised thrust sent in the last tick. The estimate does not change while the thrust is at its limits.
            state: state of this tick.
            airborne: whether only the rotors carry the vehicle.
            carrying: whether a payload was caught; without a force sensor the estimate is then frozen.
        """
        force = state.force_ext_world_n
        # The filters are always updated, so that learning does not start from stale values.
        balance = self._balance.step(
            dt_s, thrust_sent, state.acceleration_world_m_s2, force or (0.0, 0.0, 0.0), state.attitude_wxyz
        )
        if balance is None or not airborne or (carrying and force is None):
            return self.value
        thrust, load = balance
        self._learnt_s += dt_s
        time_s = self._learnt_s
        time_s = _TIME_MIN_S if time_s < _TIME_MIN_S else time_s if time_s < _TIME_MAX_S else _TIME_MAX_S
        # Linear in the noisy load, so that its noise leaves no bias.
        value = self.value + dt_s / time_s * (thrust - self.value * load)
        if not self._low <= value <= self._high:
            value = min(self._high, max(self._low, value))
        self.value = value
        return value


def off_the_ground(inputs: Inputs, ground_clearance_m: float) -> bool:
    """Return whether only the rotors carry the vehicle, according to PX4's landed state and the height."""
    if inputs.vehicle is None or inputs.status is None or inputs.status.landed is not LandedState.IN_AIR:
        return False
    return inputs.vehicle.position_world_m[2] > ground_clearance_m + AIRBORNE_M
