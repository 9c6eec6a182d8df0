"""Landing by PX4's own LAND mode, watched by the companion, which finishes what PX4 cannot.

PX4 lands on its own estimate. Without vision its height becomes invalid 4.5 s after the last pose; then it only descends at constant
thrust and never finds that it stands (measured). So the companion watches for touch-down as long as the dead-reckoned height can be
trusted, takes OFFBOARD back with zero thrust once the vehicle stands, and disarms. Pure; time is an argument.
"""

from __future__ import annotations

from dataclasses import dataclass

from companion.mission.sequencer import PEOPLE_CHOOSE, TouchdownDetector, in_offboard, is_armed, on_ground
from companion.types import AutopilotRequest, FlightMode, Inputs

TRUST_ESTIMATE_S = 4.2
"""After the last good mocap pose: PX4's height still counts."""
ZERO_THRUST_STREAM_S = 0.6
"""Zero-thrust setpoints flow for this long before OFFBOARD is asked for: no older setpoint may take effect."""
STANDING_S = 3.0
TIMEOUT_S = 30.0
_MOCAP_FRESH_S = 0.3
_HEARTBEAT_FRESH_S = 2.5


@dataclass(frozen=True, slots=True)
class LandingStep:
    """What one tick of the landing asks for."""

    request: AutopilotRequest
    zero_thrust: bool
    """Send a level, zero-thrust setpoint."""
    ended: bool
    """The vehicle stands and is disarmed, or nothing more can be done."""
    landed: bool
    """Meaningful with `ended`."""
    text: str | None = None
    """Something to tell."""


class AutopilotLanding:
    """One landing in LAND mode.

    Args:
        start_s: flight time at its start.
        clearance_m: height of the body's origin when the vehicle stands.
        pilot: a pilot took over: watch only, ask for nothing. One who takes over later is seen by PX4's mode.
    """

    def __init__(self, start_s: float, clearance_m: float, pilot: bool) -> None:
        self._start_s = start_s
        self._clearance_m = clearance_m
        self._pilot = pilot
        self._was_landing = False
        self._touchdown = TouchdownDetector(clearance_m)
        self._standing_since_s: float | None = None
        self._touched_s: float | None = None
        self._pose_s = start_s

    @property
    def pilot(self) -> bool:
        """Somebody else flies."""
        return self._pilot

    def step(self, i: Inputs) -> LandingStep:
        """One tick."""
        elapsed = i.t_s - self._start_s
        heard = i.status is not None and i.t_s - i.status.heartbeat_stamp_s < _HEARTBEAT_FRESH_S
        if not self._pilot and heard and self._pilot_takes_over(i):
            self._pilot = True
            return LandingStep(AutopilotRequest.NONE, False, False, False, "a pilot took over")
        if heard and not is_armed(i.status) and elapsed > 0.5:
            return LandingStep(AutopilotRequest.NONE, False, True, True)
        if elapsed > TIMEOUT_S and not (self._pilot and heard):  # a pilot may fly on for as long as they like
            return LandingStep(AutopilotRequest.NONE, False, True, False, "the landing could not be confirmed")
        if not heard and self._stands_by_mocap(i):
            text = "the vehicle stands, motion capture says; PX4 does not answer: go and disarm it by hand, with care"
            return LandingStep(AutopilotRequest.NONE, False, True, True, text)
        if self._pilot:
            return LandingStep(AutopilotRequest.NONE, False, False, False)
        if self._touched_s is None and heard and self._touches(i):
            self._touched_s = i.t_s
            return LandingStep(AutopilotRequest.LAND, True, False, False, "touch-down")
        if self._touched_s is None:
            done = on_ground(i.status) and elapsed > 1.0
            return LandingStep(AutopilotRequest.DISARM if done else AutopilotRequest.LAND, False, False, False)
        if on_ground(i.status):
            return LandingStep(AutopilotRequest.DISARM, True, False, False)
        wait = i.t_s - self._touched_s < ZERO_THRUST_STREAM_S or in_offboard(i.status)
        return LandingStep(AutopilotRequest.NONE if wait else AutopilotRequest.OFFBOARD, True, False, False)

    def _pilot_takes_over(self, i: Inputs) -> bool:
        """A mode in which somebody steers; or, once PX4 was landing, any that only people choose."""
        mode = i.status.mode if i.status is not None else FlightMode.UNKNOWN
        self._was_landing = self._was_landing or mode is FlightMode.LAND
        return mode is FlightMode.MANUAL or (self._was_landing and mode in PEOPLE_CHOOSE)

    def _touches(self, i: Inputs) -> bool:
        """PX4 is landing, and the height that it believes in says that the vehicle stands."""
        if i.mocap is not None and i.mocap.tracking_valid and i.t_s - i.mocap.stamp_s < _MOCAP_FRESH_S:
            self._pose_s = i.mocap.stamp_s
        vehicle = i.vehicle
        landing = i.status is not None and i.status.mode in (FlightMode.LAND, FlightMode.OTHER)
        if vehicle is None or not landing or i.t_s - self._pose_s > TRUST_ESTIMATE_S:
            return False
        height, sink = vehicle.position_world_m[2], vehicle.velocity_world_m_s[2]
        return self._touchdown.update(i.t_s, height, sink, height - 1.0)

    def _stands_by_mocap(self, i: Inputs) -> bool:
        pose = i.mocap
        fresh = pose is not None and pose.tracking_valid and i.t_s - pose.stamp_s < _MOCAP_FRESH_S
        low = pose is not None and pose.position_world_m[2] < self._clearance_m + TouchdownDetector.HEIGHT_MARGIN_M
        if not (fresh and low):
            self._standing_since_s = None
            return False
        if self._standing_since_s is None:
            self._standing_since_s = i.t_s
        return i.t_s - self._standing_since_s >= STANDING_S
