"""Decides whether a motion-capture pose is one that the vehicle can have reached. Pure.

The core, the flight's forwarding of poses to PX4 and the guardian's use this one test: a pose that fails it is not passed on.
"""

from __future__ import annotations

import math
from typing import Final, NamedTuple

from companion.model.types import MocapPose, Quat, Vec2, VehicleState
from companion.safety.inertial_check import RemoteClock

CONTINUOUS_S: Final = 0.1
"""After a longer gap a pose is compared with PX4's position, not with the previous pose."""
FORGET_S: Final = 1.0
"""On the ground the next frame is trusted after a gap this long: the vehicle may have been carried."""
UNKNOWN_S: Final = 0.5
"""If PX4's state is unknown, a pose is compared with an older one for this long."""
DRIFT_M_S: Final = 0.3
"""Permitted drift of PX4's position while no pose is trusted, m/s, up to `safety.estimate_disagreement_m`."""
BLIND_M_S15: Final = 0.2
"""Permitted error of PX4's position after a time t without a pose, divided by t^1.5: one standard deviation of a position integrated
from an accelerometer with the noise that EKF2 assumes, 0.35 m/s2 (EKF2_ACC_NOISE), divided by sqrt(3)."""
SERVER_GROWTH: Final = 1e-4
"""Largest drift of the server's clock, s/s: computers' clocks drift by less."""


class PoseLimits(NamedTuple):
    """Limits of a pose that is passed on to PX4."""

    jump_m: float
    """`safety.mocap_jump_m`."""
    jump_rad: float
    """`safety.mocap_jump_deg`, in rad."""
    disagreement_m: float
    """`safety.estimate_disagreement_m`."""
    latency_max_s: float
    """The larger one of `safety.mocap_latency_warn_s` and `safety.mocap_latency_max_s`."""


class PoseFilter:
    """Compares a pose with the newest trusted one, carried on by PX4's velocity and rates.

    Args:
        limits: limits of a pose.
        trusted: the newest trusted pose; None if there is none, so that the first pose is trusted.
        server_clock: the server's clock as earlier poses have shown it; None if none has.
    """

    def __init__(
        self, limits: PoseLimits, trusted: MocapPose | None = None, server_clock: RemoteClock | None = None
    ) -> None:
        self._limits = limits
        self._jump_cos_half = math.cos(0.5 * limits.jump_rad)
        self.trusted = self.tracked = trusted
        """The newest trusted pose, and the newest one in which the body was tracked."""
        self._server_clock = server_clock or RemoteClock(SERVER_GROWTH)
        self._blind_s = 0.0
        """Longest time without a tracked body since the newest trusted pose. Poses that are rejected do not extend it, so that
        another body's pose is not trusted in the end."""

    def check(self, pose: MocapPose, vehicle: VehicleState | None) -> bool:
        """Evaluate a new pose in the air and return whether it may be passed on to PX4: the body is tracked, the pose is reachable,
        repeats none and is not too late.
        """
        if not pose.tracking_valid:
            return False
        repeated, too_late = is_repeated(pose, self.tracked), self.exceeds(self.latency_s(pose))
        return self.evaluate(pose, vehicle) is None and not repeated and not too_late

    def after(self) -> PoseFilter:
        """Return a filter that knows what this one has seen."""
        return PoseFilter(self._limits, self.trusted, self._server_clock)

    def evaluate(self, pose: MocapPose, vehicle: VehicleState | None, *, forgotten: bool = False) -> Vec2 | None:
        """Evaluate a new pose in which the body is tracked, and return its deviation; a reachable pose is trusted.

        Args:
            pose: the pose.
            vehicle: PX4's newest state; None if it is unknown.
            forgotten: the trusted pose says nothing about this one.
        """
        off = None if forgotten else self.deviation(pose, vehicle)
        self._blind_s = 0.0 if off is None else self._blind_until_s(pose)
        self.tracked = pose
        if off is None:
            self.trusted = pose
        return off

    def latency_s(self, pose: MocapPose, *, learns: bool = True) -> float | None:
        """Return the time from the exposure of a pose to its arrival; None if it is unknown.

        If the pose's latency ends at the transmission, the delay on the network beyond its smallest is added, by the server's clock.

        Args:
            pose: the pose.
            learns: False changes nothing.
        """
        if pose.exposure_server_s is None:
            return pose.latency_s
        latency_s, clock = pose.latency_s or 0.0, self._server_clock
        sent_s = (clock.local_s if learns else clock.would_be_s)(pose.exposure_server_s + latency_s, pose.stamp_s)
        return latency_s + pose.stamp_s - sent_s

    def exceeds(self, latency_s: float | None) -> bool:
        """Return whether a latency is so large that a pose with it counts as lost."""
        return latency_s is not None and latency_s > self._limits.latency_max_s

    def deviation(self, pose: MocapPose, vehicle: VehicleState | None) -> Vec2 | None:
        """Return None if the pose is reachable, else how far it is from the expected one, in m and deg. Changes nothing. Arguments as
        for `evaluate`.
        """
        before, limits = self.trusted, self._limits
        if before is None:
            return None
        dt_s = pose.stamp_s - before.stamp_s
        if vehicle is None and dt_s > UNKNOWN_S:
            return None
        x, y, z = pose.position_world_m
        if dt_s <= CONTINUOUS_S or vehicle is None:
            vx, vy, vz = vehicle.velocity_world_m_s if vehicle is not None else (0.0, 0.0, 0.0)
            px, py, pz = before.position_world_m
            px, py, pz = px + vx * dt_s, py + vy * dt_s, pz + vz * dt_s
            allowed_m = limits.jump_m
            reference = before.attitude_wxyz
        else:
            px, py, pz = vehicle.position_world_m
            blind_s = self._blind_until_s(pose)
            blind_m = limits.jump_m + BLIND_M_S15 * blind_s * math.sqrt(blind_s)
            allowed_m = max(min(limits.jump_m + DRIFT_M_S * dt_s, limits.disagreement_m), blind_m)
            reference = vehicle.attitude_wxyz
        dx, dy, dz = x - px, y - py, z - pz
        off_m2 = dx * dx + dy * dy + dz * dz
        cos_half = abs(dot(pose.attitude_wxyz, reference))
        if off_m2 <= allowed_m * allowed_m and cos_half >= self._jump_cos_half:
            return None
        turned_rad = 2.0 * math.acos(min(1.0, cos_half))
        rate_rad_s = math.hypot(*vehicle.angular_rate_body_rad_s) if vehicle is not None else 0.0
        turnable_rad = limits.jump_rad + 1.5 * rate_rad_s * min(dt_s, CONTINUOUS_S)
        if off_m2 <= allowed_m * allowed_m and turned_rad <= turnable_rad:
            return None
        return (math.sqrt(off_m2), math.degrees(turned_rad))

    def _blind_until_s(self, pose: MocapPose) -> float:
        return max(self._blind_s, pose.stamp_s - self.tracked.stamp_s) if self.tracked is not None else self._blind_s


def is_repeated(pose: MocapPose, tracked: MocapPose | None) -> bool:
    """Return whether a pose equals the last tracked one bit for bit, which no measurement does in the air."""
    return (
        tracked is not None
        and pose.position_world_m == tracked.position_world_m
        and pose.attitude_wxyz == tracked.attitude_wxyz
    )


def dot(a: Quat, b: Quat) -> float:
    """Return the scalar product of two quaternions."""
    return a[0] * b[0] + a[1] * b[1] + a[2] * b[2] + a[3] * b[3]
