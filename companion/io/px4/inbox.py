"""Telemetry of PX4: the newest message of each kind, which the flight loop reads as records.

The three fast streams of the vehicle's state are decoded by `companion.io.px4.messages`, all other messages by pymavlink.
"""

from __future__ import annotations

import contextlib
from collections.abc import Callable, Iterator
from typing import Any

from msgspec.structs import replace
from pymavlink.dialects.v20 import common as mavlink

from companion.io.px4 import messages
from companion.io.px4.delta_velocity import DeltaVelocity
from companion.io.px4.requests import RequestQueue
from companion.model.estimator import EstimatorReport
from companion.model.frames import flu_from_frd
from companion.model.observations import StateCounts
from companion.model.types import AutopilotStatus, FlightMode, LandedState, Quat, Vec3, VehicleState


class Inbox:
    """Store for PX4's messages.

    Args:
        requests: receives answers to commands and status texts.
        after_heartbeat: called after each HEARTBEAT.
    """

    def __init__(self, requests: RequestQueue, after_heartbeat: Callable[[], None]) -> None:
        self._requests = requests
        self._after_heartbeat = after_heartbeat
        self._position: tuple[float, Vec3, Vec3] | None = None
        self._attitude: tuple[float, Quat, Vec3, float | None] | None = None
        self._imu: tuple[float, Vec3, float | None, Vec3, int] | None = None
        self._delta_velocity_frd = DeltaVelocity()
        self.system_id: int | None = None
        """MAVLink system id of PX4; None before it is known."""
        self._heartbeat: tuple[float, bool, FlightMode, int] | None = None
        self._estimator: EstimatorReport | None = None
        self._positions = self._attitudes = self._imus = 0
        self._landed = LandedState.UNKNOWN
        self._batteries = messages.Batteries()
        self._radio: bool | None = None
        self._decoder = mavlink.MAVLink(None)
        self._listeners: dict[int, list[Callable[[Any], None]]] = {}
        self._takers: dict[int, Callable[[float, Any], None]] = {
            mavlink.MAVLINK_MSG_ID_HEARTBEAT: self._on_heartbeat,
            mavlink.MAVLINK_MSG_ID_COMMAND_ACK: self._on_ack,
            mavlink.MAVLINK_MSG_ID_EXTENDED_SYS_STATE: self._on_landed,
            mavlink.MAVLINK_MSG_ID_BATTERY_STATUS: self._batteries.take,
            mavlink.MAVLINK_MSG_ID_SYS_STATUS: self._on_sys_status,
            mavlink.MAVLINK_MSG_ID_ESTIMATOR_STATUS: self._on_estimator,
            mavlink.MAVLINK_MSG_ID_STATUSTEXT: self._on_status_text,
        }
        self.readers: dict[int, Callable[[float, bytes], None]] = {
            messages.LOCAL_POSITION_NED_ID: self._on_position,
            messages.ATTITUDE_QUATERNION_ID: self._on_attitude,
            messages.HIGHRES_IMU_ID: self._on_imu,
        }
        """What stores each stream of the vehicle's state, by message id; called with arrival and payload of PX4's message."""
        self._vehicle_key: tuple[Any, ...] | None = None
        self._vehicle: VehicleState | None = None

    def start_sums(self) -> None:
        """Start the integral of the specific force at zero, also that of the newest sample; called when the flight begins."""
        self._delta_velocity_frd, self._vehicle_key = DeltaVelocity(), None
        if self._imu is not None:
            stamp_s, force_m_s2, boot_s, _, _ = self._imu
            self._imu = (stamp_s, force_m_s2, boot_s, (0.0, 0.0, 0.0), 0)

    def take(self, stamp_s: float, message_id: int, frame: bytes) -> None:
        """Store a message of the autopilot that is not one of `readers`, if the companion reads it or a question waits for it.

        Args:
            stamp_s: arrival on the flight clock.
            frame: whole frame with a valid checksum.
        """
        taker, listeners = self._takers.get(message_id), self._listeners.get(message_id)
        if taker is None and not listeners:
            return
        with contextlib.suppress(mavlink.MAVError):  # a field that pymavlink does not accept
            message = self._decoder.decode(bytearray(frame))
            if taker is not None:
                taker(stamp_s, message)
            for listener in listeners or ():
                listener(message)

    @contextlib.contextmanager
    def listening(self, message_id: int, listener: Callable[[Any], None]) -> Iterator[None]:
        """While the context is open, call `listener` with each message of this id, as pymavlink decodes it."""
        listeners = self._listeners.setdefault(message_id, [])
        listeners.append(listener)
        try:
            yield
        finally:
            listeners.remove(listener)

    def vehicle(self) -> VehicleState | None:
        """Return the latest fused state, or None before all of its parts have arrived. Stamps are arrival times."""
        position, attitude, imu = self._position, self._attitude, self._imu
        if position is None or attitude is None or imu is None:
            return None
        key = (position[0], attitude[0], imu[0])
        if key != self._vehicle_key:
            self._vehicle_key = key
            state = messages.vehicle_state(
                position[0], position[1], position[2], attitude[0], attitude[1], attitude[2], imu[0], imu[1]
            )
            if state is not None:
                total = flu_from_frd(imu[3])
                state = replace(
                    state, boot_s=attitude[3], imu_boot_s=imu[2], delta_velocity_body_m_s=total, imu_gaps=imu[4]
                )
            # Values that are not finite count as not received: the last valid state stays and becomes stale.
            self._vehicle = state or self._vehicle
        return self._vehicle

    def status(self) -> AutopilotStatus | None:
        """Return the latest status, or None before the first heartbeat. `heartbeat_stamp_s` is the newest one's arrival."""
        if self._heartbeat is None:
            return None
        stamp_s, armed, mode, system_status = self._heartbeat
        voltage_v, remaining, battery_stamp_s = self._batteries.worst()
        return AutopilotStatus(
            heartbeat_stamp_s=stamp_s,
            armed=armed,
            mode=mode,
            landed=self._landed,
            battery_voltage_v=voltage_v,
            battery_remaining=remaining,
            battery_stamp_s=battery_stamp_s,
            system_status=system_status,
            system_id=self.system_id,
            radio=self._radio,
        )

    def estimator(self) -> EstimatorReport | None:
        """Return the latest ESTIMATOR_STATUS, stamped on arrival, or None before the first."""
        return self._estimator

    def counts(self) -> StateCounts:
        """Return the number of state messages since the link was opened."""
        return StateCounts(self._positions, self._attitudes, self._imus)

    def _on_position(self, stamp_s: float, payload: bytes) -> None:
        self._position = (stamp_s, *messages.local_position_ned(payload))
        self._positions += 1

    def _on_attitude(self, stamp_s: float, payload: bytes) -> None:
        self._attitude = (stamp_s, *messages.attitude_quaternion(payload))
        self._attitudes += 1

    def _on_imu(self, stamp_s: float, payload: bytes) -> None:
        force_m_s2, boot_s = messages.highres_imu(payload)
        total = self._delta_velocity_frd
        if boot_s is not None:
            total.add(boot_s, force_m_s2)
        self._imu = (stamp_s, force_m_s2, total.boot_s, total.sum_m_s, total.gaps)
        self._imus += 1

    def _on_heartbeat(self, stamp_s: float, message: Any) -> None:
        state = messages.heartbeat_state(message.base_mode, message.custom_mode, message.system_status)
        self._heartbeat = (stamp_s, *state)
        self._after_heartbeat()

    def _on_ack(self, stamp_s: float, message: Any) -> None:
        self._requests.answer(message.command, message.result, stamp_s)

    def _on_landed(self, stamp_s: float, message: Any) -> None:
        self._landed = messages.landed_state(message.landed_state)

    def _on_sys_status(self, stamp_s: float, message: Any) -> None:
        self._radio = messages.radio_received(message.onboard_control_sensors_present)

    def _on_estimator(self, stamp_s: float, message: Any) -> None:
        self._estimator = messages.estimator_report(message.to_dict(), stamp_s)

    def _on_status_text(self, stamp_s: float, message: Any) -> None:
        self._requests.hear(message.to_dict(), stamp_s)
