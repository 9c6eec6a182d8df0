"""PX4's commander, with neither I/O nor a clock: arming state, user intention, failsafe fallbacks and automatic disarming.

Sources: PX4 1.16 Commander.cpp, UserModeIntention.cpp, failsafe.cpp, HealthAndArmingChecks. While PX4 is disarmed, any mode can be
chosen, but arming may then be refused. While it is armed, a mode that cannot run is refused. `nav_state` is the active mode: the user
intention, or a failsafe mode while the intended one cannot run.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from enum import IntEnum
from typing import Final

from sitl.autopilot.modes import PREVENT_ARMING, Health, NavState, nav_state_from_custom
from sitl.autopilot.params import Params

FORCE_MAGIC: Final = 21196
OFFBOARD_LOSS_EXTRA_S: Final = 0.05
"""Delay of the failsafe after COM_OF_LOSS_T has passed, measured on PX4 1.16."""


class Result(IntEnum):
    """Result of a command (MAV_RESULT)."""

    ACCEPTED = 0
    TEMPORARILY_REJECTED = 1
    DENIED = 2
    UNSUPPORTED = 3
    FAILED = 4


class Command(IntEnum):
    """MAV_CMD numbers that the commander handles."""

    NAV_RETURN_TO_LAUNCH = 20
    NAV_LAND = 21
    NAV_TAKEOFF = 22
    DO_SET_MODE = 176
    DO_FLIGHTTERMINATION = 185
    DO_REPOSITION = 192
    PREFLIGHT_REBOOT_SHUTDOWN = 246
    COMPONENT_ARM_DISARM = 400
    RUN_PREARM_CHECKS = 401


class Severity(IntEnum):
    """Severity of a STATUSTEXT (MAV_SEVERITY)."""

    CRITICAL = 2
    ERROR = 3
    WARNING = 4
    NOTICE = 5
    INFO = 6


@dataclass(frozen=True, slots=True)
class Notice:
    """One STATUSTEXT."""

    severity: Severity
    text: str


class Commander:
    """Arming and mode logic. `notices` collects STATUSTEXTs for ground stations; the caller empties the list."""

    def __init__(self, params: Params) -> None:
        self._params = params
        self.armed = False
        self.user_intention = NavState.LOITER
        """vehicle_status.nav_state_user_intention; PX4 boots into Hold."""
        self.nav_state = NavState.LOITER
        self.failsafe = False
        self.armed_at_s: float | None = None
        self.taken_off = False
        """Whether the vehicle has taken off since arming."""
        self.notices: list[Notice] = []
        self._intention_after_disarm = NavState.LOITER
        self._disarm_since_s: float | None = None
        self._killed_since_s: float | None = None

    def command(
        self, t_s: float, command: int, params: tuple[float, float, float, float, float, float, float], health: Health
    ) -> Result:
        """Handle COMMAND_LONG or COMMAND_INT as `Commander::handle_command` does; `params` are param1 to param7."""
        match command:
            case Command.COMPONENT_ARM_DISARM:
                return self._arm_disarm(t_s, params[0], params[1], health)
            case Command.DO_SET_MODE:
                return self._set_mode(params[0], params[1], params[2], health)
            case Command.NAV_TAKEOFF:
                return self._intend_or_reject(NavState.TAKEOFF, health)
            case Command.NAV_LAND:
                return self._intend_or_reject(NavState.LAND, health)
            case Command.NAV_RETURN_TO_LAUNCH:
                return self._intend_or_reject(NavState.RTL, health)
            case Command.DO_REPOSITION:
                if not math.isfinite(params[1]) or int(params[1]) != 1:
                    return Result.UNSUPPORTED
                return self._intend_or_reject(NavState.LOITER, health)
            case Command.DO_FLIGHTTERMINATION:
                if not params[0] > 0.5 or not self.armed:
                    return Result.DENIED
                return self._intend_or_reject(NavState.TERMINATION, health)
            case Command.RUN_PREARM_CHECKS:
                return Result.ACCEPTED
            case Command.PREFLIGHT_REBOOT_SHUTDOWN:
                return Result.DENIED  # never while armed; while disarmed, the stub does not restart its process
            case _:
                return Result.UNSUPPORTED

    def change_mode(self, state: NavState, health: Health) -> bool:
        """Set the user intention (UserModeIntention::change); return False if the mode is refused, in which case nothing changes."""
        if self.nav_state is NavState.TERMINATION:
            return False
        if self.armed and health.missing(state, self._offboard_timeout_s()) is not None:
            return False
        self.user_intention = state
        if state not in PREVENT_ARMING:
            self._intention_after_disarm = state
        if not self.armed:
            self.nav_state = state
        return True

    def arm(self, t_s: float, health: Health) -> bool:
        """Arm on an external command; return False if arming is refused (see `arming_problem`)."""
        if self.armed:
            return True
        if self.arming_problem(health) is not None:
            # PX4 reports an unmet mode requirement as an event only; STATUSTEXT carries this general text.
            self._notify(Severity.CRITICAL, "Arming denied: Resolve system health failures first")
            return False
        self.armed = True
        self.armed_at_s = t_s
        self.taken_off = False
        self._disarm_since_s = None
        self._notify(Severity.INFO, "Armed by external command")
        return True

    def arming_problem(self, health: Health) -> str | None:
        """Return why arming would be refused in the present mode, or None."""
        if health.killed:
            return "Kill switch engaged"
        if self.user_intention in PREVENT_ARMING:
            return "Mode not suitable for arming"
        missing = health.missing(self.user_intention, self._offboard_timeout_s())
        return missing.value if missing else None

    def disarm(self, landed: bool, forced: bool, reason: str) -> bool:
        """Disarm; return False if disarming is refused because the vehicle has not landed and `forced` is false."""
        if not self.armed:
            return True
        if not forced and not landed:
            self._notify(Severity.CRITICAL, "Disarming denied: not landed")
            return False
        self.armed = False
        self.armed_at_s = None
        self.taken_off = False
        self._disarm_since_s = None
        if self.nav_state is not NavState.TERMINATION:
            self.user_intention = self._intention_after_disarm
            self.nav_state = self.user_intention
        self.failsafe = False
        self._notify(Severity.INFO, f"Disarmed by {reason}")
        return True

    def update(self, t_s: float, health: Health) -> None:
        """Run one cycle of the commander: kill switch, take-off detection, failsafe and automatic disarming."""
        self._watch_kill_switch(t_s, health)
        if not self.armed:
            self.nav_state = self.user_intention if self.nav_state is not NavState.TERMINATION else self.nav_state
            return
        if not health.landed and not self.taken_off:
            self.taken_off = True
            self._notify(Severity.INFO, "Takeoff detected")
        self._fail_safe(health)
        self._auto_disarm(t_s, health)

    def _watch_kill_switch(self, t_s: float, health: Health) -> None:
        if health.killed is (self._killed_since_s is None):
            self._killed_since_s = t_s if health.killed else None
            severity = Severity.INFO if health.landed or not health.killed else Severity.CRITICAL
            self._notify(severity, "Kill engaged" if health.killed else "Kill disengaged")
        killed_s = t_s - self._killed_since_s if self._killed_since_s is not None else -math.inf
        if self.armed and killed_s >= self._params.real("COM_KILL_DISARM"):
            self.disarm(landed=True, forced=True, reason="kill-switch")

    def _fail_safe(self, health: Health) -> None:
        previous = self.nav_state
        state = self._select(health)
        if state is None:
            self.disarm(landed=True, forced=True, reason="failsafe")
            return
        self.nav_state = state
        self.failsafe = state is not self.user_intention
        if self.failsafe and state is not previous:
            self._notify(Severity.CRITICAL, f"Failsafe activated: {_FAILSAFE_NAMES.get(state, state.name)}")

    def _select(self, health: Health) -> NavState | None:
        """Return the mode to fly (as checkModeFallback and getSelectedAction choose it), or None to disarm at once."""
        if self.nav_state is NavState.TERMINATION:
            return NavState.TERMINATION
        timeout_s = self._offboard_timeout_s() + OFFBOARD_LOSS_EXTRA_S
        if health.missing(self.user_intention, timeout_s) is None:
            return self.user_intention
        first = NavState.RTL
        if self.user_intention is NavState.OFFBOARD and not health.offboard_available(timeout_s):
            action = self._params.integer("COM_OBL_RC_ACT")
            if action == 7:
                return None
            # 0 to 2 are manual modes; without a radio PX4 returns to launch.
            first = {3: NavState.RTL, 4: NavState.LAND, 5: NavState.LOITER, 6: NavState.TERMINATION}.get(action, first)
        fallbacks = (
            (first, NavState.RTL, NavState.LAND, NavState.DESCEND) if first is NavState.LOITER else _FALLBACKS[first]
        )
        for state in fallbacks:
            if health.missing(state, timeout_s) is None:
                return state
        return NavState.TERMINATION

    def _auto_disarm(self, t_s: float, health: Health) -> None:
        delay_s = self._params.real("COM_DISARM_LAND" if self.taken_off else "COM_DISARM_PRFLT")
        if not self.armed or delay_s <= 0.0 or not health.landed:
            self._disarm_since_s = None
            return
        if self._disarm_since_s is None:
            self._disarm_since_s = t_s
            if self.taken_off:
                self._notify(Severity.INFO, "Landing detected")
        if t_s - self._disarm_since_s >= delay_s:
            self.disarm(landed=True, forced=False, reason="landing" if self.taken_off else "auto preflight disarming")

    def _arm_disarm(self, t_s: float, action: float, magic: float, health: Health) -> Result:
        forced = math.isfinite(magic) and round(magic) == FORCE_MAGIC
        if not math.isfinite(action) or round(action) not in (0, 1):
            self._notify(Severity.CRITICAL, f"Unsupported ARM_DISARM param: {action:.3f}")
            return Result.UNSUPPORTED
        if round(action) == 1:  # an external command runs the checks even when it is forced
            done = self.arm(t_s, health)
        else:
            done = self.disarm(health.landed or health.maybe_landed, forced, "external command")
        return Result.ACCEPTED if done else Result.TEMPORARILY_REJECTED

    def _set_mode(self, base_mode: float, main_mode: float, sub_mode: float, health: Health) -> Result:
        if not all(map(math.isfinite, (base_mode, main_mode))):
            return Result.DENIED
        if not int(base_mode) & 1:  # MAV_MODE_FLAG_CUSTOM_MODE_ENABLED; PX4's base modes all need a radio or a mission
            return Result.TEMPORARILY_REJECTED
        state = nav_state_from_custom(int(main_mode), int(sub_mode) if math.isfinite(sub_mode) else 0)
        if state is None:
            self._notify(Severity.CRITICAL, "Unsupported auto mode")
            return Result.TEMPORARILY_REJECTED
        return Result.ACCEPTED if self.change_mode(state, health) else Result.TEMPORARILY_REJECTED

    def _intend_or_reject(self, state: NavState, health: Health) -> Result:
        if self.change_mode(state, health):
            return Result.ACCEPTED
        self._notify(Severity.CRITICAL, f"Switching to {_MODE_NAMES[state]} is currently not available")
        return Result.TEMPORARILY_REJECTED

    def _offboard_timeout_s(self) -> float:
        return self._params.real("COM_OF_LOSS_T")

    def _notify(self, severity: Severity, text: str) -> None:
        self.notices.append(Notice(severity, text))


_FALLBACKS: Final = {
    NavState.RTL: (NavState.RTL, NavState.LAND, NavState.DESCEND),
    NavState.LAND: (NavState.LAND, NavState.DESCEND),
    NavState.TERMINATION: (NavState.TERMINATION,),
}
_FAILSAFE_NAMES: Final = {
    NavState.RTL: "Return",
    NavState.LAND: "Land",
    NavState.DESCEND: "Descend",
    NavState.LOITER: "Hold",
    NavState.TERMINATION: "Terminate",
}
_MODE_NAMES = {
    NavState.TAKEOFF: "Takeoff",
    NavState.LAND: "Land",
    NavState.RTL: "Return",
    NavState.LOITER: "Hold",
    NavState.TERMINATION: "Termination",
}
