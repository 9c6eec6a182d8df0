"""PX4 through MAVSDK's native binding.

MAVSDK's callbacks come from C++ threads and do nothing but keep the newest values; frames are converted when the flight loop asks.
The hot path (`send_attitude`, `send_vision`) is one synchronous native call each.
"""

from __future__ import annotations

import asyncio
import logging
import re
import time
from collections.abc import Callable
from concurrent.futures import Future, ThreadPoolExecutor, wait
from dataclasses import dataclass, replace
from types import TracebackType
from typing import Any, Self, TypeVar

from mavsdk import ComponentType, Configuration, Mavsdk, MavsdkError
from mavsdk.plugins.info.info import Info
from mavsdk.plugins.mavlink_direct.mavlink_direct import MavlinkDirect, MavlinkDirectResult, MavlinkMessage
from mavsdk.plugins.mocap.mocap import AngleBody, Covariance, Mocap, PositionBody, VisionPositionEstimate
from mavsdk.plugins.param.param import Param, ParamError, ParamResult
from mavsdk.plugins.telemetry.telemetry import Telemetry

from companion.clock import Clock
from companion.config.vehicle import AutopilotDevice
from companion.io import autopilot_messages as messages
from companion.io.autopilot_link import (
    add_connection,
    check_address,
    device_error,
    first_autopilot,
    quiet_native_log,
    udp_ports,
)
from companion.io.autopilot_requests import RequestDesk
from companion.io.edges import DeviceError
from companion.types import (
    AttitudeSetpoint,
    AutopilotRequest,
    AutopilotStatus,
    FlightMode,
    MocapPose,
    Quat,
    Vec3,
    VehicleState,
)

POSITION_RATE_HZ = 200.0
"""Asked of LOCAL_POSITION_NED; PX4 gives about 124 Hz."""
ATTITUDE_RATE_HZ = 250.0
"""Asked of ATTITUDE_QUATERNION, which carries the angular rates too."""
IMU_RATE_HZ = 250.0
"""Asked of HIGHRES_IMU."""
LANDED_RATE_HZ = 10.0
"""Asked of EXTENDED_SYS_STATE."""
_CONNECT_DEADLINE_S = 5.0
# MAVSDK sends a command or parameter request up to six times, 0.5 s apart.
_NATIVE_CALL_DEADLINE_S = 5.0
_CLOSE_DEADLINE_S = 4.0
_PARAM_NAME = re.compile(r"[A-Z0-9_]{1,16}")
# One NaN: PX4 takes EKF2_EVP_NOISE and EKF2_EVA_NOISE instead of a covariance.
_COVARIANCE_FROM_PARAMS = Covariance([float("nan")])

_log = logging.getLogger(__name__)
_T = TypeVar("_T")


@dataclass(frozen=True, slots=True)
class LinkIdentity:
    """What another process must know to go on speaking on this link."""

    autopilot_system: int
    own_system: int
    own_component: int
    local_port: int
    """UDP port that MAVSDK speaks from; 0: not UDP, or not known."""


class MavsdkAutopilot:
    """The `Autopilot` edge.

    Setpoints go out as SET_ATTITUDE_TARGET through MavlinkDirect, not through MAVSDK's Offboard plugin. That plugin re-sends its last
    setpoint at 20 Hz from a C++ thread for as long as the process lives, so PX4's offboard-loss failsafe would never fire for a hung
    companion; it also takes Euler angles only. Here nothing leaves unless the flight loop sends it. The price was measured: 0.03 to
    0.06 ms more from datagram to wire (p50; 0.1 ms at p99), of a tick of 5 ms. benchmarks/wire_latency.py measures both.
    """

    def __init__(self, device: AutopilotDevice, clock: Clock) -> None:
        self._device = device
        self._clock = clock
        self._desk = RequestDesk()
        self._worker = ThreadPoolExecutor(max_workers=1, thread_name_prefix="autopilot")
        self._last_call: Future[Any] | None = None
        self._mavsdk: Any = None
        self._connection: Any = None
        self._restore_log: Callable[[], None] | None = None
        self._direct: Any = None
        self._mocap: Any = None
        self._telemetry: Any = None
        self._param: Any = None
        self._info: Any = None
        self._open = False
        self._system_id = 0
        self._own_ids = (0, 0)
        self._local_port = 0

        # Written by MAVSDK's threads, one assignment each; a tuple is replaced as a whole, so a reader never sees half of it.
        self._position: tuple[float, Vec3, Vec3] | None = None
        self._attitude: tuple[float, Quat, int] | None = None
        self._rates: Vec3 | None = None
        self._imu: tuple[float, Vec3] | None = None
        self._heartbeat: tuple[float, str] | None = None
        self._landed = 0
        self._battery: tuple[float, float] = (float("nan"), float("nan"))

        self._vehicle_key: tuple[Any, ...] | None = None
        self._vehicle: VehicleState | None = None
        self._heartbeat_read: tuple[float, str] | None = None
        self._armed_and_mode: tuple[bool, FlightMode] = (False, FlightMode.UNKNOWN)

    async def __aenter__(self) -> Self:
        """Open the link, find PX4, ask for the streams.

        Raises:
            DeviceError: one line per way of failing; nothing is left open.
        """
        address = self._device.address
        check_address(address)
        self._restore_log = quiet_native_log()
        try:
            configuration = Configuration.create_with_component_type(ComponentType.COMPANION_COMPUTER)
            self._own_ids = (int(configuration.system_id), int(configuration.component_id))
            ports = udp_ports()
            self._mavsdk = Mavsdk(configuration)
            self._connection = await self._call(
                "the connection to open", _CONNECT_DEADLINE_S, add_connection, self._mavsdk, address
            )
            system = await first_autopilot(self._mavsdk, address, self._device.discovery_timeout_s)
            self._system_id = int(system.get_system_id())
            new = udp_ports() - ports
            self._local_port = new.pop() if len(new) == 1 else 0
            self._direct = MavlinkDirect(system)
            self._mocap = Mocap(system)
            self._telemetry = Telemetry(system)
            self._param = Param(system)
            self._info = Info(system)
            self._subscribe()
            await self._ask_for_streams()
        except BaseException:
            await self._close()
            raise
        self._open = True
        return self

    async def __aexit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        """Cut the wire at once, then let MAVSDK's threads end. No packet leaves after this; PX4 keeps its mode."""
        await self._close()

    def identity(self) -> LinkIdentity:
        """Who speaks to whom on the open link."""
        return LinkIdentity(self._system_id, *self._own_ids, self._local_port)

    def vehicle(self) -> VehicleState | None:
        """Latest fused state; None before position, attitude, rates and IMU have all arrived. Stamps are arrival times."""
        position, attitude, rates, imu = self._position, self._attitude, self._rates, self._imu
        if position is None or attitude is None or rates is None or imu is None:
            return None
        key = (position[0], attitude[0], rates, imu[0])
        if key != self._vehicle_key:
            self._vehicle_key = key
            state = messages.vehicle_state(
                position[0], position[1], position[2], attitude[0], attitude[1], rates, imu[0], imu[1]
            )
            if state is not None and attitude[2]:
                state = replace(state, boot_s=attitude[2] * 1e-6)
            # Values that are not finite are as good as not arrived: the last good state stays, and its stamps grow old.
            self._vehicle = state or self._vehicle
        return self._vehicle

    def status(self) -> AutopilotStatus | None:
        """Latest slow state; None before the first heartbeat. `heartbeat_stamp_s` is when the newest HEARTBEAT arrived."""
        heartbeat = self._heartbeat
        if heartbeat is None:
            return None
        if heartbeat is not self._heartbeat_read:
            self._heartbeat_read = heartbeat
            self._armed_and_mode = messages.armed_and_mode(heartbeat[1])
        armed, mode = self._armed_and_mode
        voltage_v, remaining = messages.battery(*self._battery)
        return AutopilotStatus(
            heartbeat_stamp_s=heartbeat[0],
            armed=armed,
            mode=mode,
            landed=messages.landed_state(self._landed),
            battery_voltage_v=voltage_v,
            battery_remaining=remaining,
        )

    def send_attitude(self, setpoint: AttitudeSetpoint) -> bool:
        """Send SET_ATTITUDE_TARGET at once. False: the link is closed or refused it.

        Raises:
            ValueError: a value that must never leave (not finite, not a unit quaternion, thrust outside 0 to 1).
        """
        fields = messages.attitude_target_json(setpoint, int(self._clock() * 1e3), self._system_id)
        return self._open and self._send("SET_ATTITUDE_TARGET", fields)

    def send_vision(self, pose: MocapPose) -> bool:
        """Send VISION_POSITION_ESTIMATE at once. False: the link is closed or refused it.

        Raises:
            ValueError: the pose is not finite.
        """
        position_ned_m, (roll_rad, pitch_rad, yaw_rad) = messages.vision_ned(pose)
        if not self._open:
            return False
        estimate = VisionPositionEstimate(
            # Without TIMESYNC, which PX4 1.16 does not take from MAVSDK, PX4 stamps on arrival (and subtracts EKF2_EV_DELAY);
            # the companion's own clock is what a log reader can use. MAVSDK would replace 0.
            time_usec=max(1, int(pose.stamp_s * 1e6)),
            position_body=PositionBody(*position_ned_m),
            angle_body=AngleBody(roll_rad, pitch_rad, yaw_rad),
            pose_covariance=_COVARIANCE_FROM_PARAMS,
        )
        try:
            self._mocap.set_vision_position_estimate(estimate)
        except MavsdkError as error:
            _log.debug("VISION_POSITION_ESTIMATE not sent: %s", error)
            return False
        return True

    def request(self, request: AutopilotRequest) -> None:
        """Send the request's command unless one of its kind is under way or was made a moment ago. Returns at once.

        LAND never waits for a command of another kind. Refusals come out of `take_messages`.
        """
        if not self._open or not self._desk.claim(request, self._clock()):
            return

        def answered(result: Any, ack: Any, _: Any) -> None:
            if result == MavlinkDirectResult.SUCCESS:
                reason = messages.refusal(ack.fields_json)
            else:
                reason = f"no COMMAND_ACK ({result.name.lower().replace('_', ' ')})"
            self._desk.answer(request, reason, self._clock())

        command = MavlinkMessage("COMMAND_LONG", fields_json=messages.command_json(request, self._system_id))
        self._direct.send_command_async(command, answered)

    def take_messages(self) -> list[str]:
        """Refusals and STATUSTEXTs since the last call, oldest first."""
        return self._desk.take_messages()

    async def read_param(self, name: str) -> float | int:
        """Value of one PX4 parameter, int or float as PX4 stores it.

        Raises:
            DeviceError: no such name, or no answer within the deadline.
        """
        address = self._device.address
        if _PARAM_NAME.fullmatch(name) is None:
            fix = "correct the name"
            raise device_error(address, "a parameter name of up to 16 of A-Z 0-9 _", repr(name), fix)
        self._require_open()
        try:
            value: float | int = await self._call(
                f"PX4's parameter {name}", 2 * _NATIVE_CALL_DEADLINE_S, _get_param, self._param, name
            )
        except ParamError as error:
            found = error.result.name.lower().replace("_", " ")
            fix = "check the name against PX4's version, and the link"
            raise device_error(address, f"PX4's parameter {name}", found, fix) from None
        return value

    async def firmware(self) -> str:
        """PX4's version as it reports it, like `PX4 1.16.1 release (git 0123456789abcdef)`.

        Raises:
            DeviceError: no AUTOPILOT_VERSION within the deadline.
        """
        self._require_open()
        try:
            version = await self._call("PX4's version", 2 * _NATIVE_CALL_DEADLINE_S, _get_version, self._info)
        except MavsdkError as error:
            found = str(error).split(";")[0]
            fix = "check the link"
            raise device_error(self._device.address, "PX4's version (AUTOPILOT_VERSION)", found, fix) from None
        number = f"{version.flight_sw_major}.{version.flight_sw_minor}.{version.flight_sw_patch}"
        return f"PX4 {number} {version.flight_sw_version_type.name.lower()} (git {version.flight_sw_git_hash or 'unknown'})"

    def _require_open(self) -> None:
        if not self._open:
            fix = "enter the edge first"
            raise device_error(self._device.address, "an open link", "a closed one", fix)

    def _send(self, name: str, fields_json: str) -> bool:
        try:
            self._direct.send_message(MavlinkMessage(name, fields_json=fields_json))
        except MavsdkError as error:
            _log.debug("%s not sent: %s", name, error)
            return False
        return True

    def _subscribe(self) -> None:
        telemetry = self._telemetry
        telemetry.subscribe_position_velocity_ned(self._on_position)
        telemetry.subscribe_attitude_quaternion(self._on_attitude)
        telemetry.subscribe_attitude_angular_velocity_body(self._on_rates)
        telemetry.subscribe_imu(self._on_imu)
        telemetry.subscribe_landed_state(self._on_landed)
        telemetry.subscribe_battery(self._on_battery)
        telemetry.subscribe_status_text(self._on_status_text)
        # System.is_connected turns false seconds late; HEARTBEAT itself is the evidence, and carries armed and mode.
        self._direct.subscribe_message("HEARTBEAT", self._on_heartbeat)

    async def _ask_for_streams(self) -> None:
        telemetry = self._telemetry
        for stream, rate_hz, ask in (
            ("LOCAL_POSITION_NED", POSITION_RATE_HZ, telemetry.set_rate_position_velocity_ned),
            ("ATTITUDE_QUATERNION", ATTITUDE_RATE_HZ, telemetry.set_rate_attitude_quaternion),
            ("HIGHRES_IMU", IMU_RATE_HZ, telemetry.set_rate_imu),
            ("EXTENDED_SYS_STATE", LANDED_RATE_HZ, telemetry.set_rate_landed_state),
        ):
            expected = f"PX4 to stream {stream} at {rate_hz:g} Hz"
            try:
                await self._call(expected, _NATIVE_CALL_DEADLINE_S, ask, rate_hz)
            except MavsdkError as error:
                fix = "check the link's bandwidth (MAV_x_RATE, baud) and that it is an onboard-mode MAVLink instance"
                raise device_error(self._device.address, expected, str(error).split(";")[0], fix) from None

    async def _call(self, expected: str, deadline_s: float, call: Callable[..., _T], *args: Any) -> _T:
        """Run a blocking native call off the event loop, one at a time.

        Raises:
            DeviceError: it did not return within `deadline_s`.
        """
        future = self._worker.submit(call, *args)
        self._last_call = future
        try:
            return await asyncio.wait_for(asyncio.wrap_future(future), deadline_s)
        except TimeoutError:
            found = f"no answer within {deadline_s:g} s"
            raise device_error(self._device.address, expected, found, "check the link") from None

    async def _close(self) -> None:
        self._open = False
        if self._connection is not None:
            self._mavsdk.remove_connection(self._connection)  # takes 0.2 ms; from here on nothing can leave
            self._connection = None
        # Shielded: a second Ctrl-C must not leave MAVSDK half destroyed.
        await asyncio.shield(asyncio.get_running_loop().run_in_executor(None, self._tear_down))

    def _tear_down(self) -> None:
        deadline_s = time.monotonic() + _CLOSE_DEADLINE_S
        try:
            # MAVSDK must not be destroyed under a call that is still inside it, nor before the last command's callback has run.
            self._worker.shutdown(wait=False, cancel_futures=True)
            if self._last_call is not None and wait([self._last_call], _CLOSE_DEADLINE_S).not_done:
                _log.error(
                    "autopilot %s: a call into MAVSDK hangs, left to the end of the process", self._device.address
                )
                return
            while self._desk.pending() and time.monotonic() < deadline_s:
                time.sleep(0.02)
            if self._mavsdk is not None:
                self._mavsdk.destroy()
        except Exception as error:
            _log.error("autopilot %s: closing failed: %s", self._device.address, error)
        finally:
            if self._restore_log is not None:
                self._restore_log()

    # Callbacks: C++ threads. Nothing but an assignment.

    def _on_position(self, value: Any, _: Any) -> None:
        p, v = value.position, value.velocity
        self._position = (
            self._clock(),
            (p.north_m, p.east_m, p.down_m),
            (v.north_m_s, v.east_m_s, v.down_m_s),
        )

    def _on_attitude(self, value: Any, _: Any) -> None:
        self._attitude = (self._clock(), (value.w, value.x, value.y, value.z), value.timestamp_us)

    def _on_rates(self, value: Any, _: Any) -> None:
        self._rates = (value.roll_rad_s, value.pitch_rad_s, value.yaw_rad_s)

    def _on_imu(self, value: Any, _: Any) -> None:
        a = value.acceleration_frd
        self._imu = (self._clock(), (a.forward_m_s2, a.right_m_s2, a.down_m_s2))

    def _on_landed(self, value: Any, _: Any) -> None:
        self._landed = int(value)

    def _on_battery(self, value: Any, _: Any) -> None:
        self._battery = (value.voltage_v, value.remaining_percent)

    def _on_status_text(self, value: Any, _: Any) -> None:
        self._desk.note(f"PX4 {value.type.name.lower()}: {value.text}")

    def _on_heartbeat(self, message: Any, _: Any) -> None:
        # A gimbal or camera behind the same system id has a heartbeat of its own.
        if message.component_id == messages.MAV_COMP_ID_AUTOPILOT1:
            self._heartbeat = (self._clock(), message.fields_json)


def _get_param(param: Any, name: str) -> float | int:
    try:
        return float(param.get_param_float(name))
    except ParamError as error:
        if error.result not in (ParamResult.WRONG_TYPE, ParamResult.TYPE_MISMATCH):
            raise
    return int(param.get_param_int(name))


def _get_version(info: Any) -> Any:
    return info.get_version()


__all__ = ["DeviceError", "MavsdkAutopilot"]
