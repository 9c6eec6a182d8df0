"""The landing after a takeover: the guardian keeps sending motion capture to PX4, PX4 lands, and the guardian disarms if PX4 does not.
Before the landing the vehicle moves back from a surface that its tool may touch.

The rules are those of the companion's own landing on PX4 (`companion.safety.autopilot_landing`). Pure except for the link; time is
an argument.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable
from typing import Any

from pymavlink.dialects.v20 import common as mavlink

from companion.guardian.heartbeat import Heartbeat
from companion.guardian.link import Link
from companion.guardian.px4 import Px4State
from companion.guardian.retreat import Retreat
from companion.model.best_pose import tracked_pose
from companion.model.flight_stage import is_killed
from companion.model.types import (
    AutopilotRequest,
    AutopilotStatus,
    Event,
    FlightMode,
    Inputs,
    MocapPose,
    OperatorCommand,
    SafetyAction,
    Severity,
)
from companion.safety.autopilot_landing import TIMEOUT_S, AutopilotLanding, LandingStep
from companion.safety.pose_filter import PoseFilter

HEARTBEAT_PERIOD_S = 1.0
ASK_PERIOD_S = 0.1
"""Period at which the guardian requests PX4's mode, which PX4 otherwise sends once a second."""
LINK_TIMEOUT_S = 1.0
"""Timeout for PX4's first message, which reveals its address on a `udpin` link. After the timeout the landing starts without a
message.
"""
MODE_TIMEOUT_S = 0.15
"""Timeout for PX4's mode, which is requested first because a pilot may be flying. After the timeout PX4 is commanded to land."""
REPEAT_S = 0.25
"""Period at which a command is repeated until the status shows its effect."""
ZERO_THRUST_PERIOD_S = 0.02
RETREAT_PERIOD_S = 0.02
POSITION_FRESH_S = 0.1
RETREAT_WAIT_S = 0.3
"""Timeout for PX4's position, from which the way back from a surface begins; it is streamed every 20 ms."""
LINK_FRESH_S = 2.5
KILLED = "PX4's kill switch or flight termination has stopped the rotors"
TOUCH_DOWN = "touchdown"
"""Text of `LandingStep` at touchdown."""
DISARMED_AFTER_S = 1.5
"""Time after the takeover for which `disarmed` is ignored: PX4 reports it once a second, so the report may predate the takeover."""
ATTEMPTS_MAX = 4
"""Maximum number of landing attempts, 30 s each, while PX4 sends messages. After the last one the vehicle counts as lost."""
_STREAMS = (
    (mavlink.MAVLINK_MSG_ID_LOCAL_POSITION_NED, 50.0),
    (mavlink.MAVLINK_MSG_ID_ATTITUDE_QUATERNION, 50.0),
    (mavlink.MAVLINK_MSG_ID_HIGHRES_IMU, 50.0),
    (mavlink.MAVLINK_MSG_ID_EXTENDED_SYS_STATE, 10.0),
    (mavlink.MAVLINK_MSG_ID_ESTIMATOR_STATUS, 10.0),
)


Notify = Callable[[Event], None]


def notice(t_s: float, event_id: str, severity: Severity, text: str) -> Event:
    """Return an event of the guardian, with which PX4 lands or has landed."""
    return Event(t_s=t_s, id=event_id, severity=severity, action=SafetyAction.AUTOPILOT_LAND, text=text)


class TakeoverLanding:
    """Controls the vehicle from the takeover to the disarm.

    Args:
        last_heartbeat: newest heartbeat of the flight process.
        clearance_m: height of the body's origin when the vehicle rests on the ground.
        tilt_max_rad: `safety.tilt_abort_deg`, in rad.
        pose_filter: judges the poses that are sent to PX4; its newest trusted pose becomes that of the heartbeat.
        link: an open link.
        t_s: current flight clock.
        notify: called with each notice.
        external: another program feeds PX4 with poses; the report of PX4's estimator shows whether PX4 uses them.
    """

    def __init__(
        self,
        last_heartbeat: Heartbeat,
        clearance_m: float,
        tilt_max_rad: float,
        pose_filter: PoseFilter,
        link: Link,
        t_s: float,
        notify: Notify,
        *,
        external: bool = False,
    ) -> None:
        self._external = external
        self._clearance_m = clearance_m
        self._tilt_max_rad = tilt_max_rad
        self._link = link
        self._notify = notify
        self._px4 = Px4State()
        self._pose_filter = pose_filter
        pose_filter.trusted = pose_filter.tracked = _last_pose(last_heartbeat)
        self._start_s = t_s
        self._spoken_s: float | None = None
        self._pilot = last_heartbeat.pilot
        self._mocap_refused = last_heartbeat.mocap_refused
        self._pose_s = last_heartbeat.pose_stamp_s
        """Stamp of the newest pose that PX4 received, from the flight process or the guardian."""
        self._back_world_m = None if last_heartbeat.mocap_refused else last_heartbeat.back_world_m
        """The way back from a surface; None if there is none to fly."""
        self._retreat: Retreat | None = None
        self._retreat_s = float("-inf")
        self._landing: AutopilotLanding | None = None
        self._attempts = 0
        self._tick = last_heartbeat.tick
        self._pose: MocapPose | None = None
        self._heartbeat_s = self._asked_s = self._zero_s = float("-inf")
        self._request = AutopilotRequest.NONE
        self._requested_s = float("-inf")
        self._notified: set[str] = set()
        self.overturned = False
        """Whether the rotors were commanded to stop because the vehicle was flipped or tipped over."""
        self.landed: bool | None = None
        """None during the landing; then True if the vehicle is on the ground (disarmed, or PX4 does not answer), False if no
        landing was confirmed.
        """

    @property
    def pose(self) -> MocapPose | None:
        """Newest pose that was sent to PX4."""
        return self._pose

    def status(self) -> AutopilotStatus | None:
        """Return PX4's newest status, or None before its first HEARTBEAT."""
        return self._px4.status()

    def take_poses(self, poses: Iterable[MocapPose]) -> None:
        """Send plausible poses to PX4 at once; send none if the flight process landed because it rejected motion capture."""
        for pose in poses:
            if not pose.tracking_valid:
                continue
            if self._mocap_refused:
                text = "the flight process rejected motion capture; no poses are sent to PX4, which lands on its own estimate"
                self._notify_once(pose.stamp_s, "guardian_mocap", Severity.WARNING, text)
                continue
            vehicle = self._px4.vehicle()
            if vehicle is not None and pose.stamp_s - vehicle.position_stamp_s > POSITION_FRESH_S:
                vehicle = None
            if not self._pose_filter.check(pose, vehicle):
                # Until PX4 has sent its position, which takes some tens of milliseconds, a pose after a gap cannot be judged.
                if vehicle is not None:
                    text = "the motion-capture pose jumped, repeats or is late; it is not sent to PX4"
                    self._notify_once(pose.stamp_s, "guardian_mocap", Severity.WARNING, text)
                continue
            self._link.send_vision(pose)
            self._pose = pose
            self._pose_s = max(self._pose_s, pose.stamp_s)

    def take_messages(self, t_s: float, messages: Iterable[Any]) -> None:
        """Process messages from PX4."""
        for message in messages:
            self._px4.take(t_s, message)

    def link_reopened(self) -> None:
        """Request the message streams again in the next step: PX4 may have restarted, or may not have sent to this port before."""
        self._spoken_s = None

    def step(self, t_s: float) -> None:
        """Run one step; call every 10 ms."""
        if self._spoken_s is None:
            if not self._link.wire.ready and t_s - self._start_s < LINK_TIMEOUT_S:
                return
            self._spoken_s = t_s
            for message_id, rate_hz in _STREAMS:
                self._link.request_rate(message_id, rate_hz)
        if t_s - self._heartbeat_s >= HEARTBEAT_PERIOD_S:
            self._heartbeat_s = t_s
            self._link.send_heartbeat()
        if t_s - self._asked_s >= ASK_PERIOD_S:
            self._asked_s = t_s
            self._link.request_message(mavlink.MAVLINK_MSG_ID_HEARTBEAT)
        status = self._px4.status()
        if status is None and t_s - self._spoken_s < MODE_TIMEOUT_S:
            return
        self._check_pilot(t_s)
        if self._retreats(t_s, status):
            return
        if self._landing is None:
            self._attempts += 1
            self._landing = AutopilotLanding.begin(
                t_s, self._clearance_m, self._tilt_max_rad, self._pilot, pose_s=self._pose_s
            )
        self._tick += 1
        self._landing, step = self._landing.step(self._inputs(t_s, status))
        self.overturned = self.overturned or self._landing.overturned
        self._apply(t_s, status, step)

    def restart(self, t_s: float) -> None:
        """Start a new landing after an internal error. PX4 is commanded to land even if no landing had begun."""
        self._landing = self._back_world_m = None
        status = self._px4.status()
        if not self._pilot and status is not None and status.mode is not FlightMode.LAND and status.armed:
            self._send_request(t_s, AutopilotRequest.LAND)
        disarmed = status is not None and not status.armed and t_s - self._start_s > DISARMED_AFTER_S
        if disarmed or t_s - self._start_s > ATTEMPTS_MAX * TIMEOUT_S:
            self.landed = disarmed

    def _retreats(self, t_s: float, status: AutopilotStatus | None) -> bool:
        """Move back from the surface; return whether that goes on. If PX4 is not in OFFBOARD or sends no position, it lands at once."""
        back_m, vehicle = self._back_world_m, self._px4.vehicle()
        if back_m is None:
            return False
        self._back_world_m = None  # unless the motion goes on: it is not begun again
        if self._pilot or status is None or status.mode is not FlightMode.OFFBOARD or not status.armed:
            return False
        if self._retreat is None:
            if vehicle is None or t_s - vehicle.position_stamp_s > POSITION_FRESH_S:
                waits = self._spoken_s is not None and t_s - self._spoken_s < RETREAT_WAIT_S
                self._back_world_m = back_m if waits else None
                return waits
            self._retreat = Retreat.begin(t_s, vehicle, back_m)
            self._notify_once(
                t_s, "guardian_retreat", Severity.WARNING, "moving back from the surface before PX4 lands"
            )
        setpoint = self._retreat.setpoint(t_s)
        if setpoint is None:
            return False
        self._back_world_m = back_m
        if t_s - self._retreat_s >= RETREAT_PERIOD_S:
            self._retreat_s = t_s
            self._link.send_position(t_s, setpoint)
        return True

    def _check_pilot(self, t_s: float) -> None:
        if not self._pilot and self._px4.pilot:
            self._pilot = True
            self._landing = None
        if self._pilot:
            found = KILLED if is_killed(self._px4.status()) else "a pilot is flying"
            text = f"{found}: {'nothing' if self._external else 'only motion capture'} is sent to PX4"
            self._notify_once(t_s, "guardian_pilot", Severity.WARNING, text)

    def _apply(self, t_s: float, status: AutopilotStatus | None, step: LandingStep) -> None:
        mode = status.mode if status is not None else FlightMode.UNKNOWN
        if mode is FlightMode.LAND and not self._pilot:
            self._notify_once(t_s, "guardian_land", Severity.WARNING, "PX4 lands")
        if step.text == TOUCH_DOWN:
            self._notify_once(t_s, "guardian_touchdown", Severity.INFO, step.text)
        elif step.text is not None and not step.ended:
            self._notify_once(t_s, "guardian_landing", Severity.WARNING, step.text)
        if step.zero_thrust and t_s - self._zero_s >= ZERO_THRUST_PERIOD_S:
            self._zero_s = t_s
            self._link.send_zero_thrust(t_s, self._px4.yaw_rad() or 0.0)
        if step.request is not AutopilotRequest.NONE and not (
            step.request is AutopilotRequest.LAND and mode is FlightMode.LAND
        ):
            self._send_request(t_s, step.request)
        if step.ended:
            self._end(t_s, status, step)

    def _send_request(self, t_s: float, request: AutopilotRequest) -> None:
        if request is self._request and t_s - self._requested_s < REPEAT_S:
            return
        if request is self._request and self._px4.refusal is not None:
            text = f"PX4 rejected {request.value}: {self._px4.refusal}"
            self._notify_once(t_s, "guardian_refused", Severity.WARNING, text)
        self._request, self._requested_s = request, t_s
        self._link.send_request(request)

    def _end(self, t_s: float, status: AutopilotStatus | None, step: LandingStep) -> None:
        if step.landed:
            self._notify_once(
                t_s, "guardian_landed", Severity.INFO, step.text or "the vehicle is on the ground and disarmed"
            )
            self.landed = True
            return
        heard = status is not None and t_s - status.heartbeat_stamp_s < LINK_FRESH_S
        if heard and self._attempts < ATTEMPTS_MAX:
            self._landing = None  # PX4 answers: try again
            return
        self._notify_once(t_s, "guardian_lost_vehicle", Severity.CRITICAL, step.text or "no landing could be confirmed")
        self.landed = False

    def _inputs(self, t_s: float, status: AutopilotStatus | None) -> Inputs:
        return Inputs(
            tick=self._tick,
            t_s=t_s,
            vehicle=self._px4.vehicle(),
            status=status,
            mocap=self._pose,
            command=OperatorCommand.NONE,
            recorder_dropped=0,
            estimator=self._px4.estimator if self._external else None,
        )

    def _notify_once(self, t_s: float, event_id: str, severity: Severity, text: str) -> None:
        """Report an event, once per id and text."""
        if event_id + text not in self._notified:
            self._notified.add(event_id + text)
            self._notify(notice(t_s, event_id, severity, text))


def _last_pose(last: Heartbeat) -> MocapPose | None:
    """Return the newest pose that the flight process accepted; None if there was none."""
    if last.pose_stamp_s == float("-inf"):
        return None
    return tracked_pose(last.pose_stamp_s, last.position_world_m, last.attitude_wxyz)
