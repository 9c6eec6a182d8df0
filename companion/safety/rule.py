"""A row of the event table, and access to its thresholds in the vehicle file."""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from enum import Enum, StrEnum
from typing import Any

from companion.config.vehicle import Vehicle
from companion.model.types import SafetyAction, Severity
from companion.safety.flight_context import Values


class Subject(Enum):
    """What a rule observes; each subject has one tracker."""

    INPUTS = "inputs"
    OPERATOR = "operator"
    MOCAP = "motion capture"
    VISION = "external vision"
    PX4 = "PX4"
    ARM = "arm"
    FORCE = "force sensor"
    PROCESS = "process"
    FLIGHT = "flight"
    TETHER = "tether"
    PARTNER = "partner"


class Lamp(StrEnum):
    """A health lamp of the ground station, in display order."""

    FLIGHT = "flight"
    PX4 = "PX4"
    ESTIMATE = "estimate"
    MOCAP = "motion capture"
    ARM = "arm"
    FORCE = "force sensor"
    LOOP = "loop"
    RECORDER = "recorder"
    GUARDIAN = "guardian"
    BATTERY = "battery"
    TETHER = "tether"
    PARTNER = "partner"


_LAMPS: Mapping[Subject, Lamp] = {
    Subject.INPUTS: Lamp.PX4,
    Subject.OPERATOR: Lamp.FLIGHT,
    Subject.MOCAP: Lamp.MOCAP,
    Subject.VISION: Lamp.ESTIMATE,
    Subject.PX4: Lamp.PX4,
    Subject.ARM: Lamp.ARM,
    Subject.FORCE: Lamp.FORCE,
    Subject.PROCESS: Lamp.LOOP,
    Subject.FLIGHT: Lamp.FLIGHT,
    Subject.TETHER: Lamp.TETHER,
    Subject.PARTNER: Lamp.PARTNER,
}


class Repeat(Enum):
    """When a rule that has raised its event may raise it again."""

    AFTER_QUIET = "after the condition has been false for a second"
    NEVER = "once in a flight"
    AT_ONCE = "each time"


@dataclass(frozen=True, slots=True, kw_only=True)
class Rule:
    """One row of the table."""

    id: str
    subject: Subject
    what: str
    predicate: Callable[[Any, Any], Values | None]
    """Pure function of the subject's tracker and the thresholds (see `thresholds_of`). It returns the values for the message if the
    condition holds in this tick, else None.
    """
    thresholds: tuple[str, ...] = ()
    """Keys of the vehicle file, below `safety:` if they have no dot, whose values the predicate gets."""
    tracked_by: tuple[str, ...] = ()
    """Keys of thresholds that the tracker applies itself."""
    hold_time: float | str = 0.0
    """Time for which the condition must hold, s, or the key of `safety:` that gives this time."""
    ground: SafetyAction | None
    """Action before the rotors may lift; LAND and more severe actions cancel the start. None if the rule is not evaluated on the
    ground.
    """
    air: SafetyAction | None
    """Action while the rotors may lift. None if the rule is not evaluated in the air."""
    message: str
    """Text of the event, a format string for the predicate's values."""
    severity: Severity | None = None
    """Severity of the event; None means CRITICAL for RETRACT and more severe actions in the air, else WARNING."""
    pilot_flies: bool = False
    """Whether a pilot has control after this event: with AUTOPILOT_LAND the companion sends PX4 no command and only monitors the
    landing.
    """
    repeat: Repeat = Repeat.AFTER_QUIET
    while_waiting: bool = False
    """Whether the rule is also evaluated while inputs are still missing on the ground."""
    on_lamp: Lamp | None = None
    """Lamp that shows the rule while it is active; None means that of its subject."""

    @property
    def lamp(self) -> Lamp:
        """Return the lamp that shows the rule while it is active."""
        return self.on_lamp or _LAMPS[self.subject]

    def verdict(self, airborne: bool) -> tuple[SafetyAction, Severity]:
        """Return the action and the severity of the event; the action is NOMINAL if the rule is not evaluated."""
        action = (self.air if airborne else self.ground) or SafetyAction.NOMINAL
        if self.severity is not None:
            return action, self.severity
        critical = airborne and action.rank >= SafetyAction.RETRACT.rank
        return action, Severity.CRITICAL if critical else Severity.WARNING


def hold_time_s(rule: Rule, vehicle: Vehicle) -> float:
    """Return a rule's hold time."""
    return float(getattr(vehicle.safety, rule.hold_time) if isinstance(rule.hold_time, str) else rule.hold_time)


def thresholds_of(rule: Rule, vehicle: Vehicle) -> Any:
    """Return the thresholds for the predicate: None, a single value, or a tuple of several. Angles are in rad."""
    values = tuple(_value(vehicle, key) for key in rule.thresholds)
    return values if len(values) > 1 else values[0] if values else None


def _value(vehicle: Vehicle, key: str) -> Any:
    if key == "arm.joints.torque_max_nm":
        return vehicle.joint_torque_limits_nm  # a joint whose current is limited never reaches its torque_max_nm
    if key.startswith("arm.joints."):
        name = key.rpartition(".")[2]
        return tuple(_in_rad(name, getattr(joint, name)) for joint in vehicle.arm.joints)
    value: Any = vehicle if "." in key else vehicle.safety
    for name in key.split("."):
        value = getattr(value, name)
    return _in_rad(key, value)


def _in_rad(key: str, value: Any) -> Any:
    if not key.endswith(("_deg", "_deg_s")):
        return value
    return tuple(map(math.radians, value)) if isinstance(value, tuple) else math.radians(value)
