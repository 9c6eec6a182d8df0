"""Momentum observer: estimates the external force from the momentum of vehicle and arm, for a vehicle without a force sensor. Pure.

The generalized-momentum observer of De Luca and Mattone (ICRA 2005), restricted to the rows of the total linear momentum
p = m v + d(R h)/dt, where h is the first moment of arm and tool about the body origin:

    p' = F_rotors + m g + F_ext,        F^ = G(s) (p' - F_rotors - m g),        G = 1 / (T s + 1)^2

The second-order G follows Ruggiero et al. (ICRA 2014). One of first order that is as fast passes three times as much of the rotors'
vibration. The accelerometer gives m v', as in Tomic, Ott and Haddadin (T-RO 2017). G s^2 is proper, so R h is not differentiated
numerically. docs/internals/control-law.md says why the rows of the joints are not used, and gives the measured error.

F_ext is every force on the vehicle that does not come from rotors or gravity: payload, wind, tether, errors of the thrust model. What
lasts is removed by `ForceObserver.step`; a gust is not.
"""

from __future__ import annotations

import math
import operator
from typing import Final

from companion.config.arm_chain import chain_of
from companion.config.vehicle import Vehicle
from companion.control.arm_model.chain_kinematics import ChainKinematics
from companion.control.arm_model.chain_manipulator import masses_with_tool
from companion.control.disturbance import DisturbanceObserver
from companion.control.types import PlantState
from companion.model.algebra import mat_vec
from companion.model.frames import quat_rotate
from companion.model.types import Joints, Vec3

TIME_S = 0.05
"""Time constant T of each of the two filters. Shorter ones pass vibration, longer ones delay the detection of a catch."""
LAG_S = 0.05
"""Lag from the thrust command to the rotors' force."""
FORCE_MAX_N = 100.0
USED_MAX_N = 8.0
"""Largest estimate per axis that a control law gets. More is not a payload, and a law that compensated it would fight the tether."""
MEAN_S = 0.7
"""Averaging time of the mean that is subtracted. A longer one leaves more of the drag, which turns with the direction of flight."""
GAP_MAX_S: Final = 0.03
"""Longest time between two attitudes, or two joint states, over which the change of the arm's moment is a motion."""
_NO_FORCE: Vec3 = (0.0, 0.0, 0.0)


class ForceObserver:
    """Estimate of the external force on the vehicle.

    Args:
        vehicle: masses and geometry of vehicle, arm and tool.
    """

    def __init__(self, vehicle: Vehicle) -> None:
        chain = chain_of(vehicle)
        self._kinematics, self._masses = ChainKinematics(chain), masses_with_tool(chain)
        self._base = DisturbanceObserver(vehicle.airframe.mass_kg, (TIME_S, TIME_S, TIME_S), LAG_S, FORCE_MAX_N)
        self.reset()

    def reset(self) -> None:
        """Discard the estimate: the vehicle is on the ground, where the floor's force is external, too."""
        self._base.reset()
        self._moments: tuple[Vec3, Vec3] | None = None
        self._stamps_s: tuple[float, float] | None = None
        self._force_n = self._mean_n = self.force_n = _NO_FORCE
        """Force without the arm's part; the mean that is subtracted; the estimate, world frame, N."""

    def first_moment_body_kg_m(self, angle_rad: Joints) -> Vec3:
        """Return the first moment of arm and tool about the body origin."""
        x = y = z = 0.0
        frames = self._kinematics.frames(angle_rad)
        for (rotation, (px, py, pz), _), (mass_kg, moment) in zip(frames, self._masses, strict=True):
            mx, my, mz = mat_vec(rotation, moment)
            x, y, z = x + mx + mass_kg * px, y + my + mass_kg * py, z + mz + mass_kg * pz
        return (x, y, z)

    def step(
        self,
        dt_s: float,
        known_n: Vec3,
        state: PlantState,
        stamps_s: tuple[float, float] | None,
        contact: bool,
        touching: bool = False,
    ) -> Vec3:
        """Run one tick and return the estimate, world frame, N.

        What lasts is removed by subtracting a running mean: steady wind, drag, errors of the thrust model and of the attitude. During
        contact the mean of the vertical force is held, so that the weight of a payload stays in the estimate; that of the horizontal
        force is not, because a payload's weight has no horizontal part. Values that are not finite leave the estimate unchanged.

        Args:
            dt_s: time since the last tick.
            known_n: rotor force commanded in the last tick and weight, world frame.
            state: state of this tick.
            stamps_s: stamps of attitude and joint state; after a gap in either, the arm's motion is not judged. None without arm.
            contact: whether a payload may be in contact with the tip.
            touching: whether the tip may touch a surface, whose force has any direction: the whole mean is held.
        """
        acceleration = state.acceleration_world_m_s2
        moment = quat_rotate(state.attitude_wxyz, self.first_moment_body_kg_m(state.arm_rad))
        if not math.isfinite(sum((*known_n, *acceleration, *moment))):
            return self.force_n
        k = dt_s / (dt_s + TIME_S)
        dx, dy, dz = self._base.step(dt_s, known_n, acceleration, learn=True)
        fx, fy, fz = self._force_n
        fx, fy, fz = fx + k * (dx - fx), fy + k * (dy - fy), fz + k * (dz - fz)
        self._force_n = (fx, fy, fz)
        ax, ay, az = self._arm_n(k, moment, stamps_s)
        fx, fy, fz = fx + ax, fy + ay, fz + az
        nx, ny, nz = self._mean_n
        share = dt_s / MEAN_S
        if not touching:
            nx, ny = nx + share * (fx - nx), ny + share * (fy - ny)
        if not (contact or touching):
            nz += share * (fz - nz)
        self._mean_n = (nx, ny, nz)
        self.force_n = (fx - nx, fy - ny, fz - nz)
        return self.force_n

    def used_n(self) -> Vec3:
        """Return the estimate as a control law gets it, within +-`USED_MAX_N`."""
        x, y, z = self.force_n
        most = USED_MAX_N
        return (max(-most, min(most, x)), max(-most, min(most, y)), max(-most, min(most, z)))

    def _arm_n(self, k: float, moment_world: Vec3, stamps_s: tuple[float, float] | None) -> Vec3:
        """Return G d^2(R h)/dt^2; `k` is the gain of the filters, which are implicit, so that this is exact."""
        before, self._stamps_s = self._stamps_s, stamps_s
        moments = self._moments
        gap = before is not None and stamps_s is not None and max(map(operator.sub, stamps_s, before)) > GAP_MAX_S
        if moments is None or gap or (before is None) != (stamps_s is None):
            moments = (moment_world, moment_world)
        (ax, ay, az), (bx, by, bz), (mx, my, mz) = *moments, moment_world
        ax, ay, az = ax + k * (mx - ax), ay + k * (my - ay), az + k * (mz - az)
        bx, by, bz = bx + k * (ax - bx), by + k * (ay - by), bz + k * (az - bz)
        self._moments = ((ax, ay, az), (bx, by, bz))
        per_s2 = 1.0 / (TIME_S * TIME_S)
        return (per_s2 * (mx - 2.0 * ax + bx), per_s2 * (my - 2.0 * ay + by), per_s2 * (mz - 2.0 * az + bz))
