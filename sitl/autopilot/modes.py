"""PX4's navigation states, with their codes in HEARTBEAT.custom_mode and their requirements (ModeUtil/mode_requirements)."""

from __future__ import annotations

from dataclasses import dataclass
from enum import Enum, auto
from typing import Final


class NavState(Enum):
    """vehicle_status.nav_state; the value is (main mode, sub mode) of HEARTBEAT.custom_mode."""

    MANUAL = (1, 0)
    ALTCTL = (2, 0)
    POSCTL = (3, 0)
    TAKEOFF = (4, 2)
    LOITER = (4, 3)
    MISSION = (4, 4)
    RTL = (4, 5)
    LAND = (4, 6)
    ACRO = (5, 0)
    OFFBOARD = (6, 0)
    STABILIZED = (7, 0)
    # PX4 reports these two as AUTO LAND and MANUAL; a third number distinguishes them here.
    DESCEND = (4, 6, 1)
    TERMINATION = (1, 0, 1)

    @property
    def custom_mode(self) -> int:
        """Return HEARTBEAT.custom_mode."""
        numbers: tuple[int, ...] = self.value
        return numbers[0] << 16 | numbers[1] << 24

    @property
    def auto(self) -> bool:
        """Whether this is an automatic mode (MAV_MODE_FLAG_AUTO_ENABLED)."""
        numbers: tuple[int, ...] = self.value
        return numbers[0] == 4


_BY_CUSTOM = {state.value: state for state in NavState if len(state.value) == 2}


def nav_state_from_custom(main_mode: int, sub_mode: int) -> NavState | None:
    """Return the navigation state for the main and sub mode in param2 and param3 of DO_SET_MODE; AUTO without a sub mode is MISSION.

    Returns:
        None if the stub has no such mode.
    """
    if main_mode == 4 and sub_mode == 0:
        return NavState.MISSION
    return _BY_CUSTOM.get((main_mode, sub_mode if main_mode == 4 else 0))


class Need(Enum):
    """A requirement of a mode; the value is PX4's text for an unmet requirement."""

    ATTITUDE = "No valid attitude estimate"
    LOCAL_ALTITUDE = "No valid altitude estimate"
    LOCAL_POSITION = "No valid position estimate"
    GLOBAL_POSITION = "No valid global position estimate"
    HOME = "Home position not set"
    OFFBOARD_SIGNAL = "No offboard signal"
    MANUAL_CONTROL = "No manual control input"
    MISSION = "No valid mission available"


_POSITION = (Need.ATTITUDE, Need.LOCAL_ALTITUDE, Need.LOCAL_POSITION)

REQUIREMENTS: Final[dict[NavState, tuple[Need, ...]]] = {
    NavState.MANUAL: (Need.MANUAL_CONTROL,),
    NavState.ACRO: (Need.MANUAL_CONTROL,),
    NavState.STABILIZED: (Need.ATTITUDE, Need.MANUAL_CONTROL),
    NavState.ALTCTL: (Need.ATTITUDE, Need.LOCAL_ALTITUDE, Need.MANUAL_CONTROL),
    NavState.POSCTL: (*_POSITION, Need.MANUAL_CONTROL),
    NavState.TAKEOFF: _POSITION,
    NavState.LOITER: (*_POSITION, Need.GLOBAL_POSITION),
    NavState.MISSION: (*_POSITION, Need.GLOBAL_POSITION, Need.MISSION),
    NavState.RTL: (*_POSITION, Need.GLOBAL_POSITION, Need.HOME),
    NavState.LAND: _POSITION,
    NavState.DESCEND: (Need.ATTITUDE,),
    NavState.OFFBOARD: (Need.ATTITUDE, Need.OFFBOARD_SIGNAL),
    NavState.TERMINATION: (),
}

PREVENT_ARMING: Final = frozenset({NavState.RTL, NavState.LAND, NavState.DESCEND, NavState.TERMINATION})
"""Modes in which PX4 does not arm (mode_req_prevent_arming) and which it leaves on disarming."""


class OffboardKind(Enum):
    """The fields of offboard_control_mode that the setpoint stream sets."""

    ATTITUDE = auto()  # attitude or body rates: no position needed
    POSITION = auto()
    VELOCITY = auto()
    ACCELERATION = auto()


@dataclass(frozen=True, slots=True)
class Health:
    """State of the rest of the autopilot at one moment, which the commander checks."""

    attitude_valid: bool
    position_valid: bool
    height_valid: bool
    origin_set: bool
    """Whether SET_GPS_GLOBAL_ORIGIN was received, so that the global position is known as well."""
    home_set: bool
    landed: bool
    maybe_landed: bool
    """Last stage of the land detector before `landed`; it is sufficient for a disarm command."""
    setpoint_age_s: float | None
    """Time since the newest offboard setpoint arrived; None if none has arrived."""
    setpoint_kind: OffboardKind = OffboardKind.ATTITUDE
    killed: bool = False
    """Whether the kill switch is engaged."""

    def offboard_available(self, timeout_s: float) -> bool:
        """Return whether offboard setpoints are fresh and the estimate that they need is valid (offboardCheck).

        `timeout_s` is COM_OF_LOSS_T.
        """
        if self.setpoint_age_s is None or self.setpoint_age_s > timeout_s:
            return False
        return self.setpoint_kind is OffboardKind.ATTITUDE or self.position_valid

    def missing(self, state: NavState, offboard_timeout_s: float) -> Need | None:
        """Return the first requirement of a mode that is not met, or None if the mode can run."""
        for need in REQUIREMENTS[state]:
            if not self._met(need, offboard_timeout_s):
                return need
        return None

    def _met(self, need: Need, offboard_timeout_s: float) -> bool:
        match need:
            case Need.ATTITUDE:
                return self.attitude_valid
            case Need.LOCAL_ALTITUDE:
                return self.height_valid
            case Need.LOCAL_POSITION:
                return self.position_valid
            case Need.GLOBAL_POSITION:
                return self.position_valid and self.origin_set
            case Need.HOME:
                return self.home_set
            case Need.OFFBOARD_SIGNAL:
                return self.offboard_available(offboard_timeout_s)
            case Need.MANUAL_CONTROL | Need.MISSION:
                return False  # the stub has neither a radio nor a mission store
