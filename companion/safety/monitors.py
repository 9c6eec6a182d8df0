"""All monitors of one flight: the trackers are updated with each tick's inputs, then the event table is evaluated. Pure.

See `companion.safety` for how to add a rule.
"""

from __future__ import annotations

from typing import Final

import msgspec

from companion.config.vehicle import Vehicle
from companion.model.outputs import ActiveRule
from companion.model.types import Event, Inputs, MocapPose, VehicleState
from companion.safety.arm import ArmTracker, ForceTracker
from companion.safety.evaluation import Evaluation
from companion.safety.flight import FlightTracker
from companion.safety.flight_context import FlightContext
from companion.safety.mocap import MocapTracker
from companion.safety.pose_filter import PoseFilter
from companion.safety.process import ProcessTracker
from companion.safety.px4 import Px4Tracker
from companion.safety.rule import Subject
from companion.safety.team import TeamTracker
from companion.safety.validity import InputFilter
from companion.safety.vision import VisionTracker

AWAKE_STEP_MAX_S: Final = 0.02
"""Largest time that one tick adds to the age of inputs."""
LOCATED_S: Final = 1.0
"""Time without a trusted pose after which PX4's position means nothing: rules about the vehicle's place hold no longer."""
MOVING_M_S: Final = 0.03
MOVING_RAD_S: Final = 0.05
"""Motion that exceeds the noise of a vehicle at rest, so that its measurements must change."""


class Monitors:
    """Trackers and rules of one flight.

    Args:
        vehicle: thresholds, joint limits, room and tether.
    """

    def __init__(self, vehicle: Vehicle) -> None:
        self._filter = InputFilter()
        self._mocap = MocapTracker(vehicle.safety)
        self._px4 = Px4Tracker(vehicle.airframe.ground_clearance_m)
        self._arm = ArmTracker()
        self._force = ForceTracker(
            vehicle.safety.force_stuck_s, vehicle.safety.force_disagreement_n, vehicle.airframe.ground_clearance_m
        )
        self._process = ProcessTracker()
        self._flight = FlightTracker(vehicle)
        trackers: dict[Subject, object] = {
            Subject.INPUTS: self._filter,
            Subject.PX4: self._px4,
            Subject.PROCESS: self._process,
            Subject.FLIGHT: self._flight,
            Subject.OPERATOR: self._process,
        }
        self._vision = VisionTracker() if vehicle.devices.mocap.external else None
        if self._vision is None:
            trackers[Subject.MOCAP] = self._mocap
        else:
            trackers[Subject.VISION] = self._vision
        if vehicle.arm.joints:
            trackers[Subject.ARM] = self._arm
        if vehicle.devices.force is not None:
            trackers[Subject.FORCE] = self._force
        if vehicle.tether is not None:
            trackers[Subject.TETHER] = self._flight
        self._team = TeamTracker() if vehicle.devices.team is not None else None
        if self._team is not None:
            trackers[Subject.PARTNER] = self._team
        self._evaluation = Evaluation(vehicle, trackers)
        self._awake_s = self._located_awake_s = 0.0
        self._last_t_s: float | None = None
        self._airborne = False
        self.trusted: Inputs | None = None
        """Inputs of the last tick without the records that are not trusted; the same object if all are trusted."""

    @property
    def mocap_trusted(self) -> bool:
        """Return whether the newest pose is trusted, not too late and, in the air, does not repeat the one before it."""
        mocap = self._mocap
        return mocap.trusted and not mocap.too_late and not (mocap.repeats and self._airborne)

    @property
    def late_pose(self) -> MocapPose | None:
        """Return the newest pose if it is trusted but too late for PX4, else None."""
        return self._mocap.late

    def forwards(self, pose: MocapPose, vehicle: VehicleState | None) -> bool:
        """Return whether a pose that has arrived since the last tick may be passed on to PX4. Changes nothing."""
        return self._mocap.forwards(pose, vehicle, airborne=self._airborne)

    def pose_filter(self) -> PoseFilter | None:
        """Return a filter for a landing without the core; None if no pose may be passed on."""
        return self._mocap.pose_filter()

    @property
    def arm_swings(self) -> bool:
        """Return whether a joint of the arm swings."""
        return self._arm.swing is not None

    @property
    def mocap_innovation_m(self) -> float:
        """Return the distance between the newest pose and the position predicted from the IMU; 0 while that is not evaluated."""
        return self._mocap.innovation_m

    def forget(self) -> None:
        """Make all active rules raise their events again, because a HOLD was ended."""
        self._evaluation.forget()

    def active(self) -> tuple[ActiveRule, ...] | None:
        """Return the active rules, as of the last tick; None if there is none."""
        return self._evaluation.active()

    def standing(self, besides: str | None = None) -> str | None:
        """Return the message of the most severe active rule other than `besides`, as of the last tick; None if none of them requires
        HOLD or more.
        """
        return self._evaluation.standing(besides)

    def check(self, inputs: Inputs, context: FlightContext) -> tuple[Event, ...]:
        """Update with the inputs of one tick and return the new events."""
        self._airborne = airborne = context.airborne
        gap_s = inputs.t_s - self._last_t_s if self._last_t_s is not None else 0.0
        self._last_t_s = inputs.t_s
        awake_s = self._awake_s = self._awake_s + min(gap_s, AWAKE_STEP_MAX_S)
        i = self._filter.clean(inputs)
        self._process.update(i, gap_s)
        self._px4.context = context
        if not context.waiting:
            moving = i.vehicle is not None and _moves(i.vehicle)
            self._mocap.update(i, context, awake_s, moving)
            if self._vision is not None:
                self._vision.update(i, awake_s)
            seen = i.mocap if self._mocap.trusted and not self._mocap.too_late else None
            self._px4.update(i, context, awake_s, moving, seen)
            self._arm.update(i, awake_s, context.torque_refused)
            self._force.update(i, context, awake_s, gap_s, moving)
            if not self._mocap.trusted or self._mocap.too_late:
                i = msgspec.structs.replace(i, mocap=self._mocap.last_trusted)
            if self._vision is not None or self._mocap.last_trusted is not None:
                self._located_awake_s = awake_s
            if airborne:
                self._flight.update(i, context, gap_s, located=awake_s - self._located_awake_s < LOCATED_S)
            if self._team is not None:
                self._team.update(i, context, awake_s)
            if not self._force.trusted:
                i = msgspec.structs.replace(i, force=None)
        self.trusted = i
        return self._evaluation.events(inputs.t_s, airborne, context.waiting)


def _moves(v: VehicleState) -> bool:
    x, y, z = v.velocity_world_m_s
    p, q, r = v.angular_rate_body_rad_s
    return x * x + y * y + z * z > MOVING_M_S * MOVING_M_S or p * p + q * q + r * r > MOVING_RAD_S * MOVING_RAD_S
