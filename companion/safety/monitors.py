"""Monitors: pure judges of the inputs. Each finding becomes one event when it begins; a monitor says what should be done about it."""

from __future__ import annotations

import math
from dataclasses import dataclass

from companion.config.vehicle import Safety
from companion.frames import euler_zyx_from_quat, tilt_rad, wrap_rad
from companion.types import Event, FlightMode, Inputs, OperatorCommand, SafetyAction, Severity

CRASH_TILT_RAD = math.radians(70.0)
AWAKE_STEP_MAX_S = 0.02
"""A tick counts for no more than this in the age of inputs."""
WATCHDOG_RESTARTED = 0x80
"""Bit of `ArmState.hardware_error` that is the companion's own."""


FUSED_WITHIN_M = 0.10
FUSED_WITHIN_RAD = math.radians(8.0)


def unfused(i: Inputs) -> str | None:
    """Evidence that PX4 fuses vision: position and yaw of its estimate agree with motion capture. None: they do.

    PX4 takes poses that it does not fuse without a word, so having sent them proves nothing.
    """
    if i.vehicle is None or i.mocap is None:
        return "no state to compare"
    apart_m = math.dist(i.vehicle.position_world_m, i.mocap.position_world_m)
    yaw_px4, yaw_mocap = (euler_zyx_from_quat(q)[2] for q in (i.vehicle.attitude_wxyz, i.mocap.attitude_wxyz))
    turned_rad = abs(wrap_rad(yaw_px4 - yaw_mocap))
    if apart_m <= FUSED_WITHIN_M and turned_rad <= FUSED_WITHIN_RAD:
        return None
    return (
        f"PX4 does not follow motion capture: {apart_m:.2f} m and {math.degrees(turned_rad):.0f} deg of yaw apart; "
        "check EKF2_EV_CTRL = 11, EKF2_HGT_REF = 3 and the body's axes in Motive"
    )


@dataclass(frozen=True, slots=True)
class Situation:
    """What the core is doing, as far as monitors must know."""

    airborne: bool
    """Rotors may be lifting: from arming to touch-down."""
    offboard_expected: bool
    """The companion believes that it commands the vehicle."""
    tracking_error_m: float | None


@dataclass(frozen=True, slots=True)
class _Finding:
    id: str
    action: SafetyAction
    text: str
    hold_s: float = 0.0
    """Must be true for this long."""


class _Age:
    """Age of an input in time that this process was awake.

    When the process itself is held up, every stamp grows old though nothing was lost: what arrived meanwhile is read a moment
    later. The hold-up is a finding of its own (`loop_late`, `loop_stalled`), not the device's fault.
    """

    def __init__(self) -> None:
        self._stamp_s: float | None = None
        self._seen_awake_s = 0.0

    def update(self, awake_s: float, stamp_s: float | None) -> float:
        """Awake seconds since the stamp last changed; infinite without one."""
        if stamp_s is None:
            return math.inf
        if stamp_s != self._stamp_s:
            self._stamp_s, self._seen_awake_s = stamp_s, awake_s
        return awake_s - self._seen_awake_s


class Monitors:
    """All monitors of the first flight; state is how long each finding has lasted and how old each input is."""

    def __init__(self, safety: Safety) -> None:
        self._s = safety
        self._since: dict[str, float] = {}
        self._reported: set[str] = set()
        self._awake_s = 0.0
        self._last_t_s: float | None = None
        self._ages = {name: _Age() for name in ("mocap", "position", "attitude", "imu", "heartbeat", "arm", "force")}

    def check(self, inputs: Inputs, situation: Situation) -> tuple[Event, ...]:
        """Events that begin in this tick."""
        gap_s = inputs.t_s - self._last_t_s if self._last_t_s is not None else 0.0
        self._last_t_s = inputs.t_s
        self._awake_s += min(gap_s, AWAKE_STEP_MAX_S)
        found = [*self._loop(gap_s), *self._freshness(inputs), *self._machine(inputs, situation)]
        if situation.airborne:
            found += self._flight(inputs, situation)
        ids = {finding.id for finding in found}
        self._since = {key: t for key, t in self._since.items() if key in ids}
        self._reported &= ids
        events = []
        for finding in found:
            began = self._since.setdefault(finding.id, inputs.t_s)
            if finding.id not in self._reported and inputs.t_s - began >= finding.hold_s:
                self._reported.add(finding.id)
                events.append(_event(inputs.t_s, finding, situation.airborne))
        return tuple(events)

    def _loop(self, gap_s: float) -> list[_Finding]:
        text = f"the control loop was held up for {gap_s * 1e3:.0f} ms"
        if gap_s > self._s.loop_stalled_s:
            return [_Finding("loop_stalled", SafetyAction.LAND, text)]
        if gap_s > self._s.loop_late_s:
            return [_Finding("loop_late", SafetyAction.WARN, text)]
        return []

    def _freshness(self, i: Inputs) -> list[_Finding]:
        s, found = self._s, []

        def age_s(name: str, stamp_s: float | None) -> float:
            return self._ages[name].update(self._awake_s, stamp_s)

        mocap, v = i.mocap, i.vehicle
        if age_s("mocap", mocap.stamp_s if mocap else None) > s.mocap_timeout_s:
            found.append(_Finding("mocap_lost", SafetyAction.AUTOPILOT_LAND, "no motion capture"))
        elif mocap is not None and not mocap.tracking_valid:
            text = "motion capture does not see the body"
            found.append(_Finding("mocap_invalid", SafetyAction.AUTOPILOT_LAND, text, s.mocap_timeout_s))
        vehicle_s = max(
            age_s("position", v.position_stamp_s if v else None),
            age_s("attitude", v.attitude_stamp_s if v else None),
            age_s("imu", v.imu_stamp_s if v else None),
        )
        if vehicle_s > s.vehicle_timeout_s:
            found.append(_Finding("vehicle_state_lost", SafetyAction.AUTOPILOT_LAND, "no fresh state from PX4"))
        if age_s("heartbeat", i.status.heartbeat_stamp_s if i.status else None) > s.heartbeat_timeout_s:
            found.append(_Finding("heartbeat_lost", SafetyAction.AUTOPILOT_LAND, "no heartbeat from PX4"))
        if age_s("arm", i.arm.stamp_s if i.arm else None) > s.arm_timeout_s:
            found.append(_Finding("arm_lost", SafetyAction.LAND, "no joint state from the arm"))
        if age_s("force", i.force.stamp_s if i.force else None) > s.force_timeout_s:
            found.append(_Finding("force_lost", SafetyAction.WARN, "no force samples; the law flies on without"))
        return found

    def _machine(self, i: Inputs, situation: Situation) -> list[_Finding]:
        found = []
        errors = i.arm.hardware_error if i.arm is not None else (0, 0)
        if any(error & ~WATCHDOG_RESTARTED for error in errors):
            found.append(_Finding("servo_error", SafetyAction.LAND, f"servo hardware error {errors} (register 70)"))
        if any(error & WATCHDOG_RESTARTED for error in errors):
            text = "the arm's bus watchdog had let go; torque is back"
            found.append(_Finding("arm_let_go", SafetyAction.WARN, text))
        if i.recorder_dropped:
            found.append(_Finding("recorder_drops", SafetyAction.WARN, "the recorder loses samples"))
        if i.force is not None and i.force.overload:
            found.append(_Finding("force_overload", SafetyAction.WARN, "force sensor overloaded"))
        status = i.status
        if status is not None and status.battery_remaining is not None:
            if status.battery_remaining < self._s.battery_min:
                text = f"battery at {status.battery_remaining:.0%}"
                found.append(_Finding("battery_low", SafetyAction.LAND, text, 1.0))
        if i.command is OperatorCommand.LAND:
            found.append(_Finding("operator_land", SafetyAction.LAND, "landing was asked for"))
        if status is not None and situation.offboard_expected and status.mode is not FlightMode.OFFBOARD:
            text = f"PX4 left OFFBOARD for {status.mode.value.upper()}"
            # A mode that only people choose: theirs is the machine, nothing is sent against them.
            pilot = status.mode in (FlightMode.MANUAL, FlightMode.HOLD, FlightMode.RETURN, FlightMode.TAKEOFF)
            found.append(_Finding("pilot_took_over" if pilot else "offboard_left", SafetyAction.AUTOPILOT_LAND, text))
        return found

    def _flight(self, i: Inputs, situation: Situation) -> list[_Finding]:
        s, found = self._s, []
        if i.vehicle is not None:
            tilt = tilt_rad(i.vehicle.attitude_wxyz)
            if tilt > math.radians(s.tilt_abort_deg):
                text = f"tilt {math.degrees(tilt):.0f} deg"
                found.append(_Finding("tilt", SafetyAction.AUTOPILOT_LAND, text, 0.1))
            if tilt > CRASH_TILT_RAD:
                found.append(_Finding("crashed", SafetyAction.TERMINATE, "upside down", 0.3))
            if i.mocap is not None and i.mocap.tracking_valid and i.t_s - i.mocap.stamp_s < s.mocap_timeout_s:
                apart = math.dist(i.vehicle.position_world_m, i.mocap.position_world_m)
                if apart > s.estimate_disagreement_m:
                    text = f"PX4 and motion capture are {apart:.2f} m apart"
                    found.append(_Finding("estimate_disagrees", SafetyAction.AUTOPILOT_LAND, text, 0.2))
        error = situation.tracking_error_m
        if error is not None and error > s.tracking_error_abort_m:
            found.append(_Finding("tracking_error", SafetyAction.LAND, f"{error:.2f} m off the reference", 0.2))
        return found


def _event(t_s: float, finding: _Finding, airborne: bool) -> Event:
    action = finding.action
    if action is SafetyAction.WARN:
        severity = Severity.WARNING
    elif finding.id == "operator_land":
        severity = Severity.INFO
    else:
        severity = Severity.CRITICAL if airborne else Severity.WARNING
    return Event(t_s, finding.id, severity, action, finding.text)
