"""Every event that a monitor can raise, in one table: what is found, by which limits, and what is done about it.

The monitors refer to these records, `tools.docs.safety` prints them into docs/safety.md, and the tests walk them. Ids are stable:
logs, summaries and outside scripts name them.
"""

from __future__ import annotations

from dataclasses import dataclass
from enum import Enum

from companion.model.types import SafetyAction


class Part(Enum):
    """Whose health a rule watches."""

    INPUTS = "inputs"
    MOCAP = "motion capture"
    PX4 = "PX4"
    ARM = "arm"
    FORCE = "force sensor"
    PROCESS = "process"
    FLIGHT = "flight"
    TETHER = "tether"
    PEOPLE = "people"


@dataclass(frozen=True, slots=True)
class Rule:
    """One event."""

    id: str
    part: Part
    found: str
    """What is found, in words."""
    limits: tuple[str, ...]
    """Keys of `safety:` in the vehicle file (with the section's name in front: of another section) that bound it."""
    hold: float | str
    """How long it must last, s; or the key of `safety:` that says so."""
    ground: SafetyAction | None
    """Before the rotors may lift: from LAND on the companion stands down. None: not judged there."""
    air: SafetyAction | None
    clears: bool = True
    """It can be gone again, and is told again when it comes back; else once in a flight."""


RULES: list[Rule] = []

_WARN, _HOLD, _RETRACT = SafetyAction.WARN, SafetyAction.HOLD, SafetyAction.RETRACT
_LAND, _PX4_LANDS, _TERMINATE = SafetyAction.LAND, SafetyAction.AUTOPILOT_LAND, SafetyAction.TERMINATE


def _rule(
    id_: str,
    part: Part,
    found: str,
    limits: tuple[str, ...],
    hold: float | str,
    ground: SafetyAction | None,
    air: SafetyAction | None,
    clears: bool = True,
) -> Rule:
    rule = Rule(id_, part, found, limits, hold, ground, air, clears)
    RULES.append(rule)
    return rule


# A record with a value that is no number counts as not arrived; what its loss then means is its own rule.
MOCAP_NOT_FINITE = _rule(
    "mocap_not_finite", Part.INPUTS, "a pose with NaN, infinity, absurd values or no attitude", (), 0.0, _WARN, _WARN
)
VEHICLE_NOT_FINITE = _rule(
    "vehicle_not_finite",
    Part.INPUTS,
    "PX4's state with NaN, infinity, absurd values or no attitude",
    (),
    0.0,
    _WARN,
    _WARN,
)
STATUS_NOT_FINITE = _rule(
    "status_not_finite", Part.INPUTS, "PX4's status with NaN, infinity or absurd values", (), 0.0, _WARN, _WARN
)
ARM_NOT_FINITE = _rule(
    "arm_not_finite", Part.INPUTS, "a joint state with NaN, infinity or absurd values", (), 0.0, _WARN, _WARN
)
FORCE_NOT_FINITE = _rule(
    "force_not_finite", Part.INPUTS, "a force sample with NaN, infinity or absurd values", (), 0.0, _WARN, _WARN
)

MOCAP_LOST = _rule(
    "mocap_lost", Part.MOCAP, "no new pose that can be believed", ("mocap_timeout_s",), 0.0, _PX4_LANDS, _PX4_LANDS
)
MOCAP_INVALID = _rule(
    "mocap_invalid",
    Part.MOCAP,
    "poses come, but Motive has not seen the body for so long",
    ("mocap_timeout_s",),
    0.0,
    _PX4_LANDS,
    _PX4_LANDS,
)
MOCAP_SLOW = _rule("mocap_slow", Part.MOCAP, "fewer poses in a second", ("mocap_rate_min_hz",), 0.0, _WARN, _WARN)
MOCAP_LATE = _rule("mocap_late", Part.MOCAP, "poses come late", ("mocap_latency_warn_s",), 0.2, _WARN, _WARN)
MOCAP_TOO_LATE = _rule(
    "mocap_too_late", Part.MOCAP, "poses come so late that they are as good as lost", ("mocap_timeout_s",), 0.1,
    _PX4_LANDS, _PX4_LANDS,
)  # fmt: skip
MOCAP_JUMP = _rule(
    "mocap_jump",
    Part.MOCAP,
    "a pose further off than PX4's velocity and rates explain; it is not believed",
    ("mocap_jump_m", "mocap_jump_deg"),
    0.0,
    _WARN,
    _WARN,
)
MOCAP_SWAPPED = _rule(
    "mocap_swapped",
    Part.MOCAP,
    "poses jumped and stay there: another body, or a shifted one",
    ("mocap_jump_m", "mocap_jump_deg", "mocap_timeout_s"),
    0.0,
    _PX4_LANDS,
    _PX4_LANDS,
)
MOCAP_FROZEN = _rule(
    "mocap_frozen",
    Part.MOCAP,
    "new frames with the very same pose while the vehicle moves",
    ("mocap_frozen_s",),
    0.0,
    None,
    _PX4_LANDS,
)
MOCAP_TWO_STREAMS = _rule(
    "mocap_two_streams",
    Part.MOCAP,
    "frame numbers step back again and again: two servers at one address",
    (),
    0.0,
    _PX4_LANDS,
    _PX4_LANDS,
)
MOCAP_DRAGGED = _rule(
    "mocap_dragged",
    Part.MOCAP,
    "poses do not move as the IMU measures: an attacker drags them, or the calibration shifts",
    ("mocap_inertial_m", "mocap_inertial_s"),
    0.0,
    None,
    _PX4_LANDS,
    False,
)
ESTIMATE_DISAGREES = _rule(
    "estimate_disagrees",
    Part.MOCAP,
    "PX4's position and motion capture apart",
    ("estimate_disagreement_m",),
    0.2,
    None,
    _PX4_LANDS,
)
YAW_DISAGREES = _rule(
    "yaw_disagrees", Part.MOCAP, "PX4's yaw and motion capture apart", ("yaw_disagreement_deg",), 0.5, None, _PX4_LANDS
)

VEHICLE_STATE_LOST = _rule(
    "vehicle_state_lost",
    Part.PX4,
    "position, attitude or IMU from PX4 too old",
    ("vehicle_timeout_s",),
    0.0,
    _PX4_LANDS,
    _PX4_LANDS,
)
LINK_LATE = _rule(
    "link_late",
    Part.PX4,
    "what comes from PX4 is older than it was, by PX4's own clock",
    ("link_lag_max_s",),
    0.15,
    _PX4_LANDS,
    _PX4_LANDS,
)
ESTIMATE_FROZEN = _rule(
    "estimate_frozen",
    Part.PX4,
    "new positions from PX4 with the very same values",
    (),
    "vehicle_timeout_s",
    None,
    _PX4_LANDS,
)
HEARTBEAT_LOST = _rule(
    "heartbeat_lost", Part.PX4, "no heartbeat from PX4", ("heartbeat_timeout_s",), 0.0, _PX4_LANDS, _PX4_LANDS
)
PX4_REBOOTED = _rule(
    "px4_rebooted", Part.PX4, "PX4's own clock went back: it restarted", (), 0.0, _PX4_LANDS, _PX4_LANDS, False
)
REATTACHED = _rule(
    "reattached",
    Part.PX4,
    "PX4 was armed by somebody else: the companion was started in the air, or its forerunner died",
    (),
    0.0,
    _LAND,
    _PX4_LANDS,
    False,
)
PX4_DISARMED = _rule(
    "px4_disarmed", Part.PX4, "PX4 says disarmed, well above the floor", (), 0.0, None, _PX4_LANDS, False
)
PILOT_TOOK_OVER = _rule(
    "pilot_took_over",
    Part.PX4,
    "PX4 left OFFBOARD for a mode that people choose (manual, hold, return or take-off), and not by its own failsafe",
    (),
    0.0,
    _PX4_LANDS,
    _PX4_LANDS,
)
OFFBOARD_LEFT = _rule(
    "offboard_left",
    Part.PX4,
    "PX4 left OFFBOARD for another mode (its own failsafe)",
    (),
    0.0,
    _PX4_LANDS,
    _PX4_LANDS,
)
BATTERY_WARN = _rule("battery_warn", Part.PX4, "remaining charge gets small", ("battery_warn",), 1.0, _WARN, _WARN)
BATTERY_LOW = _rule("battery_low", Part.PX4, "remaining charge too small", ("battery_min",), 1.0, _LAND, _LAND)
BATTERY_VOLTAGE = _rule("battery_voltage", Part.PX4, "voltage too low", ("battery_voltage_min_v",), 2.0, _LAND, _LAND)

ARM_LOST = _rule("arm_lost", Part.ARM, "joint state too old", ("arm_timeout_s",), 0.0, _LAND, _LAND)
ARM_READ_FAILURES = _rule(
    "arm_read_failures",
    Part.ARM,
    "bus cycles without an answer, one after another",
    ("arm_read_failures_max",),
    0.0,
    _WARN,
    _WARN,
)
SERVO_ERROR = _rule(
    "servo_error", Part.ARM, "hardware error of a servo (register 70), by its name", (), 0.0, _LAND, _LAND
)
ARM_LET_GO = _rule(
    "arm_let_go", Part.ARM, "a servo's bus watchdog had let go; torque was given again", (), 0.0, _WARN, _WARN
)
SERVO_WARM = _rule("servo_warm", Part.ARM, "a servo is hot", ("servo_warn_c",), 0.5, _WARN, _WARN)
SERVO_HOT = _rule("servo_hot", Part.ARM, "a servo is about to shut down", ("servo_max_c",), 0.5, _LAND, _LAND)
SERVO_OVERLOAD = _rule(
    "servo_overload", Part.ARM, "a joint at its torque limit", ("arm.joints.torque_max_nm",), "servo_overload_s",
    _LAND, _LAND,
)  # fmt: skip
JOINT_JUMP = _rule(
    "joint_jump",
    Part.ARM,
    "an angle further from the one before than a joint can turn",
    ("joint_jump_deg",),
    0.0,
    _LAND,
    _LAND,
)
JOINT_RATE = _rule(
    "joint_rate", Part.ARM, "a speed that no joint can have", ("joint_rate_max_deg_s",), 0.05, _LAND, _LAND
)
JOINT_WALL = _rule("joint_wall", Part.ARM, "a joint beyond its wall", ("joint_wall_warn_deg",), 0.1, _WARN, _WARN)
JOINT_FAR_PAST_WALL = _rule(
    "joint_far_past_wall", Part.ARM, "a joint far beyond its wall", ("joint_wall_max_deg",), 0.3, _LAND, _LAND
)

FORCE_LOST = _rule("force_lost", Part.FORCE, "force sample too old", ("force_timeout_s",), 0.0, _LAND, _WARN)
FORCE_OVERLOAD = _rule(
    "force_overload",
    Part.FORCE,
    "the sensor says overload, or reads more than it can measure",
    ("devices.force.force_max_n",),
    0.0,
    _WARN,
    _WARN,
)
FORCE_STUCK = _rule(
    "force_stuck",
    Part.FORCE,
    "new samples with the very same values; they count as lost",
    ("force_stuck_s",),
    0.0,
    None,
    _WARN,
)
FORCE_DRIFT = _rule(
    "force_drift", Part.FORCE, "a lasting force though nothing was caught", ("force_drift_n",), 2.0, None, _WARN
)

LOOP_LATE = _rule("loop_late", Part.PROCESS, "a control tick came late", ("loop_late_s",), 0.0, _WARN, _WARN)
LOOP_STALLED = _rule("loop_stalled", Part.PROCESS, "the same, much later", ("loop_stalled_s",), 0.0, _LAND, _LAND)
RECORDER_DROPS = _rule("recorder_drops", Part.PROCESS, "the recorder loses samples", (), 0.0, _WARN, _WARN)
GUARDIAN_LOST = _rule(
    "guardian_lost", Part.PROCESS, "the guardian is dead, or could not take over", (), 0.0, _LAND, _WARN
)

TILT = _rule("tilt", Part.FLIGHT, "leans too far", ("tilt_abort_deg",), 0.1, None, _PX4_LANDS)
CRASHED = _rule(
    "crashed",
    Part.FLIGHT,
    "tilted by more than 70 deg, by PX4 and by motion capture (or the accelerometer, if the body is not seen)",
    (),
    0.3,
    None,
    _TERMINATE,
    False,
)
TRACKING_WARN = _rule("tracking_warn", Part.FLIGHT, "off the reference", ("tracking_error_warn_m",), 0.2, None, _WARN)
TRACKING_HOLD = _rule(
    "tracking_hold", Part.FLIGHT, "further off the reference", ("tracking_error_hold_m",), 0.2, None, _HOLD
)
TRACKING_ERROR = _rule(
    "tracking_error", Part.FLIGHT, "too far off the reference", ("tracking_error_abort_m",), 0.2, None, _LAND
)
THRUST_SATURATED = _rule(
    "thrust_saturated", Part.FLIGHT, "thrust at its upper limit", ("thrust_saturated_s",), 0.0, None, _LAND
)
TOO_FAST = _rule("too_fast", Part.FLIGHT, "horizontal speed", ("speed_max_m_s",), 0.1, None, _HOLD)
CLIMBS = _rule("climbs_too_fast", Part.FLIGHT, "climbs", ("climb_max_m_s",), 0.1, None, _LAND)
SINKS = _rule("sinks_too_fast", Part.FLIGHT, "sinks", ("sink_max_m_s",), 0.1, None, _LAND)
GEOFENCE_NEAR = _rule(
    "geofence_near",
    Part.FLIGHT,
    "would come to rest with its rotors outside the room",
    ("geofence_tolerance_m", "tether.react_time_s", "tether.stop_deceleration_m_s2"),
    0.05,
    None,
    _HOLD,
)
GEOFENCE_LEFT = _rule(
    "geofence_left", Part.FLIGHT, "its rotors are outside the room", ("geofence_tolerance_m",), 0.05, None, _LAND
)

TETHER_SHORT = _rule(
    "tether_short",
    Part.TETHER,
    "would come to rest with too little tether left",
    ("tether_stop_slack_min_m",),
    0.05,
    None,
    _HOLD,
)
TETHER_TAUT = _rule(
    "tether_taut",
    Part.TETHER,
    "the tether pulls, or is used up",
    ("tether.taut_slack_m", "tether.pull_min_n"),
    0.05,
    None,
    _RETRACT,
)
TETHER_SNAGGED = _rule(
    "tether_snagged", Part.TETHER, "the tether pulls though there is slack", ("tether.pull_min_n",), 0.1, None, _LAND
)
TETHER_NEAR = _rule(
    "tether_near", Part.TETHER, "the tether comes near rotors or arm", ("tether.clearance_min_m",), 0.2, None, _WARN
)
TETHER_WOUND = _rule("tether_wound", Part.TETHER, "wound about its anchor", ("tether.turns_max",), 0.2, None, _HOLD)
TETHER_SEPARATED = _rule(
    "tether_separated",
    Part.TETHER,
    "further away than the tether is long: it is cut",
    ("tether.separation_m",),
    0.1,
    None,
    _LAND,
    False,
)

OPERATOR_HOLD = _rule("operator_hold", Part.PEOPLE, "a stop was asked for", (), 0.0, None, _HOLD)
OPERATOR_RESUME = _rule("operator_resume", Part.PEOPLE, "going on was asked for", (), 0.0, None, SafetyAction.NOMINAL)
OPERATOR_START = _rule(
    "operator_start", Part.PEOPLE, "take-off was asked for", (), 0.0, SafetyAction.NOMINAL, SafetyAction.NOMINAL
)
OPERATOR_LAND = _rule(
    "operator_land",
    Part.PEOPLE,
    "a landing was asked for: a command, Ctrl-C, or the launcher is gone",
    (),
    0.0,
    _LAND,
    _LAND,
)
OPERATOR_ABORT = _rule("operator_abort", Part.PEOPLE, "an abort was asked for", (), 0.0, _LAND, _LAND)

BY_PEOPLE = frozenset(rule.id for rule in RULES if rule.part is Part.PEOPLE)
