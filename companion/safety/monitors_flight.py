"""Does the machine do what it was told: upright, on its reference, thrust to spare, not too fast, in the room, its tether free?"""

from __future__ import annotations

import math

from companion.config.vehicle import Vehicle
from companion.control.manipulator import GRAVITY_M_S2
from companion.model.frames import tilt_rad
from companion.model.types import ControlLog, Inputs, TetherState, Vec3
from companion.safety.findings import Findings, Situation
from companion.safety.governor import BODY_TOP_M
from companion.safety.rotor_stop import FLIPPED_TILT_RAD, seems_flipped
from companion.safety.rules import (
    CLIMBS,
    CRASHED,
    GEOFENCE_LEFT,
    GEOFENCE_NEAR,
    SINKS,
    TETHER_NEAR,
    TETHER_SEPARATED,
    TETHER_SHORT,
    TETHER_SNAGGED,
    TETHER_TAUT,
    TETHER_WOUND,
    THRUST_SATURATED,
    TILT,
    TOO_FAST,
    TRACKING_ERROR,
    TRACKING_HOLD,
    TRACKING_WARN,
)
from companion.safety.stop import StopModel


class FlightMonitor:
    """Only while the rotors may lift."""

    def __init__(self, vehicle: Vehicle) -> None:
        s, room, tether = vehicle.safety, vehicle.room, vehicle.tether
        self._s = s
        self._tilt_max_rad = math.radians(s.tilt_abort_deg)
        # Of a quaternion, x^2 + y^2 = sin^2(tilt / 2).
        self._lean_max = math.sin(0.5 * min(self._tilt_max_rad, FLIPPED_TILT_RAD)) ** 2
        self._weight_n = vehicle.airframe.mass_kg * GRAVITY_M_S2
        inset_m = vehicle.airframe.radius_m - s.geofence_tolerance_m
        self._x_m = (room.x_m[0] + inset_m, room.x_m[1] - inset_m)
        self._y_m = (room.y_m[0] + inset_m, room.y_m[1] - inset_m)
        self._top_m = room.z_m[1] - BODY_TOP_M + s.geofence_tolerance_m
        self._stop = StopModel(tether)
        self._turns_max = tether.turns_max
        self._clearance_min_m = tether.clearance_min_m
        self._saturated_s = 0.0

    def check(self, i: Inputs, situation: Situation, dt_s: float, findings: Findings) -> None:
        """One tick in the air; `i` without what is not to be believed."""
        vehicle = i.vehicle
        if vehicle is not None:
            _, x, y, _ = vehicle.attitude_wxyz
            if x * x + y * y > self._lean_max:
                self._lean(i, tilt_rad(vehicle.attitude_wxyz), findings)
            self._motion(vehicle.position_world_m, vehicle.velocity_world_m_s, findings)
        error_m = situation.tracking_error_m
        if error_m is not None and error_m > self._s.tracking_error_warn_m:
            self._off(error_m, findings)
        self._thrust(situation.control, dt_s, findings)
        if situation.tether is not None:
            self._tether(situation.tether, findings)

    def _lean(self, i: Inputs, lean_rad: float, findings: Findings) -> None:
        if lean_rad > self._tilt_max_rad:
            findings.found(TILT, "tilt {:.0f} deg", math.degrees(lean_rad))
        if seems_flipped(i):
            findings.found(CRASHED, "flipped: tilt {:.0f} deg, confirmed by a second source", math.degrees(lean_rad))

    def _off(self, error_m: float, findings: Findings) -> None:
        s = self._s
        findings.found(TRACKING_WARN, "{:.2f} m off the reference", error_m)
        if error_m > s.tracking_error_hold_m:
            findings.found(TRACKING_HOLD, "{:.2f} m off the reference", error_m)
        if error_m > s.tracking_error_abort_m:
            findings.found(TRACKING_ERROR, "{:.2f} m off the reference", error_m)

    def _thrust(self, control: ControlLog | None, dt_s: float, findings: Findings) -> None:
        """Counts up while the vertical force is cut at its upper limit, down while it is not: noise makes it flicker."""
        if control is not None and control.saturated[0] and control.tau[2] > self._weight_n:
            self._saturated_s += dt_s
            if self._saturated_s > self._s.thrust_saturated_s:
                findings.found(
                    THRUST_SATURATED, "thrust at its limit, {:.0f} N: too heavy, or too weak", control.tau[2]
                )
        elif self._saturated_s > 0.0:
            self._saturated_s = max(0.0, self._saturated_s - dt_s)

    def _motion(self, position_m: Vec3, velocity_m_s: Vec3, findings: Findings) -> None:
        s, (x, y, z), (vx, vy, vz) = self._s, position_m, velocity_m_s
        if vx * vx + vy * vy > s.speed_max_m_s * s.speed_max_m_s:
            findings.found(TOO_FAST, "{:.1f} m/s", math.hypot(vx, vy))
        if vz > s.climb_max_m_s:
            findings.found(CLIMBS, "climbs at {:.1f} m/s", vz)
        elif vz < -s.sink_max_m_s:
            findings.found(SINKS, "sinks at {:.1f} m/s", -vz)
        (x_low, x_high), (y_low, y_high), top = self._x_m, self._y_m, self._top_m
        if not (x_low <= x <= x_high and y_low <= y <= y_high and z <= top):
            findings.found(GEOFENCE_LEFT, "at ({:.2f}, {:.2f}, {:.2f}) m the rotors are outside the room", x, y, z)
        stop_s = self._stop.time_s(math.sqrt(vx * vx + vy * vy + vz * vz))
        x, y, z = x + vx * stop_s, y + vy * stop_s, z + vz * stop_s
        if not (x_low <= x <= x_high and y_low <= y <= y_high and z <= top):
            text = "would come to rest at ({:.2f}, {:.2f}, {:.2f}) m, the rotors outside the room"
            findings.found(GEOFENCE_NEAR, text, x, y, z)

    def _tether(self, tether: TetherState, findings: Findings) -> None:
        if tether.stop_slack_m < self._s.tether_stop_slack_min_m:
            findings.found(TETHER_SHORT, "would come to rest with {:.2f} m of tether left", tether.stop_slack_m)
        if tether.taut:
            text = "the tether is taut: {:.2f} m left, it pulls with {:.0f} N"
            findings.found(TETHER_TAUT, text, tether.slack_m, tether.pull_n)
        if tether.snagged:
            text = "the tether pulls with {:.0f} N though {:.2f} m are left: it is caught somewhere"
            findings.found(TETHER_SNAGGED, text, tether.pull_n, tether.slack_m)
        if tether.clearance_m < self._clearance_min_m:
            findings.found(TETHER_NEAR, "the tether is {:.2f} m from rotors or arm", tether.clearance_m)
        if abs(tether.turns) > self._turns_max:
            findings.found(TETHER_WOUND, "the tether is wound {:.1f} times about its anchor", abs(tether.turns))
        if tether.separated:
            findings.found(
                TETHER_SEPARATED, "{:.2f} m from the anchor without a pull: the tether is off", tether.range_m
            )
