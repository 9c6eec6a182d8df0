"""The flight's sequence on top of the plan: wait, offboard, arm, spool up, fly the plan, touch down, disarm. Pure; time is an argument.

WAIT -> OFFBOARD -> ARM -> SPOOL -> PLAN -> TOUCHDOWN -> DISARM -> DONE
WAIT <-> READY -> OFFBOARD, where people say when
in the air, at any time:  -> PLAN (a landing from here)  or  -> AUTOPILOT_LAND, both ending in DONE
before SPOOL, at any time: -> STAND_DOWN -> DONE
"""

from __future__ import annotations

from enum import Enum

from companion.model.types import AutopilotStatus, FlightMode, LandedState

WAIT_TIMEOUT_S = 15.0
TARE_S = 1.0
"""The force sensor is weighed for so long; a flight that waits for its start does so over and over."""
LOOK_AGAIN_S = 0.1
"""A flight that waits for its start judges estimate and place so often."""
STREAM_BEFORE_OFFBOARD_S = 0.8
OFFBOARD_TIMEOUT_S = 8.0
ARM_TIMEOUT_S = 10.0
SPOOL_S = 1.2
SPOOL_SHARE = 0.7
"""Share of hover thrust at the end of spooling up; the plan's first tick takes it from there."""
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
    PLAN = "plan"
    TOUCHDOWN = "touchdown"
    DISARM = "disarm"
    AUTOPILOT_LAND = "autopilot land"
    STAND_DOWN = "stand down"
    DONE = "done"


BEFORE_LIFT = frozenset({Stage.WAIT, Stage.READY, Stage.OFFBOARD, Stage.ARM})
BEFORE_ARMING = frozenset({Stage.WAIT, Stage.READY, Stage.OFFBOARD})
"""Whoever armed PX4 now, the companion did not."""
LIFTING = frozenset({Stage.SPOOL, Stage.PLAN, Stage.TOUCHDOWN, Stage.AUTOPILOT_LAND})
DISARMING = frozenset({Stage.DISARM, Stage.STAND_DOWN})
COMMANDING = frozenset({Stage.ARM, Stage.SPOOL, Stage.PLAN, Stage.TOUCHDOWN})
"""Stages in which PX4 must be in OFFBOARD, by the companion's belief."""
PILOT_FLIES = "a pilot flies"
"""Name of the phase in which nothing is sent because somebody else has the vehicle."""
PEOPLE_CHOOSE = frozenset({FlightMode.MANUAL, FlightMode.HOLD, FlightMode.RETURN, FlightMode.TAKEOFF})
"""Modes that only people choose, unless one of PX4's failsafes has: a pilot flies, and nothing is sent against a pilot."""
FAILSAFE_STATES = frozenset({5, 6, 8})
"""MAV_STATE_CRITICAL, EMERGENCY and FLIGHT_TERMINATION: HEARTBEAT.system_status while one of PX4's failsafes acts."""


def in_offboard(status: AutopilotStatus | None) -> bool:
    """PX4 says that it is in OFFBOARD."""
    return status is not None and status.mode is FlightMode.OFFBOARD


def is_armed(status: AutopilotStatus | None) -> bool:
    """PX4 says that it is armed."""
    return status is not None and status.armed


def on_ground(status: AutopilotStatus | None) -> bool:
    """PX4's land detector says that the vehicle stands."""
    return status is not None and status.landed is LandedState.ON_GROUND


def failsafe_chose(status: AutopilotStatus) -> bool:
    """One of PX4's failsafes acts, and the mode is one that it can choose. In MANUAL a pilot steers, failsafe or not."""
    return status.system_status in FAILSAFE_STATES and status.mode is not FlightMode.MANUAL


def people_chose(status: AutopilotStatus) -> bool:
    """PX4 is in a mode that only people choose, and no failsafe has chosen it."""
    return status.mode in PEOPLE_CHOOSE and not failsafe_chose(status)


def people_fly(status: AutopilotStatus | None) -> bool:
    """PX4 is armed and in a mode that people chose: a pilot flies."""
    return status is not None and status.armed and people_chose(status)
