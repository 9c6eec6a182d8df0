"""The stages of a flight, their times, and what PX4's status shows about a pilot. `companion.core.sequence` executes the stages.

WAIT -> OFFBOARD -> ARM -> SPOOL -> PLAN -> TOUCHDOWN -> DISARM -> DONE
WAIT <-> READY -> OFFBOARD, if the operator starts the take-off
in the air, at any time:  -> PLAN (a landing from here)  or  -> AUTOPILOT_LAND, both ending in DONE
before SPOOL, at any time: -> STAND_DOWN -> DONE
"""

from __future__ import annotations

from enum import Enum
from typing import Final

from companion.model.types import AutopilotStatus, FlightMode, LandedState

WAIT_TIMEOUT_S = 15.0
TARE_S = 1.0
"""Duration of the force sensor's tare. A flight that waits for its start repeats the tare."""
LOOK_AGAIN_S = 0.1
"""Period with which a flight that waits for its start checks the estimate and the position."""
STREAM_BEFORE_OFFBOARD_S = 0.8
OFFBOARD_TIMEOUT_S = 8.0
ARM_TIMEOUT_S = 10.0
SPOOL_S = 1.2
SPOOL_SHARE = 0.7
"""Fraction of hover thrust at the end of spooling up, at which the plan begins."""
SPOOL_TO_FULL_S = 0.4
TOUCHDOWN_RAMP_S = 0.4
DISARM_TIMEOUT_S = 8.0
HEARTBEAT_FRESH_S = 2.5


class Stage(Enum):
    """Stages of a flight."""

    WAIT = "wait"
    READY = "waits for start"
    OFFBOARD = "offboard"
    ARM = "arm"
    SPOOL = "spool up"
    MISSION = "mission"
    TOUCHDOWN = "touchdown"
    DISARM = "disarm"
    AUTOPILOT_LAND = "autopilot land"
    STAND_DOWN = "stand down"
    DONE = "done"

    # An enum's own hash is a Python function; sets and tables of stages are looked up in every tick.
    __hash__ = object.__hash__


BEFORE_LIFT = frozenset({Stage.WAIT, Stage.READY, Stage.OFFBOARD, Stage.ARM})
BEFORE_ARMING = frozenset({Stage.WAIT, Stage.READY, Stage.OFFBOARD})
"""If PX4 is armed in these stages, the companion has not armed it."""
LIFTING = frozenset({Stage.SPOOL, Stage.MISSION, Stage.TOUCHDOWN, Stage.AUTOPILOT_LAND})
DISARMING = frozenset({Stage.DISARM, Stage.STAND_DOWN})
COMMANDING = frozenset({Stage.ARM, Stage.SPOOL, Stage.MISSION, Stage.TOUCHDOWN})
"""Stages in which the companion commands the vehicle, so that PX4 must be in OFFBOARD."""
ROTORS_MAY_START = "its rotors may start until it is disarmed, keep away"
"""Part of the answer to a command that ends a flight while PX4 arms, which HEARTBEAT shows up to a second later."""
PILOT_FLIES = "a pilot flies"
"""Name of the phase in which the companion sends nothing because a pilot has control."""
PILOT_MODES: Final = frozenset({FlightMode.MANUAL, FlightMode.HOLD, FlightMode.RETURN, FlightMode.TAKEOFF})
"""Modes that only a pilot or one of PX4's failsafes chooses. While a pilot is flying, the companion sends nothing."""
FLIGHT_TERMINATION: Final = 8
"""HEARTBEAT.system_status (MAV_STATE_FLIGHT_TERMINATION) while PX4's kill switch is engaged or its flight termination is active: the
rotors are stopped. After a kill PX4 stays armed, usually in its mode, for COM_KILL_DISARM; a switch that is released before starts the
rotors again.
"""
FAILSAFE_STATES = frozenset({5, 6, FLIGHT_TERMINATION})
"""Values of HEARTBEAT.system_status while a PX4 failsafe is active: MAV_STATE_CRITICAL, EMERGENCY and FLIGHT_TERMINATION."""


def in_offboard(status: AutopilotStatus | None) -> bool:
    """Return whether PX4 reports OFFBOARD."""
    return status is not None and status.mode is FlightMode.OFFBOARD


def is_armed(status: AutopilotStatus | None) -> bool:
    """Return whether PX4 reports that it is armed."""
    return status is not None and status.armed


def on_ground(status: AutopilotStatus | None) -> bool:
    """Return whether PX4's land detector reports that the vehicle is on the ground."""
    return status is not None and status.landed is LandedState.ON_GROUND


def failsafe_chose(status: AutopilotStatus) -> bool:
    """Return whether a PX4 failsafe is active and has chosen the mode. In MANUAL, a pilot has control even during a failsafe."""
    return status.system_status in FAILSAFE_STATES and status.mode is not FlightMode.MANUAL


def chosen_by_pilot(status: AutopilotStatus) -> bool:
    """Return whether PX4 is in a mode that a pilot has chosen."""
    return status.mode in PILOT_MODES and not failsafe_chose(status)


def is_killed(status: AutopilotStatus | None) -> bool:
    """Return whether PX4 reports a stop of the rotors by its kill switch or its flight termination."""
    return status is not None and status.system_status == FLIGHT_TERMINATION


def flown_by_pilot(status: AutopilotStatus | None) -> bool:
    """Return whether a pilot has control: PX4 is armed, in a pilot's mode or stopped by the kill switch; nothing is sent then."""
    return status is not None and status.armed and (chosen_by_pilot(status) or is_killed(status))
