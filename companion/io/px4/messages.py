"""Conversion between PX4's MAVLink messages and the companion's records. Pure: no socket, no MAVSDK, no clock.

All frame conversions between companion and PX4 are here: NED/FRD on the wire, world ENU / body FLU in the records.
"""

from __future__ import annotations

import math
import struct
from collections.abc import Mapping, Sequence
from typing import Any

from companion.model.estimator import EstimatorReport
from companion.model.frames import (
    attitude_enu_flu_from_ned_frd,
    attitude_ned_frd_from_enu_flu,
    enu_from_ned,
    euler_zyx_from_quat,
    flu_from_frd,
    ned_from_enu,
    quat_normalize,
)
from companion.model.types import (
    AttitudeSetpoint,
    AutopilotRequest,
    FlightMode,
    LandedState,
    MocapPose,
    Quat,
    Vec3,
    VehicleState,
)

LOCAL_POSITION_NED_ID, ATTITUDE_QUATERNION_ID, HIGHRES_IMU_ID = 32, 31, 105
SET_ATTITUDE_TARGET_ID, VISION_POSITION_ESTIMATE_ID = 82, 102
UNREAD_IDS = (30, 33, 36, 65, 74, 83, 85, 87, 141, 290, 291, 331)
"""Streams of PX4's onboard mode (mavlink_main.cpp, MAVLINK_MODE_ONBOARD) at 10 Hz and above that the companion does not read:
ATTITUDE, GLOBAL_POSITION_INT, SERVO_OUTPUT_RAW, RC_CHANNELS, VFR_HUD, ATTITUDE_TARGET, POSITION_TARGET_LOCAL_NED,
POSITION_TARGET_GLOBAL_INT, ALTITUDE, ESC_INFO, ESC_STATUS, ODOMETRY. TIMESYNC stays, for PX4's clock.
"""
HEARTBEAT_ID, COMMAND_LONG_ID, COMMAND_ACK_ID, AUTOPILOT_VERSION_ID = 0, 76, 77, 148
PARAM_REQUEST_READ_ID, PARAM_VALUE_ID, PARAM_SET_ID, SET_GPS_GLOBAL_ORIGIN_ID = 20, 22, 23, 48
MAV_PARAM_TYPE_INT32, MAV_PARAM_TYPE_REAL32 = 6, 9
GROUND_STATION_HEARTBEAT = struct.pack("<I5B", 0, 6, 8, 0, 4, 3)
"""Payload of HEARTBEAT: MAV_TYPE_GCS, MAV_AUTOPILOT_INVALID, MAV_STATE_ACTIVE."""
MAV_RESULT_ACCEPTED, MAV_RESULT_IN_PROGRESS = 0, 5
REQUEST_MESSAGE, SET_MESSAGE_INTERVAL = 512, 511
"""MAV_CMD; the first parameter is a message id."""

MAV_COMP_ID_AUTOPILOT1 = 1
_MAV_MODE_FLAG_CUSTOM_MODE_ENABLED = 1
MAV_MODE_FLAG_SAFETY_ARMED = 128
_MAV_SYS_STATUS_SENSOR_RC_RECEIVER = 65536
_PX4_MAIN_MODE_AUTO = 4
_PX4_MAIN_MODE_OFFBOARD = 6
# Body rates are not commanded: ATTITUDE_TARGET_TYPEMASK_BODY_ROLL_RATE_IGNORE | PITCH | YAW.
TYPE_MASK_IGNORE_RATES = 7
_QUAT_NORM_TOLERANCE = 1e-2
_NO_CELL = 0xFFFF
"""Value of an unused cell in BATTERY_STATUS.voltages."""

# PX4's px4_custom_mode.h. Main modes in which a pilot steers; 9 simple, 11 altitude cruise.
_PX4_PILOT_MAIN_MODES = frozenset({1, 2, 3, 5, 7, 8, 9, 11})
_PX4_AUTO_SUB_MODES = {
    2: FlightMode.TAKEOFF,
    3: FlightMode.HOLD,
    5: FlightMode.RETURN,
    6: FlightMode.LAND,
    9: FlightMode.LAND,  # precision landing
}
_LANDED_STATES = (
    LandedState.UNKNOWN,
    LandedState.ON_GROUND,
    LandedState.IN_AIR,
    LandedState.TAKING_OFF,
    LandedState.LANDING,
)
_MAV_RESULTS = {
    0: "accepted",
    1: "temporarily rejected",
    2: "denied",
    3: "unsupported",
    4: "failed",
    5: "in progress",
    6: "cancelled",
}
_COMMANDS: dict[AutopilotRequest, tuple[int, float, float]] = {
    AutopilotRequest.OFFBOARD: (176, float(_MAV_MODE_FLAG_CUSTOM_MODE_ENABLED), float(_PX4_MAIN_MODE_OFFBOARD)),
    AutopilotRequest.ARM: (400, 1.0, 0.0),
    AutopilotRequest.DISARM: (400, 0.0, 0.0),
    AutopilotRequest.FORCE_DISARM: (400, 0.0, 21196.0),
    AutopilotRequest.LAND: (21, 0.0, 0.0),
}


def heartbeat_state(base_mode: int, custom_mode: int, system_status: int) -> tuple[bool, FlightMode, int]:
    """Return the armed flag, flight mode and MAV_STATE from a HEARTBEAT's fields."""
    return bool(base_mode & MAV_MODE_FLAG_SAFETY_ARMED), flight_mode(base_mode, custom_mode), system_status


def flight_mode(base_mode: int, custom_mode: int) -> FlightMode:
    """Return PX4's mode: main mode in bits 16-23 of `custom_mode`, sub mode in bits 24-31."""
    main, sub = (custom_mode >> 16) & 0xFF, (custom_mode >> 24) & 0xFF
    if not base_mode & _MAV_MODE_FLAG_CUSTOM_MODE_ENABLED or main == 0:
        return FlightMode.UNKNOWN
    if main == _PX4_MAIN_MODE_OFFBOARD:
        return FlightMode.OFFBOARD
    if main == _PX4_MAIN_MODE_AUTO:
        return _PX4_AUTO_SUB_MODES.get(sub, FlightMode.OTHER)
    return FlightMode.MANUAL if main in _PX4_PILOT_MAIN_MODES else FlightMode.OTHER


_LOCAL_POSITION, _ATTITUDE, _IMU = struct.Struct("<I6f"), struct.Struct("<I7f"), struct.Struct("<Q3f")
_PARAM_REQUEST_READ, _GLOBAL_ORIGIN = struct.Struct("<hBB16s"), struct.Struct("<3iB")
_ATTITUDE_TARGET, _VISION, _COMMAND_LONG = struct.Struct("<I8f3B"), struct.Struct("<Q7f"), struct.Struct("<7fH3B")


def local_position_ned(payload: bytes) -> tuple[Vec3, Vec3]:
    """Return position (m) and velocity (m/s) of LOCAL_POSITION_NED in NED."""
    _, x, y, z, vx, vy, vz = _LOCAL_POSITION.unpack_from(payload.ljust(_LOCAL_POSITION.size, b"\0"))
    return (x, y, z), (vx, vy, vz)


def attitude_quaternion(payload: bytes) -> tuple[Quat, Vec3, float | None]:
    """Return attitude FRD -> NED, body rates FRD (rad/s) and time since boot (s; None if it is 0) of ATTITUDE_QUATERNION."""
    boot_ms, q1, q2, q3, q4, roll, pitch, yaw = _ATTITUDE.unpack_from(payload.ljust(_ATTITUDE.size, b"\0"))
    return (q1, q2, q3, q4), (roll, pitch, yaw), boot_ms * 1e-3 if boot_ms else None


def highres_imu(payload: bytes) -> tuple[Vec3, float | None]:
    """Return specific force FRD (m/s^2) and time since boot (s; None if it is 0) of HIGHRES_IMU."""
    boot_us, x, y, z = _IMU.unpack_from(payload.ljust(_IMU.size, b"\0"))
    return (x, y, z), boot_us * 1e-6 if boot_us else None


def landed_state(value: int) -> LandedState:
    """Return the landed state of EXTENDED_SYS_STATE.landed_state."""
    return _LANDED_STATES[value] if 0 <= value < len(_LANDED_STATES) else LandedState.UNKNOWN


def battery(voltages_mv: Sequence[int], remaining_percent: int) -> tuple[float | None, float | None]:
    """Return voltage (V) and charge (0 to 1) of BATTERY_STATUS from `voltages` and `battery_remaining`; None if unknown."""
    voltage_v = sum(cell for cell in voltages_mv if cell != _NO_CELL) * 1e-3
    return voltage_v or None, min(remaining_percent / 100.0, 1.0) if remaining_percent >= 0 else None


def radio_received(sensors_present: int) -> bool:
    """Return whether PX4 receives a pilot's radio or joystick, given SYS_STATUS.onboard_control_sensors_present."""
    return bool(sensors_present & _MAV_SYS_STATUS_SENSOR_RC_RECEIVER)


class Batteries:
    """The newest BATTERY_STATUS of each battery, by its id. Of several batteries the worst counts."""

    def __init__(self) -> None:
        self._newest: dict[int, tuple[float, float | None, float | None]] = {}

    def take(self, stamp_s: float, message: Any) -> None:
        """Store a decoded message that arrived at `stamp_s`."""
        self._newest[message.id] = (stamp_s, *battery(message.voltages, message.battery_remaining))

    def worst(self) -> tuple[float | None, float | None, float | None]:
        """Return the lowest voltage (V), the lowest remaining charge (0 to 1) and the oldest arrival; None for what is not known."""
        newest = self._newest.values()
        voltages_v = [voltage_v for _, voltage_v, _ in newest if voltage_v is not None]
        remaining = [share for *_, share in newest if share is not None]
        return min(voltages_v, default=None), min(remaining, default=None), min((b[0] for b in newest), default=None)


def vehicle_state(
    position_stamp_s: float,
    position_ned_m: Vec3,
    velocity_ned_m_s: Vec3,
    attitude_stamp_s: float,
    attitude_ned_frd: Quat,
    rates_frd_rad_s: Vec3,
    imu_stamp_s: float,
    specific_force_frd_m_s2: Vec3,
) -> VehicleState | None:
    """Return position, attitude and IMU messages in the companion's frames, or None if a value is not finite or the quaternion is 0."""
    values = (*position_ned_m, *velocity_ned_m_s, *attitude_ned_frd, *rates_frd_rad_s, *specific_force_frd_m_s2)
    if not all(map(math.isfinite, values)):
        return None
    try:
        attitude_ned_frd = quat_normalize(attitude_ned_frd)
    except ValueError:
        return None
    return VehicleState(
        position_stamp_s=position_stamp_s,
        attitude_stamp_s=attitude_stamp_s,
        imu_stamp_s=imu_stamp_s,
        position_world_m=enu_from_ned(position_ned_m),
        velocity_world_m_s=enu_from_ned(velocity_ned_m_s),
        attitude_wxyz=attitude_enu_flu_from_ned_frd(attitude_ned_frd),
        angular_rate_body_rad_s=flu_from_frd(rates_frd_rad_s),
        specific_force_body_m_s2=flu_from_frd(specific_force_frd_m_s2),
    )


def attitude_target_ned(setpoint: AttitudeSetpoint) -> Quat:
    """Return the attitude FRD -> NED of a valid setpoint.

    Raises:
        ValueError: a value is not finite, the quaternion is not of unit norm, or thrust is outside 0 to 1.
    """
    w, x, y, z = setpoint.attitude_wxyz
    norm_squared = w * w + x * x + y * y + z * z
    # Written so that NaN fails both tests.
    if not abs(norm_squared - 1.0) <= _QUAT_NORM_TOLERANCE:
        raise ValueError(f"attitude setpoint {setpoint.attitude_wxyz} is not a unit quaternion")
    if not 0.0 <= setpoint.thrust <= 1.0:
        raise ValueError(f"thrust setpoint {setpoint.thrust} is outside 0 to 1")
    return attitude_ned_frd_from_enu_flu(setpoint.attitude_wxyz)


def attitude_target_deg(setpoint: AttitudeSetpoint) -> Vec3:
    """Return roll, pitch, yaw (ZYX, FRD -> NED) of a valid setpoint, deg; raises the errors of `attitude_target_ned`."""
    roll_rad, pitch_rad, yaw_rad = euler_zyx_from_quat(quat_normalize(attitude_target_ned(setpoint)))
    return math.degrees(roll_rad), math.degrees(pitch_rad), math.degrees(yaw_rad)


def attitude_target(setpoint: AttitudeSetpoint, time_boot_ms: int, target_system: int) -> bytes:
    """Return the payload of SET_ATTITUDE_TARGET: quaternion FRD -> NED and thrust, no rates; raises as `attitude_target_ned`."""
    q, target = attitude_target_ned(setpoint), (target_system, MAV_COMP_ID_AUTOPILOT1, TYPE_MASK_IGNORE_RATES)
    return _ATTITUDE_TARGET.pack(time_boot_ms & 0xFFFFFFFF, *q, 0.0, 0.0, 0.0, setpoint.thrust, *target)


def vision_ned(pose: MocapPose) -> tuple[Vec3, Vec3]:
    """Return the NED position (m) and the roll, pitch and yaw (ZYX, FRD -> NED, rad) for VISION_POSITION_ESTIMATE.

    Raises:
        ValueError: a value is not finite or the quaternion is zero.
    """
    if not all(map(math.isfinite, (*pose.position_world_m, *pose.attitude_wxyz))):
        raise ValueError(f"mocap pose {pose.position_world_m}, {pose.attitude_wxyz} is not finite")
    attitude = attitude_ned_frd_from_enu_flu(quat_normalize(pose.attitude_wxyz))
    return ned_from_enu(pose.position_world_m), euler_zyx_from_quat(attitude)


def vision_position_estimate(pose: MocapPose) -> bytes:
    """Return the payload of VISION_POSITION_ESTIMATE; raises the errors of `vision_ned`.

    PX4 stamps on arrival (and subtracts EKF2_EV_DELAY), because nobody answers its TIMESYNC (docs/internals/px4.md); the companion's
    own clock is what a log reader can use. The first covariance is NaN, which makes PX4 use EKF2_EVP_NOISE and EKF2_EVA_NOISE.
    """
    position_ned_m, euler_rad = vision_ned(pose)
    return _VISION.pack(max(1, int(pose.stamp_s * 1e6)), *position_ned_m, *euler_rad, math.nan)


def command(request: AutopilotRequest) -> tuple[int, float, float]:
    """Return MAV_CMD and its first two parameters (the others are 0): DO_SET_MODE (176), COMPONENT_ARM_DISARM (400) or NAV_LAND
    (21).

    Raises:
        KeyError: for `AutopilotRequest.NONE`, which is not a command.
    """
    return _COMMANDS[request]


def command_long(number: int, param1: float, param2: float, target_system: int) -> tuple[int, bytes]:
    """Return id and payload of COMMAND_LONG with a MAV_CMD and its first two parameters; the others are 0."""
    payload = _COMMAND_LONG.pack(
        param1, param2, 0.0, 0.0, 0.0, 0.0, 0.0, number, target_system, MAV_COMP_ID_AUTOPILOT1, 0
    )
    return COMMAND_LONG_ID, payload


def param_request_read(name: str, target_system: int) -> tuple[int, bytes]:
    """Return id and payload of PARAM_REQUEST_READ by name."""
    return PARAM_REQUEST_READ_ID, _PARAM_REQUEST_READ.pack(-1, target_system, MAV_COMP_ID_AUTOPILOT1, name.encode())


def param_set(name: str, value: int | float, target_system: int) -> tuple[int, bytes]:
    """Return id and payload of PARAM_SET; PX4 expects the bytes of an INT32 in place of the float."""
    kind, wire = (MAV_PARAM_TYPE_INT32, "<iBB16sB") if isinstance(value, int) else (MAV_PARAM_TYPE_REAL32, "<fBB16sB")
    return PARAM_SET_ID, struct.pack(wire, value, target_system, MAV_COMP_ID_AUTOPILOT1, name.encode(), kind)


def set_global_origin(
    latitude_deg: float, longitude_deg: float, altitude_m: float, target_system: int
) -> tuple[int, bytes]:
    """Return id and payload of SET_GPS_GLOBAL_ORIGIN: angles in 1e-7 deg, altitude in mm."""
    place = round(latitude_deg * 1e7), round(longitude_deg * 1e7), round(altitude_m * 1e3)
    return SET_GPS_GLOBAL_ORIGIN_ID, _GLOBAL_ORIGIN.pack(*place, target_system)


def estimator_report(fields: Mapping[str, Any], stamp_s: float) -> EstimatorReport:
    """Convert ESTIMATOR_STATUS; NaN for a ratio that is not fused becomes 0, for an unknown accuracy infinity."""

    def number(key: str, unknown: float) -> float:
        value = fields[key]
        return float(value) if value is not None and math.isfinite(value) else unknown

    return EstimatorReport(
        stamp_s=stamp_s,
        flags=int(fields["flags"]),
        velocity_ratio=number("vel_ratio", 0.0),
        position_horizontal_ratio=number("pos_horiz_ratio", 0.0),
        position_vertical_ratio=number("pos_vert_ratio", 0.0),
        position_horizontal_accuracy_m=number("pos_horiz_accuracy", math.inf),
        position_vertical_accuracy_m=number("pos_vert_accuracy", math.inf),
    )


_RELEASES = {0: "dev", 64: "alpha", 128: "beta", 192: "rc", 255: "release"}


def firmware(message: Any) -> str:
    """Return an AUTOPILOT_VERSION as text: version, FIRMWARE_VERSION_TYPE and the git hash, whose bytes PX4 sends last first."""
    major, minor, patch, release = int(message.flight_sw_version).to_bytes(4, "big")
    git = bytes(message.flight_custom_version[::-1])
    return (
        f"PX4 {major}.{minor}.{patch} {_RELEASES.get(release, 'unknown')} (git {git.hex() if any(git) else 'unknown'})"
    )


def result_text(result: int) -> str:
    """Return a MAV_RESULT as text."""
    return f"{_MAV_RESULTS.get(result, 'unknown result')} (MAV_RESULT {result})"
