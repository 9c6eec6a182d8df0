"""The event table: every rule of the monitors, one row each.

`companion.safety.evaluation` evaluates the rows, `tools.docs.safety` prints them into docs/internals/safety.md, and the tests go
through them. Ids are stable because logs, summaries and users' scripts contain them. Simultaneous events are in the order of the rows.
"""

from __future__ import annotations

from typing import Final

from companion.model.types import OperatorCommand, SafetyAction, Severity
from companion.safety import arm, flight, mocap, process, px4, team, vision
from companion.safety.process import commanded
from companion.safety.rule import Lamp, Repeat, Rule, Subject
from companion.safety.validity import invalid

_NOMINAL: Final = SafetyAction.NOMINAL
_WARN: Final = SafetyAction.WARN
_HOLD: Final = SafetyAction.HOLD
_RETRACT: Final = SafetyAction.RETRACT
_LAND: Final = SafetyAction.LAND
_PX4_LANDS: Final = SafetyAction.AUTOPILOT_LAND
_TERMINATE: Final = SafetyAction.TERMINATE

MOCAP_DRAGGED, MOCAP_FROZEN = "mocap_dragged", "mocap_frozen"
MOCAP_SWAPPED, MOCAP_TWO_STREAMS = "mocap_swapped", "mocap_two_streams"
ARMED_EXTERNALLY: Final = "armed_externally"
PILOT_TOOK_OVER: Final = "pilot_took_over"
KILLED: Final = "killed"
CRASHED: Final = "crashed"
OPERATOR_START: Final = "operator_start"
OPERATOR_RESUME: Final = "operator_resume"
OPERATOR_LAND, OPERATOR_ABORT = "operator_land", "operator_abort"


def _invalid(id_: str, field: str, what: str, message: str, on_lamp: Lamp) -> Rule:
    """Return the rule for an invalid record, which counts as not received; a separate rule covers its loss."""
    return Rule(
        id=id_, subject=Subject.INPUTS, what=what, predicate=invalid(field), ground=_WARN, air=_WARN, message=message,
        while_waiting=True, on_lamp=on_lamp,
    )  # fmt: skip


def _operator(
    command: OperatorCommand, what: str, ground: SafetyAction | None, air: SafetyAction, message: str
) -> Rule:
    """Return the rule for an operator's command; a command that lasts for several ticks counts once."""
    return Rule(
        id=f"operator_{command.value}", subject=Subject.OPERATOR, what=what, predicate=commanded(command), ground=ground,
        air=air, message=message, severity=Severity.INFO, repeat=Repeat.AT_ONCE, while_waiting=True,
    )  # fmt: skip


RULES: tuple[Rule, ...] = (
    _invalid(
        "vehicle_not_finite", "vehicle", "PX4's state has a non-finite or out-of-range value, or an invalid attitude",
        "PX4's state is invalid and is ignored: {}", Lamp.PX4,
    ),
    _invalid(
        "mocap_not_finite", "mocap", "a pose has a non-finite or out-of-range value, or an invalid attitude",
        "the motion-capture pose is invalid and is ignored: {}", Lamp.MOCAP,
    ),
    _invalid(
        "arm_not_finite", "arm", "a joint state has a non-finite or out-of-range value",
        "the joint state is invalid and is ignored: {}", Lamp.ARM,
    ),
    _invalid(
        "force_not_finite", "force", "a force sample has a non-finite or out-of-range value",
        "the force sample is invalid and is ignored: {}", Lamp.FORCE,
    ),
    _invalid(
        "status_not_finite", "status", "PX4's status has a non-finite or out-of-range value",
        "PX4's status is invalid and is ignored: {}", Lamp.PX4,
    ),

    _operator(OperatorCommand.HOLD, "HOLD was commanded", None, _HOLD, "hold commanded"),
    _operator(OperatorCommand.RESUME, "RESUME was commanded", None, _NOMINAL, "resume commanded"),
    _operator(OperatorCommand.START, "START was commanded", _NOMINAL, _NOMINAL, "take-off commanded"),
    _operator(
        OperatorCommand.LAND, "LAND was commanded (also by Ctrl-C), or the launcher has ended", _LAND, _LAND,
        "landing commanded",
    ),
    _operator(OperatorCommand.ABORT, "ABORT was commanded", _LAND, _LAND, "abort commanded"),

    Rule(
        id=KILLED, subject=Subject.PX4,
        what="PX4's kill switch or its flight termination has stopped the rotors (MAV_STATE_FLIGHT_TERMINATION)",
        predicate=px4.killed, ground=_PX4_LANDS, air=_PX4_LANDS, pilot_flies=True, severity=Severity.CRITICAL,
        message="PX4's kill switch or flight termination has stopped the rotors; nothing is sent to PX4 any more",
    ),
    Rule(
        id=ARMED_EXTERNALLY, subject=Subject.PX4,
        what="PX4 was armed without a request from the companion: the companion was started in the air, or a pilot armed it",
        predicate=px4.armed_externally, ground=_LAND, air=_PX4_LANDS, message="{}", severity=Severity.CRITICAL,
        repeat=Repeat.NEVER, while_waiting=True,
    ),

    Rule(
        id="mocap_lost", subject=Subject.MOCAP, what="no new frame", predicate=mocap.mocap_lost,
        thresholds=("mocap_timeout_s",), ground=_PX4_LANDS, air=_PX4_LANDS,
        message="no motion-capture frame for more than {:.2f} s",
    ),
    Rule(
        id="mocap_invalid", subject=Subject.MOCAP, what="frames are arriving, but Motive does not track the body",
        predicate=mocap.mocap_invalid, thresholds=("mocap_timeout_s",), ground=_PX4_LANDS, air=_PX4_LANDS,
        message="motion capture has not tracked the body for more than {:.2f} s",
    ),
    Rule(
        id=MOCAP_SWAPPED, subject=Subject.MOCAP, what="the pose jumped and stayed there: another body, or this one has shifted",
        predicate=mocap.mocap_swapped, thresholds=("mocap_timeout_s",), tracked_by=("mocap_jump_m", "mocap_jump_deg"),
        ground=_PX4_LANDS, air=_PX4_LANDS,
        message="motion capture jumped by {:.2f} m and {:.0f} deg and stayed there: another body, or this one has shifted",
    ),
    Rule(
        id="mocap_jump", subject=Subject.MOCAP,
        what="a pose is further from the previous one than PX4's velocity and angular rates allow; it is ignored",
        predicate=mocap.mocap_jump, thresholds=("mocap_timeout_s",), tracked_by=("mocap_jump_m", "mocap_jump_deg"),
        ground=_WARN, air=_WARN, message="motion capture jumped by {:.2f} m and {:.0f} deg; the pose is ignored",
    ),
    Rule(
        id=MOCAP_TWO_STREAMS, subject=Subject.MOCAP,
        what="frame numbers step back repeatedly: two servers at one address", predicate=mocap.mocap_two_streams,
        ground=_PX4_LANDS, air=_PX4_LANDS,
        message="motion capture arrives in two sequences of frame numbers: two servers at one address; both are ignored",
    ),
    Rule(
        id=MOCAP_DRAGGED, subject=Subject.MOCAP,
        what="poses do not move as the IMU measures: an attacker is shifting them, or the calibration is drifting",
        predicate=mocap.mocap_dragged, thresholds=("mocap_inertial_m",), tracked_by=("mocap_inertial_s",), ground=None,
        air=_PX4_LANDS, repeat=Repeat.NEVER,
        message="motion-capture poses do not move as the IMU measures: {:.0f} mm off (limit {:.0f} mm); PX4 lands without it",
    ),
    Rule(
        id=MOCAP_FROZEN, subject=Subject.MOCAP, what="new frames repeat the same pose although the vehicle is moving",
        predicate=mocap.mocap_frozen, tracked_by=("mocap_frozen_s",), ground=None, air=_PX4_LANDS,
        message="motion capture repeats the same pose although the vehicle is moving",
    ),
    Rule(
        id="mocap_slow", subject=Subject.MOCAP, what="frame rate too low", predicate=mocap.mocap_slow,
        thresholds=("mocap_rate_min_hz", "mocap_timeout_s"), ground=_WARN, air=_WARN,
        message="motion capture arrives at {:.0f} Hz (limit {:.0f} Hz)",
    ),
    Rule(
        id="mocap_late", subject=Subject.MOCAP, what="latency too large", predicate=mocap.mocap_late,
        thresholds=("mocap_latency_warn_s", "mocap_latency_max_s"), hold_time=0.2, ground=_WARN, air=_WARN,
        message="motion capture is {:.0f} ms late (limit {:.0f} ms)",
    ),
    Rule(
        id="mocap_too_late", subject=Subject.MOCAP, what="latency so large that the poses count as lost",
        predicate=mocap.mocap_too_late, thresholds=("mocap_latency_warn_s", "mocap_latency_max_s"), hold_time=0.1,
        ground=_PX4_LANDS, air=_PX4_LANDS, message="motion capture is {:.0f} ms late (limit {:.0f} ms)",
    ),
    Rule(
        id="estimate_disagrees", subject=Subject.MOCAP, on_lamp=Lamp.ESTIMATE, what="PX4's position disagrees with motion capture",
        predicate=mocap.estimate_disagrees, thresholds=("estimate_disagreement_m",), hold_time=0.2, ground=None,
        air=_PX4_LANDS, message="PX4's position is {:.2f} m from motion capture (limit {:.2f} m)",
    ),
    Rule(
        id="yaw_disagrees", subject=Subject.MOCAP, on_lamp=Lamp.ESTIMATE, what="PX4's yaw disagrees with motion capture",
        predicate=mocap.yaw_disagrees, thresholds=("yaw_disagreement_deg",), hold_time=0.5, ground=None, air=_PX4_LANDS,
        message="PX4's yaw is {:.0f} deg from motion capture (limit {:.0f} deg)",
    ),

    Rule(
        id="estimator_silent", subject=Subject.VISION, what="no ESTIMATOR_STATUS, so PX4's use of external vision is unknown",
        predicate=vision.estimator_silent, thresholds=("vehicle_timeout_s",), ground=_PX4_LANDS, air=_PX4_LANDS,
        message="no ESTIMATOR_STATUS from PX4 for more than {:.2f} s",
    ),
    Rule(
        id="vision_lost", subject=Subject.VISION, what="PX4 fuses no external vision: the program that sends it has stopped",
        predicate=vision.vision_lost, ground=_PX4_LANDS, air=_PX4_LANDS,
        message="PX4 fuses no external vision: its estimator has no measurement of {}",
    ),
    Rule(
        id="vision_rejected", subject=Subject.VISION, what="PX4 rejects external vision", predicate=vision.vision_rejected,
        hold_time=0.2, ground=None, air=_WARN,
        message="PX4 rejects external vision: innovation test ratio {:.1f} (limit {:.0f})",
    ),

    Rule(
        id="px4_rebooted", subject=Subject.PX4, what="PX4's clock went back: it restarted",
        predicate=px4.px4_rebooted, ground=_PX4_LANDS, air=_PX4_LANDS, repeat=Repeat.NEVER,
        message="PX4 restarted: its clock went back to {:.1f} s",
    ),
    Rule(
        id="link_slow", subject=Subject.PX4, what="PX4's state is delayed, at the cost of the control loop's stability margin",
        predicate=px4.link_slow, thresholds=("link_lag_warn_s", "link_lag_max_s"), hold_time=0.15, ground=_WARN, air=_WARN,
        message="messages from PX4 are {:.0f} ms late (limit {:.0f} ms)",
    ),
    Rule(
        id="link_late", subject=Subject.PX4, what="PX4's state is delayed: its lag on PX4's clock exceeds the smallest lag seen",
        predicate=px4.link_late, thresholds=("link_lag_max_s",), hold_time=0.15, ground=_PX4_LANDS, air=_PX4_LANDS,
        message="messages from PX4 are {:.0f} ms late (limit {:.0f} ms)",
    ),
    Rule(
        id="estimate_frozen", subject=Subject.PX4, on_lamp=Lamp.ESTIMATE,
        what="new positions from PX4 repeat the same values although the vehicle is moving",
        predicate=px4.estimate_frozen, hold_time="vehicle_timeout_s", ground=None, air=_PX4_LANDS,
        message="PX4 repeats the same position and velocity although the vehicle is moving",
    ),
    Rule(
        id="vehicle_state_lost", subject=Subject.PX4, what="PX4's position, attitude or IMU sample is stale",
        predicate=px4.vehicle_state_lost, thresholds=("vehicle_timeout_s",), ground=_PX4_LANDS, air=_PX4_LANDS,
        message="no position, attitude or IMU sample from PX4 for more than {:.2f} s",
    ),
    Rule(
        id="heartbeat_lost", subject=Subject.PX4, what="no heartbeat from PX4", predicate=px4.heartbeat_lost,
        thresholds=("heartbeat_timeout_s",), ground=_PX4_LANDS, air=_PX4_LANDS,
        message="no heartbeat from PX4 for more than {:.1f} s",
    ),
    Rule(
        id=PILOT_TOOK_OVER, subject=Subject.PX4,
        what="PX4 left OFFBOARD for a mode that only a pilot chooses (manual, hold, return or take-off), without a failsafe",
        predicate=px4.pilot_took_over, ground=_PX4_LANDS, air=_PX4_LANDS, pilot_flies=True,
        message="PX4 left OFFBOARD for {}{}",
    ),
    Rule(
        id="offboard_left", subject=Subject.PX4, what="PX4 left OFFBOARD for any other mode (its own failsafe)",
        predicate=px4.offboard_left, ground=_PX4_LANDS, air=_PX4_LANDS, message="PX4 left OFFBOARD for {}{}",
    ),
    Rule(
        id="px4_disarmed", subject=Subject.PX4, what="PX4 reports that it is disarmed, although the vehicle is well above the floor",
        predicate=px4.px4_disarmed, ground=None, air=_PX4_LANDS, repeat=Repeat.NEVER,
        message="PX4 reports that it is disarmed, at a height of {:.2f} m",
    ),
    Rule(
        id="battery_warn", subject=Subject.PX4, on_lamp=Lamp.BATTERY, what="remaining charge low", predicate=px4.battery_below,
        thresholds=("battery_warn",), hold_time=1.0, ground=_WARN, air=_WARN,
        message="battery at {:.0%} (limit {:.0%})",
    ),
    Rule(
        id="battery_low", subject=Subject.PX4, on_lamp=Lamp.BATTERY, what="remaining charge too low", predicate=px4.battery_below,
        thresholds=("battery_min",), hold_time=1.0, ground=_LAND, air=_LAND, message="battery at {:.0%} (limit {:.0%})",
    ),
    Rule(
        id="battery_silent", subject=Subject.PX4, on_lamp=Lamp.BATTERY,
        what="a battery is not reported any more, so that its charge is unknown",
        predicate=px4.battery_silent, ground=_LAND, air=_LAND,
        message="no BATTERY_STATUS of a battery for more than {:.0f} s: its charge is unknown",
    ),
    Rule(
        id="battery_voltage", subject=Subject.PX4, on_lamp=Lamp.BATTERY, what="voltage too low", predicate=px4.battery_voltage,
        thresholds=("battery_voltage_min_v",), hold_time=2.0, ground=_LAND, air=_LAND,
        message="battery at {:.1f} V (limit {:.1f} V)",
    ),

    Rule(
        id="arm_lost", subject=Subject.ARM, what="joint state stale", predicate=arm.arm_lost,
        thresholds=("arm_timeout_s",), ground=_LAND, air=_LAND,
        message="no joint state from the arm for more than {:.2f} s",
    ),
    Rule(
        id="arm_read_failures", subject=Subject.ARM, what="several bus cycles in a row without an answer",
        predicate=arm.arm_read_failures, thresholds=("arm_read_failures_max",), ground=_WARN, air=_WARN,
        message="{} bus cycles without an answer",
    ),
    Rule(
        id="joint_states_late", subject=Subject.ARM, what="joint states are late: a slow adapter, a busy bus or a busy computer",
        predicate=arm.joint_states_late, ground=_WARN, air=_WARN,
        message="in {:.0f} % of the ticks the joint state is older than {:.0f} ms, {:.0f} ms in the mean (limit {:.0f} %); check the "
        "adapter's latency timer and the computer's load",
    ),
    Rule(
        id="joint_swings", subject=Subject.ARM, what="a joint swings: its rate turns three times in 0.5 s, by 2 rad/s and more",
        predicate=arm.joint_swings, ground=_WARN, air=_WARN,
        message="joint {} swings at {:.0f} Hz with {:.0f} deg/s; no catch is detected meanwhile",
    ),
    Rule(
        id="joint_swings_on", subject=Subject.ARM, what="a joint still swings", predicate=arm.joint_swings, hold_time=1.5,
        ground=_LAND, air=_LAND, message="joint {} still swings at {:.0f} Hz with {:.0f} deg/s",
    ),
    Rule(
        id="torque_refused", subject=Subject.ARM,
        what="the control law's joint torques are not finite or not one per joint, so that none are sent and the arm is limp, "
        "for 0.1 s; ticks with usable torques count backwards, at a quarter",
        predicate=arm.torque_refused, ground=_LAND, air=_PX4_LANDS,
        message="the arm is limp, because the control law's torques are unusable: {}",
    ),
    Rule(
        id="servo_error", subject=Subject.ARM, what="a servo reports a hardware error (register 70)",
        predicate=arm.servo_error, ground=_LAND, air=_LAND, message="hardware error (register 70) of {}",
    ),
    Rule(
        id="servo_watchdog_tripped", subject=Subject.ARM, what="a servo's bus watchdog has switched its torque off",
        predicate=arm.servo_watchdog_tripped, ground=_WARN, air=_WARN,
        message="a servo's bus watchdog had switched its torque off; it is on again",
    ),
    Rule(
        id="joint_jump", subject=Subject.ARM, what="a joint angle changed more between two reads than the joint can turn in that time",
        predicate=arm.joint_jump, thresholds=("joint_jump_deg", "joint_rate_max_deg_s"), ground=_LAND, air=_LAND,
        message="joint {} jumped by {:.0f} deg between two reads",
    ),
    Rule(
        id="servo_warm", subject=Subject.ARM, what="a servo is hot", predicate=arm.servo_warm,
        thresholds=("servo_warn_c", "servo_max_c"), hold_time=0.5, ground=_WARN, air=_WARN,
        message="a servo at {:.0f} degC (limit {:.0f} degC)",
    ),
    Rule(
        id="servo_hot", subject=Subject.ARM, what="a servo is about to shut down", predicate=arm.servo_hot,
        thresholds=("servo_warn_c", "servo_max_c"), hold_time=0.5, ground=_LAND, air=_LAND,
        message="a servo at {:.0f} degC (limit {:.0f} degC)",
    ),
    Rule(
        id="servo_overload", subject=Subject.ARM, what="a joint at its torque limit", predicate=arm.servo_overload,
        thresholds=("arm.joints.torque_max_nm",), hold_time="servo_overload_s", ground=_LAND, air=_LAND,
        message="joint torques {} N m are at the limit",
    ),
    Rule(
        id="joint_rate", subject=Subject.ARM, what="joint speed implausibly high", predicate=arm.joint_rate,
        thresholds=("joint_rate_max_deg_s",), hold_time=0.05, ground=_LAND, air=_LAND,
        message="joint speeds {} deg/s (limit {:.0f} deg/s)",
    ),
    Rule(
        id="joint_beyond_limit", subject=Subject.ARM, what="a joint beyond its limit", predicate=arm.joint_beyond_limit,
        thresholds=("joint_limit_warn_deg", "arm.joints.angle_deg"), hold_time=0.1, ground=_WARN, air=_WARN,
        message="joints at {} deg: {:.0f} deg beyond a joint limit",
    ),
    Rule(
        id="joint_far_beyond_limit", subject=Subject.ARM, what="a joint far beyond its limit",
        predicate=arm.joint_beyond_limit, thresholds=("joint_limit_max_deg", "arm.joints.angle_deg"), hold_time=0.3,
        ground=_LAND, air=_LAND, message="joints at {} deg: {:.0f} deg beyond a joint limit",
    ),

    Rule(
        id="force_lost", subject=Subject.FORCE, what="force sample stale", predicate=arm.force_lost,
        thresholds=("force_timeout_s",), ground=_LAND, air=_WARN,
        message="no force sample for more than {:.2f} s; the controller flies without it",
    ),
    Rule(
        id="force_overload", subject=Subject.FORCE, what="the sensor reports an overload, or a force beyond its range",
        predicate=arm.force_overload, thresholds=("devices.force.force_max_n",), ground=_WARN, air=_WARN,
        message="force sensor overloaded: {:.0f}, {:.0f}, {:.0f} N",
    ),
    Rule(
        id="force_stuck", subject=Subject.FORCE,
        what="samples repeat the same values although the vehicle is moving; they count as lost", predicate=arm.force_stuck,
        tracked_by=("force_stuck_s",), ground=None, air=_WARN,
        message="the force sensor repeats the same values although the vehicle is moving; the controller flies without it",
    ),
    Rule(
        id="force_drift", subject=Subject.FORCE, what="a lasting force on an empty net",
        predicate=arm.force_drift, thresholds=("force_drift_n",), hold_time=2.0, ground=None, air=_WARN,
        message="the force sensor measures {:.1f}, {:.1f}, {:.1f} N on an empty net (limit {:.1f} N)",
    ),
    Rule(
        id="force_disagrees", subject=Subject.FORCE,
        what="the measured force changes and the vehicle's motion shows another change: a wrong sign, exchanged axes or a shifted "
        "zero; from then on the samples count as lost",
        predicate=arm.force_disagrees, tracked_by=("force_disagreement_n",), ground=None, air=_WARN, repeat=Repeat.NEVER,
        message="the force sensor measures a change of {:.1f}, {:.1f}, {:.1f} N, the vehicle's motion shows {:.1f}, {:.1f}, {:.1f} N: "
        "wrong axes or a shifted zero; the controller flies without the force",
    ),

    Rule(
        id="loop_late", subject=Subject.PROCESS, what="a control tick was late", predicate=process.loop_late,
        thresholds=("loop_late_s", "loop_stalled_s"), ground=_WARN, air=_WARN,
        message="no control tick for {:.0f} ms (limit {:.0f} ms)",
    ),
    Rule(
        id="loop_stalled", subject=Subject.PROCESS, what="a control tick was much too late", predicate=process.loop_stalled,
        thresholds=("loop_late_s", "loop_stalled_s"), ground=_LAND, air=_LAND,
        message="no control tick for {:.0f} ms (limit {:.0f} ms)",
    ),
    Rule(
        id="recorder_drops", subject=Subject.PROCESS, on_lamp=Lamp.RECORDER, what="the recorder is dropping samples",
        predicate=process.recorder_drops, ground=_WARN, air=_WARN, message="the recorder is dropping samples",
    ),
    Rule(
        id="guardian_lost", subject=Subject.PROCESS, on_lamp=Lamp.GUARDIAN, what="the guardian is dead or cannot take over",
        predicate=process.guardian_lost, ground=_LAND, air=_WARN, message="the guardian is dead or cannot take over",
    ),

    Rule(
        id="tilt", subject=Subject.FLIGHT, what="tilted too far", predicate=flight.tilt, thresholds=("tilt_abort_deg",),
        hold_time=0.1, ground=None, air=_PX4_LANDS, message="tilt {:.0f} deg (limit {:.0f} deg)",
    ),
    Rule(
        id="oscillates", subject=Subject.FLIGHT,
        what="the position error and the tilt swing to and fro: the control loop is unstable, for example because of a delay",
        predicate=flight.oscillates, tracked_by=("oscillation_m",), ground=None, air=_PX4_LANDS,
        message="the vehicle swings to and fro by more than {:.2f} m, tilting at {:.0f} deg/s: the control loop is unstable",
    ),
    Rule(
        id=CRASHED, subject=Subject.FLIGHT,
        what="tilted by more than 70 deg according to PX4 and to motion capture (without a fresh pose, to the accelerometer)",
        predicate=flight.crashed, hold_time=0.3, ground=None, air=_TERMINATE, repeat=Repeat.NEVER,
        message="flipped: tilt {:.0f} deg, confirmed by a second source",
    ),
    Rule(
        id="too_fast", subject=Subject.FLIGHT, what="horizontal speed too high", predicate=flight.too_fast,
        thresholds=("speed_max_m_s",), hold_time=0.1, ground=None, air=_HOLD,
        message="horizontal speed {:.1f} m/s (limit {:.1f} m/s)",
    ),
    Rule(
        id="climbs_too_fast", subject=Subject.FLIGHT, what="climbing too fast", predicate=flight.climbs_too_fast,
        thresholds=("climb_max_m_s",), hold_time=0.1, ground=None, air=_LAND,
        message="climbing at {:.1f} m/s (limit {:.1f} m/s)",
    ),
    Rule(
        id="sinks_too_fast", subject=Subject.FLIGHT, what="sinking too fast", predicate=flight.sinks_too_fast,
        thresholds=("sink_max_m_s",), hold_time=0.1, ground=None, air=_LAND,
        message="sinking at {:.1f} m/s (limit {:.1f} m/s)",
    ),
    Rule(
        id="geofence_left", subject=Subject.FLIGHT, what="the rotors are outside the room",
        predicate=flight.geofence_left, tracked_by=("geofence_tolerance_m",), hold_time=0.05, ground=None, air=_LAND,
        message="the rotors are outside the room at ({:.2f}, {:.2f}, {:.2f}) m",
    ),
    Rule(
        id="geofence_near", subject=Subject.FLIGHT, what="the vehicle would stop with its rotors outside the room",
        predicate=flight.geofence_near, tracked_by=("geofence_tolerance_m", "react_time_s", "stop_deceleration_m_s2"),
        hold_time=0.05, ground=None, air=_HOLD,
        message="the vehicle would stop at ({:.2f}, {:.2f}, {:.2f}) m with its rotors outside the room",
    ),
    Rule(
        id="tracking_warn", subject=Subject.FLIGHT, what="off the reference", predicate=flight.tracking_warn,
        thresholds=("tracking_error_warn_m",), hold_time=0.2, ground=None, air=_WARN,
        message="{:.2f} m off the reference (limit {:.2f} m)",
    ),
    Rule(
        id="tracking_hold", subject=Subject.FLIGHT, what="further off the reference", predicate=flight.tracking_error,
        thresholds=("tracking_error_warn_m", "tracking_error_hold_m"), hold_time=0.2, ground=None, air=_HOLD,
        message="{:.2f} m off the reference (limit {:.2f} m)",
    ),
    Rule(
        id="tracking_error", subject=Subject.FLIGHT, what="too far off the reference", predicate=flight.tracking_error,
        thresholds=("tracking_error_warn_m", "tracking_error_abort_m"), hold_time=0.2, ground=None, air=_LAND,
        message="{:.2f} m off the reference (limit {:.2f} m)",
    ),
    Rule(
        id="thrust_saturated", subject=Subject.FLIGHT, what="thrust at its upper limit",
        predicate=flight.thrust_saturated, thresholds=("thrust_saturated_s",), ground=None, air=_LAND,
        message="thrust at its limit of {:.0f} N for more than {:.1f} s: the vehicle is too heavy or its rotors are too weak",
    ),
    Rule(
        id="contact_force_high", subject=Subject.FLIGHT,
        what="the surface that the mission touches is pressed too hard; the vehicle moves back from it first",
        predicate=flight.contact_force_high, thresholds=("contact_force_max_n",), hold_time=0.1, ground=None, air=_HOLD,
        message="the surface presses with {:.1f} N (limit {:.1f} N)",
    ),

    Rule(
        id="tether_short", subject=Subject.TETHER, what="the vehicle would stop with too little tether left",
        predicate=flight.tether_short, thresholds=("tether_stop_slack_min_m",), hold_time=0.05, ground=None, air=_HOLD,
        message="the vehicle would stop with {:.2f} m of tether left (limit {:.2f} m)",
    ),
    Rule(
        id="tether_taut", subject=Subject.TETHER, what="no slack is left", predicate=flight.tether_taut,
        tracked_by=("tether.taut_slack_m",), hold_time=0.05, ground=None, air=_RETRACT,
        message="the tether is taut: {:.2f} m left, tension {:.0f} N",
    ),
    Rule(
        id="tether_snagged", subject=Subject.TETHER, what="the tether pulls although there is slack",
        predicate=flight.tether_snagged, tracked_by=("tether.pull_min_n",), hold_time=0.1, ground=None, air=_LAND,
        message="the tether pulls with {:.0f} N although {:.2f} m are left: the tether is snagged",
    ),
    Rule(
        id="tether_near", subject=Subject.TETHER, what="the tether is close to the rotors or the arm",
        predicate=flight.tether_near, thresholds=("tether.clearance_min_m",), hold_time=0.2, ground=None, air=_WARN,
        message="the tether is {:.2f} m from the rotors or the arm (limit {:.2f} m)",
    ),
    Rule(
        id="tether_wound", subject=Subject.TETHER, what="the tether is wound about its anchor", predicate=flight.tether_wound,
        thresholds=("tether.turns_max",), hold_time=0.2, ground=None, air=_HOLD,
        message="the tether is wound {:.1f} times about its anchor (limit {:.1f})",
    ),
    Rule(
        id="tether_separated", subject=Subject.TETHER, what="the distance to the anchor exceeds the tether's length: the tether is cut",
        predicate=flight.tether_separated, tracked_by=("tether.separation_m",), hold_time=0.1, ground=None, air=_LAND,
        repeat=Repeat.NEVER, message="{:.2f} m from the anchor without a pull: the tether is cut or detached",
    ),

    Rule(
        id="partner_quiet", subject=Subject.PARTNER, what="nothing is heard from the other vehicle; this one holds no bar",
        predicate=team.partner_quiet, thresholds=("partner_timeout_s",), ground=_WARN, air=_WARN,
        message="nothing from the other vehicle for more than {:.1f} s",
    ),
    Rule(
        id="partner_silent", subject=Subject.PARTNER, what="nothing is heard from the other vehicle, which holds the same bar",
        predicate=team.partner_silent, thresholds=("partner_timeout_s",), ground=None, air=_LAND,
        message="nothing from the other vehicle for more than {:.1f} s, and both hold the bar",
    ),
    Rule(
        id="partner_holds", subject=Subject.PARTNER, what="the other vehicle, which holds the same bar, has stopped",
        predicate=team.partner_holds, ground=None, air=_HOLD, message="the other vehicle holds",
    ),
    Rule(
        id="partner_lands", subject=Subject.PARTNER, what="the other vehicle, which holds the same bar, lands because of an event",
        predicate=team.partner_lands, ground=None, air=_LAND, message="the other vehicle lands",
    ),
    Rule(
        id="partner_let_go", subject=Subject.PARTNER, what="the other vehicle has let go of a bar that is in the air",
        predicate=team.partner_let_go, hold_time=0.1, ground=None, air=_LAND,
        message="the other vehicle has let go of the bar",
    ),
    Rule(
        id="partner_near", subject=Subject.PARTNER, what="the rotor circles of the two vehicles nearly touch",
        predicate=team.partner_near, thresholds=("airframe.radius_m",), hold_time=0.05, ground=None, air=_LAND,
        message="the other vehicle is {:.2f} m away (limit {:.2f} m)",
    ),
    Rule(
        id="bar_force_high", subject=Subject.PARTNER, what="the bar pulls too hard",
        predicate=team.bar_force_high, thresholds=("bar_force_max_n",), hold_time=0.3, ground=None, air=_LAND,
        message="the bar pulls with {:.1f} N (limit {:.1f} N)",
    ),
)  # fmt: skip
