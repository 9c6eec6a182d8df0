"""Landing in PX4's LAND mode, supervised by the companion, which completes what PX4 cannot.

PX4 lands using its own estimate. Without vision, and without a barometer, its height becomes invalid 1.4 s after the last pose
(EKF2_NOAID_TOUT); from then on it descends at constant thrust and never detects the ground (measured). The companion therefore
watches for touchdown as long as the dead-reckoned height is valid, returns PX4 to OFFBOARD with zero thrust once the vehicle
has landed, and disarms. No single source decides: PX4's estimate and motion capture must both show a vehicle at rest while PX4
descends. Poses that are too late for PX4 still show where the vehicle was: they show a touchdown that a drifting estimate does
not. The vehicle is disarmed even if PX4's land detector alone does not respond. `companion.safety.rotor_stop` decides when a
stop of the rotors may be requested, including that of a vehicle that is flipped or tipped over. Pure; time is an argument.
"""

from __future__ import annotations

from dataclasses import dataclass, field, replace
from typing import Final

from companion.model.best_pose import pose_used_s
from companion.model.flight_stage import chosen_by_pilot, in_offboard, is_armed, is_killed, on_ground
from companion.model.types import AutopilotRequest, FlightMode, Inputs, MocapPose
from companion.safety.rotor_stop import (
    ESTIMATE_TRUSTED_S,
    FORCE_DISARM_S,
    STATE_FRESH_S,
    RotorStop,
    fresh_pose,
    hears_px4,
)
from companion.safety.touchdown import (
    HEIGHT_HOLD_S,
    HEIGHT_MARGIN_M,
    NEVER_ABOVE_M,
    STILL_M_S,
    HeightEvidence,
    Sinking,
    low_below_m,
)

ZERO_THRUST_STREAM_S = 0.6
"""Zero-thrust setpoints are streamed for this time before OFFBOARD is requested, so that no older setpoint takes effect."""
BEGUN_S = 1.0
"""Time from LAND to the start of PX4's descent. Before that, a vehicle that does not sink is no evidence of touchdown."""
DESCENT_M_S = 0.25
"""PX4 counts as descending if its estimate sinks faster than this, a third of MPC_LAND_SPEED."""
DESCENT_HOLD_S = 0.3
DESCENT_COUNTED_M_S = 0.7
"""MPC_LAND_SPEED. A faster descent counts as this one, because PX4 slows a falling vehicle to this speed while it is still in the
air.
"""
ARRESTED_SHARE = 0.5
"""Fraction of the fastest descent. PX4 controls its estimated speed, so an estimate that slows down to less than this was stopped by
the floor.
"""
IMPACT_M_S: Final = 0.2
"""An estimated descent that slows down by this much within `IMPACT_WITHIN_S` hit something: a quarter of the weight was lifted off.
PX4 brakes more gradually.
"""
IMPACT_WITHIN_S: Final = 0.08
IMPACT_KEPT_M_S: Final = 0.1
"""After an impact in the air PX4 descends as before, within this."""
IMPACT_HOLD_S: Final = 0.6
DRIFT_M_S2 = 0.5
"""Without motion capture the estimated height may be off by half of this times the square of the time."""
LATE_STANDS_S: Final = 1.5
"""Poses that are too late for PX4 show a touchdown after this time near the floor without vertical motion."""
STANDING_S = 3.0
TIMEOUT_S = 30.0
PILOT_S: Final = 1.0
"""While a pilot flies, the landing counts as begun this time ago."""
FLIPPED: Final = "flipped: FORCE_DISARM is requested at once"
KILLED: Final = "PX4's kill switch or flight termination has stopped the rotors; nothing is sent to PX4 any more"
TIPPED: Final = "tipped over on the floor: FORCE_DISARM is requested at once"


@dataclass(frozen=True, slots=True)
class LandingStep:
    """Requests of one tick of the landing."""

    request: AutopilotRequest
    zero_thrust: bool = False
    ended: bool = False
    """Whether the vehicle is disarmed on the ground, or nothing more can be done."""
    landed: bool = False
    """Whether the vehicle has landed. Valid only if `ended` is True."""
    text: str | None = None
    """Event to report and its text, if any."""


@dataclass(frozen=True, slots=True)
class Arrest:
    """Evidence of touchdown for an estimate that drifts: according to that estimate, PX4's descent stopped and did not resume.

    Dead reckoning from an accelerometer with an error of 0.2 m/s^2 is wrong by 0.4 m/s and 0.4 m after 2 s, so speed and height do
    not show rest, but the change of speed at the floor does. PX4 believes that a vehicle with such an error descends at
    MPC_LAND_SPEED; it touches down more slowly, and its estimate loses less than half of its speed. Then the impact counts.
    """

    descends_since_s: float | None = None
    fastest_m_s: float = 0.0
    """Fastest descent that lasted for `DESCENT_HOLD_S`, limited to `DESCENT_COUNTED_M_S`; 0 before the first."""
    arrested_since_s: float | None = None
    recent: tuple[tuple[float, float], ...] = ()
    """Stamps and estimated vertical speeds of the last `IMPACT_WITHIN_S`; a change across a longer gap is no impact."""
    impact: tuple[float, float] | None = None
    """Time of an impact after which the descent has not resumed, and the vertical speed before it."""

    def update(self, t_s: float, stamp_s: float, up_m_s: float) -> Arrest:
        """Return the evidence after one more tick of PX4's descent; `up_m_s` is its estimated vertical speed, stamped `stamp_s`."""
        descends = up_m_s < -max(DESCENT_M_S, ARRESTED_SHARE * self.fastest_m_s)
        since_s = (t_s if self.descends_since_s is None else self.descends_since_s) if descends else None
        lasting = since_s is not None and t_s - since_s >= DESCENT_HOLD_S
        fastest_m_s = max(self.fastest_m_s, min(-up_m_s, DESCENT_COUNTED_M_S)) if lasting else self.fastest_m_s
        arrested = fastest_m_s > 0.0 and up_m_s > -ARRESTED_SHARE * fastest_m_s
        arrested_since_s = (t_s if self.arrested_since_s is None else self.arrested_since_s) if arrested else None
        recent = (*(seen for seen in self.recent if stamp_s - seen[0] <= IMPACT_WITHIN_S), (stamp_s, up_m_s))
        before_m_s = max(-DESCENT_COUNTED_M_S, min(speed for _, speed in recent))
        impact = self.impact
        if impact is not None and up_m_s < impact[1] + IMPACT_KEPT_M_S:
            impact = None
        elif impact is None and fastest_m_s > 0.0 and before_m_s < -DESCENT_M_S and up_m_s - before_m_s >= IMPACT_M_S:
            impact = (t_s, before_m_s)
        return Arrest(since_s, fastest_m_s, arrested_since_s, recent, impact)

    def stands(self, t_s: float) -> bool:
        """Return whether the descent has been arrested for long enough."""
        arrested = self.arrested_since_s is not None and t_s - self.arrested_since_s >= HEIGHT_HOLD_S
        return arrested or (self.impact is not None and t_s - self.impact[0] >= IMPACT_HOLD_S)


@dataclass(frozen=True, slots=True)
class AutopilotLanding:
    """One landing in LAND mode."""

    start_s: float
    """Time on the flight clock at the start of the landing."""
    clearance_m: float
    """Height of the body's origin when the vehicle is on the ground."""
    pilot: bool
    """Whether a pilot has taken over; the landing is then only monitored."""
    pose_s: float
    """Time on the flight clock of the newest pose that PX4 received; if -inf, PX4's estimate does not count until poses arrive."""
    stop: RotorStop
    height: HeightEvidence
    sinking: Sinking = field(default_factory=Sinking)
    arrest: Arrest = field(default_factory=Arrest)
    late_sinking: Sinking = field(default_factory=Sinking)
    late_rest_since_s: float | None = None
    """Time since which poses that are too late for PX4 have shown the vehicle near the floor without vertical motion."""
    was_landing: bool = False
    standing_since_s: float | None = None
    touched_s: float | None = None
    landing_since_s: float | None = None
    zero_thrust_since_s: float | None = None
    overturned: bool = False
    """Whether a stop of the rotors was requested because the vehicle was flipped or tipped over."""

    @classmethod
    def begin(
        cls,
        start_s: float,
        clearance_m: float,
        tilt_max_rad: float,
        pilot: bool,
        *,
        pose_s: float,
        flipped: bool = False,
    ) -> AutopilotLanding:
        """Return the landing before its first tick.

        Args:
            start_s: time on the flight clock.
            clearance_m: height of the body's origin when the vehicle is on the ground.
            tilt_max_rad: `safety.tilt_abort_deg`, in rad; a vehicle that lies on the floor beyond it is tipped over.
            pilot: a pilot has taken over. PX4's mode shows a later takeover.
            pose_s: time on the flight clock of the newest pose that PX4 received; -inf if unknown.
            flipped: the vehicle is known to have been flipped for long enough.
        """
        stop = RotorStop.begin(clearance_m, tilt_max_rad, pose_s, flipped=flipped)
        return cls(
            start_s=start_s,
            clearance_m=clearance_m,
            pilot=pilot,
            pose_s=pose_s,
            stop=stop,
            height=HeightEvidence(low_below_m(clearance_m)),
        )

    def step(self, i: Inputs, late: MocapPose | None = None) -> tuple[AutopilotLanding, LandingStep]:
        """Return the landing after one more tick, and what that tick requests.

        Args:
            i: inputs of the tick, with trusted records only.
            late: newest pose, if it is trusted but too late for PX4.
        """
        elapsed = i.t_s - self.start_s
        heard = hears_px4(i)
        now = replace(self, stop=self.stop.update(i))
        if late is not None or self.late_rest_since_s is not None:
            now = now._watch_late(i.t_s, late)
        if not now.pilot and heard:
            now, takes_over = now._watch_mode(i)
            if takes_over:
                text = KILLED if is_killed(i.status) else "a pilot took over"
                return replace(now, pilot=True), LandingStep(AutopilotRequest.NONE, text=text)
        if now.pilot and heard and is_armed(i.status):  # a pilot may fly for any length of time
            now = replace(now, start_s=max(now.start_s, i.t_s - PILOT_S))
        if heard and not is_armed(i.status) and elapsed > 0.5:
            overturned = "the vehicle was flipped or tipped over; it is disarmed" if now.overturned else None
            return now, LandingStep(AutopilotRequest.NONE, ended=True, landed=True, text=overturned)
        if i.t_s - now.start_s > TIMEOUT_S:
            text = "the landing could not be confirmed"
            return now, LandingStep(AutopilotRequest.NONE, ended=True, text=text)
        if not heard:
            now, stands = now._watch_standing(i)
            if stands:
                text = "PX4 does not answer; motion capture shows the vehicle at rest: approach with care and disarm it by hand"
                return now, LandingStep(AutopilotRequest.NONE, ended=True, landed=True, text=text)
        if now.pilot:
            return now, LandingStep(AutopilotRequest.NONE)
        if now.stop.overturned:
            found = None if now.overturned else FLIPPED if now.stop.flipped else TIPPED
            return replace(now, overturned=True), LandingStep(
                AutopilotRequest.FORCE_DISARM, zero_thrust=True, text=found
            )
        if now.touched_s is None and heard:
            now, touches = now._watch_touchdown(i)
            if touches:
                now = replace(now, touched_s=i.t_s)
                return now, LandingStep(AutopilotRequest.LAND, zero_thrust=True, text="touchdown")
        if now.touched_s is None:
            done = on_ground(i.status) and elapsed > 1.0 and now.stop.may_disarm
            return now, LandingStep(AutopilotRequest.DISARM if done else AutopilotRequest.LAND)
        if on_ground(i.status) and now.stop.may_disarm:
            return now, LandingStep(AutopilotRequest.DISARM, zero_thrust=True)
        touched_s = now.touched_s
        now, unnoticed = now._watch_zero_thrust(i)
        if unnoticed:
            return now, LandingStep(AutopilotRequest.FORCE_DISARM, zero_thrust=True)
        wait = i.t_s - touched_s < ZERO_THRUST_STREAM_S or in_offboard(i.status)
        return now, LandingStep(AutopilotRequest.NONE if wait else AutopilotRequest.OFFBOARD, zero_thrust=True)

    def _watch_late(self, t_s: float, late: MocapPose | None) -> AutopilotLanding:
        sinking = self.late_sinking.update(t_s, late)
        speed_m_s = sinking.speed_m_s
        low = late is not None and late.position_world_m[2] < self.clearance_m + HEIGHT_MARGIN_M
        since_s = None
        if low and speed_m_s is not None and abs(speed_m_s) < STILL_M_S:
            since_s = t_s if self.late_rest_since_s is None else self.late_rest_since_s
        return replace(self, late_sinking=sinking, late_rest_since_s=since_s)

    def _late_rest(self, t_s: float, least_s: float) -> bool:
        return self.late_rest_since_s is not None and t_s - self.late_rest_since_s >= least_s

    def _watch_mode(self, i: Inputs) -> tuple[AutopilotLanding, bool]:
        """Return whether a pilot has taken over: PX4 is in a manual mode or, after it began to land, in any mode that only a pilot
        selects, or its rotors were stopped by the kill switch.
        """
        mode = i.status.mode if i.status is not None else FlightMode.UNKNOWN
        now = self if self.was_landing or mode is not FlightMode.LAND else replace(self, was_landing=True)
        chosen = i.status is not None and chosen_by_pilot(i.status)
        return now, mode is FlightMode.MANUAL or (now.was_landing and chosen) or is_killed(i.status)

    def _watch_touchdown(self, i: Inputs) -> tuple[AutopilotLanding, bool]:
        """Detect and handle a touchdown: PX4 is landing, its height shows a vehicle on the ground, and motion capture does not
        contradict it.
        """
        pose, vehicle, t_s = fresh_pose(i), i.vehicle, i.t_s
        used_s = pose_used_s(i) if i.mocap is None else None
        pose_s = pose.stamp_s if pose is not None else self.pose_s if used_s is None else used_s
        sinking = self.sinking.update(t_s, i.mocap)
        since_s = self.landing_since_s
        if i.status is None or i.status.mode not in (FlightMode.LAND, FlightMode.OTHER):
            since_s = None
        elif since_s is None:
            since_s = t_s
        begun = since_s is not None and t_s - since_s > BEGUN_S
        fresh = vehicle is not None and t_s - vehicle.position_stamp_s < STATE_FRESH_S
        now = replace(self, pose_s=pose_s, sinking=sinking, landing_since_s=since_s)
        if begun and now._late_rest(t_s, LATE_STANDS_S):
            return now, True
        if vehicle is None or not fresh or since_s is None or t_s - pose_s > ESTIMATE_TRUSTED_S:
            return replace(now, height=replace(self.height, since_s=None), arrest=Arrest()), False
        height_m, up_m_s = vehicle.position_world_m[2], vehicle.velocity_world_m_s[2]
        arrest = self.arrest.update(t_s, vehicle.position_stamp_s, up_m_s) if pose is None else Arrest()
        now = replace(now, arrest=arrest)
        if not begun:
            return replace(now, height=replace(self.height, since_s=None)), False
        height = self.height.update(t_s, height_m, up_m_s, height_m - 1.0)
        drift_m = 0.5 * DRIFT_M_S2 * (t_s - pose_s) ** 2
        arrested = arrest.stands(t_s) and height_m < self.height.low_m + drift_m
        flies = pose is not None and self._flies_by_mocap(i, sinking.speed_m_s)
        return replace(now, height=height), (height.stands(t_s) or arrested) and not flies

    def _flies_by_mocap(self, i: Inputs, sink_m_s: float | None) -> bool:
        high = i.mocap is not None and i.mocap.position_world_m[2] > self.clearance_m + NEVER_ABOVE_M
        return high or sink_m_s is None or sink_m_s > STILL_M_S

    def _watch_zero_thrust(self, i: Inputs) -> tuple[AutopilotLanding, bool]:
        """Handle a vehicle that has been in OFFBOARD with zero thrust for `FORCE_DISARM_S` although PX4 has detected no landing."""
        since_s = self.zero_thrust_since_s
        if not in_offboard(i.status):
            since_s = None
        elif since_s is None:
            since_s = i.t_s
        rests = self.stop.may_force or self._late_rest(i.t_s, FORCE_DISARM_S)
        unnoticed = since_s is not None and i.t_s - since_s >= FORCE_DISARM_S and rests
        return replace(self, zero_thrust_since_s=since_s), unnoticed

    def _watch_standing(self, i: Inputs) -> tuple[AutopilotLanding, bool]:
        """Return whether motion capture has shown the vehicle at standing height for `STANDING_S`."""
        pose, since_s = fresh_pose(i), self.standing_since_s
        if pose is None or pose.position_world_m[2] >= self.clearance_m + HEIGHT_MARGIN_M:
            since_s = None
        elif since_s is None:
            since_s = i.t_s
        stands = since_s is not None and i.t_s - since_s >= STANDING_S
        return replace(self, standing_since_s=since_s), stands
