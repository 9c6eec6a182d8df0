"""The event table: every rule of the monitors, one row each.

The loop in `companion.safety.evaluation` executes the rows, `tools.docs.safety` prints them into docs/safety.md, and the tests walk
them. Ids are stable: logs, summaries and outside scripts name them. Simultaneous events come in the order of the rows.
"""

from __future__ import annotations

from companion.model.types import OperatorCommand, SafetyAction, Severity
from companion.safety import arm, flight, mocap, process, px4
from companion.safety.process import commanded
from companion.safety.rule import Repeat, Rule, Subject
from companion.safety.validity import invalid

_NOMINAL, _WARN, _HOLD, _RETRACT = SafetyAction.NOMINAL, SafetyAction.WARN, SafetyAction.HOLD, SafetyAction.RETRACT
_LAND, _PX4_LANDS, _TERMINATE = SafetyAction.LAND, SafetyAction.AUTOPILOT_LAND, SafetyAction.TERMINATE

MOCAP_DRAGGED, MOCAP_FROZEN = "mocap_dragged", "mocap_frozen"
MOCAP_SWAPPED, MOCAP_TWO_STREAMS = "mocap_swapped", "mocap_two_streams"
REATTACHED, PILOT_TOOK_OVER, CRASHED = "reattached", "pilot_took_over", "crashed"
OPERATOR_START, OPERATOR_RESUME = "operator_start", "operator_resume"
OPERATOR_LAND, OPERATOR_ABORT = "operator_land", "operator_abort"


def _invalid(id_: str, field: str, what: str, message: str) -> Rule:
    """A record with a value that is not finite counts as not arrived; its loss has a rule of its own."""
    return Rule(
        id=id_, subject=Subject.INPUTS, what=what, predicate=invalid(field), ground=_WARN, air=_WARN, message=message,
        while_waiting=True,
    )  # fmt: skip


def _operator(
    command: OperatorCommand, what: str, ground: SafetyAction | None, air: SafetyAction, message: str
) -> Rule:
    """A command lasts one tick; one that lasts longer counts once."""
    return Rule(
        id=f"operator_{command.value}", subject=Subject.OPERATOR, what=what, predicate=commanded(command), ground=ground,
        air=air, message=message, severity=Severity.INFO, repeat=Repeat.AT_ONCE, while_waiting=True,
    )  # fmt: skip


RULES: tuple[Rule, ...] = (
    _invalid(
        "vehicle_not_finite", "vehicle", "PX4's state with NaN, infinity, absurd values or no attitude",
        "PX4's state is no measurement: {}",
    ),
    _invalid(
        "mocap_not_finite", "mocap", "a pose with NaN, infinity, absurd values or no attitude",
        "this pose is no measurement: {}",
    ),
    _invalid(
        "arm_not_finite", "arm", "a joint state with NaN, infinity or absurd values",
        "this joint state is no measurement: {}",
    ),
    _invalid(
        "force_not_finite", "force", "a force sample with NaN, infinity or absurd values",
        "this force sample is no measurement: {}",
    ),
    _invalid(
        "status_not_finite", "status", "PX4's status with NaN, infinity or absurd values",
        "PX4's status is no measurement: {}",
    ),

    _operator(OperatorCommand.HOLD, "a stop was asked for", None, _HOLD, "a stop was asked for"),
    _operator(OperatorCommand.RESUME, "going on was asked for", None, _NOMINAL, "going on was asked for"),
    _operator(OperatorCommand.START, "take-off was asked for", _NOMINAL, _NOMINAL, "take-off was asked for"),
    _operator(
        OperatorCommand.LAND, "a landing was asked for: a command, Ctrl-C, or the launcher is gone", _LAND, _LAND,
        "landing was asked for",
    ),
    _operator(OperatorCommand.ABORT, "an abort was asked for", _LAND, _LAND, "an abort was asked for"),

    Rule(
        id=REATTACHED, subject=Subject.PX4,
        what="PX4 was armed by somebody else: the companion was started in the air, or its forerunner died",
        predicate=px4.reattached, ground=_LAND, air=_PX4_LANDS, message="{}", severity=Severity.CRITICAL,
        repeat=Repeat.NEVER, while_waiting=True,
    ),

    Rule(
        id="mocap_lost", subject=Subject.MOCAP, what="no new pose that can be believed", predicate=mocap.mocap_lost,
        thresholds=("mocap_timeout_s",), ground=_PX4_LANDS, air=_PX4_LANDS, message="no motion capture",
    ),
    Rule(
        id="mocap_invalid", subject=Subject.MOCAP, what="poses come, but Motive has not seen the body for so long",
        predicate=mocap.mocap_invalid, thresholds=("mocap_timeout_s",), ground=_PX4_LANDS, air=_PX4_LANDS,
        message="motion capture does not see the body",
    ),
    Rule(
        id=MOCAP_SWAPPED, subject=Subject.MOCAP, what="poses jumped and stay there: another body, or a shifted one",
        predicate=mocap.mocap_swapped, thresholds=("mocap_timeout_s",), tracked_by=("mocap_jump_m", "mocap_jump_deg"),
        ground=_PX4_LANDS, air=_PX4_LANDS,
        message="motion capture jumped by {:.2f} m and {:.0f} deg and stays there: another body?",
    ),
    Rule(
        id="mocap_jump", subject=Subject.MOCAP,
        what="a pose further off than PX4's velocity and rates explain; it is not believed",
        predicate=mocap.mocap_jump, thresholds=("mocap_timeout_s",), tracked_by=("mocap_jump_m", "mocap_jump_deg"),
        ground=_WARN, air=_WARN, message="motion capture is {:.2f} m and {:.0f} deg off, in no time",
    ),
    Rule(
        id=MOCAP_TWO_STREAMS, subject=Subject.MOCAP,
        what="frame numbers step back again and again: two servers at one address", predicate=mocap.mocap_two_streams,
        ground=_PX4_LANDS, air=_PX4_LANDS,
        message="motion capture comes in two sequences of frame numbers: two servers at one address; neither is believed",
    ),
    Rule(
        id=MOCAP_DRAGGED, subject=Subject.MOCAP,
        what="poses do not move as the IMU measures: an attacker drags them, or the calibration shifts",
        predicate=mocap.mocap_dragged, thresholds=("mocap_inertial_m",), tracked_by=("mocap_inertial_s",), ground=None,
        air=_PX4_LANDS, repeat=Repeat.NEVER,
        message="motion capture does not move as the IMU measures: {:.0f} mm off (limit {:.0f} mm); PX4 lands without it",
    ),
    Rule(
        id=MOCAP_FROZEN, subject=Subject.MOCAP, what="new frames with the very same pose while the vehicle moves",
        predicate=mocap.mocap_frozen, tracked_by=("mocap_frozen_s",), ground=None, air=_PX4_LANDS,
        message="motion capture repeats the same pose, the vehicle moves",
    ),
    Rule(
        id="mocap_slow", subject=Subject.MOCAP, what="fewer poses in a second", predicate=mocap.mocap_slow,
        thresholds=("mocap_rate_min_hz", "mocap_timeout_s"), ground=_WARN, air=_WARN,
        message="motion capture comes at {:.0f} Hz",
    ),
    Rule(
        id="mocap_late", subject=Subject.MOCAP, what="poses come late", predicate=mocap.mocap_late,
        thresholds=("mocap_latency_warn_s", "mocap_timeout_s"), hold_time=0.2, ground=_WARN, air=_WARN,
        message="motion capture is {:.0f} ms late",
    ),
    Rule(
        id="mocap_too_late", subject=Subject.MOCAP, what="poses come so late that they are as good as lost",
        predicate=mocap.mocap_too_late, thresholds=("mocap_latency_warn_s", "mocap_timeout_s"), hold_time=0.1,
        ground=_PX4_LANDS, air=_PX4_LANDS, message="motion capture is {:.0f} ms late",
    ),
    Rule(
        id="estimate_disagrees", subject=Subject.MOCAP, what="PX4's position and motion capture apart",
        predicate=mocap.estimate_disagrees, thresholds=("estimate_disagreement_m",), hold_time=0.2, ground=None,
        air=_PX4_LANDS, message="PX4 and motion capture are {:.2f} m apart",
    ),
    Rule(
        id="yaw_disagrees", subject=Subject.MOCAP, what="PX4's yaw and motion capture apart",
        predicate=mocap.yaw_disagrees, thresholds=("yaw_disagreement_deg",), hold_time=0.5, ground=None, air=_PX4_LANDS,
        message="PX4 and motion capture are {:.0f} deg of yaw apart",
    ),

    Rule(
        id="px4_rebooted", subject=Subject.PX4, what="PX4's own clock went back: it restarted",
        predicate=px4.px4_rebooted, ground=_PX4_LANDS, air=_PX4_LANDS, repeat=Repeat.NEVER,
        message="PX4 restarted: its clock went back to {:.1f} s",
    ),
    Rule(
        id="link_late", subject=Subject.PX4, what="what comes from PX4 is older than it was, by PX4's own clock",
        predicate=px4.link_late, thresholds=("link_lag_max_s",), hold_time=0.15, ground=_PX4_LANDS, air=_PX4_LANDS,
        message="what PX4 says is {:.0f} ms late",
    ),
    Rule(
        id="estimate_frozen", subject=Subject.PX4, what="new positions from PX4 with the very same values",
        predicate=px4.estimate_frozen, hold_time="vehicle_timeout_s", ground=None, air=_PX4_LANDS,
        message="PX4 repeats the same position and velocity, the vehicle moves",
    ),
    Rule(
        id="vehicle_state_lost", subject=Subject.PX4, what="position, attitude or IMU from PX4 too old",
        predicate=px4.vehicle_state_lost, thresholds=("vehicle_timeout_s",), ground=_PX4_LANDS, air=_PX4_LANDS,
        message="no fresh state from PX4",
    ),
    Rule(
        id="heartbeat_lost", subject=Subject.PX4, what="no heartbeat from PX4", predicate=px4.heartbeat_lost,
        thresholds=("heartbeat_timeout_s",), ground=_PX4_LANDS, air=_PX4_LANDS, message="no heartbeat from PX4",
    ),
    Rule(
        id=PILOT_TOOK_OVER, subject=Subject.PX4,
        what="PX4 left OFFBOARD for a mode that people choose (manual, hold, return or take-off), and not by its own failsafe",
        predicate=px4.pilot_took_over, ground=_PX4_LANDS, air=_PX4_LANDS, message="PX4 left OFFBOARD for {}{}",
    ),
    Rule(
        id="offboard_left", subject=Subject.PX4, what="PX4 left OFFBOARD for another mode (its own failsafe)",
        predicate=px4.offboard_left, ground=_PX4_LANDS, air=_PX4_LANDS, message="PX4 left OFFBOARD for {}{}",
    ),
    Rule(
        id="px4_disarmed", subject=Subject.PX4, what="PX4 says disarmed, well above the floor",
        predicate=px4.px4_disarmed, ground=None, air=_PX4_LANDS, repeat=Repeat.NEVER,
        message="PX4 says disarmed at a height of {:.2f} m",
    ),
    Rule(
        id="battery_warn", subject=Subject.PX4, what="remaining charge gets small", predicate=px4.battery_below,
        thresholds=("battery_warn",), hold_time=1.0, ground=_WARN, air=_WARN, message="battery at {:.0%}",
    ),
    Rule(
        id="battery_low", subject=Subject.PX4, what="remaining charge too small", predicate=px4.battery_below,
        thresholds=("battery_min",), hold_time=1.0, ground=_LAND, air=_LAND, message="battery at {:.0%}",
    ),
    Rule(
        id="battery_voltage", subject=Subject.PX4, what="voltage too low", predicate=px4.battery_voltage,
        thresholds=("battery_voltage_min_v",), hold_time=2.0, ground=_LAND, air=_LAND,
        message="battery at {:.1f} V, {:.1f} V wanted",
    ),

    Rule(
        id="arm_lost", subject=Subject.ARM, what="joint state too old", predicate=arm.arm_lost,
        thresholds=("arm_timeout_s",), ground=_LAND, air=_LAND, message="no joint state from the arm",
    ),
    Rule(
        id="arm_read_failures", subject=Subject.ARM, what="bus cycles without an answer, one after another",
        predicate=arm.arm_read_failures, thresholds=("arm_read_failures_max",), ground=_WARN, air=_WARN,
        message="{} bus cycles without an answer",
    ),
    Rule(
        id="servo_error", subject=Subject.ARM, what="hardware error of a servo (register 70), by its name",
        predicate=arm.servo_error, ground=_LAND, air=_LAND, message="hardware error (register 70) of {}",
    ),
    Rule(
        id="arm_let_go", subject=Subject.ARM, what="a servo's bus watchdog had let go; torque was given again",
        predicate=arm.arm_let_go, ground=_WARN, air=_WARN, message="the arm's bus watchdog had let go; torque is back",
    ),
    Rule(
        id="joint_jump", subject=Subject.ARM, what="an angle further from the one before than a joint can turn",
        predicate=arm.joint_jump, thresholds=("joint_jump_deg", "joint_rate_max_deg_s"), ground=_LAND, air=_LAND,
        message="joint {} jumped by {:.0f} deg between two reads",
    ),
    Rule(
        id="servo_warm", subject=Subject.ARM, what="a servo is hot", predicate=arm.servo_warm,
        thresholds=("servo_warn_c", "servo_max_c"), hold_time=0.5, ground=_WARN, air=_WARN,
        message="a servo at {:.0f} degC",
    ),
    Rule(
        id="servo_hot", subject=Subject.ARM, what="a servo is about to shut down", predicate=arm.servo_hot,
        thresholds=("servo_warn_c", "servo_max_c"), hold_time=0.5, ground=_LAND, air=_LAND,
        message="a servo at {:.0f} degC",
    ),
    Rule(
        id="servo_overload", subject=Subject.ARM, what="a joint at its torque limit", predicate=arm.servo_overload,
        thresholds=("arm.joints.torque_max_nm",), hold_time="servo_overload_s", ground=_LAND, air=_LAND,
        message="joint torques {:.1f}, {:.1f} N m: at the limit",
    ),
    Rule(
        id="joint_rate", subject=Subject.ARM, what="a speed that no joint can have", predicate=arm.joint_rate,
        thresholds=("joint_rate_max_deg_s",), hold_time=0.05, ground=_LAND, air=_LAND,
        message="joint speeds {:.0f}, {:.0f} deg/s",
    ),
    Rule(
        id="joint_wall", subject=Subject.ARM, what="a joint beyond its wall", predicate=arm.joint_beyond_limit,
        thresholds=("joint_wall_warn_deg", "arm.joints.angle_deg"), hold_time=0.1, ground=_WARN, air=_WARN,
        message="joints at {:.0f}, {:.0f} deg: {:.0f} deg beyond a wall",
    ),
    Rule(
        id="joint_far_past_wall", subject=Subject.ARM, what="a joint far beyond its wall",
        predicate=arm.joint_beyond_limit, thresholds=("joint_wall_max_deg", "arm.joints.angle_deg"), hold_time=0.3,
        ground=_LAND, air=_LAND, message="joints at {:.0f}, {:.0f} deg: {:.0f} deg beyond a wall",
    ),

    Rule(
        id="force_lost", subject=Subject.FORCE, what="force sample too old", predicate=arm.force_lost,
        thresholds=("force_timeout_s",), ground=_LAND, air=_WARN, message="no force samples; the law flies on without",
    ),
    Rule(
        id="force_overload", subject=Subject.FORCE, what="the sensor says overload, or reads more than it can measure",
        predicate=arm.force_overload, thresholds=("devices.force.force_max_n",), ground=_WARN, air=_WARN,
        message="force sensor overloaded: {:.0f}, {:.0f}, {:.0f} N",
    ),
    Rule(
        id="force_stuck", subject=Subject.FORCE, what="new samples with the very same values; they count as lost",
        predicate=arm.force_stuck, tracked_by=("force_stuck_s",), ground=None, air=_WARN,
        message="the force sensor repeats the same values; the law flies on without",
    ),
    Rule(
        id="force_drift", subject=Subject.FORCE, what="a lasting force though nothing was caught",
        predicate=arm.force_drift, thresholds=("force_drift_n",), hold_time=2.0, ground=None, air=_WARN,
        message="the force sensor reads {:.1f}, {:.1f}, {:.1f} N on an empty net",
    ),

    Rule(
        id="loop_late", subject=Subject.PROCESS, what="a control tick came late", predicate=process.loop_late,
        thresholds=("loop_late_s", "loop_stalled_s"), ground=_WARN, air=_WARN,
        message="the control loop was held up for {:.0f} ms",
    ),
    Rule(
        id="loop_stalled", subject=Subject.PROCESS, what="the same, much later", predicate=process.loop_stalled,
        thresholds=("loop_late_s", "loop_stalled_s"), ground=_LAND, air=_LAND,
        message="the control loop was held up for {:.0f} ms",
    ),
    Rule(
        id="recorder_drops", subject=Subject.PROCESS, what="the recorder loses samples",
        predicate=process.recorder_drops, ground=_WARN, air=_WARN, message="the recorder loses samples",
    ),
    Rule(
        id="guardian_lost", subject=Subject.PROCESS, what="the guardian is dead, or could not take over",
        predicate=process.guardian_lost, ground=_LAND, air=_WARN, message="the guardian is dead, or could not take over",
    ),

    Rule(
        id="tilt", subject=Subject.FLIGHT, what="leans too far", predicate=flight.tilt, thresholds=("tilt_abort_deg",),
        hold_time=0.1, ground=None, air=_PX4_LANDS, message="tilt {:.0f} deg",
    ),
    Rule(
        id=CRASHED, subject=Subject.FLIGHT,
        what="tilted by more than 70 deg, by PX4 and by motion capture (or the accelerometer, if the body is not seen)",
        predicate=flight.crashed, hold_time=0.3, ground=None, air=_TERMINATE, repeat=Repeat.NEVER,
        message="flipped: tilt {:.0f} deg, confirmed by a second source",
    ),
    Rule(
        id="too_fast", subject=Subject.FLIGHT, what="horizontal speed", predicate=flight.too_fast,
        thresholds=("speed_max_m_s",), hold_time=0.1, ground=None, air=_HOLD, message="{:.1f} m/s",
    ),
    Rule(
        id="climbs_too_fast", subject=Subject.FLIGHT, what="climbs", predicate=flight.climbs_too_fast,
        thresholds=("climb_max_m_s",), hold_time=0.1, ground=None, air=_LAND, message="climbs at {:.1f} m/s",
    ),
    Rule(
        id="sinks_too_fast", subject=Subject.FLIGHT, what="sinks", predicate=flight.sinks_too_fast,
        thresholds=("sink_max_m_s",), hold_time=0.1, ground=None, air=_LAND, message="sinks at {:.1f} m/s",
    ),
    Rule(
        id="geofence_left", subject=Subject.FLIGHT, what="its rotors are outside the room",
        predicate=flight.geofence_left, thresholds=("geofence_tolerance_m",), hold_time=0.05, ground=None, air=_LAND,
        message="at ({:.2f}, {:.2f}, {:.2f}) m the rotors are outside the room",
    ),
    Rule(
        id="geofence_near", subject=Subject.FLIGHT, what="would come to rest with its rotors outside the room",
        predicate=flight.geofence_near, thresholds=("geofence_tolerance_m",),
        tracked_by=("tether.react_time_s", "tether.stop_deceleration_m_s2"), hold_time=0.05, ground=None, air=_HOLD,
        message="would come to rest at ({:.2f}, {:.2f}, {:.2f}) m, the rotors outside the room",
    ),
    Rule(
        id="tracking_warn", subject=Subject.FLIGHT, what="off the reference", predicate=flight.tracking_warn,
        thresholds=("tracking_error_warn_m",), hold_time=0.2, ground=None, air=_WARN,
        message="{:.2f} m off the reference",
    ),
    Rule(
        id="tracking_hold", subject=Subject.FLIGHT, what="further off the reference", predicate=flight.tracking_error,
        thresholds=("tracking_error_warn_m", "tracking_error_hold_m"), hold_time=0.2, ground=None, air=_HOLD,
        message="{:.2f} m off the reference",
    ),
    Rule(
        id="tracking_error", subject=Subject.FLIGHT, what="too far off the reference", predicate=flight.tracking_error,
        thresholds=("tracking_error_warn_m", "tracking_error_abort_m"), hold_time=0.2, ground=None, air=_LAND,
        message="{:.2f} m off the reference",
    ),
    Rule(
        id="thrust_saturated", subject=Subject.FLIGHT, what="thrust at its upper limit",
        predicate=flight.thrust_saturated, thresholds=("thrust_saturated_s",), ground=None, air=_LAND,
        message="thrust at its limit, {:.0f} N: too heavy, or too weak",
    ),

    Rule(
        id="tether_short", subject=Subject.TETHER, what="would come to rest with too little tether left",
        predicate=flight.tether_short, thresholds=("tether_stop_slack_min_m",), hold_time=0.05, ground=None, air=_HOLD,
        message="would come to rest with {:.2f} m of tether left",
    ),
    Rule(
        id="tether_taut", subject=Subject.TETHER, what="the tether pulls, or is used up", predicate=flight.tether_taut,
        tracked_by=("tether.taut_slack_m", "tether.pull_min_n"), hold_time=0.05, ground=None, air=_RETRACT,
        message="the tether is taut: {:.2f} m left, it pulls with {:.0f} N",
    ),
    Rule(
        id="tether_snagged", subject=Subject.TETHER, what="the tether pulls though there is slack",
        predicate=flight.tether_snagged, tracked_by=("tether.pull_min_n",), hold_time=0.1, ground=None, air=_LAND,
        message="the tether pulls with {:.0f} N though {:.2f} m are left: it is caught somewhere",
    ),
    Rule(
        id="tether_near", subject=Subject.TETHER, what="the tether comes near rotors or arm",
        predicate=flight.tether_near, thresholds=("tether.clearance_min_m",), hold_time=0.2, ground=None, air=_WARN,
        message="the tether is {:.2f} m from rotors or arm",
    ),
    Rule(
        id="tether_wound", subject=Subject.TETHER, what="wound about its anchor", predicate=flight.tether_wound,
        thresholds=("tether.turns_max",), hold_time=0.2, ground=None, air=_HOLD,
        message="the tether is wound {:.1f} times about its anchor",
    ),
    Rule(
        id="tether_separated", subject=Subject.TETHER, what="further away than the tether is long: it is cut",
        predicate=flight.tether_separated, tracked_by=("tether.separation_m",), hold_time=0.1, ground=None, air=_LAND,
        repeat=Repeat.NEVER, message="{:.2f} m from the anchor without a pull: the tether is off",
    ),
)  # fmt: skip
