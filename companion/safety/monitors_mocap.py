"""Is motion capture alive, often enough, in time, and of our body?

A pose is believed when it is where PX4's own velocity and rates say that the body should be by now. What is not believed counts as not
arrived, and is not to be passed on to PX4: an estimator that was fed with another body's pose is no help in a landing.
"""

from __future__ import annotations

import math

from companion.config.vehicle import Vehicle
from companion.control.manipulator import GRAVITY_M_S2
from companion.model.frames import euler_zyx_from_quat, quat_rotate, wrap_rad
from companion.model.types import Inputs, MocapPose, Quat, VehicleState
from companion.safety.findings import Findings, Situation
from companion.safety.inertial_check import IMU_GAP_MAX_S, InertialCheck, RemoteClock
from companion.safety.rules import (
    ESTIMATE_DISAGREES,
    MOCAP_DRAGGED,
    MOCAP_FROZEN,
    MOCAP_INVALID,
    MOCAP_JUMP,
    MOCAP_LATE,
    MOCAP_LOST,
    MOCAP_SLOW,
    MOCAP_SWAPPED,
    MOCAP_TOO_LATE,
    MOCAP_TWO_STREAMS,
    YAW_DISAGREES,
)
from companion.safety.stream_watch import StreamWatch

FUSED_WITHIN_M = 0.10
FUSED_WITHIN_RAD = math.radians(8.0)
CONTINUOUS_S = 0.1
"""Over a longer gap a pose is held against PX4's own position, not against the pose before."""
FORGET_S = 1.0
"""After so long without any frame the next one is believed: whoever looks at it knows that it was gone."""
DRIFT_M_S = 0.3
"""PX4's own position may be off by so much more for every second without a pose to believe."""
RATE_WINDOW_S = 1.0


def unfused(i: Inputs) -> str | None:
    """Evidence that PX4 fuses vision: position and yaw of its estimate agree with motion capture. None: they do.

    PX4 takes poses that it does not fuse without a word, so having sent them proves nothing.
    """
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


class MocapMonitor:
    """Judges one frame after the other; a frame that was seen before is not judged again."""

    def __init__(self, vehicle: Vehicle) -> None:
        s = vehicle.safety
        self._s = s
        self._jump_rad = math.radians(s.mocap_jump_deg)
        self._jump_cos_half = math.cos(0.5 * self._jump_rad)
        self._yaw_disagreement_rad = math.radians(s.yaw_disagreement_deg)
        self._frame: MocapPose | None = None
        """The newest one."""
        self._frame_awake_s = -math.inf
        self._believed: MocapPose | None = None
        self._believed_awake_s = -math.inf
        self._plausible = True
        self._apart = (0.0, 0.0)
        self._same_since_s: float | None = None
        self._moved = False
        self._streams = StreamWatch()
        self._inertial = InertialCheck(s.mocap_inertial_m, s.mocap_inertial_s, s.mocap_timeout_s)
        self._imu: VehicleState | None = None
        """The state whose IMU samples were used last."""
        self._imu_s = 0.0
        """End of the newest of them, flight clock."""
        self._px4_clock, self._server_clock = RemoteClock(), RemoteClock()
        self._against_imu = False
        """The newest believed pose does not move as the IMU says."""
        self._dragged = False
        """That was found in the air while the companion commands. Latched: the observer soon follows the drag, and the poses must not
        be believed again. Not judged once PX4 lands for another reason: behind a late link the check can be wrong, and PX4 needs
        the poses."""
        self._window_awake_s: float | None = None
        self._window_frames = 0
        self._rate_hz: float | None = None
        self.trusted = True
        """The newest pose is of our body and of now."""
        self.repeats = False
        """The newest pose is the one before to the last bit: nothing that was measured in the air."""

    def check(self, i: Inputs, situation: Situation, awake_s: float, moving: bool, findings: Findings) -> None:
        """One tick; `moving`: the IMU or PX4's velocity say that the vehicle moves."""
        pose, vehicle, s = i.mocap, i.vehicle, self._s
        self._moved = self._moved or moving
        if vehicle is not None and vehicle.imu_boot_s is not None:
            self._predict(vehicle, vehicle.imu_boot_s)
        if pose is not None and (self._frame is None or pose.stamp_s != self._frame.stamp_s):
            self._judge(pose, vehicle, awake_s)
        if awake_s - self._believed_awake_s > s.mocap_timeout_s:
            self._tell_lost(awake_s, findings)
        elif not self._plausible:
            findings.found(MOCAP_JUMP, "motion capture is {:.2f} m and {:.0f} deg off, in no time", *self._apart)
        frozen = (
            self._same_since_s is not None
            and self._moved
            and situation.airborne
            and awake_s - self._same_since_s > s.mocap_frozen_s
        )
        two_streams = self._streams.two(awake_s)
        self._dragged = self._dragged or (self._against_imu and situation.airborne and situation.offboard_expected)
        self.trusted = self._plausible and not frozen and not two_streams and not self._dragged
        if two_streams:
            text = "motion capture comes in two sequences of frame numbers: two servers at one address; neither is believed"
            findings.found(MOCAP_TWO_STREAMS, text)
        if self._dragged:
            text = "motion capture does not move as the IMU measures: {:.0f} mm off (limit {:.0f} mm); PX4 lands without it"
            findings.found(MOCAP_DRAGGED, text, self._inertial.innovation_m * 1e3, s.mocap_inertial_m * 1e3)
        if frozen:
            findings.found(MOCAP_FROZEN, "motion capture repeats the same pose, the vehicle moves")
        self._tell_rate(awake_s, findings)
        if pose is None:
            return
        latency_s = pose.latency_s
        if latency_s is not None and latency_s > s.mocap_latency_warn_s:
            rule = MOCAP_TOO_LATE if latency_s > s.mocap_timeout_s else MOCAP_LATE
            findings.found(rule, "motion capture is {:.0f} ms late", latency_s * 1e3)
        fresh = self.trusted and pose.tracking_valid and awake_s - self._frame_awake_s < s.mocap_timeout_s
        if fresh and vehicle is not None and situation.airborne:
            self._compare(pose, vehicle, findings)

    @property
    def innovation_m(self) -> float:
        """Distance between the newest pose and the position predicted by the IMU; 0 while that is not judged."""
        return self._inertial.innovation_m

    def _predict(self, vehicle: VehicleState, boot_s: float) -> None:
        """All IMU samples that came since the last tick; `boot_s` is the time of the newest."""
        before = self._imu
        if before is not None and boot_s == before.imu_boot_s:
            return
        self._imu, self._imu_s = vehicle, self._px4_clock.local_s(boot_s, vehicle.imu_stamp_s)
        if before is None or before.imu_boot_s is None:
            return
        now, then = vehicle.delta_velocity_body_m_s, before.delta_velocity_body_m_s
        if now is None or then is None:
            return
        dt_s = boot_s - before.imu_boot_s
        (x, y, z), (bx, by, bz) = now, then
        x, y, z = quat_rotate(vehicle.attitude_wxyz, (x - bx, y - by, z - bz))
        self._inertial.imu(vehicle.imu_stamp_s, dt_s, (x, y, z - GRAVITY_M_S2 * dt_s))

    def _judge(self, pose: MocapPose, vehicle: VehicleState | None, awake_s: float) -> None:
        """A new frame."""
        before, believed = self._frame, self._believed
        gone_s = awake_s - self._frame_awake_s
        self._frame, self._frame_awake_s = pose, awake_s
        self._window_frames += 1
        self._streams.update(pose.frame_number, (pose.position_world_m, pose.attitude_wxyz), awake_s)
        # The gap was reported as lost; a rate over it says nothing about this stream.
        if gone_s > self._s.mocap_timeout_s:
            self._window_awake_s = self._rate_hz = None
        self.repeats = (
            before is not None
            and pose.position_world_m == before.position_world_m
            and pose.attitude_wxyz == before.attitude_wxyz
        )
        if before is None or pose.position_world_m != before.position_world_m or not pose.tracking_valid:
            self._same_since_s, self._moved = None, False
        elif self._same_since_s is None and pose.attitude_wxyz == before.attitude_wxyz:
            self._same_since_s, self._moved = awake_s, False
        if not pose.tracking_valid:
            return
        self._plausible = (
            believed is None or vehicle is None or gone_s > FORGET_S or self._follows(believed, pose, vehicle)
        )
        if self._plausible:
            self._believed, self._believed_awake_s = pose, awake_s
            # A repeated pose is judged by mocap_frozen: it is not passed on, and says nothing of how the vehicle moves.
            if not self.repeats:
                self._against_imu = self._inertial.pose(pose.stamp_s, pose.position_world_m, self._age_s(pose))
        else:
            self._against_imu = False

    def _age_s(self, pose: MocapPose) -> float:
        """Time from the exposure of a pose to the newest IMU sample, limited; negative if the pose is newer."""
        latency_s, sent_s = pose.latency_s or 0.0, pose.stamp_s
        if pose.exposure_server_s is not None:
            sent_s = self._server_clock.local_s(pose.exposure_server_s + latency_s, sent_s)
        return min(max(-IMU_GAP_MAX_S, self._imu_s - sent_s + latency_s), self._s.mocap_timeout_s)

    def _follows(self, before: MocapPose, pose: MocapPose, vehicle: VehicleState) -> bool:
        """The pose is where the body can be by now."""
        dt_s = pose.stamp_s - before.stamp_s
        x, y, z = pose.position_world_m
        if dt_s <= CONTINUOUS_S:
            vx, vy, vz = vehicle.velocity_world_m_s
            px, py, pz = before.position_world_m
            px, py, pz = px + vx * dt_s, py + vy * dt_s, pz + vz * dt_s
            allowed_m = self._s.mocap_jump_m
            reference = before.attitude_wxyz
        else:
            px, py, pz = vehicle.position_world_m
            allowed_m = min(self._s.mocap_jump_m + DRIFT_M_S * dt_s, self._s.estimate_disagreement_m)
            reference = vehicle.attitude_wxyz
        off_m2 = (x - px) ** 2 + (y - py) ** 2 + (z - pz) ** 2
        cos_half = abs(_dot(pose.attitude_wxyz, reference))
        if off_m2 <= allowed_m * allowed_m and cos_half >= self._jump_cos_half:
            return True
        turned_rad = 2.0 * math.acos(min(1.0, cos_half))
        turnable_rad = self._jump_rad + 1.5 * math.hypot(*vehicle.angular_rate_body_rad_s) * min(dt_s, CONTINUOUS_S)
        if off_m2 <= allowed_m * allowed_m and turned_rad <= turnable_rad:
            return True
        self._apart = (math.sqrt(off_m2), math.degrees(turned_rad))
        return False

    def _tell_lost(self, awake_s: float, findings: Findings) -> None:
        frame = self._frame
        if frame is None or awake_s - self._frame_awake_s > self._s.mocap_timeout_s:
            findings.found(MOCAP_LOST, "no motion capture")
        elif not frame.tracking_valid:
            findings.found(MOCAP_INVALID, "motion capture does not see the body")
        else:
            text = "motion capture jumped by {:.2f} m and {:.0f} deg and stays there: another body?"
            findings.found(MOCAP_SWAPPED, text, *self._apart)

    def _tell_rate(self, awake_s: float, findings: Findings) -> None:
        start_s = self._window_awake_s
        if start_s is None:
            self._window_awake_s, self._window_frames = awake_s, 0
        elif awake_s - start_s >= RATE_WINDOW_S:
            self._rate_hz = self._window_frames / (awake_s - start_s)
            self._window_awake_s, self._window_frames = awake_s, 0
        rate_hz, silent = self._rate_hz, awake_s - self._frame_awake_s > self._s.mocap_timeout_s
        if rate_hz is not None and rate_hz < self._s.mocap_rate_min_hz and not silent:
            findings.found(MOCAP_SLOW, "motion capture comes at {:.0f} Hz", rate_hz)

    def _compare(self, pose: MocapPose, vehicle: VehicleState, findings: Findings) -> None:
        apart_m = math.dist(vehicle.position_world_m, pose.position_world_m)
        if apart_m > self._s.estimate_disagreement_m:
            findings.found(ESTIMATE_DISAGREES, "PX4 and motion capture are {:.2f} m apart", apart_m)
        # Most ticks need no angles: attitudes that differ by less than the limit cannot differ by more in yaw, near level.
        if abs(_dot(vehicle.attitude_wxyz, pose.attitude_wxyz)) < math.cos(0.4 * self._yaw_disagreement_rad):
            turned_rad = _yaw_between(vehicle.attitude_wxyz, pose.attitude_wxyz)
            if turned_rad > self._yaw_disagreement_rad:
                text = "PX4 and motion capture are {:.0f} deg of yaw apart"
                findings.found(YAW_DISAGREES, text, math.degrees(turned_rad))


def _dot(a: Quat, b: Quat) -> float:
    return a[0] * b[0] + a[1] * b[1] + a[2] * b[2] + a[3] * b[3]


def _yaw_between(a: Quat, b: Quat) -> float:
    return abs(wrap_rad(euler_zyx_from_quat(a)[2] - euler_zyx_from_quat(b)[2]))
