"""Landing in PX4's LAND mode, supervised by the companion, which completes what PX4 cannot.

PX4 lands on its own estimate. Without vision its height becomes invalid 4.5 s after the last pose; from then on it descends at constant
thrust and never detects the ground (measured). The companion therefore watches for touchdown as long as the dead-reckoned height is
valid, takes OFFBOARD back with zero thrust once the vehicle has landed, and disarms. No single source decides: PX4's estimate and
motion capture must both show a vehicle at rest while PX4 descends. If PX4's land detector alone does not respond, the vehicle is
disarmed all the same. `companion.safety.rotor_stop` decides when a stop of the rotors may be requested, also for a vehicle that is
flipped or tipped over. Pure; time is an argument.
"""

from __future__ import annotations

from dataclasses import dataclass

from companion.model.flight_stage import in_offboard, is_armed, on_ground, people_chose
from companion.model.types import AutopilotRequest, FlightMode, Inputs
from companion.safety.rotor_stop import (
    ESTIMATE_TRUSTED_S,
    FORCE_DISARM_S,
    STATE_FRESH_S,
    RotorStop,
    fresh_pose,
    hears_px4,
)
from companion.safety.touchdown import HEIGHT_MARGIN_M, NEVER_ABOVE_M, STILL_M_S, HeightEvidence, Sinking

ZERO_THRUST_STREAM_S = 0.6
"""Zero-thrust setpoints are streamed for this time before OFFBOARD is requested, so that no older setpoint takes effect."""
BEGUN_S = 1.0
"""Time from LAND to the start of PX4's descent. Before that a vehicle that does not sink is not evidence of touchdown."""
STANDING_S = 3.0
TIMEOUT_S = 30.0
FLIPPED = "flipped: FORCE_DISARM is requested at once"
TIPPED = "tipped over on the floor: FORCE_DISARM is requested at once"


@dataclass(frozen=True, slots=True)
class LandingStep:
    """Requests of one tick of the landing."""

    request: AutopilotRequest
    zero_thrust: bool
    """Whether to send a level, zero-thrust setpoint."""
    ended: bool
    """Whether the vehicle stands disarmed, or nothing more can be done."""
    landed: bool
    """Whether the vehicle has landed. Valid with `ended`."""
    text: str | None = None
    """Message to report, or an empty text."""


class AutopilotLanding:
    """One landing in LAND mode.

    Args:
        start_s: flight time at its start.
        clearance_m: height of the body's origin when the vehicle stands on the ground.
        tilt_max_rad: `safety.tilt_abort_deg`; a vehicle on the ground beyond this tilt is tipped over.
        pilot: a pilot has taken over: monitor only, request nothing. A later takeover is seen by PX4's mode.
        pose_s: flight time of the newest pose sent to PX4; with -inf its estimate is not used until poses arrive.
        flipped: the vehicle is known to have been flipped for the required time.
    """

    def __init__(
        self,
        start_s: float,
        clearance_m: float,
        tilt_max_rad: float,
        pilot: bool,
        *,
        pose_s: float,
        flipped: bool = False,
    ) -> None:
        self._start_s = start_s
        self._clearance_m = clearance_m
        self._pilot = pilot
        self._was_landing = False
        self._height = HeightEvidence(clearance_m)
        self._sinking = Sinking()
        self._standing_since_s: float | None = None
        self._touched_s: float | None = None
        self._landing_since_s: float | None = None
        self._zero_thrust_since_s: float | None = None
        self.overturned = False
        """Whether the vehicle was flipped or tipped over and a stop of its rotors was requested for that reason."""
        self._pose_s = pose_s
        self._stop = RotorStop(clearance_m, tilt_max_rad, pose_s, flipped=flipped)

    @property
    def pilot(self) -> bool:
        """Whether a pilot has control."""
        return self._pilot

    def step(self, i: Inputs) -> LandingStep:
        """Run one tick."""
        elapsed = i.t_s - self._start_s
        heard = hears_px4(i)
        self._stop.update(i)
        if not self._pilot and heard and self._pilot_takes_over(i):
            self._pilot = True
            return LandingStep(AutopilotRequest.NONE, False, False, False, "a pilot took over")
        if heard and not is_armed(i.status) and elapsed > 0.5:
            text = "the vehicle was flipped or tipped over; it is disarmed" if self.overturned else None
            return LandingStep(AutopilotRequest.NONE, False, True, True, text)
        if elapsed > TIMEOUT_S and not (self._pilot and heard):  # a pilot may fly on for as long as they like
            return LandingStep(AutopilotRequest.NONE, False, True, False, "the landing could not be confirmed")
        if not heard and self._stands_by_mocap(i):
            text = "the vehicle stands, motion capture says; PX4 does not answer: go and disarm it by hand, with care"
            return LandingStep(AutopilotRequest.NONE, False, True, True, text)
        if self._pilot:
            return LandingStep(AutopilotRequest.NONE, False, False, False)
        if self._stop.overturned:
            text = None if self.overturned else FLIPPED if self._stop.flipped else TIPPED
            self.overturned = True
            return LandingStep(AutopilotRequest.FORCE_DISARM, True, False, False, text)
        if self._touched_s is None and heard and self._touches(i):
            self._touched_s = i.t_s
            return LandingStep(AutopilotRequest.LAND, True, False, False, "touchdown")
        if self._touched_s is None:
            done = on_ground(i.status) and elapsed > 1.0 and self._stop.may_disarm
            return LandingStep(AutopilotRequest.DISARM if done else AutopilotRequest.LAND, False, False, False)
        if on_ground(i.status) and self._stop.may_disarm:
            return LandingStep(AutopilotRequest.DISARM, True, False, False)
        if self._unnoticed(i):
            return LandingStep(AutopilotRequest.FORCE_DISARM, True, False, False)
        wait = i.t_s - self._touched_s < ZERO_THRUST_STREAM_S or in_offboard(i.status)
        return LandingStep(AutopilotRequest.NONE if wait else AutopilotRequest.OFFBOARD, True, False, False)

    def _pilot_takes_over(self, i: Inputs) -> bool:
        """Return whether PX4 is in a manual mode or, once PX4 was landing, in any mode that only a pilot selects."""
        mode = i.status.mode if i.status is not None else FlightMode.UNKNOWN
        self._was_landing = self._was_landing or mode is FlightMode.LAND
        chosen = i.status is not None and people_chose(i.status)
        return mode is FlightMode.MANUAL or (self._was_landing and chosen)

    def _touches(self, i: Inputs) -> bool:
        """Return whether PX4 is landing, its valid height shows the vehicle on the ground, and motion capture does not contradict."""
        pose = fresh_pose(i)
        if pose is not None:
            self._pose_s = pose.stamp_s
        sink_m_s = self._sinking.update(i.t_s, i.mocap)
        vehicle = i.vehicle
        landing = i.status is not None and i.status.mode in (FlightMode.LAND, FlightMode.OTHER)
        if not landing:
            self._landing_since_s = None
        elif self._landing_since_s is None:
            self._landing_since_s = i.t_s
        begun = self._landing_since_s is not None and i.t_s - self._landing_since_s > BEGUN_S
        fresh = vehicle is not None and i.t_s - vehicle.position_stamp_s < STATE_FRESH_S
        if vehicle is None or not fresh or not begun or i.t_s - self._pose_s > ESTIMATE_TRUSTED_S:
            self._height = HeightEvidence(self._clearance_m)
            return False
        height, sink = vehicle.position_world_m[2], vehicle.velocity_world_m_s[2]
        stands = self._height.update(i.t_s, height, sink, height - 1.0)
        return stands and not (pose is not None and self._flies_by_mocap(i, sink_m_s))

    def _flies_by_mocap(self, i: Inputs, sink_m_s: float | None) -> bool:
        high = i.mocap is not None and i.mocap.position_world_m[2] > self._clearance_m + NEVER_ABOVE_M
        return high or sink_m_s is None or sink_m_s > STILL_M_S

    def _unnoticed(self, i: Inputs) -> bool:
        """Return whether the vehicle has stood in OFFBOARD without thrust for `FORCE_DISARM_S` while PX4's land detector has not
        responded.
        """
        if not in_offboard(i.status):
            self._zero_thrust_since_s = None
        elif self._zero_thrust_since_s is None:
            self._zero_thrust_since_s = i.t_s
        since_s = self._zero_thrust_since_s
        return since_s is not None and i.t_s - since_s >= FORCE_DISARM_S and self._stop.may_force

    def _stands_by_mocap(self, i: Inputs) -> bool:
        pose = fresh_pose(i)
        if pose is None or pose.position_world_m[2] >= self._clearance_m + HEIGHT_MARGIN_M:
            self._standing_since_s = None
            return False
        if self._standing_since_s is None:
            self._standing_since_s = i.t_s
        return i.t_s - self._standing_since_s >= STANDING_S
