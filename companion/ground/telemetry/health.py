"""One light for each device: is it well, by the limits of the vehicle file? With the figure that says so. Pure.

Limits are those of the monitors (`companion.safety.events`): what lands the vehicle or takes a device away is BAD, what is told is
WARN. The lights decide nothing: the monitors do.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

from companion.config.vehicle import Vehicle
from companion.ground.protocol.messages import Health, Light
from companion.model.frames import wrap_rad, yaw_from_quat
from companion.model.types import Inputs, Outputs, PhaseKind
from companion.safety.arm import WATCHDOG_RESTARTED, error_text

NAMES = (
    "PX4", "estimate", "motion capture", "arm", "force sensor", "loop", "recorder", "guardian", "battery", "tether",
)  # fmt: skip
"""In the order in which they are shown."""
UNKNOWN_S = -math.inf


@dataclass(slots=True)
class Ages:
    """The worst of some ticks; `UNKNOWN_S` where there was nothing to measure. Seconds."""

    vehicle_s: float = UNKNOWN_S
    """Oldest of position, attitude and IMU from PX4."""
    heartbeat_s: float = UNKNOWN_S
    mocap_s: float = UNKNOWN_S
    """Since the datagram arrived."""
    arm_s: float = UNKNOWN_S
    force_s: float = UNKNOWN_S
    lateness_s: float = UNKNOWN_S

    def add_tick(self, i: Inputs, lateness_s: float) -> None:
        """One tick."""
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

    def merge(self, other: Ages) -> None:
        """The worst of both."""
        for name in self.__slots__:
            setattr(self, name, max(getattr(self, name), getattr(other, name)))


@dataclass(frozen=True, slots=True)
class Look:
    """What the lights are judged by."""

    inputs: Inputs
    """Of the newest tick."""
    outputs: Outputs
    ages: Ages
    """Worst of the last second."""
    mocap_rate_hz: float | None
    """Frames seen in the last second; None: not yet known."""
    missed: int
    dropped: int
    """Records that were lost, of the whole session."""
    recorder_error: str | None = None


class Lights:
    """Judges by one vehicle file."""

    def __init__(self, vehicle: Vehicle) -> None:
        self._s = vehicle.safety
        self._tether = vehicle.tether
        self._force_max_n = vehicle.devices.force.force_max_n

    def evaluate(self, look: Look) -> tuple[Health, ...]:
        """All lights, in the order of `NAMES`."""
        judged = (
            self._px4(look),
            self._estimate(look),
            self._mocap(look),
            self._arm(look),
            self._force(look),
            self._loop(look),
            _recorder(look),
            _guardian(look),
            self._battery(look),
            self._tether_light(look),
        )
        return tuple(Health(name, light, text) for name, (light, text) in zip(NAMES, judged, strict=True))

    def _px4(self, look: Look) -> tuple[Light, str]:
        status, ages, s = look.inputs.status, look.ages, self._s
        if status is None and look.inputs.vehicle is None:
            return Light.OFF, "nothing heard yet"
        mode = f"{status.mode.value.upper()}, {'armed' if status.armed else 'disarmed'}" if status else "no heartbeat"
        if status is None or ages.heartbeat_s > s.heartbeat_timeout_s:
            return Light.BAD, f"no heartbeat for {ages.heartbeat_s:.1f} s" if status else mode
        if look.inputs.vehicle is None:
            return Light.WARN, f"no state yet, {mode}"
        return _by_age(ages.vehicle_s, s.vehicle_timeout_s), f"{_old(ages.vehicle_s)}, {mode}"

    def _estimate(self, look: Look) -> tuple[Light, str]:
        i, s, ages = look.inputs, self._s, look.ages
        if i.vehicle is None or i.mocap is None or not i.mocap.tracking_valid or not ages.mocap_s <= s.mocap_timeout_s:
            return Light.OFF, "nothing to compare with"
        apart_m = math.dist(i.vehicle.position_world_m, i.mocap.position_world_m)
        turned_deg = math.degrees(
            abs(wrap_rad(yaw_from_quat(i.vehicle.attitude_wxyz) - yaw_from_quat(i.mocap.attitude_wxyz)))
        )
        share = max(apart_m / s.estimate_disagreement_m, turned_deg / s.yaw_disagreement_deg)
        return _by_share(share), f"{apart_m * 100:.1f} cm, {turned_deg:.1f} deg from motion capture"

    def _mocap(self, look: Look) -> tuple[Light, str]:
        mocap, s, rate_hz = look.inputs.mocap, self._s, look.mocap_rate_hz
        if mocap is None:
            return Light.OFF, "no pose yet"
        age_s, late_s = look.ages.mocap_s, mocap.latency_s or 0.0
        rate = f", {rate_hz:.0f} Hz" if rate_hz is not None else ""
        text = f"{_old(age_s)}{rate}"
        if not mocap.tracking_valid:
            return Light.BAD, "the body is not seen"
        if not look.outputs.mocap_trusted:
            return Light.BAD, "not believed: it jumps or stands still"
        if not late_s <= s.mocap_timeout_s:
            return Light.BAD, f"{late_s * 1e3:.0f} ms late by Motive's clock"
        light = _by_age(age_s, s.mocap_timeout_s)
        if light is Light.OK and late_s > s.mocap_latency_warn_s:
            return Light.WARN, f"{late_s * 1e3:.0f} ms late by Motive's clock"
        if light is Light.OK and rate_hz is not None and rate_hz < s.mocap_rate_min_hz:
            return Light.WARN, text
        return light, text

    def _arm(self, look: Look) -> tuple[Light, str]:
        arm, s, age_s = look.inputs.arm, self._s, look.ages.arm_s
        if arm is None:
            return Light.OFF, "no joint state yet"
        hottest_c = max(arm.temperature_c)
        text = f"{_old(age_s)}, {arm.temperature_c[0]:.0f} / {arm.temperature_c[1]:.0f} degC"
        if any(error & ~WATCHDOG_RESTARTED for error in arm.hardware_error):
            return Light.BAD, error_text(arm.hardware_error)
        if hottest_c >= s.servo_max_c:
            return Light.BAD, text
        light = _by_age(age_s, s.arm_timeout_s)
        if light is Light.OK and any(arm.hardware_error):
            return Light.WARN, "the bus watchdog had let go; torque is back"
        if light is Light.OK and arm.read_failures >= s.arm_read_failures_max:
            return Light.WARN, f"{arm.read_failures} bus cycles without an answer"
        return Light.WARN if light is Light.OK and hottest_c >= s.servo_warn_c else light, text

    def _force(self, look: Look) -> tuple[Light, str]:
        force, age_s = look.inputs.force, look.ages.force_s
        if force is None:
            return Light.OFF, "no sample yet"
        size_n = math.hypot(*force.force_sensor_n)
        light = _by_age(age_s, self._s.force_timeout_s)
        if light is Light.OK and (force.overload or not size_n <= self._force_max_n):
            return Light.WARN, f"overloaded: {size_n:.0f} N"
        return light, f"{_old(age_s)}, {size_n:.1f} N"

    def _loop(self, look: Look) -> tuple[Light, str]:
        late_s, s = look.ages.lateness_s, self._s
        light = Light.BAD if late_s > s.loop_stalled_s else Light.WARN if late_s > s.loop_late_s else Light.OK
        missed = f"{look.missed} ticks missed" if look.missed else "no tick missed"
        return light, f"{late_s * 1e3:.1f} ms late at worst, {missed}"

    def _battery(self, look: Look) -> tuple[Light, str]:
        status, s = look.inputs.status, self._s
        voltage_v = status.battery_voltage_v if status is not None else None
        remaining = status.battery_remaining if status is not None else None
        parts = [f"{voltage_v:.1f} V"] if voltage_v is not None else []
        parts += [f"{remaining * 100:.0f} %"] if remaining is not None else []
        if not parts:
            return Light.OFF, "PX4 does not say"
        empty = remaining is not None and not remaining >= s.battery_min
        if voltage_v is not None and s.battery_voltage_min_v is not None:
            empty = empty or not voltage_v >= s.battery_voltage_min_v
        warn = remaining is not None and remaining < s.battery_warn
        return Light.BAD if empty else Light.WARN if warn else Light.OK, ", ".join(parts)

    def _tether_light(self, look: Look) -> tuple[Light, str]:
        state, tether = look.outputs.tether, self._tether
        if state is None:
            return Light.OFF, "not measured"
        left = f"{state.slack_m:.2f} m left"
        if state.separated:
            return Light.BAD, "holds the machine no more"
        if state.snagged:
            return Light.BAD, f"snagged: pulls with {state.pull_n:.0f} N, {left}"
        if state.taut:
            return Light.BAD, f"taut: pulls with {state.pull_n:.0f} N, {left}"
        if look.outputs.phase_kind in (PhaseKind.GROUND, PhaseKind.DONE):
            return Light.OK, left
        if not state.stop_slack_m >= self._s.tether_stop_slack_min_m:
            return Light.BAD, f"{left}, {state.stop_slack_m:.2f} m where it could stop"
        if abs(state.turns) > tether.turns_max:
            return Light.BAD, f"wound: {state.turns:+.1f} turns, {left}"
        if state.clearance_m < tether.clearance_min_m:
            return Light.WARN, f"{state.clearance_m * 100:.0f} cm from rotors or arm, {left}"
        return Light.WARN if state.stop_slack_m < tether.margin_m else Light.OK, left


def _recorder(look: Look) -> tuple[Light, str]:
    if look.recorder_error is not None:
        return Light.BAD, look.recorder_error
    if look.dropped:
        return Light.WARN, f"{look.dropped} records lost"
    return Light.OK, "nothing lost"


def _guardian(look: Look) -> tuple[Light, str]:
    ready = look.inputs.guardian_ready
    if ready is None:
        return Light.OFF, "none stands by"
    return (Light.OK, "stands by") if ready else (Light.BAD, "dead, or could not take over")


def _by_age(age_s: float, limit_s: float) -> Light:
    return _by_share(age_s / limit_s)


def _by_share(share: float) -> Light:
    """Of a limit: beyond it BAD, from the half on WARN; what is no number is BAD."""
    return Light.OK if share <= 0.5 else Light.WARN if share <= 1.0 else Light.BAD


def _old(age_s: float) -> str:
    age_s = max(0.0, age_s)  # joints are read within their tick
    return f"{age_s * 1e3:.0f} ms old" if age_s < 1.0 else f"{age_s:.1f} s old"
