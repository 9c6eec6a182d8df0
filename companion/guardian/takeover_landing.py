"""The guardian in charge: motion capture goes on flowing to PX4, PX4 lands, and the guardian finishes what PX4 cannot.

The landing itself is the companion's own (`companion.mission.autopilot_landing`): the same rules, other inputs. Pure but for the link
that it sends on; time is an argument.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable
from dataclasses import dataclass
from typing import Any

from pymavlink.dialects.v20 import common as mavlink

from companion.guardian.heartbeat import Beat
from companion.guardian.link import Link
from companion.guardian.monitors import Plausible
from companion.guardian.px4 import Px4State
from companion.mission.autopilot_landing import TIMEOUT_S, AutopilotLanding, LandingStep
from companion.model.types import (
    AutopilotRequest,
    AutopilotStatus,
    FlightMode,
    Inputs,
    MocapPose,
    OperatorCommand,
    SafetyAction,
    Severity,
)

HEARTBEAT_PERIOD_S = 1.0
ASK_PERIOD_S = 0.1
"""PX4 says its mode once a second; asked for, at once."""
LINK_TIMEOUT_S = 1.0
"""On a `udpin` link PX4, which streams all the time, is heard before it is spoken to; after this nobody is waited for."""
MODE_TIMEOUT_S = 0.15
"""Whether a pilot flies is asked first; without an answer for this long PX4 is told to land."""
REPEAT_S = 0.25
"""A command is given again until the status shows it done."""
ZERO_THRUST_PERIOD_S = 0.02
LINK_FRESH_S = 2.5
TOUCH_DOWN = "touchdown"
"""What the landing says when it feels the floor."""
DISARMED_AFTER_S = 1.5
"""PX4 says once a second whether it is armed; an older word does not count."""
ROUNDS = 4
"""Landings of 30 s each that are watched before the vehicle counts as lost, as long as PX4 answers."""
_STREAMS = (
    (mavlink.MAVLINK_MSG_ID_LOCAL_POSITION_NED, 50.0),
    (mavlink.MAVLINK_MSG_ID_ATTITUDE_QUATERNION, 50.0),
    (mavlink.MAVLINK_MSG_ID_HIGHRES_IMU, 50.0),
    (mavlink.MAVLINK_MSG_ID_EXTENDED_SYS_STATE, 10.0),
)


@dataclass(frozen=True, slots=True)
class Told:
    """Something for people: log, summary and display."""

    t_s: float
    id: str
    severity: Severity
    action: SafetyAction
    text: str


Tell = Callable[[Told], None]


class Charge:
    """From the take-over to the disarm.

    Args:
        beat: the flight process's last word.
        clearance_m: height of the body's origin when the vehicle stands.
        tilt_max_rad: `safety.tilt_abort_deg`.
        link: open.
        t_s: now, on the flight clock.
        tell: takes what people must know.
    """

    def __init__(self, beat: Beat, clearance_m: float, tilt_max_rad: float, link: Link, t_s: float, tell: Tell) -> None:
        self._clearance_m = clearance_m
        self._tilt_max_rad = tilt_max_rad
        self._link = link
        self._tell = tell
        self._px4 = Px4State()
        self._plausible = Plausible(beat.pose_stamp_s, beat.position_world_m)
        self._start_s = t_s
        self._spoken_s: float | None = None
        self._pilot = beat.pilot
        self._mocap_refused = beat.mocap_refused
        self._pose_s = beat.pose_stamp_s
        """Of the newest pose that PX4 has had, by the flight process or by the guardian."""
        self._landing: AutopilotLanding | None = None
        self._rounds = 0
        self._tick = beat.tick
        self._pose: MocapPose | None = None
        self._pose_sent_s: float | None = None
        self._heartbeat_s = self._asked_s = self._zero_s = float("-inf")
        self._request = AutopilotRequest.NONE
        self._requested_s = float("-inf")
        self._told: set[str] = set()
        self.overturned = False
        """The vehicle was flipped or tipped over, and its rotors were to be stopped for that."""
        self.landed: bool | None = None
        """Set at the end: the vehicle stands disarmed (or stands, and nobody answers), or nothing more can be done."""

    @property
    def pose(self) -> MocapPose | None:
        """Newest pose that went to PX4."""
        return self._pose

    def status(self) -> AutopilotStatus | None:
        """What PX4 said last about itself."""
        return self._px4.status()

    def take_poses(self, poses: Iterable[MocapPose]) -> None:
        """Motion capture: pass on at once what can be true; nothing if the flight process landed because it did not believe it."""
        for pose in poses:
            if not pose.tracking_valid:
                continue
            if self._mocap_refused:
                text = "motion capture was not believed by the flight process; held back from PX4, which lands on its own estimate"
                self._say(pose.stamp_s, "guardian_mocap", Severity.WARNING, text)
                continue
            if not self._plausible.check(pose.stamp_s, pose.position_world_m):
                self._say(pose.stamp_s, "guardian_mocap", Severity.WARNING, "motion capture jumps; held back from PX4")
                continue
            self._link.vision(pose)
            self._pose = pose
            self._pose_s = max(self._pose_s, pose.stamp_s)

    def take_messages(self, t_s: float, messages: Iterable[Any]) -> None:
        """What PX4 says."""
        for message in messages:
            self._px4.take(t_s, message)

    def link_reopened(self) -> None:
        """Ask for the streams again with the next step: PX4 may have restarted, or the port is a new one to it."""
        self._spoken_s = None

    def step(self, t_s: float) -> None:
        """Every hundredth of a second."""
        if self._spoken_s is None:
            if not self._link.wire.ready and t_s - self._start_s < LINK_TIMEOUT_S:
                return
            self._spoken_s = t_s
            for message_id, rate_hz in _STREAMS:
                self._link.set_rate(message_id, rate_hz)
        if t_s - self._heartbeat_s >= HEARTBEAT_PERIOD_S:
            self._heartbeat_s = t_s
            self._link.heartbeat()
        if t_s - self._asked_s >= ASK_PERIOD_S:
            self._asked_s = t_s
            self._link.ask_for(mavlink.MAVLINK_MSG_ID_HEARTBEAT)
        status = self._px4.status()
        if status is None and t_s - self._spoken_s < MODE_TIMEOUT_S:
            return
        self._mind_the_pilot(t_s)
        if self._landing is None:
            self._rounds += 1
            self._landing = AutopilotLanding(
                t_s, self._clearance_m, self._tilt_max_rad, self._pilot, pose_s=self._pose_s
            )
        self._tick += 1
        step = self._landing.step(self._inputs(t_s, status))
        self.overturned = self.overturned or self._landing.overturned
        self._carry_out(t_s, status, step)

    def begin_again(self, t_s: float) -> None:
        """The landing met an error of its own: a new one begins with the next step. If none gets anywhere, PX4 is told all the same."""
        self._landing = None
        status = self._px4.status()
        if not self._pilot and status is not None and status.mode is not FlightMode.LAND and status.armed:
            self._ask(t_s, AutopilotRequest.LAND)
        disarmed = status is not None and not status.armed and t_s - self._start_s > DISARMED_AFTER_S
        if disarmed or t_s - self._start_s > ROUNDS * TIMEOUT_S:
            self.landed = disarmed

    def _mind_the_pilot(self, t_s: float) -> None:
        if not self._pilot and self._px4.pilot:
            self._pilot = True
            self._landing = None
        if self._pilot:
            text = "a pilot flies: motion capture goes on, nothing else is sent"
            self._say(t_s, "guardian_pilot", Severity.WARNING, text)

    def _carry_out(self, t_s: float, status: AutopilotStatus | None, step: LandingStep) -> None:
        mode = status.mode if status is not None else FlightMode.UNKNOWN
        if mode is FlightMode.LAND and not self._pilot:
            self._say(t_s, "guardian_land", Severity.WARNING, "PX4 lands")
        if step.text == TOUCH_DOWN:
            self._say(t_s, "guardian_touchdown", Severity.INFO, step.text)
        elif step.text is not None and not step.ended:
            self._say(t_s, "guardian_landing", Severity.WARNING, step.text)
        if step.zero_thrust and t_s - self._zero_s >= ZERO_THRUST_PERIOD_S:
            self._zero_s = t_s
            self._link.stand_still(t_s, self._px4.yaw_rad() or 0.0)
        if step.request is not AutopilotRequest.NONE and not (
            step.request is AutopilotRequest.LAND and mode is FlightMode.LAND
        ):
            self._ask(t_s, step.request)
        if step.ended:
            self._end(t_s, status, step)

    def _ask(self, t_s: float, request: AutopilotRequest) -> None:
        if request is self._request and t_s - self._requested_s < REPEAT_S:
            return
        if request is self._request and self._px4.refusal is not None:
            text = f"PX4 refuses {request.value}: {self._px4.refusal}"
            self._say(t_s, "guardian_refused", Severity.WARNING, text)
        self._request, self._requested_s = request, t_s
        self._link.request(request)

    def _end(self, t_s: float, status: AutopilotStatus | None, step: LandingStep) -> None:
        if step.landed:
            self._say(t_s, "guardian_landed", Severity.INFO, step.text or "the vehicle stands and is disarmed")
            self.landed = True
            return
        heard = status is not None and t_s - status.heartbeat_stamp_s < LINK_FRESH_S
        if heard and self._rounds < ROUNDS:
            self._landing = None  # PX4 is there: go on as long as that is so
            return
        self._say(t_s, "guardian_lost_vehicle", Severity.CRITICAL, step.text or "no landing could be confirmed")
        self.landed = False

    def _inputs(self, t_s: float, status: AutopilotStatus | None) -> Inputs:
        return Inputs(
            tick=self._tick,
            t_s=t_s,
            vehicle=self._px4.vehicle(),
            status=status,
            mocap=self._pose,
            arm=None,
            force=None,
            command=OperatorCommand.NONE,
            recorder_dropped=0,
        )

    def _say(self, t_s: float, event_id: str, severity: Severity, text: str) -> None:
        """Once per id and text."""
        if event_id + text not in self._told:
            self._told.add(event_id + text)
            self._tell(Told(t_s, event_id, severity, SafetyAction.AUTOPILOT_LAND, text))
