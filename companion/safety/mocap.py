"""Motion capture: decides which poses are trusted, and contains the predicates of its rules.

A pose is trusted if it is near the one that PX4's velocity and rates predict. A pose that is not trusted counts as not received and
is not passed on to PX4: an estimator that has fused another body's pose is useless for a landing. Thresholds are keys of `safety:`
in the vehicle file (`companion.config.safety.Safety`). The rows of these rules, with their thresholds, actions and the texts for
the operator, are in `companion.safety.rules`.
"""

from __future__ import annotations

import math
from typing import Final

from companion.config.safety import Safety
from companion.model.constants import GRAVITY_M_S2
from companion.model.frames import euler_zyx_from_quat, quat_rotate, wrap_rad
from companion.model.types import Inputs, MocapPose, Quat, Vec2, VehicleState
from companion.safety.flight_context import HOLDS, FlightContext, Values
from companion.safety.inertial_check import IMU_LATE_MAX_S, InertialCheck, RemoteClock
from companion.safety.pose_filter import FORGET_S, PoseFilter, PoseLimits, dot, is_repeated
from companion.safety.stream_watch import StreamWatch

FUSED_WITHIN_M: Final = 0.10
FUSED_WITHIN_RAD: Final = math.radians(8.0)
RATE_WINDOW_S: Final = 1.0


def unfused(i: Inputs) -> str | None:
    """Return why PX4 appears not to fuse vision, or None if position and yaw of its estimate agree with motion capture.

    PX4 accepts poses without fusing them and does not report it, so having sent them proves nothing. If another program sends them,
    there is only the report of PX4's estimator.
    """
    if i.estimator is not None:
        lacking = i.estimator.unaided
        return (
            None if lacking is None else f"PX4 fuses no external vision: its estimator has no measurement of {lacking}"
        )
    if i.vehicle is None or i.mocap is None:
        return "no state to compare"
    apart_m = math.dist(i.vehicle.position_world_m, i.mocap.position_world_m)
    turned_rad = _yaw_between(i.vehicle.attitude_wxyz, i.mocap.attitude_wxyz)
    if apart_m <= FUSED_WITHIN_M and turned_rad <= FUSED_WITHIN_RAD:
        return None
    return (
        f"PX4 does not follow motion capture: {apart_m:.2f} m and {math.degrees(turned_rad):.0f} deg of yaw apart; "
        "check EKF2_EV_CTRL = 11, EKF2_HGT_REF = 3 and the body's axes in Motive"
    )


def limits_of(safety: Safety) -> PoseLimits:
    """Return the limits of a pose that is passed on to PX4."""
    return PoseLimits(
        safety.mocap_jump_m,
        math.radians(safety.mocap_jump_deg),
        safety.estimate_disagreement_m,
        max(safety.mocap_latency_warn_s, safety.mocap_latency_max_s),
    )


LATE_MAX_S: Final = 0.5
"""Age above which a late pose shows nothing: in a queue, poses still show the floor after lift-off."""


class MocapTracker:
    """Evaluates each frame once: whether it is trusted, repeats the previous one, and agrees with the IMU.

    Args:
        safety: thresholds for a trusted pose.
    """

    def __init__(self, safety: Safety) -> None:
        s = self._s = safety
        self._filter = PoseFilter(limits_of(s))
        self._frame_awake_s = -math.inf
        self._trusted_awake_s = self._timely_awake_s = self._awake_s = -math.inf
        self._timely: MocapPose | None = None
        """The newest trusted pose that was not too late."""
        self.too_late = False
        """Whether the newest tracked pose is so late that it counts as not received."""
        self._same_since_s: float | None = None
        self._moved = False
        self._streams = StreamWatch()
        self._inertial = InertialCheck(s.mocap_inertial_m, s.mocap_inertial_s, s.mocap_timeout_s)
        self._imu: VehicleState | None = None
        """PX4's state whose IMU samples were used last."""
        self._imu_s = 0.0
        """End of the newest IMU sample on the flight clock."""
        self._px4_clock = RemoteClock()
        self._against_imu = False
        """Whether the newest trusted pose disagrees with the IMU."""
        self._window_awake_s: float | None = None
        self._window_frames = 0
        self.pose: MocapPose | None = None
        self.frame: MocapPose | None = None
        """The newest frame, valid or not."""
        self.frame_age_s = self.trusted_age_s = math.inf
        """Awake time since the newest frame, and since the newest trusted pose."""
        self.plausible = True
        """Whether the newest valid pose is trusted."""
        self.off = (0.0, 0.0)
        """Deviation of the newest rejected pose: m and deg."""
        self.frozen = False
        """New frames repeat the same pose while the vehicle is moving in the air, for longer than `safety.mocap_frozen_s`."""
        self.latency_s: float | None = None
        """Time from the exposure of the newest frame to its arrival; None if it is unknown."""
        self.two_streams = False
        self.dragged = False
        """In the air, while the companion commanded, poses disagreed with the IMU. Latched: the observer soon follows the
        drag, and the poses must not be trusted again. Not evaluated once PX4 lands for another reason: with a delayed link the check
        can be wrong, and PX4 needs the poses."""
        self.rate_hz: float | None = None
        self.compared: tuple[MocapPose, VehicleState] | None = None
        """A trusted pose and PX4's state at the same time in the air, the newest such pair; None if there is none within
        `safety.mocap_timeout_s`. A rejected pose in between does not end the hold time of a disagreement."""
        self._compared_awake_s = -math.inf
        self.trusted = True
        """Whether poses are trusted: the newest one is plausible, and they are not frozen, dragged or from two servers."""
        self.repeats = False
        """Whether the newest pose equals the last tracked one bit for bit, which no measurement does in the air."""

    def update(self, i: Inputs, context: FlightContext, awake_s: float, moving: bool) -> None:
        """Update with the inputs of one tick; `moving` is True if PX4's velocity or rates show that the vehicle is moving."""
        pose, vehicle, s = i.mocap, i.vehicle, self._s
        self._awake_s = awake_s
        self.pose = pose
        self._moved = self._moved or moving
        if vehicle is not None and vehicle.imu_boot_s is not None:
            self._predict(vehicle, vehicle.imu_boot_s)
        if pose is not None and (self.frame is None or pose.stamp_s != self.frame.stamp_s):
            self._judge(pose, vehicle, awake_s, context.airborne)
        self.frame_age_s = awake_s - self._frame_awake_s
        self.trusted_age_s = awake_s - self._trusted_awake_s
        self.frozen = (
            self._same_since_s is not None
            and self._moved
            and context.airborne
            and awake_s - self._same_since_s > s.mocap_frozen_s
        )
        self.two_streams = self._streams.two(awake_s)
        self.dragged = self.dragged or (self._against_imu and context.airborne and context.offboard_expected)
        self.trusted = self.plausible and not self.frozen and not self.two_streams and not self.dragged
        self._count(awake_s)
        if not context.airborne or awake_s - self._compared_awake_s > s.mocap_timeout_s:
            self.compared = None
        if pose is not None and vehicle is not None and context.airborne and self.trusted and not self.too_late:
            if pose.tracking_valid and self.frame_age_s < s.mocap_timeout_s:
                self.compared, self._compared_awake_s = (pose, vehicle), awake_s

    @property
    def innovation_m(self) -> float:
        """Return the distance between the newest pose and the position predicted from the IMU; 0 while that is not evaluated."""
        return self._inertial.innovation_m

    @property
    def last_trusted(self) -> MocapPose | None:
        """Return the newest pose that was trusted and not too late, as if those after it had not arrived; None if it is older than
        `safety.mocap_timeout_s` or the stream is rejected.
        """
        rejected = self.frozen or self.two_streams or self.dragged
        return None if rejected or self._awake_s - self._timely_awake_s > self._s.mocap_timeout_s else self._timely

    @property
    def late(self) -> MocapPose | None:
        """Return the newest pose if it is trusted but too late, by at most `LATE_MAX_S`; else None."""
        frame, age_s = self.frame, self.latency_s
        if frame is None or age_s is None or age_s > LATE_MAX_S or not frame.tracking_valid:
            return None
        return frame if self.too_late and self.trusted and not self.repeats else None

    def pose_filter(self) -> PoseFilter | None:
        """Return a filter for a landing without the core; None if the stream is rejected, so that no pose may be passed on."""
        rejected = self.frozen or self.two_streams or self.dragged
        return None if rejected else self._filter.after()

    def forwards(self, pose: MocapPose, vehicle: VehicleState | None, *, airborne: bool) -> bool:
        """Return whether a pose may be passed on to PX4, which need not wait for the next tick. Changes nothing.

        In the air a repeated pose is withheld, long before `mocap_frozen`, because it suggests a vehicle at rest.
        """
        frame = self.frame
        if not pose.tracking_valid or self._filter.exceeds(self._filter.latency_s(pose, learns=False)):
            return False
        if frame is None or pose.stamp_s == frame.stamp_s:  # the first, or one that a tick has evaluated
            return self.trusted and not (self.repeats and airborne)
        if self.frozen or self.two_streams or self.dragged:
            return False
        if airborne and is_repeated(pose, self._filter.tracked):
            return False
        forgotten = pose.stamp_s - frame.stamp_s > FORGET_S and not airborne
        return forgotten or self._filter.deviation(pose, vehicle) is None

    def untrusted(self, timeout_s: float) -> bool:
        """Return whether frames are arriving but the last trusted one is older than the timeout."""
        return self.trusted_age_s > timeout_s and not self.frame_age_s > timeout_s

    def _predict(self, vehicle: VehicleState, boot_s: float) -> None:
        """Integrate all IMU samples since the last tick; `boot_s` is the time of the newest."""
        before = self._imu
        if before is not None and boot_s == before.imu_boot_s:
            return
        self._imu, self._imu_s = vehicle, self._px4_clock.local_s(boot_s, vehicle.imu_stamp_s)
        if before is None or before.imu_boot_s is None:
            return
        now, then = vehicle.delta_velocity_body_m_s, before.delta_velocity_body_m_s
        if now is None or then is None:
            return
        dt_s = boot_s - before.imu_boot_s if vehicle.imu_gaps == before.imu_gaps else math.inf
        x, y, z = now
        bx, by, bz = then
        x, y, z = quat_rotate(vehicle.attitude_wxyz, (x - bx, y - by, z - bz))
        self._inertial.imu(vehicle.imu_stamp_s, dt_s, (x, y, z - GRAVITY_M_S2 * dt_s))

    def _judge(self, pose: MocapPose, vehicle: VehicleState | None, awake_s: float, airborne: bool) -> None:
        """Evaluate a new frame."""
        before = self.frame
        if before is None:
            self._trusted_awake_s = awake_s  # a stream may begin within a burst of lost frames
        gone_s = awake_s - self._frame_awake_s
        self.frame, self._frame_awake_s = pose, awake_s
        self.latency_s = self._filter.latency_s(pose)
        self._window_frames += 1
        self._streams.update(pose.frame_number, (pose.position_world_m, pose.attitude_wxyz), awake_s)
        # The gap was reported as a loss; a rate across it does not describe this stream.
        if gone_s > self._s.mocap_timeout_s:
            self._window_awake_s = self.rate_hz = None
        # A frame in which the body is not tracked does not end a freeze: only another pose does.
        tracked = self._filter.tracked
        same = tracked is not None and pose.position_world_m == tracked.position_world_m
        self.repeats = is_repeated(pose, tracked)
        if not pose.tracking_valid:
            return
        if not same:
            self._same_since_s, self._moved = None, False
        elif self._same_since_s is None and self.repeats:
            self._same_since_s, self._moved = awake_s, False
        self.too_late = self._filter.exceeds(self.latency_s)
        off = self._filter.evaluate(pose, vehicle, forgotten=gone_s > FORGET_S and not airborne)
        self.plausible = off is None
        if off is None:
            self._trusted_awake_s = awake_s
            if not self.too_late:
                self._timely, self._timely_awake_s = pose, awake_s
            # mocap_frozen evaluates repeated poses; they are not passed on and are not evidence of motion.
            if not self.repeats:
                self._against_imu = self._inertial.pose(pose.stamp_s, pose.position_world_m, self._age_s(pose))
        else:
            self.off = off
            self._against_imu = False

    def _age_s(self, pose: MocapPose) -> float:
        """Return the time from the exposure of a pose to the newest IMU sample, limited; negative if the pose is newer."""
        exposed_s = pose.stamp_s - (self.latency_s or 0.0)
        return min(max(-IMU_LATE_MAX_S, self._imu_s - exposed_s), self._s.mocap_timeout_s)

    def _count(self, awake_s: float) -> None:
        """Count the frames in each `RATE_WINDOW_S`."""
        start_s = self._window_awake_s
        if start_s is None:
            self._window_awake_s, self._window_frames = awake_s, 0
        elif awake_s - start_s >= RATE_WINDOW_S:
            self.rate_hz = self._window_frames / (awake_s - start_s)
            self._window_awake_s, self._window_frames = awake_s, 0


def mocap_lost(m: MocapTracker, timeout_s: float) -> Values | None:
    """Fires if no frame has arrived for longer than the timeout."""
    return (timeout_s,) if m.frame_age_s > timeout_s else None


def mocap_invalid(m: MocapTracker, timeout_s: float) -> Values | None:
    """Fires if frames are arriving, but the last trusted one is older than the timeout, and the newest has no valid pose."""
    return (timeout_s,) if m.untrusted(timeout_s) and m.frame is not None and not m.frame.tracking_valid else None


def mocap_swapped(m: MocapTracker, timeout_s: float) -> Values | None:
    """Fires if poses are arriving, but the last trusted one is older than the timeout."""
    return m.off if m.untrusted(timeout_s) and m.frame is not None and m.frame.tracking_valid else None


def mocap_jump(m: MocapTracker, timeout_s: float) -> Values | None:
    """Fires if the newest pose is rejected, but the last trusted one is not older than the timeout."""
    return m.off if not m.plausible and m.trusted_age_s <= timeout_s else None


def mocap_two_streams(m: MocapTracker, _: None) -> Values | None:
    """Fires if frame numbers step back repeatedly."""
    return HOLDS if m.two_streams else None


def mocap_dragged(m: MocapTracker, limit_m: float) -> Values | None:
    """Fires if poses do not move as the IMU measures."""
    return (m.innovation_m * 1e3, limit_m * 1e3) if m.dragged else None


def mocap_frozen(m: MocapTracker, _: None) -> Values | None:
    """Fires if new frames repeat the same pose although the vehicle is moving."""
    return HOLDS if m.frozen else None


def mocap_slow(m: MocapTracker, thresholds: Vec2) -> Values | None:
    """Fires if the rate is below the first threshold; the second is the timeout after which the stream is lost instead."""
    rate_hz = m.rate_hz
    slow = rate_hz is not None and rate_hz < thresholds[0] and not m.frame_age_s > thresholds[1]
    return (rate_hz, thresholds[0]) if slow else None


def mocap_late(m: MocapTracker, thresholds: Vec2) -> Values | None:
    """Fires if the latency exceeds the first threshold but not the second."""
    latency_s = m.latency_s if m.pose is not None else None
    if latency_s is None or not thresholds[0] < latency_s <= thresholds[1]:
        return None
    return (latency_s * 1e3, thresholds[0] * 1e3)


def mocap_too_late(m: MocapTracker, thresholds: Vec2) -> Values | None:
    """Fires if the latency exceeds both thresholds."""
    latency_s = m.latency_s if m.pose is not None else None
    if latency_s is None or not (latency_s > thresholds[0] and latency_s > thresholds[1]):
        return None
    return (latency_s * 1e3, max(thresholds) * 1e3)


def estimate_disagrees(m: MocapTracker, disagreement_m: float) -> Values | None:
    """Fires if PX4's position and the pose are further apart than the threshold."""
    if m.compared is None:
        return None
    (x, y, z), (px, py, pz) = m.compared[1].position_world_m, m.compared[0].position_world_m
    dx, dy, dz = x - px, y - py, z - pz
    apart_m = math.sqrt(dx * dx + dy * dy + dz * dz)
    return (apart_m, disagreement_m) if apart_m > disagreement_m else None


def yaw_disagrees(m: MocapTracker, disagreement_rad: float) -> Values | None:
    """Fires if the yaw of PX4 and that of the pose differ by more than the threshold."""
    if m.compared is None:
        return None
    pose, vehicle = m.compared[0].attitude_wxyz, m.compared[1].attitude_wxyz
    # Most ticks need no angles: attitudes that differ by less than the threshold cannot differ by more in yaw, near level.
    if abs(dot(vehicle, pose)) >= math.cos(0.4 * disagreement_rad):
        return None
    turned_rad = _yaw_between(vehicle, pose)
    return (math.degrees(turned_rad), math.degrees(disagreement_rad)) if turned_rad > disagreement_rad else None


def _yaw_between(a: Quat, b: Quat) -> float:
    return abs(wrap_rad(euler_zyx_from_quat(a)[2] - euler_zyx_from_quat(b)[2]))
