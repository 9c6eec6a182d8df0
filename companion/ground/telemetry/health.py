"""Health of each device according to the limits in the vehicle file, with the measured value. Pure.

The limits are those of the safety monitors (`companion.safety.rules`): a value for which they land the vehicle or disable a device
is BAD, one that causes a warning is WARN. The health is for display only; the monitors act on their own.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

from companion.config.vehicle import OBSERVER, Vehicle
from companion.ground.protocol.messages import DeviceHealth, HealthLevel
from companion.model.estimator import EstimatorReport
from companion.model.frames import wrap_rad, yaw_from_quat
from companion.model.listing import listed
from companion.model.servos import WATCHDOG_ERROR
from companion.model.types import Inputs, Outputs, PhaseKind
from companion.safety.arm import error_text
from companion.safety.px4 import BATTERY_SILENT_S

DEVICE_NAMES = (
    "PX4", "estimate", "motion capture", "arm", "force sensor", "loop", "recorder", "guardian", "battery", "tether",
)  # fmt: skip
"""Devices in display order."""
UNKNOWN_S = -math.inf


@dataclass(slots=True)
class WorstAges:
    """The largest ages in a group of ticks, s; `UNKNOWN_S` without a measurement."""

    vehicle_s: float = UNKNOWN_S
    """Age of the oldest of position, attitude and IMU sample from PX4."""
    heartbeat_s: float = UNKNOWN_S
    mocap_s: float = UNKNOWN_S
    """Time since the datagram arrived."""
    arm_s: float = UNKNOWN_S
    force_s: float = UNKNOWN_S
    lateness_s: float = UNKNOWN_S

    def add_tick(self, i: Inputs, lateness_s: float) -> None:
        """Include one tick."""
        t_s, v = i.t_s, i.vehicle
        if v is not None:
            oldest_s = min(v.position_stamp_s, v.attitude_stamp_s, v.imu_stamp_s)
            self.vehicle_s = max(self.vehicle_s, t_s - oldest_s)
        if i.status is not None:
            self.heartbeat_s = max(self.heartbeat_s, t_s - i.status.heartbeat_stamp_s)
        if i.mocap is not None:
            self.mocap_s = max(self.mocap_s, t_s - i.mocap.stamp_s)
        if i.arm is not None:
            self.arm_s = max(self.arm_s, t_s - i.arm.stamp_s)
        if i.force is not None:
            self.force_s = max(self.force_s, t_s - i.force.stamp_s)
        self.lateness_s = max(self.lateness_s, lateness_s)

    def merge(self, other: WorstAges) -> None:
        """Include the ticks of another instance."""
        for name in self.__slots__:
            setattr(self, name, max(getattr(self, name), getattr(other, name)))


@dataclass(frozen=True, slots=True)
class Snapshot:
    """Values from which the health is evaluated."""

    inputs: Inputs
    """Inputs of the newest tick."""
    outputs: Outputs
    ages: WorstAges
    """Largest ages of the last second."""
    mocap_rate_hz: float | None
    """Frames in the last second; None if unknown."""
    missed: int
    dropped: int
    """Number of lost records in the whole session."""
    recorder_error: str | None = None


class HealthEvaluator:
    """Evaluates the health of all devices against the limits in a vehicle file."""

    def __init__(self, vehicle: Vehicle) -> None:
        self._s = vehicle.safety
        self._tether = vehicle.tether
        self._external = vehicle.devices.mocap.external
        self._has_arm = bool(vehicle.arm.joints)
        self._force_device = vehicle.devices.force
        self._no_force = "momentum observer" if vehicle.force_source == OBSERVER else "none on this vehicle"

    def evaluate(self, snapshot: Snapshot) -> tuple[DeviceHealth, ...]:
        """Return the health of all devices, in the order of `DEVICE_NAMES`."""
        judged = (
            self._px4(snapshot),
            self._estimate(snapshot),
            self._mocap(snapshot),
            self._arm(snapshot),
            self._force(snapshot),
            self._loop(snapshot),
            _recorder(snapshot),
            _guardian(snapshot),
            self._battery(snapshot),
            self._tether_health(snapshot),
        )
        return tuple(DeviceHealth(name, light, text) for name, (light, text) in zip(DEVICE_NAMES, judged, strict=True))

    def _px4(self, snapshot: Snapshot) -> tuple[HealthLevel, str]:
        status, ages, s = snapshot.inputs.status, snapshot.ages, self._s
        if status is None and snapshot.inputs.vehicle is None:
            return HealthLevel.OFF, "nothing received yet"
        mode = f"{status.mode.value.upper()}, {'armed' if status.armed else 'disarmed'}" if status else "no heartbeat"
        if status is None or ages.heartbeat_s > s.heartbeat_timeout_s:
            return HealthLevel.BAD, f"no heartbeat for {ages.heartbeat_s:.1f} s" if status else mode
        if snapshot.inputs.vehicle is None:
            return HealthLevel.WARN, f"no state yet, {mode}"
        return _level_by_age(ages.vehicle_s, s.vehicle_timeout_s), f"{_age_text(ages.vehicle_s)}, {mode}"

    def _estimate(self, snapshot: Snapshot) -> tuple[HealthLevel, str]:
        i, s, ages = snapshot.inputs, self._s, snapshot.ages
        if self._external:
            return _external_vision(i.estimator)
        if i.vehicle is None or i.mocap is None or not i.mocap.tracking_valid or not ages.mocap_s <= s.mocap_timeout_s:
            return HealthLevel.OFF, "no fresh pose to compare with"
        apart_m = math.dist(i.vehicle.position_world_m, i.mocap.position_world_m)
        turned_deg = math.degrees(
            abs(wrap_rad(yaw_from_quat(i.vehicle.attitude_wxyz) - yaw_from_quat(i.mocap.attitude_wxyz)))
        )
        ratio = max(apart_m / s.estimate_disagreement_m, turned_deg / s.yaw_disagreement_deg)
        return _level_by_ratio(ratio), f"{apart_m * 100:.1f} cm, {turned_deg:.1f} deg from motion capture"

    def _mocap(self, snapshot: Snapshot) -> tuple[HealthLevel, str]:
        mocap, s, rate_hz = snapshot.inputs.mocap, self._s, snapshot.mocap_rate_hz
        if self._external:
            return HealthLevel.OFF, "another program feeds PX4"
        if mocap is None:
            return HealthLevel.OFF, "no pose yet"
        age_s, late_s = snapshot.ages.mocap_s, mocap.latency_s or 0.0
        rate = f", {rate_hz:.0f} Hz" if rate_hz is not None else ""
        text = f"{_age_text(age_s)}{rate}"
        if not mocap.tracking_valid:
            return HealthLevel.BAD, "rigid body not tracked"
        if not late_s <= s.mocap_latency_max_s:
            return HealthLevel.BAD, f"{late_s * 1e3:.0f} ms late"
        light = _level_by_age(age_s, s.mocap_timeout_s)
        if not snapshot.outputs.mocap_trusted and light is not HealthLevel.BAD:
            return HealthLevel.BAD, "rejected: poses jump or are frozen"
        if light is HealthLevel.OK and late_s > s.mocap_latency_warn_s:
            return HealthLevel.WARN, f"{late_s * 1e3:.0f} ms late"
        if light is HealthLevel.OK and rate_hz is not None and rate_hz < s.mocap_rate_min_hz:
            return HealthLevel.WARN, text
        return light, text

    def _arm(self, snapshot: Snapshot) -> tuple[HealthLevel, str]:
        arm, s, age_s = snapshot.inputs.arm, self._s, snapshot.ages.arm_s
        if not self._has_arm:
            return HealthLevel.OFF, "none on this vehicle"
        if arm is None:
            return HealthLevel.OFF, "no joint state yet"
        hottest_c = max(arm.temperature_c)
        text = f"{_age_text(age_s)}, {listed(arm.temperature_c, '.0f', ' / ')} degC"
        if any(error & ~WATCHDOG_ERROR for error in arm.hardware_error):
            return HealthLevel.BAD, error_text(arm.hardware_error)
        if hottest_c >= s.servo_max_c:
            return HealthLevel.BAD, text
        light = _level_by_age(age_s, s.arm_timeout_s)
        if light is HealthLevel.OK and any(arm.hardware_error):
            return HealthLevel.WARN, "the bus watchdog had switched torque off; it is on again"
        if light is HealthLevel.OK and arm.read_failures >= s.arm_read_failures_max:
            return HealthLevel.WARN, f"{arm.read_failures} bus cycles without an answer"
        return HealthLevel.WARN if light is HealthLevel.OK and hottest_c >= s.servo_warn_c else light, text

    def _force(self, snapshot: Snapshot) -> tuple[HealthLevel, str]:
        force, age_s, device = snapshot.inputs.force, snapshot.ages.force_s, self._force_device
        if device is None:
            return HealthLevel.OFF, self._no_force
        if force is None:
            return HealthLevel.OFF, "no sample yet"
        size_n = math.hypot(*force.force_sensor_n)
        light = _level_by_age(age_s, self._s.force_timeout_s)
        if light is HealthLevel.OK and (force.overload or not size_n <= device.force_max_n):
            return HealthLevel.WARN, f"overloaded: {size_n:.0f} N"
        return light, f"{_age_text(age_s)}, {size_n:.1f} N"

    def _loop(self, snapshot: Snapshot) -> tuple[HealthLevel, str]:
        late_s, s = snapshot.ages.lateness_s, self._s
        light = (
            HealthLevel.BAD
            if late_s > s.loop_stalled_s
            else HealthLevel.WARN
            if late_s > s.loop_late_s
            else HealthLevel.OK
        )
        missed = f"{snapshot.missed} ticks missed" if snapshot.missed else "no tick missed"
        return light, f"{late_s * 1e3:.1f} ms late at worst, {missed}"

    def _battery(self, snapshot: Snapshot) -> tuple[HealthLevel, str]:
        status, s = snapshot.inputs.status, self._s
        voltage_v = status.battery_voltage_v if status is not None else None
        remaining = status.battery_remaining if status is not None else None
        parts = [f"{voltage_v:.1f} V"] if voltage_v is not None else []
        parts += [f"{remaining * 100:.0f} %"] if remaining is not None else []
        if not parts:
            return HealthLevel.OFF, "not reported by PX4"
        stamp_s = status.battery_stamp_s if status is not None else None
        if stamp_s is not None and snapshot.inputs.t_s - stamp_s > BATTERY_SILENT_S:
            return HealthLevel.BAD, f"not reported for {snapshot.inputs.t_s - stamp_s:.0f} s"
        empty = remaining is not None and not remaining >= s.battery_min
        if voltage_v is not None and s.battery_voltage_min_v is not None:
            empty = empty or not voltage_v >= s.battery_voltage_min_v
        warn = remaining is not None and remaining < s.battery_warn
        return HealthLevel.BAD if empty else HealthLevel.WARN if warn else HealthLevel.OK, ", ".join(parts)

    def _tether_health(self, snapshot: Snapshot) -> tuple[HealthLevel, str]:
        state, tether = snapshot.outputs.tether, self._tether
        if tether is None:
            return HealthLevel.OFF, "none on this vehicle"
        if state is None:
            return HealthLevel.OFF, "not measured"
        left = f"{state.slack_m:.2f} m left"
        if state.separated:
            return HealthLevel.BAD, "no longer holds the vehicle"
        if state.snagged:
            return HealthLevel.BAD, f"snagged: pulls with {state.pull_n:.0f} N, {left}"
        if state.taut:
            return HealthLevel.BAD, f"taut: pulls with {state.pull_n:.0f} N, {left}"
        if snapshot.outputs.phase_kind in (PhaseKind.GROUND, PhaseKind.DONE):
            return HealthLevel.OK, left
        if not state.stop_slack_m >= self._s.tether_stop_slack_min_m:
            return HealthLevel.BAD, f"{left}, {state.stop_slack_m:.2f} m where it could stop"
        if abs(state.turns) > tether.turns_max:
            return HealthLevel.BAD, f"wound: {state.turns:+.1f} turns, {left}"
        if state.clearance_m < tether.clearance_min_m:
            return HealthLevel.WARN, f"{state.clearance_m * 100:.0f} cm from the rotors or the arm, {left}"
        return HealthLevel.WARN if state.stop_slack_m < tether.margin_m else HealthLevel.OK, left


def _external_vision(report: EstimatorReport | None) -> tuple[HealthLevel, str]:
    if report is None:
        return HealthLevel.OFF, "no ESTIMATOR_STATUS yet"
    if report.unaided is not None:
        return HealthLevel.BAD, f"PX4 has no measurement of {report.unaided}"
    return _level_by_ratio(report.worst_ratio), f"fuses external vision, test ratio {report.worst_ratio:.2f}"


def _recorder(snapshot: Snapshot) -> tuple[HealthLevel, str]:
    if snapshot.recorder_error is not None:
        return HealthLevel.BAD, snapshot.recorder_error
    if snapshot.dropped:
        return HealthLevel.WARN, f"{snapshot.dropped} records lost"
    return HealthLevel.OK, "nothing lost"


def _guardian(snapshot: Snapshot) -> tuple[HealthLevel, str]:
    ready = snapshot.inputs.guardian_ready
    if ready is None:
        return HealthLevel.OFF, "no guardian"
    return (HealthLevel.OK, "standby") if ready else (HealthLevel.BAD, "dead or not ready")


def _level_by_age(age_s: float, limit_s: float) -> HealthLevel:
    return _level_by_ratio(age_s / limit_s)


def _level_by_ratio(ratio: float) -> HealthLevel:
    """Return the level for a ratio of value to limit: BAD above 1 or if not finite, WARN above 0.5."""
    return HealthLevel.OK if ratio <= 0.5 else HealthLevel.WARN if ratio <= 1.0 else HealthLevel.BAD


def _age_text(age_s: float) -> str:
    age_s = max(0.0, age_s)  # joints are read during the tick
    return f"{age_s * 1e3:.0f} ms old" if age_s < 1.0 else f"{age_s:.1f} s old"
