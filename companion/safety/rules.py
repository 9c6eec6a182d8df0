"""The event table: every rule of the monitors, one row each.

The rows of the devices are in `companion.safety.device_rules`. `companion.safety.evaluation` evaluates the rows, `tools.docs.safety`
prints them into docs/internals/safety.md, and the tests go through them. Ids are stable because logs, summaries and users' scripts
contain them. Simultaneous events are in the order of the rows.
"""

from __future__ import annotations

from typing import Final

from companion.model.types import OperatorCommand, SafetyAction, Severity
from companion.safety import flight, process, px4, team
from companion.safety.device_rules import DEVICE_RULES
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

ARMED_EXTERNALLY: Final = "armed_externally"
KILLED: Final = "killed"
CRASHED: Final = "crashed"
OPERATOR_START: Final = "operator_start"
OPERATOR_RESUME: Final = "operator_resume"
OPERATOR_LAND, OPERATOR_ABORT = "operator_land", "operator_abort"
PARTNER_HOLDS: Final = "partner_holds"


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

    *DEVICE_RULES,

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
        message="the tether pulls with {:.0f} N although {:.2f} m of slack are left: the tether is snagged",
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
        id="partner_quiet", subject=Subject.PARTNER, what="nothing is heard from the other vehicle; not both hold the bar yet",
        predicate=team.partner_quiet, thresholds=("partner_timeout_s",), ground=_WARN, air=_WARN,
        message="nothing from the other vehicle for more than {:.1f} s",
    ),
    Rule(
        id="partner_silent", subject=Subject.PARTNER, what="nothing is heard from the other vehicle, which holds the same bar",
        predicate=team.partner_silent, thresholds=("partner_timeout_s",), ground=None, air=_LAND,
        message="nothing from the other vehicle for more than {:.1f} s, and both hold the bar",
    ),
    Rule(
        id="partner_late", subject=Subject.PARTNER, what="what the other vehicle says, which holds the same bar, arrives late",
        predicate=team.partner_late, thresholds=("partner_timeout_s",), hold_time=0.1, ground=None, air=_LAND,
        message="what the other vehicle says is {:.1f} s old (limit {:.1f} s), and both hold the bar",
    ),
    Rule(
        id=PARTNER_HOLDS, subject=Subject.PARTNER, what="the other vehicle, which carries the same bar, has stopped by itself",
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
    Rule(
        id="bar_tilted", subject=Subject.PARTNER, what="one end of the bar in the air is much higher than the other",
        predicate=team.bar_tilted, hold_time=0.2, ground=None, air=_HOLD,
        message="the bar is tilted by {:.0f} deg (limit {:.0f} deg)",
    ),
    Rule(
        id="bar_unseen", subject=Subject.PARTNER, what="motion capture does not see the bar in the air",
        predicate=team.bar_unseen, ground=None, air=_WARN,
        message="motion capture has not seen the bar for {:.1f} s; its tilt is not judged",
    ),
)  # fmt: skip
