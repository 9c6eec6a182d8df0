"""Health lamps: each is the gravest active rule that it shows (`companion.safety.rules`), or its measured value. Pure."""

from __future__ import annotations

import math
from dataclasses import dataclass

from companion.config.vehicle import OBSERVER, Vehicle
from companion.ground.protocol.messages import DeviceHealth, HealthLevel
from companion.model.estimator import EstimatorReport
from companion.model.frames import wrap_rad, yaw_from_quat
from companion.model.listing import listed
from companion.model.outputs import ActiveRule, Outputs
from companion.model.types import Inputs, PhaseKind, SafetyAction
from companion.safety.rule import Lamp
from companion.safety.rules import RULES

_LAMP_OF = {rule.id: rule.lamp for rule in RULES}
UNKNOWN_S = -math.inf


@dataclass(slots=True)
class WorstAges:
    """The largest ages in a group of ticks, s; `UNKNOWN_S` without a measurement."""

    vehicle_s: float = UNKNOWN_S
    """Age of the oldest of position, attitude and IMU sample from PX4."""
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
    """Evaluates all lamps.

    Args:
        vehicle: its devices and the ages at which a rule would fire; half of such an age is a warning.
    """

    def __init__(self, vehicle: Vehicle) -> None:
        self._s = vehicle.safety
        self._tether = vehicle.tether
        self._external = vehicle.devices.mocap.external
        self._has_arm = bool(vehicle.arm.joints)
        self._has_force_sensor = vehicle.devices.force is not None
        self._no_force = "momentum observer" if vehicle.force_source == OBSERVER else "none on this vehicle"

    def evaluate(self, snapshot: Snapshot) -> tuple[DeviceHealth, ...]:
        """Return all lamps, in the order of `Lamp`."""
        measured = {
            Lamp.FLIGHT: _flight(snapshot),
            Lamp.PX4: self._px4(snapshot),
            Lamp.ESTIMATE: self._estimate(snapshot),
            Lamp.MOCAP: self._mocap(snapshot),
            Lamp.ARM: self._arm(snapshot),
            Lamp.FORCE: self._force(snapshot),
            Lamp.LOOP: _loop(snapshot),
            Lamp.RECORDER: _recorder(snapshot),
            Lamp.GUARDIAN: _guardian(snapshot),
            Lamp.BATTERY: _battery(snapshot),
            Lamp.TETHER: self._tether_health(snapshot),
            Lamp.PARTNER: self._partner(snapshot),
        }
        gravest: dict[Lamp, ActiveRule] = {}
        for rule in snapshot.outputs.active or ():
            lamp = _LAMP_OF.get(rule.id, Lamp.FLIGHT)
            if lamp not in gravest or rule.action.rank > gravest[lamp].action.rank:
                gravest[lamp] = rule
        return tuple(DeviceHealth(lamp, *_worse(*measured[lamp], gravest.get(lamp))) for lamp in Lamp)

    def _px4(self, snapshot: Snapshot) -> tuple[HealthLevel, str]:
        status, age_s = snapshot.inputs.status, snapshot.ages.vehicle_s
        if status is None:
            if snapshot.inputs.vehicle is None:
                return HealthLevel.OFF, "nothing received yet"
            return HealthLevel.BAD, "no heartbeat"
        mode = f"{status.mode.value.upper()}, {'armed' if status.armed else 'disarmed'}"
        if snapshot.inputs.vehicle is None:
            return HealthLevel.WARN, f"no state yet, {mode}"
        return _level_by_age(age_s, self._s.vehicle_timeout_s), f"{_age_text(age_s)}, {mode}"

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
        mocap, age_s, rate_hz = snapshot.inputs.mocap, snapshot.ages.mocap_s, snapshot.mocap_rate_hz
        if self._external:
            return HealthLevel.OFF, "another program feeds PX4"
        if mocap is None:
            return HealthLevel.OFF, "no pose yet"
        if not mocap.tracking_valid:
            return HealthLevel.BAD, "rigid body not tracked"
        if not snapshot.outputs.mocap_trusted:
            return HealthLevel.BAD, "poses are rejected"
        rate = f", {rate_hz:.0f} Hz" if rate_hz is not None else ""
        return _level_by_age(age_s, self._s.mocap_timeout_s), f"{_age_text(age_s)}{rate}"

    def _arm(self, snapshot: Snapshot) -> tuple[HealthLevel, str]:
        arm, age_s = snapshot.inputs.arm, snapshot.ages.arm_s
        if not self._has_arm:
            return HealthLevel.OFF, "none on this vehicle"
        if arm is None:
            return HealthLevel.OFF, "no joint state yet"
        text = f"{_age_text(age_s)}, {listed(arm.temperature_c, '.0f', ' / ')} degC"
        return _level_by_age(age_s, self._s.arm_timeout_s), text

    def _force(self, snapshot: Snapshot) -> tuple[HealthLevel, str]:
        force, age_s = snapshot.inputs.force, snapshot.ages.force_s
        if not self._has_force_sensor:
            return HealthLevel.OFF, self._no_force
        if force is None:
            return HealthLevel.OFF, "no sample yet"
        text = f"{_age_text(age_s)}, {math.hypot(*force.force_sensor_n):.1f} N"
        return _level_by_age(age_s, self._s.force_timeout_s), text

    def _tether_health(self, snapshot: Snapshot) -> tuple[HealthLevel, str]:
        state, tether = snapshot.outputs.tether, self._tether
        if tether is None:
            return HealthLevel.OFF, "none on this vehicle"
        if state is None:
            return HealthLevel.OFF, "not measured"
        near = _flies(snapshot.outputs) and state.stop_slack_m < tether.margin_m
        return HealthLevel.WARN if near else HealthLevel.OK, f"{state.slack_m:.2f} m left"

    def _partner(self, snapshot: Snapshot) -> tuple[HealthLevel, str]:
        partner = snapshot.inputs.partner
        if snapshot.outputs.team is None:
            return HealthLevel.OFF, "this vehicle flies alone"
        if partner is None:
            return HealthLevel.WARN, "nothing received yet"
        age_s = snapshot.inputs.t_s - partner.stamp_s
        return _level_by_age(age_s, self._s.partner_timeout_s), _age_text(age_s)


def _flies(outputs: Outputs) -> bool:
    return outputs.phase_kind not in (PhaseKind.GROUND, PhaseKind.DONE)


def _worse(level: HealthLevel, text: str, rule: ActiveRule | None) -> tuple[HealthLevel, str]:
    """Return what the lamp shows: the rule, unless the measurement is worse or there is no rule."""
    if rule is None or (level is HealthLevel.BAD and rule.action.rank < SafetyAction.HOLD.rank):
        return level, text
    return (HealthLevel.BAD if rule.action.rank >= SafetyAction.HOLD.rank else HealthLevel.WARN), rule.text


def _flight(snapshot: Snapshot) -> tuple[HealthLevel, str]:
    outputs = snapshot.outputs
    if not _flies(outputs):
        return HealthLevel.OFF, "on the ground"
    return (
        HealthLevel.OK,
        f"{math.hypot(*outputs.control.error[0:3]):.2f} m off the reference" if outputs.control else "",
    )


def _loop(snapshot: Snapshot) -> tuple[HealthLevel, str]:
    missed = f"{snapshot.missed} ticks missed" if snapshot.missed else "no tick missed"
    return HealthLevel.OK, f"{snapshot.ages.lateness_s * 1e3:.1f} ms late at worst, {missed}"


def _battery(snapshot: Snapshot) -> tuple[HealthLevel, str]:
    status = snapshot.inputs.status
    voltage_v = status.battery_voltage_v if status is not None else None
    remaining = status.battery_remaining if status is not None else None
    parts = [f"{voltage_v:.1f} V"] if voltage_v is not None else []
    parts += [f"{remaining * 100:.0f} %"] if remaining is not None else []
    return (HealthLevel.OK, ", ".join(parts)) if parts else (HealthLevel.OFF, "not reported by PX4")


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
