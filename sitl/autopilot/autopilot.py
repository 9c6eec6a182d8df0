"""The PX4 stub, with neither I/O nor a clock of its own: commander, navigator, estimator and cascade, stepped on world time.

Frames are PX4's: local NED, body FRD. Every input carries the world time of its arrival, so the same object runs behind MAVLink in
real time and inside the fast closed loop.
"""

from __future__ import annotations

import math
from collections import deque
from typing import Final

from companion.model.rotors import motor_signal
from companion.model.types import Quat, Vec3
from sitl.autopilot.cascade import Cascade
from sitl.autopilot.commander import Command, Commander, Notice, Result, Severity
from sitl.autopilot.estimator import Estimator
from sitl.autopilot.land_detector import LandDetector
from sitl.autopilot.modes import Health, NavState, OffboardKind
from sitl.autopilot.navigator import Navigator
from sitl.autopilot.origin import Origin
from sitl.autopilot.params import Params
from sitl.autopilot.position_control import heading_rad
from sitl.autopilot.setpoints import OffboardTarget, PositionTarget
from sitl.autopilot.types import (
    AttitudeTarget,
    Battery,
    Command7,
    Estimate,
    Fusion,
    ImuSample,
    LearnedBias,
    RotorCommands,
)

_COMMANDER_PERIOD_S: Final = 0.01
_POSITION_PERIOD_S: Final = 0.004
_EV_POSITION_AND_YAW: Final = 1 | 2 | 8
"""Bits of EKF2_EV_CTRL for horizontal position, vertical position and yaw. Without magnetometer, barometer and GPS, PX4 needs all of
them.
"""
_TIME_EPSILON_S: Final = 1e-9
# Looking up an Enum member costs as much as ten comparisons; these two are used at 250 Hz.
_OFFBOARD: Final = NavState.OFFBOARD
_TERMINATION: Final = NavState.TERMINATION


_SOMEWHERE = Origin(47.4, 8.5, 480.0)


class Px4Stub:
    """A PX4-like autopilot.

    Args:
        params: parameter store; changes take effect at once.
        setpoint_delay_s: delay from the arrival of a setpoint to its effect in the attitude loop.
        learned: biases that PX4 has learned before the world starts; None for an IMU without bias.
    """

    def __init__(
        self,
        params: Params,
        estimator: Estimator,
        cascade: Cascade,
        *,
        setpoint_delay_s: float = 0.0,
        learned: LearnedBias | None = None,
    ) -> None:
        self.params = params
        self.commander = Commander(params)
        self.navigator = Navigator(params)
        self.land = LandDetector(params)
        self.battery = Battery()
        self.origin: Origin | None = None
        self.home_ned_m: Vec3 | None = None
        self.notices: deque[Notice] = deque(maxlen=64)
        """STATUSTEXTs waiting to be sent; if the queue is full, the oldest are dropped."""
        self.t_s = 0.0
        self.imu: ImuSample | None = None
        """Newest IMU sample after subtraction of the learned biases, as in HIGHRES_IMU."""
        self.estimate: Estimate | None = None
        self.target = AttitudeTarget((1.0, 0.0, 0.0, 0.0), 0.0)
        """Setpoint of the attitude loop (ATTITUDE_TARGET)."""
        self._stopped: RotorCommands = (0.0,) * cascade.mixer.count
        self.rotors = self._stopped
        self.vision_received = 0
        """Number of vision poses that arrived."""
        self._estimator = estimator
        self._cascade = cascade
        self._setpoint_delay_s = setpoint_delay_s
        self._learned = learned
        self.refuses_offboard = False
        """Fault: PX4 leaves OFFBOARD and refuses to enter it."""
        self.refuses_arming = False
        self.kill_switch = False
        """Whether the kill switch of the pilot's radio is engaged: the rotors stop at once."""
        self.booted_at_s = 0.0
        """World time of the last boot, at which PX4's own clock starts. PX4 does not run before this time."""
        self.clock_ahead_s = 0.0
        """Total duration of the world's pauses, during which PX4's own clock continues."""
        self.since_sample_s = 0.0
        """Time from the last IMU sample to the arrival of the message being handled; set by the links."""
        self._queue: deque[tuple[float, OffboardTarget]] = deque()
        self._offboard: OffboardTarget | None = None
        self.setpoint_at_s: float | None = None
        """World time at which the newest offboard setpoint arrived, or None."""
        self._setpoint_kind = OffboardKind.ATTITUDE
        self._next_commander_s = -math.inf
        self._position_at_s = -math.inf
        self._flying: NavState | None = None
        self.position_controlled = False
        """Whether the position controller computes the attitude target."""

    @property
    def arrival_s(self) -> float:
        """World time at which the message that is being handled arrived."""
        return self.t_s + self.since_sample_s

    @property
    def armed(self) -> bool:
        """Whether the vehicle is armed."""
        return self.commander.armed

    @property
    def nav_state(self) -> NavState:
        """Active mode."""
        return self.commander.nav_state

    @property
    def fusion(self) -> Fusion:
        """Innovation test ratios and accuracy of vision."""
        return self._estimator.fusion()

    @property
    def landed(self) -> bool:
        """Whether the land detector reports landed."""
        return self.land.landed

    def step(self, imu: ImuSample) -> RotorCommands:
        """Advance to the sample's world time and return normalised rotor commands (0 to 1); all are zero while disarmed."""
        t_s = imu.t_s
        if self._learned is not None:
            imu = _without(imu, self._learned)
        dt_s = t_s - self.imu.t_s if self.imu is not None else 0.0
        self.imu = imu
        self.t_s = t_s
        if t_s < self.booted_at_s:
            return self._stopped
        self._estimator.predict(imu)
        if imu.baro_m is not None and self.params.integer("EKF2_BARO_CTRL"):
            descends = self.armed and self.nav_state in (NavState.LAND, NavState.DESCEND)
            self._estimator.fuse_barometer(imu.baro_m, descends)
        self.estimate = estimate = self._estimator.estimate(1e-6 * self.params.integer("EKF2_NOAID_TOUT"))
        queue = self._queue
        while queue and queue[0][0] <= t_s + _TIME_EPSILON_S:
            self._offboard = queue.popleft()[1]
        if t_s >= self._next_commander_s:
            self._next_commander_s = t_s + _COMMANDER_PERIOD_S - _TIME_EPSILON_S
            self._command_cycle(t_s, estimate)
        commander = self.commander
        if not commander.armed or commander.nav_state is _TERMINATION:
            self.target = AttitudeTarget(estimate.attitude_ned_frd, 0.0)
            self.rotors = self._stopped
            return self._stopped
        self._choose_target(t_s, estimate)
        if dt_s > 0.0:
            self.rotors = self._cascade.step(dt_s, estimate, self.target)  # also while killed, as in PX4
            factor = self.params.real("THR_MDL_FAC")
            if factor > 0.0:
                self.rotors = tuple([motor_signal(command, factor) for command in self.rotors])
        if self.kill_switch:
            self.rotors = self._stopped
        return self.rotors

    def on_setpoint(self, t_s: float, target: OffboardTarget) -> None:
        """Process an offboard setpoint that arrived at world time `t_s`."""
        self.setpoint_at_s = t_s
        self._setpoint_kind = target.kind if isinstance(target, PositionTarget) else OffboardKind.ATTITUDE
        self._queue.append((t_s + self._setpoint_delay_s, target))

    def on_vision(self, t_s: float, position_ned_m: Vec3, attitude_ned_frd: Quat) -> bool:
        """Process a vision pose that arrived at world time `t_s`; return whether EKF2_EV_CTRL enables its fusion."""
        self.vision_received += 1
        if self.params.integer("EKF2_EV_CTRL") & _EV_POSITION_AND_YAW != _EV_POSITION_AND_YAW:
            return False
        taken_s = t_s - self.params.real("EKF2_EV_DELAY") / 1000.0
        self._estimator.fuse_vision(taken_s, position_ned_m, attitude_ned_frd, self.params.real("EKF2_EVP_NOISE"))
        return True

    def on_command(self, t_s: float, command: int, params: Command7) -> Result:
        """Execute a MAV_CMD that arrived at world time `t_s`. `params` are param1 to param7, with positions in degrees and m."""
        refusal = self._refusal(command, params)
        if refusal is not None:
            self.notices.append(Notice(Severity.CRITICAL, refusal))
            return Result.TEMPORARILY_REJECTED
        was_armed = self.commander.armed
        result = self.commander.command(t_s, command, params, self._health(t_s))
        if self.commander.armed and not was_armed:
            self._on_arming()
        if result is Result.ACCEPTED and command == Command.DO_REPOSITION and self.estimate is not None:
            self._follow_mode(self.estimate)
            self._reposition(params)
        self._collect_notices()
        return result

    def _refusal(self, command: int, params: Command7) -> str | None:
        if self.refuses_offboard and command == Command.DO_SET_MODE and params[1] == NavState.OFFBOARD.value[0]:
            return "Switching to Offboard is currently not available"
        if self.refuses_arming and command == Command.COMPONENT_ARM_DISARM and params[0] == 1.0:
            return "Arming denied: Resolve system health failures first"
        return None

    def reboot(self, for_s: float) -> None:
        """Restart PX4, which keeps only its parameters and runs again after `for_s`."""
        self.booted_at_s = self.t_s + for_s
        self.commander, self.navigator = Commander(self.params), Navigator(self.params)
        self.land, self._estimator = LandDetector(self.params), Estimator()
        self.estimate = self.origin = self.home_ned_m = self._offboard = self.setpoint_at_s = self._flying = None
        self.target, self.rotors = AttitudeTarget((1.0, 0.0, 0.0, 0.0), 0.0), self._stopped
        self._queue.clear()
        self._cascade.reset()
        self._next_commander_s = self._position_at_s = -math.inf
        self.position_controlled = False

    def start_over(self) -> None:
        """Return to the state before the first step: world time starts over. Parameters and the global origin stay."""
        origin = self.origin
        self.t_s = 0.0
        self.reboot(0.0)
        self.origin, self.imu, self.battery = origin, None, Battery()
        self.notices.clear()
        self.vision_received = 0
        self.clock_ahead_s = self.since_sample_s = 0.0

    def pilot_sets_mode(self, state: NavState) -> None:
        """Change the mode as a pilot's mode switch does; set origin and home position first if they are not known."""
        estimate = self.estimate
        if estimate is None:
            return
        if self.origin is None:
            self.set_origin(_SOMEWHERE)
        if self.home_ned_m is None:
            self.home_ned_m = estimate.position_ned_m
        self.commander.change_mode(state, self._health(self.t_s))

    def set_origin(self, origin: Origin) -> None:
        """Set the global origin (SET_GPS_GLOBAL_ORIGIN), from which the global position follows."""
        self.origin = origin

    def arming_problem(self) -> str | None:
        """Return why arming would be refused now, or None."""
        return self.commander.arming_problem(self._health(self.t_s))

    def _command_cycle(self, t_s: float, estimate: Estimate) -> None:
        commander = self.commander
        self.land.update(
            t_s,
            commander.armed,
            estimate,
            self.target.thrust,
            self.position_controlled,
            self.navigator.descend_m_s,
        )
        if self.home_ned_m is None and self.origin is not None and estimate.position_valid:
            self.home_ned_m = estimate.position_ned_m
        health = self._health(t_s)
        if commander.armed and commander.nav_state is NavState.TAKEOFF and self.navigator.takeoff_done:
            commander.change_mode(NavState.LOITER, health)  # COM_TAKEOFF_ACT 0
        commander.update(t_s, health)
        self._follow_mode(estimate)
        self._collect_notices()

    def _follow_mode(self, estimate: Estimate) -> None:
        state = self.commander.nav_state if self.commander.armed else None
        if state is self._flying:
            return
        self._flying = state
        self._position_at_s = -math.inf
        if state is None:
            self.navigator.leave()
        else:
            self.navigator.enter(state, estimate, self.home_ned_m, self.land.landed)

    def _choose_target(self, t_s: float, estimate: Estimate) -> None:
        offboard = self._offboard if self.commander.nav_state is _OFFBOARD else None
        if isinstance(offboard, AttitudeTarget):
            self.position_controlled = False
            self.navigator.settle(self.land.landed)
            self.target = offboard
            return
        self.position_controlled = True
        since_s = t_s - self._position_at_s
        if since_s < _POSITION_PERIOD_S - _TIME_EPSILON_S:
            return
        self._position_at_s = t_s
        self.target = self.navigator.step(
            t_s,
            since_s if math.isfinite(since_s) else 0.0,
            estimate,
            self.home_ned_m,
            offboard,
            armed_s=t_s - (self.commander.armed_at_s or 0.0),
            landed=self.land.landed,
            touching=self.land.ground_contact or self.land.maybe_landed,
        )

    def _on_arming(self) -> None:
        self._cascade.reset()
        estimate = self.estimate
        if estimate is not None and estimate.position_valid and self.params.integer("COM_HOME_EN"):
            self.home_ned_m = estimate.position_ned_m

    def _reposition(self, params: Command7) -> None:
        if self.origin is None or self.estimate is None:
            return
        known = self.origin.global_deg_m(self.estimate.position_ned_m)
        wanted = (params[4], params[5], params[6])
        where = tuple(new if math.isfinite(new) else old for new, old in zip(wanted, known, strict=True))
        yaw = params[3] if math.isfinite(params[3]) else None
        self.navigator.reposition(self.origin.local_ned_m(where[0], where[1], where[2]), yaw)

    def _health(self, t_s: float) -> Health:
        estimate = self.estimate
        origin_set = self.origin is not None
        return Health(
            attitude_valid=estimate is not None and estimate.attitude_valid,
            position_valid=estimate is not None and estimate.position_valid,
            height_valid=estimate is not None and estimate.height_valid,
            origin_set=origin_set,
            home_set=origin_set and self.home_ned_m is not None,
            landed=self.land.landed,
            maybe_landed=self.land.maybe_landed,
            setpoint_age_s=None if self.setpoint_at_s is None or self.refuses_offboard else t_s - self.setpoint_at_s,
            setpoint_kind=self._setpoint_kind,
            killed=self.kill_switch,
        )

    def _collect_notices(self) -> None:
        if self.commander.notices:
            self.notices.extend(self.commander.notices)
            self.commander.notices.clear()

    @property
    def heading_rad(self) -> float:
        """Return the estimated yaw in rad; 0 before the first estimate."""
        return heading_rad(self.estimate.attitude_ned_frd) if self.estimate is not None else 0.0


def _without(imu: ImuSample, learned: LearnedBias) -> ImuSample:
    p, q, r = imu.gyro_frd_rad_s
    x, y, z = imu.accel_frd_m_s2
    bp, bq, br = learned.gyro_frd_rad_s
    return ImuSample(imu.t_s, (p - bp, q - bq, r - br), (x, y, z - learned.accel_down_m_s2), imu.baro_m)
