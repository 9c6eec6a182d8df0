"""Motion capture of the fast closed loop: what the companion's client makes of the frames, without their encoding."""

from __future__ import annotations

from companion.config.devices import MocapDevice
from companion.io.mocap.client import KEEP_ALIVE_PERIOD_S
from companion.io.mocap.markers import marker_frame
from companion.io.mocap.server_clock import ServerClock
from companion.model.markers import MarkerFrame
from companion.model.team import BarPose
from companion.model.types import MocapPose, Vec3
from sitl.faults.injector import Faults
from sitl.mocap import MocapFrame


class FastMocap:
    """The newest pose, markers and bar that the companion has received."""

    def __init__(self, device: MocapDevice, faults: Faults | None) -> None:
        self._faults, self._external = faults, device.external
        self._sees_ball, self._sees_bar = device.ball is not None, device.bar_id is not None
        self.newest: MocapPose | None = None
        """Newest pose; None before the first frame, and if another program feeds PX4 with poses: the companion receives none."""
        self.markers: MarkerFrame | None = None
        self.bar: BarPose | None = None
        self._tracked_m: Vec3 = (0.0, 0.0, 0.0)
        """Newest position at which the vehicle's body was tracked."""
        self._server_clock, self._echo_due_s = ServerClock(), 0.0

    def receive(self, frame: MocapFrame, t_s: float) -> MocapPose:
        """Process a frame that arrives at world time `t_s`; return its pose."""
        pose = self.pose(frame, t_s)
        if not self._external:
            self.newest = pose
        if self._sees_bar and frame.bar is not None:
            at, turned = frame.bar
            self.bar = BarPose(stamp_s=t_s, position_world_m=at, attitude_wxyz=turned, tracking_valid=True)
        if self._sees_ball:
            self._tracked_m = pose.position_world_m if pose.tracking_valid else self._tracked_m
            self.markers = marker_frame(t_s, pose.latency_s, pose.frame_number, frame.markers, self._tracked_m)
        return pose

    def pose(self, frame: MocapFrame, t_s: float) -> MocapPose:
        """Return the pose of a frame that arrives at world time `t_s`, with its age by the server's clock."""
        number, exposure_s, position, attitude, valid, network_s, _, _ = frame
        latency_s, exposure_server_s = t_s - exposure_s, exposure_s
        if self._faults is not None:
            clock = self._faults.server_clock_s
            if t_s >= self._echo_due_s:
                self._echo_due_s = t_s + KEEP_ALIVE_PERIOD_S
                self._server_clock.echo(t_s, clock(t_s))
            exposure_server_s = clock(exposure_s)
            latency_s = clock(t_s - network_s) - exposure_server_s
            latency_s = self._server_clock.age_s(exposure_server_s, latency_s, t_s)
        return MocapPose(
            stamp_s=t_s,
            latency_s=latency_s,
            frame_number=number,
            position_world_m=position,
            attitude_wxyz=attitude,
            tracking_valid=valid,
            marker_error_m=0.0002,
            exposure_server_s=exposure_server_s,
        )
