"""Tracker of PX4's state, clock and status, and the predicates of its rules.

The rows of these rules, with the actions and the texts for the operator, are in `companion.safety.rules`.
"""

from __future__ import annotations

import math
from typing import Final

from companion.model.algebra import minus
from companion.model.flight_stage import chosen_by_pilot, failsafe_chose, is_killed
from companion.model.types import AutopilotStatus, FlightMode, Inputs, MocapPose, Vec2, VehicleState
from companion.safety.flight_context import HOLDS, Age, FlightContext, Values
from companion.safety.inertial_check import CLOCK_GROWTH
from companion.safety.motion_lag import MotionLag

DISARMED_ABOVE_M = 0.15
"""Margin over standing height below which PX4's own disarm after a landing is not a fault."""
CLOCK_BACK_S: Final = 1.0
BATTERY_SILENT_S: Final = 10.0
"""Max age of a battery's newest BATTERY_STATUS, which PX4 sends every 2 s: a charge that is not known is not taken for a full one."""
LAG_FORGOTTEN_S_PER_S: Final = CLOCK_GROWTH
"""Rate at which a lasting lag is reduced, because two clocks drift apart; a queue that fills more slowly is not detected."""
GAP_MAX_S: Final = 0.05
"""Longest time step of the measurement of the lag; a longer gap between two poses counts as this."""


class Px4Tracker:
    """Tracks age, lag and repetition of PX4's state, its restarts and its mode.

    Args:
        clearance_m: height of the body's origin when the vehicle is on the ground.
    """

    def __init__(self, clearance_m: float) -> None:
        self.high_m = clearance_m + DISARMED_ABOVE_M
        self._position, self._attitude, self._imu, self._heartbeat = Age(), Age(), Age(), Age()
        self._seen: VehicleState | None = None
        self._same_since_s: float | None = None
        self._moved = False
        self._boot_s: float | None = None
        self._offset_s = math.inf
        """Flight clock minus PX4's clock, without lag."""
        self._lag_awake_s = 0.0
        self.vehicle: VehicleState | None = None
        self.status: AutopilotStatus | None = None
        self.context = FlightContext(False, False, None)
        self.state_age_s = self.heartbeat_age_s = 0.0
        """Age of the oldest of position, attitude and IMU sample; `heartbeat_age_s` is the age of the newest heartbeat."""
        self.battery_age_s = 0.0
        """Time since the last report of the battery that has been silent for the longest time; 0 before the first report."""
        self.lag_s = 0.0
        """Lag of PX4's state: beyond the smallest one seen, by PX4's clock, or by the vehicle's motion, whichever is larger."""
        self._motion = MotionLag()
        self._pose_s = 0.0
        """Stamp of the newest pose that was compared with PX4's position."""
        self.rebooted_s: float | None = None
        """PX4's clock in the tick in which it stepped back."""
        self.repeats = False
        """PX4 sends new positions with the same values although the vehicle is moving in the air."""
        self.left_offboard: AutopilotStatus | None = None
        """PX4's status if PX4 has left OFFBOARD without a request; else None."""

    def update(
        self, i: Inputs, context: FlightContext, awake_s: float, moving: bool, pose: MocapPose | None = None
    ) -> None:
        """Update with the inputs of one tick.

        Args:
            i: inputs.
            context: activity of the core.
            awake_s: awake time of this process.
            moving: True if PX4's velocity or rates show that the vehicle is moving.
            pose: the newest pose of motion capture, if it is trusted.
        """
        v = self.vehicle = i.vehicle
        status = self.status = i.status
        self.lag_s, self.rebooted_s, self.repeats = 0.0, None, False
        if v is None:
            self.state_age_s = max(age.update(awake_s, None) for age in (self._position, self._attitude, self._imu))
        else:
            age_s = self._position.update(awake_s, v.position_stamp_s)
            attitude_s = self._attitude.update(awake_s, v.attitude_stamp_s)
            imu_s = self._imu.update(awake_s, v.imu_stamp_s)
            if attitude_s > age_s:
                age_s = attitude_s
            if imu_s > age_s:
                age_s = imu_s
            self.state_age_s = age_s
            self._compare(v, context, awake_s, moving)
            if context.airborne:
                if pose is not None and pose.tracking_valid and pose.stamp_s > self._pose_s:
                    dt_s, self._pose_s = min(GAP_MAX_S, pose.stamp_s - self._pose_s), pose.stamp_s
                    self._motion.update(dt_s, minus(v.position_world_m, pose.position_world_m), v.velocity_world_m_s)
                self.lag_s = max(self.lag_s, self._motion.one_way_s)
        reported_s = status.battery_stamp_s if status is not None else None
        self.battery_age_s = i.t_s - reported_s if reported_s is not None else 0.0
        left = context.offboard_expected and status is not None and status.mode is not FlightMode.OFFBOARD
        # PX4 reports its flight termination as MANUAL, which no pilot has chosen.
        self.left_offboard = status if left and not is_killed(status) else None
        self.heartbeat_age_s = self._heartbeat.update(awake_s, status.heartbeat_stamp_s if status else None)

    def _compare(self, v: VehicleState, context: FlightContext, awake_s: float, moving: bool) -> None:
        before, self._seen = self._seen, v
        if v.boot_s is not None:
            if self._boot_s is not None and v.boot_s < self._boot_s - CLOCK_BACK_S:
                self.rebooted_s = v.boot_s
                self._offset_s = math.inf
            # The clock offset is unknown: its smallest value counts as zero lag and slowly grows.
            offset_s = v.attitude_stamp_s - v.boot_s
            grown_s = LAG_FORGOTTEN_S_PER_S * (awake_s - self._lag_awake_s)
            self._lag_awake_s = awake_s
            self._offset_s = min(self._offset_s + grown_s, offset_s)
            self.lag_s = offset_s - self._offset_s
            self._boot_s = v.boot_s
        if before is not None and v.position_stamp_s != before.position_stamp_s:
            if v.position_world_m != before.position_world_m or v.velocity_world_m_s != before.velocity_world_m_s:
                self._same_since_s = None
            elif self._same_since_s is None:
                self._same_since_s, self._moved = awake_s, False
        if self._same_since_s is not None and context.airborne:
            self._moved = self._moved or moving
            self.repeats = self._moved


def armed_externally(p: Px4Tracker, _: None) -> Values | None:
    """Fires if PX4 is armed although the companion has not requested it."""
    found = p.context.found_armed
    return None if found is None else (found,)


def killed(p: Px4Tracker, _: None) -> Values | None:
    """Fires if PX4's kill switch or its flight termination has stopped the rotors."""
    return HOLDS if is_killed(p.status) else None


def px4_rebooted(p: Px4Tracker, _: None) -> Values | None:
    """Fires if PX4's clock has stepped back."""
    return None if p.rebooted_s is None else (p.rebooted_s,)


def link_slow(p: Px4Tracker, thresholds: Vec2) -> Values | None:
    """Fires if the lag of PX4's state exceeds the first threshold but not the second."""
    return (p.lag_s * 1e3, thresholds[0] * 1e3) if thresholds[0] < p.lag_s <= thresholds[1] else None


def link_late(p: Px4Tracker, lag_max_s: float) -> Values | None:
    """Fires if the lag of PX4's state exceeds the threshold."""
    return (p.lag_s * 1e3, lag_max_s * 1e3) if p.lag_s > lag_max_s else None


def estimate_frozen(p: Px4Tracker, _: None) -> Values | None:
    """Fires if PX4 sends new positions with the same values although the vehicle is moving."""
    return HOLDS if p.repeats else None


def vehicle_state_lost(p: Px4Tracker, timeout_s: float) -> Values | None:
    """Fires if PX4's position, attitude or IMU sample is older than the timeout."""
    return (timeout_s,) if p.state_age_s > timeout_s else None


def heartbeat_lost(p: Px4Tracker, timeout_s: float) -> Values | None:
    """Fires if no heartbeat has arrived for longer than the timeout."""
    return (timeout_s,) if p.heartbeat_age_s > timeout_s else None


def pilot_took_over(p: Px4Tracker, _: None) -> Values | None:
    """Fires if PX4 is in a mode that a pilot has chosen."""
    status = p.left_offboard
    return (status.mode.value.upper(), "") if status is not None and chosen_by_pilot(status) else None


def offboard_left(p: Px4Tracker, _: None) -> Values | None:
    """Fires if PX4 has changed on its own to a mode other than OFFBOARD."""
    status = p.left_offboard
    if status is None or chosen_by_pilot(status):
        return None
    return (status.mode.value.upper(), "; a failsafe of PX4 is active" if failsafe_chose(status) else "")


def px4_disarmed(p: Px4Tracker, _: None) -> Values | None:
    """Fires if PX4 reports in the air that it is disarmed, while the companion controls the vehicle."""
    status, vehicle = p.status, p.vehicle
    if status is None or status.armed or vehicle is None:
        return None
    height_m = vehicle.position_world_m[2]
    flies = p.context.offboard_expected and p.context.airborne and height_m > p.high_m
    return (height_m,) if flies else None


def battery_below(p: Px4Tracker, remaining_min: float) -> Values | None:
    """Fires if the remaining charge, 0 to 1, is below the threshold."""
    remaining = p.status.battery_remaining if p.status is not None else None
    return (remaining, remaining_min) if remaining is not None and remaining < remaining_min else None


def battery_silent(p: Px4Tracker, _: None) -> Values | None:
    """Fires if a battery has not been reported for longer than `BATTERY_SILENT_S`."""
    return (BATTERY_SILENT_S,) if p.battery_age_s > BATTERY_SILENT_S else None


def battery_voltage(p: Px4Tracker, voltage_min_v: float | None) -> Values | None:
    """Fires if a voltage threshold is configured and the voltage is below it."""
    voltage_v = p.status.battery_voltage_v if p.status is not None else None
    below = voltage_v is not None and voltage_min_v is not None and voltage_v < voltage_min_v
    return (voltage_v, voltage_min_v) if below else None
