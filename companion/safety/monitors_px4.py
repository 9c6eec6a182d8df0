"""Is PX4 alive, believable, in the mode that it should be in, and charged?"""

from __future__ import annotations

import math

from companion.config.vehicle import Vehicle
from companion.model.flight_stage import failsafe_chose, people_chose
from companion.model.types import AutopilotStatus, FlightMode, Inputs, VehicleState
from companion.safety.findings import Age, Findings, Situation
from companion.safety.rules import (
    BATTERY_LOW,
    BATTERY_VOLTAGE,
    BATTERY_WARN,
    ESTIMATE_FROZEN,
    HEARTBEAT_LOST,
    LINK_LATE,
    OFFBOARD_LEFT,
    PILOT_TOOK_OVER,
    PX4_DISARMED,
    PX4_REBOOTED,
    VEHICLE_STATE_LOST,
)

DISARMED_ABOVE_M = 0.15
"""Lower than this above standing, PX4's own disarm after a landing is nothing to wonder about."""
CLOCK_BACK_S = 1.0
LAG_FORGOTTEN_S_PER_S = 0.05
"""What came late once and goes on so is no lag any more after a while: then it was the clocks."""


class Px4Monitor:
    """Ages, frozen estimate, restart, mode and battery."""

    def __init__(self, vehicle: Vehicle) -> None:
        self._s = vehicle.safety
        self._high_m = vehicle.airframe.ground_clearance_m + DISARMED_ABOVE_M
        self._position, self._attitude, self._imu, self._heartbeat = Age(), Age(), Age(), Age()
        self._seen: VehicleState | None = None
        self._same_since_s: float | None = None
        self._moved = False
        self._boot_s: float | None = None
        self._offset_s = math.inf
        """Flight clock less PX4's clock, without lag."""
        self._lag_awake_s = 0.0

    def check(self, i: Inputs, situation: Situation, awake_s: float, moving: bool, findings: Findings) -> None:
        """One tick; `moving`: the IMU says that the vehicle moves."""
        s, v = self._s, i.vehicle
        if v is None:
            age_s = max(age.update(awake_s, None) for age in (self._position, self._attitude, self._imu))
        else:
            age_s = self._position.update(awake_s, v.position_stamp_s)
            attitude_s = self._attitude.update(awake_s, v.attitude_stamp_s)
            imu_s = self._imu.update(awake_s, v.imu_stamp_s)
            if attitude_s > age_s:
                age_s = attitude_s
            if imu_s > age_s:
                age_s = imu_s
            self._estimate(v, situation, awake_s, moving, findings)
        if age_s > s.vehicle_timeout_s:
            findings.found(VEHICLE_STATE_LOST, "no fresh state from PX4")
        status = i.status
        if self._heartbeat.update(awake_s, status.heartbeat_stamp_s if status else None) > s.heartbeat_timeout_s:
            findings.found(HEARTBEAT_LOST, "no heartbeat from PX4")
        if status is None:
            return
        if situation.offboard_expected:
            if status.mode is not FlightMode.OFFBOARD:
                rule = PILOT_TOOK_OVER if people_chose(status) else OFFBOARD_LEFT
                why = "; its failsafe acts" if failsafe_chose(status) else ""
                findings.found(rule, "PX4 left OFFBOARD for {}{}", status.mode.value.upper(), why)
            if not status.armed and situation.airborne and v is not None and v.position_world_m[2] > self._high_m:
                findings.found(PX4_DISARMED, "PX4 says disarmed at a height of {:.2f} m", v.position_world_m[2])
        self._battery(status, findings)

    def _estimate(
        self, v: VehicleState, situation: Situation, awake_s: float, moving: bool, findings: Findings
    ) -> None:
        before, self._seen = self._seen, v
        if v.boot_s is not None:
            if self._boot_s is not None and v.boot_s < self._boot_s - CLOCK_BACK_S:
                findings.found(PX4_REBOOTED, "PX4 restarted: its clock went back to {:.1f} s", v.boot_s)
                self._offset_s = math.inf
            self._lag(v.attitude_stamp_s - v.boot_s, awake_s, findings)
            self._boot_s = v.boot_s
        if before is not None and v.position_stamp_s != before.position_stamp_s:
            if v.position_world_m != before.position_world_m or v.velocity_world_m_s != before.velocity_world_m_s:
                self._same_since_s = None
            elif self._same_since_s is None:
                self._same_since_s, self._moved = awake_s, False
        if self._same_since_s is not None and situation.airborne:
            self._moved = self._moved or moving
            if self._moved:
                findings.found(ESTIMATE_FROZEN, "PX4 repeats the same position and velocity, the vehicle moves")

    def _lag(self, offset_s: float, awake_s: float, findings: Findings) -> None:
        """Clocks of which nobody knows the difference: the least that it ever was stands for no lag, and slowly grows."""
        grown_s = LAG_FORGOTTEN_S_PER_S * (awake_s - self._lag_awake_s)
        self._lag_awake_s = awake_s
        self._offset_s = min(self._offset_s + grown_s, offset_s)
        lag_s = offset_s - self._offset_s
        if lag_s > self._s.link_lag_max_s:
            findings.found(LINK_LATE, "what PX4 says is {:.0f} ms late", lag_s * 1e3)

    def _battery(self, status: AutopilotStatus, findings: Findings) -> None:
        s, remaining, voltage_v = self._s, status.battery_remaining, status.battery_voltage_v
        if remaining is not None and remaining < s.battery_warn:
            findings.found(BATTERY_WARN, "battery at {:.0%}", remaining)
        if remaining is not None and remaining < s.battery_min:
            findings.found(BATTERY_LOW, "battery at {:.0%}", remaining)
        if voltage_v is not None and s.battery_voltage_min_v is not None and voltage_v < s.battery_voltage_min_v:
            findings.found(BATTERY_VOLTAGE, "battery at {:.1f} V, {:.1f} V wanted", voltage_v, s.battery_voltage_min_v)
