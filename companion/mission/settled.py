"""Checks that the vehicle is at rest and PX4's estimate has converged to motion capture, as the core's last check before it requests
OFFBOARD. Pure; time is an argument.

An estimate that has only begun to follow is close for a moment; one that has converged stays close. PX4's position and yaw are
compared with those of motion capture while the vehicle is on the ground. If another program feeds PX4 there is no motion capture to
compare with; the estimate must then stay where it was.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Final

from companion.model.flight_stage import TARE_S
from companion.model.frames import euler_zyx_from_quat, wrap_rad
from companion.model.types import MocapPose, Vec3, VehicleState

SETTLED_S: Final = TARE_S
"""Time for which the estimate must be close and steady; equal to the duration of the tare, which runs at the same time."""
OFF_MAX_M: Final = 0.05
"""Largest mean distance, m; the mean removes the noise of EKF2."""
SPREAD_MAX_M: Final = 0.02
"""Largest standard deviation of the distance over all three axes, m. EKF2 shows a few millimetres at rest with 1 cm of vision noise."""
YAW_OFF_MAX_RAD: Final = math.radians(5.0)
YAW_SPREAD_MAX_RAD: Final = math.radians(2.0)
_NOWHERE: Vec3 = (0.0, 0.0, 0.0)


@dataclass(frozen=True, slots=True)
class SettledEstimate:
    """Differences between PX4's estimate and motion capture over the last `SETTLED_S`."""

    seen: tuple[tuple[float, Vec3, float, Vec3], ...] = ()
    """Time on the flight clock (s), position (m) and yaw (rad) of the estimate minus those of motion capture, if there is any, and the
    position by motion capture."""
    alone: bool = False
    """Whether there is no motion capture to compare with."""
    since_s: float | None = None
    """Time on the flight clock of the first tick; None before it."""

    def take(self, t_s: float, vehicle: VehicleState, pose: MocapPose | None) -> SettledEstimate:
        """Return the evidence after one more tick; `pose` is None if another program feeds PX4."""
        x, y, z = vehicle.position_world_m
        yaw_rad = euler_zyx_from_quat(vehicle.attitude_wxyz)[2]
        a, b, c = pose.position_world_m if pose is not None else _NOWHERE
        yaw_rad -= euler_zyx_from_quat(pose.attitude_wxyz)[2] if pose is not None else 0.0
        first = 0
        while first < len(self.seen) and self.seen[first][0] < t_s - SETTLED_S:
            first += 1
        seen = (*self.seen[first:], (t_s, (x - a, y - b, z - c), wrap_rad(yaw_rad), (a, b, c)))
        return SettledEstimate(seen, pose is None, t_s if self.since_s is None else self.since_s)

    @property
    def _compared_with(self) -> str:
        return f"that of {SETTLED_S:g} s ago" if self.alone else "that of motion capture"

    def lasted(self, t_s: float) -> bool:
        """Return whether there is evidence of `SETTLED_S`."""
        return self.since_s is not None and t_s - self.since_s >= SETTLED_S

    def problem(self, t_s: float) -> str | None:
        """Return a message that says what moves or has not converged; None if the vehicle has been at rest for `SETTLED_S`."""
        if not self.lasted(t_s):
            return f"PX4's estimate has not followed motion capture for {SETTLED_S:g} s without interruption"
        count = len(self.seen)
        moved_m = _spread_m([position for _, _, _, position in self.seen])[1]
        if moved_m > SPREAD_MAX_M:
            return (
                f"the vehicle does not stand still: its position has moved by {moved_m * 1e3:.0f} mm in the last {SETTLED_S:g} s "
                f"(allowed: {SPREAD_MAX_M * 1e3:.0f} mm); leave it alone"
            )
        _, (a, b, c), first_rad, _ = self.seen[0] if self.alone else (0.0, _NOWHERE, 0.0, _NOWHERE)
        mean, spread_m = _spread_m([(x - a, y - b, z - c) for _, (x, y, z), _, _ in self.seen])
        turned_rad = [wrap_rad(yaw - first_rad) for _, _, yaw, _ in self.seen]
        yaw_rad = math.fsum(turned_rad) / count
        yaw_spread_rad = math.sqrt(math.fsum((yaw - yaw_rad) ** 2 for yaw in turned_rad) / count)
        off_m = math.hypot(*mean)
        wrong = []
        if off_m > OFF_MAX_M or spread_m > SPREAD_MAX_M:
            wrong.append(
                f"its position is {off_m * 1e3:.0f} mm from {self._compared_with} and drifts by {spread_m * 1e3:.0f} mm "
                f"(allowed: {OFF_MAX_M * 1e3:.0f} and {SPREAD_MAX_M * 1e3:.0f} mm)"
            )
        if abs(yaw_rad) > YAW_OFF_MAX_RAD or yaw_spread_rad > YAW_SPREAD_MAX_RAD:
            limits = f"{math.degrees(YAW_OFF_MAX_RAD):.0f} and {math.degrees(YAW_SPREAD_MAX_RAD):.0f} deg"
            off_deg, spread_deg = math.degrees(yaw_rad), math.degrees(yaw_spread_rad)
            wrong.append(f"its yaw is {off_deg:.1f} deg off and drifts by {spread_deg:.1f} deg (allowed: {limits})")
        if not wrong:
            return None
        return (
            f"PX4's estimate has not settled in the last {SETTLED_S:g} s: {', '.join(wrong)}; do not move the vehicle, "
            "and check that PX4 and Motive use the same body and axes (EKF2_EV_DELAY, EKF2_EVP_NOISE, the rigid body's markers)"
        )


def _spread_m(positions_m: list[Vec3]) -> tuple[list[float], float]:
    """Return the mean of positions, and their standard deviation over all three axes."""
    count = len(positions_m)
    mean = [math.fsum(position[axis] for position in positions_m) / count for axis in range(3)]
    return mean, math.sqrt(math.fsum(math.dist(position, mean) ** 2 for position in positions_m) / count)
