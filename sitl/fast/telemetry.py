"""PX4's telemetry in the fast closed loop: what arrives in each tick, by the same schedule as over the wires, without messages."""

from __future__ import annotations

import math
from collections.abc import Callable

from msgspec.structs import replace
from pymavlink.dialects.v20 import common as mavlink

from companion.io.px4.delta_velocity import DeltaVelocity
from companion.io.px4.messages import Batteries, estimator_report, heartbeat_state, landed_state
from companion.io.px4.streams import (
    ATTITUDE_RATE_HZ,
    ESTIMATOR_RATE_HZ,
    HEARTBEAT_ASK_PERIOD_S,
    IMU_RATE_HZ,
    LANDED_RATE_HZ,
    POSITION_RATE_HZ,
)
from companion.model.estimator import WATCHED_RATE_HZ, EstimatorReport
from companion.model.frames import attitude_enu_flu_from_ned_frd, enu_from_ned, flu_from_frd
from companion.model.types import (
    IDENTITY_QUAT,
    AutopilotStatus,
    FlightMode,
    LandedState,
    Quat,
    Vec3,
    VehicleState,
)
from sitl.autopilot import telemetry
from sitl.autopilot.autopilot import Px4Stub
from sitl.autopilot.streams import STREAMS, Schedule
from sitl.autopilot.types import Battery, Estimate

_POSITION, _ATTITUDE = mavlink.MAVLINK_MSG_ID_LOCAL_POSITION_NED, mavlink.MAVLINK_MSG_ID_ATTITUDE_QUATERNION
_IMU = mavlink.MAVLINK_MSG_ID_HIGHRES_IMU
_ZERO: Vec3 = (0.0, 0.0, 0.0)


class FastTelemetry:
    """The newest data of each stream that the companion reads.

    Args:
        battery: returns the measurement of the power module.
        external: whether another program feeds PX4 with poses; its estimator is then watched at a higher rate.
    """

    def __init__(self, px4: Px4Stub, battery: Callable[[], Battery], *, external: bool) -> None:
        self._px4 = px4
        self._measured_battery = battery
        self._takers: dict[int, Callable[[], None]] = {
            _POSITION: self._take_position,
            _ATTITUDE: self._take_attitude,
            _IMU: self._take_imu,
            mavlink.MAVLINK_MSG_ID_HEARTBEAT: self._take_heartbeat,
            mavlink.MAVLINK_MSG_ID_EXTENDED_SYS_STATE: self._take_landed,
            mavlink.MAVLINK_MSG_ID_BATTERY_STATUS: self._take_battery,
            mavlink.MAVLINK_MSG_ID_ESTIMATOR_STATUS: self._take_estimator,
        }
        self._schedule = Schedule(False)
        for message_id in STREAMS:
            if message_id not in self._takers:
                self._schedule.set_rate(message_id, 0.0)
        for message_id, rate_hz in (
            (_POSITION, POSITION_RATE_HZ),
            (_ATTITUDE, ATTITUDE_RATE_HZ),
            (_IMU, IMU_RATE_HZ),
            (mavlink.MAVLINK_MSG_ID_EXTENDED_SYS_STATE, LANDED_RATE_HZ),
            (mavlink.MAVLINK_MSG_ID_ESTIMATOR_STATUS, WATCHED_RATE_HZ if external else ESTIMATOR_RATE_HZ),
        ):
            self._schedule.set_rate(message_id, rate_hz)
        self._sums = DeltaVelocity()
        self._position: tuple[Vec3, Vec3] = (_ZERO, _ZERO)
        self._attitude: tuple[Quat, Vec3, float | None] = (IDENTITY_QUAT, _ZERO, None)
        self._imu: tuple[Vec3, float | None, Vec3, int] = (_ZERO, None, _ZERO, 0)
        self._heartbeat: tuple[bool, FlightMode, int] | None = None
        self._landed = LandedState.UNKNOWN
        self._batteries = Batteries()
        self._estimator: EstimatorReport | None = None
        self._unread: set[int] = set()
        """Streams that have sent since the last tick."""
        self._stamp_s = {_POSITION: -math.inf, _ATTITUDE: -math.inf, _IMU: -math.inf}
        """Time of the tick that read the newest data of a stream."""
        self._heartbeat_s = 0.0
        self._asked_s = -math.inf
        """Time at which the driver last requested HEARTBEAT."""
        self._vehicle: VehicleState | None = None

    def start_sums(self) -> None:
        """Start the integral of the specific force at zero, as the driver does when the flight begins."""
        self._sums = DeltaVelocity()

    def pump(self, t_s: float) -> None:
        """Send the streams that are due at world time `t_s`; call this method after every step of the physics."""
        if t_s >= self._px4.booted_at_s:
            for message_id in self._schedule.due(t_s):
                self._takers[message_id]()
            if self._heartbeat is not None and self._heartbeat[0] and t_s - self._asked_s >= HEARTBEAT_ASK_PERIOD_S:
                self._asked_s = t_s
                self._take_heartbeat()

    def vehicle(self, t_s: float) -> VehicleState | None:
        """Return the state that the tick at world time `t_s` reads; None before position, attitude and IMU have all arrived."""
        unread, stamp_s = self._unread, self._stamp_s
        if not unread:
            return self._vehicle
        for message_id in unread:
            stamp_s[message_id] = t_s
        unread.clear()
        if -math.inf in stamp_s.values():
            return None
        (position, velocity), (attitude, rates, boot_s) = self._position, self._attitude
        force, imu_boot_s, total, gaps = self._imu
        self._vehicle = VehicleState(
            position_stamp_s=stamp_s[_POSITION],
            attitude_stamp_s=stamp_s[_ATTITUDE],
            imu_stamp_s=stamp_s[_IMU],
            position_world_m=enu_from_ned(position),
            velocity_world_m_s=enu_from_ned(velocity),
            attitude_wxyz=attitude_enu_flu_from_ned_frd(attitude),
            angular_rate_body_rad_s=flu_from_frd(rates),
            specific_force_body_m_s2=flu_from_frd(force),
            boot_s=boot_s,
            imu_boot_s=imu_boot_s,
            delta_velocity_body_m_s=flu_from_frd(total),
            imu_gaps=gaps,
        )
        return self._vehicle

    def status(self, t_s: float) -> AutopilotStatus | None:
        """Return the status that the tick at world time `t_s` reads; None before the first heartbeat."""
        if self._heartbeat is None:
            return None
        if math.isnan(self._heartbeat_s):
            self._heartbeat_s = t_s
        armed, mode, system_status = self._heartbeat
        voltage_v, remaining, battery_stamp_s = self._batteries.worst()
        return AutopilotStatus(
            heartbeat_stamp_s=self._heartbeat_s,
            armed=armed,
            mode=mode,
            landed=self._landed,
            battery_voltage_v=voltage_v,
            battery_remaining=remaining,
            battery_stamp_s=battery_stamp_s,
            system_status=system_status,
            system_id=self._px4.params.integer("MAV_SYS_ID"),
        )

    def estimator(self, t_s: float) -> EstimatorReport | None:
        """Return the newest report of the estimator that the tick at world time `t_s` reads; None before the first."""
        if self._estimator is not None and math.isnan(self._estimator.stamp_s):
            self._estimator = replace(self._estimator, stamp_s=t_s)
        return self._estimator

    def _estimate(self) -> Estimate | None:
        estimate = self._px4.estimate
        return estimate if estimate is not None and estimate.attitude_valid else None

    def _take_position(self) -> None:
        if (estimate := self._estimate()) is not None:
            self._position = (estimate.position_ned_m, estimate.velocity_ned_m_s)
            self._unread.add(_POSITION)

    def _take_attitude(self) -> None:
        if (estimate := self._estimate()) is not None:
            boot_ms = telemetry.clock_us(self._px4) // 1000
            boot_s = boot_ms * 1e-3 if boot_ms else None
            self._attitude = (estimate.attitude_ned_frd, estimate.rates_frd_rad_s, boot_s)
            self._unread.add(_ATTITUDE)

    def _take_imu(self) -> None:
        imu = self._px4.imu
        if imu is None:
            return
        total, boot_us = self._sums, telemetry.clock_us(self._px4)
        if boot_us:
            total.add(boot_us * 1e-6, imu.accel_frd_m_s2)
        self._imu = (imu.accel_frd_m_s2, total.boot_s, total.sum_m_s, total.gaps)
        self._unread.add(_IMU)

    def _take_heartbeat(self) -> None:
        message = telemetry.heartbeat(self._px4)
        self._heartbeat = heartbeat_state(message.base_mode, message.custom_mode, message.system_status)
        self._heartbeat_s = math.nan

    def _take_landed(self) -> None:
        self._landed = landed_state(telemetry.extended_sys_state(self._px4).landed_state)

    def _take_battery(self) -> None:
        self._px4.battery = self._measured_battery()
        self._batteries.take(self._px4.t_s, telemetry.battery_status(self._px4))

    def _take_estimator(self) -> None:
        message = telemetry.estimator_status(self._px4)
        if message is not None:
            self._estimator = estimator_report(message.to_dict(), math.nan)
