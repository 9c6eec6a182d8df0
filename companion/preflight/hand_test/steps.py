"""The guided hand test: the operator carries the vehicle, rotors off, and every axis of motion capture is compared with the IMU. No
I/O.

The steps are: rest on the floor, lift, forward, turn left. Each step is recognised by the distance that motion capture measures, in
any direction, because the directions are under test. Directions are evaluated at the end
(`companion.preflight.hand_test.evaluation`).
"""

from __future__ import annotations

import math
from bisect import bisect_left
from dataclasses import dataclass
from enum import Enum
from typing import Final

from companion.model.types import MocapPose, Quat, Vec3, VehicleState
from companion.preflight.hand_test.motion import (
    GapError,
    ImuAt,
    Motion,
    PoseAt,
    mean_attitude,
    mean_vector,
    measure,
    turned_rad,
)

MOVE_WANTED_M: Final = 0.30
MOVE_MIN_M: Final = 0.18
TURN_WANTED_DEG: Final = 45.0
TURN_MIN_DEG: Final = 30.0
STEP_TIMEOUT_S: Final = 60.0
STAND_S: Final = 2.5
"""Time that the vehicle must rest on the floor before the test begins; longer than an accidental pause."""
STILL_S: Final = 0.6
STILL_M, STILL_DEG = 0.02, 5.0
"""Largest deviation from the mean within `STILL_S` for a vehicle of 3 kg held by hand."""
STAND_M, STAND_DEG = 0.004, 1.0
"""Largest deviation from the mean for a vehicle on the floor."""
MOVE_MAX_S: Final = 8.0
"""Longest motion that is evaluated, because the IMU's integration drifts."""
SILENCE_MAX_S: Final = 3.0
"""Timeout for PX4's report on whether it is armed."""
_PERIOD_S: Final = 0.05
_POSES_MIN: Final = 10
_SPARSE_S: Final = 0.12
"""Longest gap between poses in which the vehicle may still count as at rest."""
_KEEP_S: Final = 20.0


class Step(Enum):
    """Step of the test."""

    STAND = "stand"
    LIFT = "lift"
    FORWARD = "forward"
    TURN = "turn"
    DONE = "done"


_NEXT: Final = {Step.STAND: Step.LIFT, Step.LIFT: Step.FORWARD, Step.FORWARD: Step.TURN, Step.TURN: Step.DONE}
INSTRUCTIONS: Final = {
    Step.STAND: "place the vehicle on the floor and let go of it",
    Step.LIFT: "hold it by its legs, lift it straight up by 30 cm in about two seconds, and hold it still",
    Step.FORWARD: "move it 30 cm forward, where its nose points, without turning it; hold it still",
    Step.TURN: "turn it to the left, seen from above, by 45 deg; hold it still",
    Step.DONE: "done; put it back in its place",
}


@dataclass(frozen=True, slots=True)
class HandSample:
    """Data at one time of the flight clock."""

    t_s: float
    pose: MocapPose | None
    vehicle: VehicleState | None
    armed: bool | None
    """Whether PX4 is armed; None if it has not reported recently."""


@dataclass(frozen=True, slots=True)
class Stood:
    """State of the vehicle on the floor before it was lifted."""

    attitude: Quat
    """Attitude measured by motion capture."""
    force_m_s2: Vec3
    rate_rad_s: Vec3
    """Specific force and rate measured by the IMU, body FLU; the rate is the gyro's bias."""


@dataclass(frozen=True, slots=True)
class HandResult:
    """All measurements of a finished test."""

    stood: Stood
    lift: Motion
    forward: Motion
    turn: Motion


@dataclass(frozen=True, slots=True)
class HandView:
    """Progress of the test for display."""

    step: Step
    progress: float
    seen: str
    """Motion measured by motion capture, as text."""
    notice: str
    """Why the last attempt did not count; empty if there was none."""
    ended: str
    """Why the test ended without a result; empty while it runs."""
    result: HandResult | None


@dataclass(frozen=True, slots=True)
class _Rest:
    from_s: float
    to_s: float
    position_m: Vec3
    attitude: Quat


class HandTest:
    """State of the test. Call `update` with each sample in time order."""

    def __init__(self) -> None:
        self._poses: list[PoseAt] = []
        self._imu: list[ImuAt] = []
        self._frame: int | None = None
        self._step = Step.STAND
        self._step_s: float | None = None
        self._due_s = -math.inf
        self._heard_s: float | None = None
        self._still_since_s: float | None = None
        self._rest: _Rest | None = None
        self._stood: Stood | None = None
        self._motions: dict[Step, Motion] = {}
        self._notice = self._ended = self._seen = ""
        self._progress = 0.0

    def update(self, sample: HandSample) -> HandView:
        """Process one sample and return the state of the test."""
        if self._step_s is None:
            self._step_s = self._heard_s = sample.t_s
        if not self._ended and self._step is not Step.DONE:
            self._hear(sample)
            if not self._ended and sample.t_s >= self._due_s:
                self._due_s = sample.t_s + _PERIOD_S
                self._look(sample.t_s)
        result = None
        if self._step is Step.DONE:
            assert self._stood is not None
            m = self._motions
            result = HandResult(self._stood, m[Step.LIFT], m[Step.FORWARD], m[Step.TURN])
        return HandView(
            step=self._step,
            progress=self._progress,
            seen=self._seen,
            notice=self._notice,
            ended=self._ended,
            result=result,
        )

    def _hear(self, sample: HandSample) -> None:
        assert self._heard_s is not None
        if sample.armed:
            self._ended = "PX4 reports that it is armed: put the vehicle down, disarm it, and start again"
            return
        if sample.armed is not None:
            self._heard_s = sample.t_s
        elif sample.t_s - self._heard_s > SILENCE_MAX_S:
            self._ended = f"PX4 has not reported for {SILENCE_MAX_S:g} s whether it is armed: check the link"
            return
        pose, vehicle = sample.pose, sample.vehicle
        if pose is not None and pose.tracking_valid and pose.frame_number != self._frame:
            self._frame = pose.frame_number
            if not self._poses or pose.stamp_s > self._poses[-1].t_s:
                self._poses.append(PoseAt(pose.stamp_s, pose.position_world_m, pose.attitude_wxyz))
        if vehicle is not None and (not self._imu or vehicle.imu_stamp_s > self._imu[-1].t_s):
            self._imu.append(
                ImuAt(vehicle.imu_stamp_s, vehicle.specific_force_body_m_s2, vehicle.angular_rate_body_rad_s)
            )

    def _look(self, t_s: float) -> None:
        assert self._step_s is not None
        still = self._still(t_s)
        self._still_since_s = None if still is None else self._still_since_s or t_s - STILL_S
        if self._step is Step.STAND:
            self._stand(t_s)
        elif self._rest is not None:
            self._move(t_s, self._rest, still)
        if self._step is not Step.DONE and t_s - self._step_s > STEP_TIMEOUT_S:
            self._ended = f"not done within {STEP_TIMEOUT_S:g} s: {INSTRUCTIONS[self._step]} ({self._why(t_s)})"

    def _why(self, t_s: float) -> str:
        for samples, what in (
            (self._poses, "motion capture does not track the rigid body"),
            (self._imu, "no state from PX4: position, attitude and IMU are needed"),
        ):
            if not samples or t_s - samples[-1].t_s > 1.0:
                return what
        return self._notice or f"motion capture: {self._seen or 'nothing'}"

    def _still(
        self, t_s: float, window_s: float = STILL_S, within_m: float = STILL_M, within_deg: float = STILL_DEG
    ) -> _Rest | None:
        """Return the mean pose of the last `window_s`, or None if the vehicle moved or was not tracked."""
        recent = self._poses[bisect_left(self._poses, t_s - window_s, key=lambda pose: pose.t_s) :]
        if len(recent) < _POSES_MIN or recent[0].t_s > t_s - window_s + _SPARSE_S or recent[-1].t_s < t_s - _SPARSE_S:
            return None
        # A few samples distinguish rest from motion; 200 per second are not needed.
        some = recent[:: max(1, len(recent) // 24)]
        position = mean_vector([pose.position_m for pose in some])
        if max(math.dist(pose.position_m, position) for pose in some) > within_m:
            return None
        attitude = mean_attitude([pose.attitude for pose in some])
        if max(turned_rad(pose.attitude, attitude) for pose in some) > math.radians(within_deg):
            return None
        return _Rest(t_s - window_s, t_s, position, attitude)

    def _stand(self, t_s: float) -> None:
        assert self._step_s is not None
        rest = self._still(t_s, STAND_S, STAND_M, STAND_DEG)
        stood_s = 0.0 if self._still_since_s is None else t_s - max(self._still_since_s, self._step_s)
        self._progress = min(1.0, stood_s / STAND_S)
        self._seen = (
            "the vehicle is at rest" if self._still_since_s is not None else "the vehicle is moving or is not tracked"
        )
        felt = self._imu[bisect_left(self._imu, t_s - STAND_S, key=lambda sample: sample.t_s) :]
        if rest is None or len(felt) < _POSES_MIN:
            return
        self._stood = Stood(
            rest.attitude,
            mean_vector([sample.force_m_s2 for sample in felt]),
            mean_vector([sample.rate_rad_s for sample in felt]),
        )
        self._go_on(t_s, rest)

    def _move(self, t_s: float, before: _Rest, still: _Rest | None) -> None:
        turning = self._step is Step.TURN
        if not self._poses:
            return
        at = self._poses[-1] if still is None else still
        moved_m = math.dist(at.position_m, before.position_m)
        turned_deg = math.degrees(turned_rad(before.attitude, at.attitude))
        self._progress = min(1.0, turned_deg / TURN_WANTED_DEG if turning else moved_m / MOVE_WANTED_M)
        self._seen = f"turned by {turned_deg:.0f} deg" if turning else f"moved by {100.0 * moved_m:.0f} cm"
        if still is None:
            return
        share = turned_deg / TURN_MIN_DEG if turning else moved_m / MOVE_MIN_M
        if share < 0.25:
            self._rest = still  # not begun; a move is measured from the last rest before it
        elif share >= 1.0:
            self._take(t_s, before, still)

    def _take(self, t_s: float, before: _Rest, after: _Rest) -> None:
        assert self._stood is not None
        start_s, end_s = before.to_s - 0.5 * STILL_S, after.from_s + 0.5 * STILL_S
        if end_s - start_s > MOVE_MAX_S:
            self._again(
                after, f"the move took {end_s - start_s:.0f} s, too long for the IMU: repeat it in about two seconds"
            )
            return
        try:
            motion = measure(self._poses, self._imu, start_s, end_s, self._stood.rate_rad_s)
        except GapError as error:
            self._again(after, f"{error}: repeat the move")
            return
        self._motions[self._step] = motion
        self._go_on(t_s, after)

    def _again(self, rest: _Rest, notice: str) -> None:
        self._notice = notice
        self._rest = rest

    def _go_on(self, t_s: float, rest: _Rest) -> None:
        self._step, self._step_s, self._rest = _NEXT[self._step], t_s, rest
        self._notice = self._seen = ""
        self._progress = 1.0 if self._step is Step.DONE else 0.0
        oldest_s = t_s - _KEEP_S
        del self._poses[: bisect_left(self._poses, oldest_s, key=lambda pose: pose.t_s)]
        del self._imu[: bisect_left(self._imu, oldest_s, key=lambda sample: sample.t_s)]
