"""Tracker and predicates of the vehicle in the air: tilt, tracking, thrust, speed, room and tether. Only the limited thrust is tracked
over time.

The rows of these rules, with the actions and the texts for the operator, are in `companion.safety.rules`.
"""

from __future__ import annotations

import math

from companion.config.vehicle import Vehicle
from companion.model.constants import GRAVITY_M_S2
from companion.model.frames import tilt_rad
from companion.model.outputs import ControlLog, TetherState
from companion.model.types import Inputs, VehicleState
from companion.safety.flight_context import FlightContext, Values
from companion.safety.governor import BODY_TOP_M
from companion.safety.oscillation import Oscillation
from companion.safety.rotor_stop import FLIPPED_TILT_RAD, seems_flipped
from companion.safety.stop import StopModel


class FlightTracker:
    """Tracks the vehicle in the air.

    Args:
        vehicle: room, airframe and tether.
    """

    def __init__(self, vehicle: Vehicle) -> None:
        tilt_max_rad = math.radians(vehicle.safety.tilt_abort_deg)
        # For a quaternion, x^2 + y^2 = sin^2(tilt / 2): most ticks need no angle.
        self._upright_max = math.sin(0.5 * min(tilt_max_rad, FLIPPED_TILT_RAD)) ** 2
        self._weight_n = vehicle.airframe.mass_kg * GRAVITY_M_S2
        room, tolerance_m = vehicle.room, vehicle.safety.geofence_tolerance_m
        x_low, x_high = room.x_m
        y_low, y_high = room.y_m
        inset_m = vehicle.airframe.radius_m - tolerance_m
        self._fence_m = (
            (x_low + inset_m, x_high - inset_m),
            (y_low + inset_m, y_high - inset_m),
            room.z_m[1] - BODY_TOP_M + tolerance_m,
        )
        """Range of x and y, and largest z, of a vehicle whose rotors are in the room, with the tolerance."""
        self._stop = StopModel(vehicle.safety)
        self.oscillation_m = vehicle.safety.oscillation_m
        self.oscillation = Oscillation(self.oscillation_m)
        self._inputs: Inputs | None = None
        self.vehicle: VehicleState | None = None
        self.located = True
        """Whether PX4's position means anything; without poses its estimate drifts by metres."""
        self.tilt_rad = 0.0
        """PX4's tilt; 0 while it is below `safety.tilt_abort_deg` and `FLIPPED_TILT_RAD`."""
        self.tracking_error_m: float | None = None
        self.tether: TetherState | None = None
        self.contact_n: float | None = None
        self.vertical_n: float | None = None
        """Vertical force commanded by the control law while it is limited above the weight; else None."""
        self.saturated_s = 0.0
        """Counter that rises while the vertical force is limited and falls otherwise, because noise makes the limit flicker."""

    def update(self, i: Inputs, context: FlightContext, dt_s: float, located: bool = True) -> None:
        """Update with the inputs of one tick in the air; `i` holds only trusted inputs.

        If the vehicle is not `located`, no rule about its place or its tether holds.
        """
        self._inputs, vehicle, self.located = i, i.vehicle, located
        self.vehicle = vehicle
        self.tilt_rad = 0.0
        if vehicle is not None:
            _, x, y, _ = vehicle.attitude_wxyz
            if x * x + y * y > self._upright_max:
                self.tilt_rad = tilt_rad(vehicle.attitude_wxyz)
        self.tracking_error_m = context.tracking_error_m
        self.tether = context.tether if located else None
        self.contact_n = context.contact_n
        control = context.control
        self._count_saturation(control, dt_s)
        if control is None or vehicle is None or self.tracking_error_m is None:
            self.oscillation.rate_rad_s = None
        elif context.chases:
            self.oscillation = Oscillation(self.oscillation_m)
        else:
            e, w = control.error, vehicle.angular_rate_body_rad_s
            self.oscillation.update(i.t_s, dt_s, (e[0], e[1]), (w[0], w[1]))

    def _count_saturation(self, control: ControlLog | None, dt_s: float) -> None:
        self.vertical_n = None
        if control is not None and control.saturated[0] and control.tau[2] > self._weight_n:
            self.vertical_n = control.tau[2]
            self.saturated_s += dt_s
        elif self.saturated_s > 0.0:
            self.saturated_s = max(0.0, self.saturated_s - dt_s)

    @property
    def flipped(self) -> bool:
        """Return whether two sources report in this tick that the vehicle is flipped; valid while `tilt_rad` is above 0."""
        return self._inputs is not None and seems_flipped(self._inputs)

    def stop_s(self, vehicle: VehicleState) -> float:
        """Return the stopping time, s; the velocity multiplied by it is the displacement to the predicted stop after a fault."""
        vx, vy, vz = vehicle.velocity_world_m_s
        return self._stop.time_s(math.sqrt(vx * vx + vy * vy + vz * vz))

    def rotors_in_room(self, x: float, y: float, z: float) -> bool:
        """Return whether the rotors of a vehicle at this position, in m, are in the room or beyond it by less than the tolerance."""
        (x_low, x_high), (y_low, y_high), z_high = self._fence_m
        return x_low <= x <= x_high and y_low <= y <= y_high and z <= z_high


def tilt(f: FlightTracker, tilt_max_rad: float) -> Values | None:
    """Fires if PX4's tilt exceeds the threshold."""
    return (math.degrees(f.tilt_rad), math.degrees(tilt_max_rad)) if f.tilt_rad > tilt_max_rad else None


def oscillates(f: FlightTracker, _: None) -> Values | None:
    """Fires if the position error and the tilt oscillate."""
    rate_rad_s = f.oscillation.rate_rad_s
    return None if rate_rad_s is None else (f.oscillation_m, math.degrees(rate_rad_s))


def crashed(f: FlightTracker, _: None) -> Values | None:
    """Fires if the vehicle is flipped."""
    return (math.degrees(f.tilt_rad),) if f.tilt_rad > 0.0 and f.flipped else None


def too_fast(f: FlightTracker, speed_max_m_s: float) -> Values | None:
    """Fires if the horizontal speed exceeds the threshold."""
    if f.vehicle is None:
        return None
    vx, vy, _ = f.vehicle.velocity_world_m_s
    fast = vx * vx + vy * vy > speed_max_m_s * speed_max_m_s
    return (math.hypot(vx, vy), speed_max_m_s) if fast else None


def climbs_too_fast(f: FlightTracker, climb_max_m_s: float) -> Values | None:
    """Fires if the vertical speed upward exceeds the threshold."""
    up_m_s = f.vehicle.velocity_world_m_s[2] if f.vehicle is not None else 0.0
    return (up_m_s, climb_max_m_s) if up_m_s > climb_max_m_s else None


def sinks_too_fast(f: FlightTracker, sink_max_m_s: float) -> Values | None:
    """Fires if the vertical speed downward exceeds the threshold."""
    up_m_s = f.vehicle.velocity_world_m_s[2] if f.vehicle is not None else 0.0
    return (-up_m_s, sink_max_m_s) if up_m_s < -sink_max_m_s else None


def geofence_left(f: FlightTracker, _: None) -> Values | None:
    """Fires if the rotors are outside the room by more than the tolerance."""
    if f.vehicle is None or not f.located:
        return None
    x, y, z = f.vehicle.position_world_m
    return None if f.rotors_in_room(x, y, z) else (x, y, z)


def geofence_near(f: FlightTracker, _: None) -> Values | None:
    """Fires if at the predicted stop after a fault the rotors would be outside the room by more than the tolerance."""
    if f.vehicle is None or not f.located:
        return None
    x, y, z = f.vehicle.position_world_m
    vx, vy, vz = f.vehicle.velocity_world_m_s
    stop_s = f.stop_s(f.vehicle)
    x, y, z = x + vx * stop_s, y + vy * stop_s, z + vz * stop_s
    return None if f.rotors_in_room(x, y, z) else (x, y, z)


def tracking_error(f: FlightTracker, thresholds: tuple[float, float]) -> Values | None:
    """Fires if the tracking error exceeds both thresholds."""
    error_m = f.tracking_error_m
    if error_m is None or not (error_m > thresholds[0] and error_m > thresholds[1]):
        return None
    return (error_m, max(thresholds))


def tracking_warn(f: FlightTracker, threshold_m: float) -> Values | None:
    """Fires if the tracking error exceeds the threshold."""
    error_m = f.tracking_error_m
    return (error_m, threshold_m) if error_m is not None and error_m > threshold_m else None


def thrust_saturated(f: FlightTracker, saturated_max_s: float) -> Values | None:
    """Fires if the vertical force has been limited for longer than the threshold."""
    found = f.vertical_n is not None and f.saturated_s > saturated_max_s
    return (f.vertical_n, saturated_max_s) if found else None


def contact_force_high(f: FlightTracker, force_max_n: float) -> Values | None:
    """Fires if the force of the surface that the mission touches exceeds the threshold."""
    force_n = f.contact_n
    return (force_n, force_max_n) if force_n is not None and force_n > force_max_n else None


def tether_short(f: FlightTracker, slack_min_m: float) -> Values | None:
    """Fires if less tether than the threshold would be left at the predicted stop after a fault."""
    t = f.tether
    return (t.stop_slack_m, slack_min_m) if t is not None and t.stop_slack_m < slack_min_m else None


def tether_taut(f: FlightTracker, _: None) -> Values | None:
    """Fires if the tether is taut."""
    t = f.tether
    return (t.slack_m, t.pull_n) if t is not None and t.taut else None


def tether_snagged(f: FlightTracker, _: None) -> Values | None:
    """Fires if the tether pulls although there is slack."""
    t = f.tether
    return (t.pull_n, t.slack_m) if t is not None and t.snagged else None


def tether_near(f: FlightTracker, clearance_min_m: float) -> Values | None:
    """Fires if the tether is nearer to the rotors or the arm than the threshold."""
    t = f.tether
    return (t.clearance_m, clearance_min_m) if t is not None and t.clearance_m < clearance_min_m else None


def tether_wound(f: FlightTracker, turns_max: float) -> Values | None:
    """Fires if the tether is wound by more turns than the threshold."""
    t = f.tether
    return (abs(t.turns), turns_max) if t is not None and abs(t.turns) > turns_max else None


def tether_separated(f: FlightTracker, _: None) -> Values | None:
    """Fires if the distance to the anchor exceeds the tether's length although the tether does not pull."""
    t = f.tether
    return (t.range_m,) if t is not None and t.separated else None
