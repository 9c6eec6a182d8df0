"""Converts inputs and a reference to an attitude setpoint and joint torques. Pure; time is an argument."""

from __future__ import annotations

import math

import msgspec

from companion.config.controller import law_class
from companion.config.loader import FlightConfig
from companion.config.vehicle import OBSERVER
from companion.control.arm_hold import ArmHold, towards
from companion.control.arm_model import manipulator_of
from companion.control.disturbance import DisturbanceObserver
from companion.control.force_observer import ForceObserver
from companion.control.gain_backoff import GainBackoff
from companion.control.hover_thrust import HoverThrust, off_the_ground
from companion.control.joint_prediction import JointPrediction
from companion.control.online import OnlineImpedance
from companion.control.sensing import CatchDetector, ForceSensing, MeanAcceleration, ObservedCatchDetector
from companion.control.slide import Slide
from companion.control.types import Controller, Law, MakeLaw, PlantState, Tuning
from companion.model.algebra import across, dot
from companion.model.codec import Record
from companion.model.constants import GRAVITY_M_S2
from companion.model.frames import euler_zyx_from_quat, quat_from_euler_zyx, quat_rotate
from companion.model.outputs import ControlLog
from companion.model.types import AttitudeSetpoint, Inputs, Joints, Reference, Vec3, VehicleState

FOLD_RATE_RAD_S = 1.2
PULL_TIME_S, PULL_LAG_S, PULL_MAX_N = 0.1, 0.05, 100.0
"""Parameters of the disturbance estimate for the safety monitors."""


class Command(Record, frozen=True):
    """Command of one tick, before the gate."""

    attitude: AttitudeSetpoint | None = None
    arm_torque_nm: Joints | None = None
    log: ControlLog | None = None


class VehicleControl:
    """Owns the control law, the force sensor's tare and the arm's holding target.

    Args:
        config: the effective configuration; `vehicle.airframe.hover_thrust` must be set.
        make_law: makes the law in place of the configured one's class.

    Raises:
        ValueError: the hover thrust is not set.
    """

    def __init__(self, config: FlightConfig, make_law: MakeLaw | None = None) -> None:
        vehicle = config.vehicle
        hover_thrust = vehicle.airframe.hover_thrust
        if hover_thrust is None:
            raise ValueError("hover_thrust must be in the effective configuration before the core starts")
        self._hover = HoverThrust(hover_thrust, vehicle.airframe.mass_kg)
        self._hover_adapts = vehicle.airframe.hover_thrust_adapt
        self._ground_clearance_m = vehicle.airframe.ground_clearance_m
        self._weight_n = vehicle.airframe.mass_kg * GRAVITY_M_S2
        self._thrust_sent = 0.0
        self._force_timeout_s = vehicle.safety.force_timeout_s
        self._arm_hold = ArmHold(vehicle)
        self._joints = JointPrediction(vehicle)
        self._backoff = GainBackoff()
        self._sensing = ForceSensing(vehicle.tool, manipulator_of(vehicle))
        self._slide = Slide(vehicle)
        self._acceleration = MeanAcceleration()
        self._observer = ForceObserver(vehicle) if vehicle.force_source == OBSERVER else None
        self._catch = CatchDetector() if self._observer is None else ObservedCatchDetector()
        self._has_net = vehicle.has_net
        self.tether_pulls = False
        """Whether the tether pulls; set only with the momentum observer, which cannot tell that from a payload: no catch is then
        confirmed."""
        self.near_surface = False
        """Whether the force of a surface is looked for: the momentum observer then holds its mean, which would hide a force that
        rises slowly."""
        self.press_direction: Vec3 | None = None
        """Direction in which the tool presses on a surface, world frame; None if it touches none. While it does, the integrators of the
        law and the estimators do not change, and the law gets only the force along this direction: an arm that held the friction, and
        a base that carried it, would work against each other.
        """
        self._state: PlantState | None = None
        """State in the last tick in which the law ran."""
        make_law = make_law or law_class(config.controller.law)
        self._law: Law = make_law(config.controller, vehicle, hover_thrust)
        self._controller: Controller = self._law
        self.online: OnlineImpedance | None = getattr(self._law, "online", None)
        """Optimisation of the law's target impedance; None if it is off or the law has none."""
        self.tuning = Tuning.FREEZE
        """What this optimisation may do in this tick."""
        self.fold_rad: Joints = tuple(map(math.radians, vehicle.fold_arm_deg))
        self._arm_target_rad: Joints | None = None
        self.tracking_error_m: float | None = None
        """Distance from the reference in the last tick in which the law ran, m."""
        self._pull = DisturbanceObserver(
            vehicle.airframe.mass_kg, (PULL_TIME_S, PULL_TIME_S, PULL_TIME_S), PULL_LAG_S, PULL_MAX_N
        )
        self.force_n: Vec3 | None = None
        """Force on the tool in the law's last tick, as the law used it or the observer estimated it, world frame; None if unknown."""
        self.disturbance_world_n: Vec3 | None = None
        """Force on the vehicle other than rotor thrust and weight, payload included, world frame, N. None on the ground."""
        self._known_n: Vec3 = (0.0, 0.0, 0.0)
        """Rotor force commanded in the last tick and weight, world frame."""

    @property
    def thrust_share(self) -> float:
        """Return the thrust of the law's last command divided by hover thrust."""
        return self._thrust_sent / self._hover.value

    def watch_joints(self, i: Inputs, dt_s: float, swings: bool) -> None:
        """Lower the feedback of the arm while a joint swings or joint states are very late, and raise it again afterwards."""
        self._backoff.update(dt_s, swings, i.t_s - i.arm.measured_s if i.arm is not None else 0.0)

    def begin_tare(self) -> None:
        """Start a new tare. The previous one stays valid until the new one is finished."""
        self._sensing.begin_tare()

    def collect_tare(self, i: Inputs) -> None:
        """Add this tick's force sample, taken at rest, to the tare, and make the present joint angles those that hold the arm."""
        if i.vehicle is None or i.arm is None:
            return
        self._arm_target_rad = i.arm.angle_rad
        if i.force is not None:
            self._sensing.collect(i.force, i.vehicle.attitude_wxyz, i.arm.angle_rad)

    def finish_tare(self) -> None:
        """Set the force sensor's bias from the collected samples."""
        self._sensing.finish_tare()

    def force_on_tool_n(self, i: Inputs) -> Vec3 | None:
        """Return the measured force on the tool, world frame, N, in a tick without the law; None if it is stale, or without a tare."""
        if i.vehicle is None or i.arm is None:
            return None
        return self._external_n(i, i.vehicle, i.arm.angle_rad)

    def _external_n(self, i: Inputs, vehicle: VehicleState, arm_rad: Joints) -> Vec3 | None:
        if i.force is None or i.t_s - i.force.stamp_s > self._force_timeout_s:
            return None
        return self._sensing.external_world_n(i.force, vehicle.attitude_wxyz, arm_rad)

    def level(self, i: Inputs) -> AttitudeSetpoint | None:
        """Return a level attitude at the current yaw without thrust, or None if the attitude is not known."""
        if i.vehicle is None:
            return None
        yaw = euler_zyx_from_quat(i.vehicle.attitude_wxyz)[2]
        return AttitudeSetpoint(quat_from_euler_zyx(0.0, 0.0, yaw), 0.0)

    def wait(self, i: Inputs) -> Command:
        """Return the command that is streamed before take-off and after touchdown: zero thrust, with the arm held in place."""
        return Command(self.level(i), self._hold(i))

    def fold(self, i: Inputs, dt_s: float) -> Command:
        """Return the command that moves the arm to its folded pose at a limited rate, without an attitude setpoint. The way is straight
        in joint space, as the mission check assumes (`companion.mission.arm_clearance`).
        """
        # The arm was not held before: start from the present angle.
        now = self._arm_target_rad or (i.arm.angle_rad if i.arm is not None else None)
        if now is None:
            return Command()
        self._arm_target_rad = towards(now, self.fold_rad, FOLD_RATE_RAD_S * dt_s)
        return Command(attitude=None, arm_torque_nm=self._hold(i))

    def hold_arm(self, i: Inputs) -> Command:
        """Return the command that keeps the arm where it was in flight, without an attitude setpoint."""
        return Command(attitude=None, arm_torque_nm=self._hold(i))

    def _hold(self, i: Inputs) -> Joints | None:
        if i.arm is None or i.vehicle is None:
            return None
        target, still = self._arm_target_rad or i.arm.angle_rad, (0.0,) * len(i.arm.angle_rad)
        angles, rates = self._joints.now(i.t_s, i.arm)
        torque = self._arm_hold.torque_nm(angles, rates, target, still, i.vehicle.attitude_wxyz)
        return self._sent(i.t_s, torque, angles, i.vehicle)

    def _sent(self, t_s: float, torque_nm: Joints | None, angle_rad: Joints, vehicle: VehicleState) -> Joints | None:
        """Return the torques for the arm: with less feedback after a joint has swung."""
        if torque_nm and self._backoff.share < 1.0:
            gravity_nm = self._arm_hold.gravity_torque_nm(angle_rad, vehicle.attitude_wxyz)
            torque_nm = self._backoff.torque_nm(torque_nm, gravity_nm)
        self._joints.sent(t_s, torque_nm)
        return torque_nm

    def fly(self, i: Inputs, dt_s: float, reference: Reference, vertical_scale: float) -> Command:
        """Run one tick of the control law. `vertical_scale` is as in `Controller.step`."""
        vehicle, arm = i.vehicle, i.arm
        if vehicle is None:
            return Command()
        arm_rad, arm_rate_rad_s = reference.arm_rad, reference.arm_rate_rad_s
        if arm is not None:
            arm_rad, arm_rate_rad_s = self._joints.now(i.t_s, arm)
        self._arm_target_rad = arm_rad
        force = self._external_n(i, vehicle, arm_rad)
        off_the_floor = vertical_scale >= 1.0 and off_the_ground(i, self._ground_clearance_m)
        pressing = self.press_direction
        airborne = off_the_floor and pressing is None
        state = PlantState(
            position_world_m=vehicle.position_world_m,
            velocity_world_m_s=vehicle.velocity_world_m_s,
            acceleration_world_m_s2=self._acceleration.update(vehicle),
            attitude_wxyz=vehicle.attitude_wxyz,
            angular_rate_body_rad_s=vehicle.angular_rate_body_rad_s,
            arm_rad=arm_rad,
            arm_rate_rad_s=arm_rate_rad_s,
            force_ext_world_n=_used(force, pressing) if self._observer is None else None,
            airborne=airborne,
            tuning=self.tuning if airborne else Tuning.FREEZE,
        )
        carries = self._catch.carries(i.t_s)
        if self._hover_adapts:
            self._hover.step(dt_s, self._thrust_sent, state, airborne, carries)
        self._watch_disturbance(dt_s, state, vertical_scale)
        if self._observer is not None:
            state = self._observe(self._observer, dt_s, i, state, carries, off_the_floor)
        self._state = state
        self._law.hover_thrust = hover = self._hover.value
        wrench = self._controller.step(dt_s, state, reference, vertical_scale)
        error = wrench.log.error
        self.tracking_error_m = math.hypot(error[0], error[1], error[2])
        thrust = wrench.collective_n * hover / self._weight_n
        if not math.isfinite(
            thrust + self.tracking_error_m
        ):  # NaN passes `thrust < 1.0` below and every limit on the error
            raise ValueError("the control law's thrust or tracking error is not finite")
        self._thrust_sent = thrust if thrust < 1.0 else 1.0
        torque, log = (wrench.arm_torque_nm or ()) if arm is not None else None, wrench.log
        attitude = wrench.attitude_wxyz
        if pressing is None:
            self._slide.end()
        elif torque is not None:
            torque = self._slide.torque_nm(dt_s, torque, state, reference.slide_world_n, pressing, force)
            friction = None if force is None else across(force, pressing)
            attitude = self._slide.attitude(dt_s, attitude, state, reference, friction)
        torque = self._sent(i.t_s, torque, arm_rad, vehicle)
        self.force_n = None if force is None else log.force_ext_world_n
        if self._observer is not None:
            self.force_n = observed = self._observer.force_n
            log = msgspec.structs.replace(log, force_observed_world_n=observed, force_measured_world_n=force)
        elif pressing is not None:
            log = msgspec.structs.replace(log, force_measured_world_n=force)
        return Command(AttitudeSetpoint(attitude, self._thrust_sent), torque, log)

    def _observe(
        self, observer: ForceObserver, dt_s: float, i: Inputs, state: PlantState, carries: bool, off_the_floor: bool
    ) -> PlantState:
        """Run the momentum observer and return the state with its estimate while something may be in the net or touches the tool.

        At other times the estimate is wind and model error, to which the arm must not yield: the law then flies without a force.
        """
        if not off_the_floor:
            observer.reset()
            return state
        assert i.vehicle is not None
        stamps_s = (i.vehicle.attitude_stamp_s, i.arm.stamp_s) if i.arm is not None else None
        pressing = self.press_direction
        observer.step(dt_s, self._known_n, state, stamps_s, carries, self.near_surface)
        if pressing is not None:
            return msgspec.structs.replace(state, force_ext_world_n=_used(observer.used_n(), pressing))
        if not carries or (self.tether_pulls and self._catch.caught_s is None):
            return state
        return msgspec.structs.replace(state, force_ext_world_n=observer.used_n())

    def _watch_disturbance(self, dt_s: float, state: PlantState, vertical_scale: float) -> None:
        """Update the disturbance estimate with the measured attitude, because a slow attitude response is not a disturbance."""
        if vertical_scale < 1.0:
            self._pull.reset()
            self.disturbance_world_n = None
            return
        weight_n = self._weight_n
        x, y, z = quat_rotate(state.attitude_wxyz, (0.0, 0.0, self._thrust_sent / self._hover.value * weight_n))
        self._known_n = (x, y, z - weight_n)
        self.disturbance_world_n = self._pull.step(dt_s, self._known_n, state.acceleration_world_m_s2, learn=True)

    def catch_s(self, t_s: float, log: ControlLog, arm_swings: bool) -> float | None:
        """Return the time of the impact in the tick that confirms a catch, and None in every other tick. An arm that swings strikes the
        sensor by itself, and confirms none.
        """
        observed = log.force_observed_world_n
        if not self._has_net or not self._catch.update(t_s, log.force_ext_world_n if observed is None else observed):
            return None
        if self.tether_pulls or arm_swings:
            self._catch.reject()
        return self._catch.caught_s

    def payload_left(self, t_s: float) -> bool:
        """Return True only in the tick that confirms that a caught payload has left the net. Call it after `fly`."""
        state = self._state
        if self._catch.caught_s is None or state is None:
            return False
        # Not from the law's log record, which is also zero while the sensor is silent.
        return self._catch.left(t_s, state.force_ext_world_n, state.acceleration_world_m_s2[2])


def _used(force: Vec3 | None, direction: Vec3 | None) -> Vec3 | None:
    """Return the force that the law gets: with a direction, only the part along it."""
    if force is None or direction is None:
        return force
    nx, ny, nz = direction
    along = dot(force, direction)
    return (along * nx, along * ny, along * nz)
