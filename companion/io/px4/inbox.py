"""Telemetry of PX4: the newest message of each kind, which the flight loop reads as records.

The three streams of the vehicle's state are decoded from the link in the flight loop itself; all other messages come from MAVSDK's
threads.
"""

from __future__ import annotations

import contextlib
import json
from collections.abc import Callable
from typing import Any

from mavsdk import MavsdkError
from mavsdk.plugins.mavlink_direct.mavlink_direct import MavlinkDirect, MavlinkMessage
from mavsdk.plugins.telemetry.telemetry import Telemetry
from msgspec.structs import replace

from companion.io.px4 import messages
from companion.io.px4.calls import NATIVE_CALL_DEADLINE_S, NativeCalls
from companion.io.px4.delta_velocity import DeltaVelocity
from companion.io.px4.link import device_error
from companion.io.px4.requests import RequestQueue
from companion.model.estimator import EstimatorReport
from companion.model.frames import flu_from_frd
from companion.model.observations import StateCounts
from companion.model.types import AutopilotStatus, FlightMode, Quat, Vec3, VehicleState
from companion.runtime.clock import Clock

POSITION_RATE_HZ = 200.0
"""Requested rate of LOCAL_POSITION_NED; PX4 delivers about 124 Hz."""
ATTITUDE_RATE_HZ = 250.0
"""Requested rate of ATTITUDE_QUATERNION, which also carries the angular rates."""
IMU_RATE_HZ = 250.0
LANDED_RATE_HZ = 10.0
ESTIMATOR_RATE_HZ = 5.0


class Inbox:
    """Store for PX4's messages. MAVSDK's threads write it as well, one assignment per message. A tuple is replaced as a whole, so a
    reader never sees a partial update.
    """

    def __init__(self, clock: Clock, requests: RequestQueue, after_heartbeat: Callable[[], None]) -> None:
        self._clock = clock
        self._requests = requests
        self._after_heartbeat = after_heartbeat
        self._position: tuple[float, Vec3, Vec3] | None = None
        self._attitude: tuple[float, Quat, Vec3, float | None] | None = None
        self._imu: tuple[float, Vec3, float | None, Vec3, int] | None = None
        self._delta_velocity_frd = DeltaVelocity()
        self._heartbeat: tuple[float, str] | None = None
        self._estimator: tuple[float, str] | None = None
        self._positions = self._attitudes = self._imus = 0
        self._landed = 0
        self._battery: tuple[float, float] = (float("nan"), float("nan"))

        self._vehicle_key: tuple[Any, ...] | None = None
        self._vehicle: VehicleState | None = None
        self._heartbeat_read: tuple[float, str] | None = None
        self._state: tuple[bool, FlightMode, int | None] = (False, FlightMode.UNKNOWN, None)
        self._estimator_read: tuple[float, str] | None = None
        self._estimator_report: EstimatorReport | None = None

    def subscribe(self, telemetry: Telemetry, direct: MavlinkDirect) -> None:
        """Subscribe to the messages that come through MAVSDK; every one that arrives is stored from then on."""
        self._telemetry = telemetry  # MAVSDK's plugin ends its subscriptions when it is garbage-collected
        telemetry.subscribe_landed_state(self._on_landed)
        telemetry.subscribe_battery(self._on_battery)
        # System.is_connected turns false seconds late; HEARTBEAT itself is the evidence, and carries armed and mode.
        direct.subscribe_message("HEARTBEAT", self._on_heartbeat)
        direct.subscribe_message("ESTIMATOR_STATUS", self._on_estimator)
        # Telemetry.status_text cuts the first long text after PX4's boot in two and keeps one of exactly 50 characters back.
        direct.subscribe_message("STATUSTEXT", self._on_status_text)

    def vehicle(self) -> VehicleState | None:
        """Return the latest fused state, or None before position, attitude, rates and IMU have all arrived. Stamps are arrival
        times.
        """
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
        """Return the latest status, or None before the first heartbeat. `heartbeat_stamp_s` is the arrival of the newest
        HEARTBEAT.
        """
        heartbeat = self._heartbeat
        if heartbeat is None:
            return None
        if heartbeat is not self._heartbeat_read:
            self._heartbeat_read = heartbeat
            self._state = messages.heartbeat_state(heartbeat[1])
        armed, mode, system_status = self._state
        voltage_v, remaining = messages.battery(*self._battery)
        return AutopilotStatus(
            heartbeat_stamp_s=heartbeat[0],
            armed=armed,
            mode=mode,
            landed=messages.landed_state(self._landed),
            battery_voltage_v=voltage_v,
            battery_remaining=remaining,
            system_status=system_status,
        )

    def estimator(self) -> EstimatorReport | None:
        """Return the latest ESTIMATOR_STATUS, stamped on arrival, or None before the first."""
        newest = self._estimator
        if newest is not None and newest is not self._estimator_read:
            self._estimator_read = newest
            self._estimator_report = messages.estimator_report(json.loads(newest[1]), newest[0])
        return self._estimator_report

    def counts(self) -> StateCounts:
        """Return the number of state messages since the link was opened."""
        return StateCounts(self._positions, self._attitudes, self._imus)

    @property
    def readers(self) -> dict[int, Callable[[float, bytes], None]]:
        """Return what stores each stream of the vehicle's state, by message id; to be called with arrival and payload of a message of
        the autopilot.
        """
        return {
            messages.LOCAL_POSITION_NED_ID: self._on_position,
            messages.ATTITUDE_QUATERNION_ID: self._on_attitude,
            messages.HIGHRES_IMU_ID: self._on_imu,
        }

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

    # Callbacks of MAVSDK: C++ threads, one message type in one thread.

    def _on_landed(self, value: Any, _: Any) -> None:
        self._landed = int(value)

    def _on_battery(self, value: Any, _: Any) -> None:
        self._battery = (value.voltage_v, value.remaining_percent)

    def _on_status_text(self, message: Any, _: Any) -> None:
        if message.component_id == messages.MAV_COMP_ID_AUTOPILOT1:
            self._requests.hear(json.loads(message.fields_json), self._clock())

    def _on_heartbeat(self, message: Any, _: Any) -> None:
        # A gimbal or camera with the same system id has a heartbeat of its own.
        if message.component_id == messages.MAV_COMP_ID_AUTOPILOT1:
            self._heartbeat = (self._clock(), message.fields_json)
            self._after_heartbeat()

    def _on_estimator(self, message: Any, _: Any) -> None:
        if message.component_id == messages.MAV_COMP_ID_AUTOPILOT1:
            self._estimator = (self._clock(), message.fields_json)


async def ask_for_streams(
    address: str,
    calls: NativeCalls,
    telemetry: Telemetry,
    direct: MavlinkDirect,
    system_id: int,
    estimator_rate_hz: float = ESTIMATOR_RATE_HZ,
) -> None:
    """Request every stream that `Inbox` stores, at its rate.

    Raises:
        DeviceError: PX4 refused one, or did not answer.
    """

    def estimator_rate(rate_hz: float) -> None:
        fields = messages.set_message_interval_json(messages.ESTIMATOR_STATUS_ID, rate_hz, system_id)
        ack = direct.send_command(MavlinkMessage("COMMAND_LONG", fields_json=fields))
        reason = messages.refusal(ack.fields_json)
        if reason is not None:
            raise _RefusedError(reason)

    for stream, rate_hz, ask in (
        ("LOCAL_POSITION_NED", POSITION_RATE_HZ, telemetry.set_rate_position_velocity_ned),
        ("ATTITUDE_QUATERNION", ATTITUDE_RATE_HZ, telemetry.set_rate_attitude_quaternion),
        ("HIGHRES_IMU", IMU_RATE_HZ, telemetry.set_rate_imu),
        ("EXTENDED_SYS_STATE", LANDED_RATE_HZ, telemetry.set_rate_landed_state),
        ("ESTIMATOR_STATUS", estimator_rate_hz, estimator_rate),
    ):
        expected = f"PX4 to stream {stream} at {rate_hz:g} Hz"
        try:
            await calls.run(expected, NATIVE_CALL_DEADLINE_S, ask, rate_hz)
        except (MavsdkError, _RefusedError) as error:
            fix = "check the link's bandwidth (MAV_x_RATE, baud) and that it is an onboard-mode MAVLink instance"
            raise device_error(address, expected, str(error).split(";")[0], fix) from None


async def stop_unread_streams(
    address: str, calls: NativeCalls, direct: MavlinkDirect, system_id: int, *, forwarded: bool
) -> None:
    """Stop the streams of PX4's onboard mode that the companion does not read, 250 messages a second: MAVSDK converts each of them to
    JSON, read or not. A ground station behind the link reads them: with `forwarded` they get PX4's default rates again.

    PX4 may lack one, and a link that loses these commands costs nothing but processor time, so answers are ignored.

    Raises:
        DeviceError: a call into MAVSDK hangs.
    """
    interval_json = messages.default_message_interval_json if forwarded else messages.stop_message_json
    for message_id in messages.UNREAD_IDS:
        command = MavlinkMessage("COMMAND_LONG", fields_json=interval_json(message_id, system_id))
        with contextlib.suppress(MavsdkError):
            await calls.run("an answer to SET_MESSAGE_INTERVAL", NATIVE_CALL_DEADLINE_S, direct.send_command, command)


class _RefusedError(Exception):
    """PX4 denied a command; the text is PX4's reason."""
