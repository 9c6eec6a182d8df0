"""The rows of the event table (`companion.safety.rules`) for what the devices deliver: motion capture, external vision, PX4, arm and
force sensor.
"""

from __future__ import annotations

from typing import Final

from companion.model.types import SafetyAction
from companion.safety import arm, mocap, px4, vision
from companion.safety.rule import Lamp, Repeat, Rule, Subject

_WARN: Final = SafetyAction.WARN
_LAND: Final = SafetyAction.LAND
_PX4_LANDS: Final = SafetyAction.AUTOPILOT_LAND

MOCAP_DRAGGED, MOCAP_FROZEN = "mocap_dragged", "mocap_frozen"
MOCAP_SWAPPED, MOCAP_TWO_STREAMS = "mocap_swapped", "mocap_two_streams"
PILOT_TOOK_OVER: Final = "pilot_took_over"

DEVICE_RULES: tuple[Rule, ...] = (
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
        message="{:.0f} % of the ticks use a joint state older than {:.0f} ms, {:.0f} ms on average (limit {:.0f} % of the ticks); "
        "check the adapter's latency timer and the computer's load",
    ),
    Rule(
        id="joint_swings", subject=Subject.ARM, what="a joint swings: its rate turns three times in 0.5 s, by 2 rad/s and more",
        predicate=arm.joint_swings, ground=_WARN, air=_WARN,
        message="joint {} swings at {:.0f} Hz with {:.0f} deg/s; the arm gets less feedback, and no catch is detected meanwhile",
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
        id="clamp_error", subject=Subject.ARM,
        what="the clamp's servo reports a hardware error (register 70): it has no torque and may let the bar go",
        predicate=arm.clamp_error, ground=_LAND, air=_LAND, message="hardware error (register 70) of the clamp's servo: {}",
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
)  # fmt: skip
