"""PX4's modes with position control (Hold, Takeoff, Land, Descend, Return, and OFFBOARD with position setpoints) and the take-off ramp.

Every mode produces a `PositionTarget`, which `PositionControl` converts to attitude and thrust.
"""

from __future__ import annotations

import math
from enum import Enum, auto

from companion.model.constants import STANDARD_GRAVITY_M_S2
from companion.model.frames import quat_rotate
from companion.model.types import Vec3
from sitl.autopilot.modes import NavState
from sitl.autopilot.params import Params
from sitl.autopilot.position_control import PositionControl, heading_rad
from sitl.autopilot.setpoints import PositionTarget
from sitl.autopilot.smoothing import Smoothing
from sitl.autopilot.types import AttitudeTarget, Estimate

_STOP_AHEAD_S = 0.6
"""Delay until full deceleration (a constant in Navigator::preproject_stop_point of PX4 1.16)."""
_MEASURED_ACCELERATION = (1, 18)
"""First version whose trajectories start with the measured acceleration; earlier ones start with none (FlightTaskAuto::activate)."""
_BLIND_DESCENT_M_S2 = 0.3
"""Downward acceleration that FlightTaskDescend commands without a vertical velocity estimate."""
_DESCENT_SLEW_M_S2 = 1.0
_REACHED_M = 0.1
_HOME_RADIUS_M = 0.3
_LEVEL_IDLE = PositionTarget(velocity_ned_m_s=(0.0, 0.0, 0.0))


class Phase(Enum):
    """Take-off state of mc_pos_control."""

    GROUND = auto()  # idle thrust
    RAMPUP = auto()
    FLIGHT = auto()


class Navigator:
    """Computes the attitude target of the active mode."""

    def __init__(self, params: Params) -> None:
        self._params = params
        self.control = PositionControl(params)
        self.phase = Phase.GROUND
        self.takeoff_done = False
        self.target = _LEVEL_IDLE
        """Setpoint of the position controller (POSITION_TARGET_LOCAL_NED)."""
        self._state: NavState | None = None
        self._ramp_since_s = 0.0
        self._hold_ned_m: Vec3 = (0.0, 0.0, 0.0)
        self._way = Smoothing((0.0, 0.0), (0.0, 0.0))
        """Trajectory to the position that the mode holds."""
        self._yaw_rad = 0.0
        self._descent_m_s = 0.0
        self._descending = False

    @property
    def descend_m_s(self) -> float:
        """Commanded descent speed for the land detector (trajectory_setpoint.velocity[2]); 0 if only a position is commanded."""
        return self.target.velocity_ned_m_s[2] or 0.0

    def enter(self, state: NavState, estimate: Estimate, home_ned_m: Vec3 | None, landed: bool) -> None:
        """Enter a mode and set the point that the mode holds."""
        previous, self._state = self._state, state
        came_from_takeoff = previous is NavState.TAKEOFF and self.takeoff_done
        self.takeoff_done = False
        self._descending = state in (NavState.LAND, NavState.DESCEND)
        self._descent_m_s = max(0.0, estimate.velocity_ned_m_s[2])
        if previous is None:
            self.settle(landed)
        if landed or previous is None or previous is NavState.OFFBOARD:
            self.control.reset()
        ax, ay, _ = quat_rotate(estimate.attitude_ned_frd, estimate.accel_frd_m_s2)
        acceleration = (ax, ay) if self._params.release >= _MEASURED_ACCELERATION else (0.0, 0.0)
        self._way = Smoothing(estimate.position_ned_m[:2], estimate.velocity_ned_m_s[:2], acceleration)
        if state is NavState.LOITER and came_from_takeoff:
            return
        self._yaw_rad = heading_rad(estimate.attitude_ned_frd)
        if state is NavState.TAKEOFF:
            x, y, z = estimate.position_ned_m
            ground_z = z if landed or home_ned_m is None else home_ned_m[2]
            self._hold_ned_m = (x, y, min(z, ground_z - self._params.real("MIS_TAKEOFF_ALT")))
        else:
            self._hold_ned_m = self._stopping_point(estimate)

    def leave(self) -> None:
        """Leave the active mode; called on disarming."""
        self._state = None

    def settle(self, landed: bool) -> None:
        """Reset the take-off phase; called while the position loop is inactive (disarmed, or with attitude or rate setpoints)."""
        self.phase = Phase.GROUND if landed else Phase.FLIGHT

    def reposition(self, position_ned_m: Vec3, yaw_rad: float | None) -> None:
        """Move the point that the mode Hold keeps (MAV_CMD_DO_REPOSITION); None keeps the yaw."""
        self._hold_ned_m = position_ned_m
        if yaw_rad is not None:
            self._yaw_rad = yaw_rad

    def step(
        self,
        t_s: float,
        dt_s: float,
        estimate: Estimate,
        home_ned_m: Vec3 | None,
        offboard: PositionTarget | None,
        *,
        armed_s: float,
        landed: bool,
        touching: bool,
    ) -> AttitudeTarget:
        """Run one period of the position loop.

        Args:
            offboard: position setpoint in OFFBOARD, or None.
            touching: whether the land detector reports ground contact.
        """
        self.target = target = self._mode_target(dt_s, estimate, home_ned_m, offboard)
        self._advance(t_s, estimate, target, armed_s, landed)
        if self.phase is Phase.GROUND or (self.phase is Phase.FLIGHT and touching):
            return self.control.idle(estimate)
        climb = self._climb_limit(t_s)
        if self._state is NavState.TAKEOFF and abs(estimate.position_ned_m[2] - self._hold_ned_m[2]) < _REACHED_M:
            self.takeoff_done = True
        return self.control.step(dt_s, estimate, target, climb)

    def _mode_target(
        self, dt_s: float, estimate: Estimate, home_ned_m: Vec3 | None, offboard: PositionTarget | None
    ) -> PositionTarget:
        if self._state is NavState.OFFBOARD:
            return offboard or _LEVEL_IDLE
        if self._state is NavState.DESCEND:
            if not estimate.height_valid:
                return PositionTarget(acceleration_ned_m_s2=(None, None, _BLIND_DESCENT_M_S2))
            return PositionTarget(velocity_ned_m_s=(None, None, self._descent(dt_s, estimate, home_ned_m)))
        if self._state is NavState.RTL and home_ned_m is not None and not self._descending:
            x, y, _ = estimate.position_ned_m
            self._hold_ned_m = (home_ned_m[0], home_ned_m[1], self._hold_ned_m[2])
            self._descending = math.hypot(x - home_ned_m[0], y - home_ned_m[1]) < _HOME_RADIUS_M
        self._way.step(dt_s, self._hold_ned_m[:2], self._params)
        x, y = self._way.position_m
        vx, vy = self._way.velocity_m_s
        ax, ay = self._way.acceleration_m_s2
        if self._descending:
            speed = self._descent(dt_s, estimate, home_ned_m)
            return PositionTarget((x, y, None), (vx, vy, speed), (ax, ay, None), yaw_rad=self._yaw_rad)
        return PositionTarget((x, y, self._hold_ned_m[2]), (vx, vy, None), (ax, ay, None), yaw_rad=self._yaw_rad)

    def _descent(self, dt_s: float, estimate: Estimate, home_ned_m: Vec3 | None) -> float:
        """Return the descent speed for the present height above home (MPC_LAND_ALT1/2), with a limited rate of change."""
        real = self._params.real
        height = (home_ned_m[2] if home_ned_m else 0.0) - estimate.position_ned_m[2]
        low, high = real("MPC_LAND_ALT2"), max(real("MPC_LAND_ALT1"), real("MPC_LAND_ALT2") + 1e-3)
        share = min(1.0, max(0.0, (height - low) / (high - low)))
        wanted = real("MPC_LAND_SPEED") + share * (real("MPC_Z_VEL_MAX_DN") - real("MPC_LAND_SPEED"))
        step = _DESCENT_SLEW_M_S2 * dt_s
        self._descent_m_s += max(-step, min(step, wanted - self._descent_m_s))
        return self._descent_m_s

    def _advance(self, t_s: float, estimate: Estimate, target: PositionTarget, armed_s: float, landed: bool) -> None:
        if self.phase is Phase.FLIGHT:
            if landed:
                self.phase = Phase.GROUND
            return
        if self.phase is Phase.RAMPUP:
            if t_s - self._ramp_since_s >= self._params.real("MPC_TKO_RAMP_T"):
                self.phase = Phase.FLIGHT
            return
        if armed_s >= self._params.real("COM_SPOOLUP_TIME") and self._wants_up(estimate, target):
            self.phase = Phase.RAMPUP
            self._ramp_since_s = t_s
            self.control.reset()

    def _wants_up(self, estimate: Estimate, target: PositionTarget) -> bool:
        z = target.position_ned_m[2]
        if z is not None:
            return z < estimate.position_ned_m[2] - 0.05
        vz, az = target.velocity_ned_m_s[2], target.acceleration_ned_m_s2[2]
        return (vz is not None and vz < 0.0) or (az is not None and az < 0.0)

    def _climb_limit(self, t_s: float) -> float | None:
        """Return the upward speed limit, m/s, or None; in the take-off ramp it rises from that of zero thrust (updateRamp)."""
        real = self._params.real
        speed = real("MPC_TKO_SPEED")
        if self.phase is Phase.RAMPUP:
            start = -STANDARD_GRAVITY_M_S2 / real("MPC_Z_VEL_P_ACC")
            share = (t_s - self._ramp_since_s) / max(real("MPC_TKO_RAMP_T"), 1e-3)
            return start + min(1.0, share) * (speed - start)
        return speed if self._state is NavState.TAKEOFF else None

    def _stopping_point(self, estimate: Estimate) -> Vec3:
        x, y, z = estimate.position_ned_m
        vx, vy, _ = estimate.velocity_ned_m_s
        ahead_s = _STOP_AHEAD_S + math.hypot(vx, vy) / (2.0 * max(self._params.real("MPC_ACC_HOR"), 0.1))
        return (x + vx * ahead_s, y + vy * ahead_s, z)
