"""Telemetry of the PX4 stub: one builder per MAVLink message, without I/O or clock.

A builder returns None while PX4 would not send the message, for example ATTITUDE before the filter is aligned.
"""

from __future__ import annotations

import math
from typing import Any

from pymavlink.dialects.v20 import common as mavlink

from companion.model.frames import euler_zyx_from_quat
from sitl.autopilot.autopilot import Px4Stub
from sitl.autopilot.modes import NavState
from sitl.autopilot.types import Estimate

Message = Any

_NAN = math.nan
_NO_COVARIANCE = [_NAN] * 21
_PRESSURE_HPA, _TEMPERATURE_C = 1013.25, 25.0
_PATCH_RELEASE = 1 << 8 | 255
"""Patch number 1 and type of a release, encoded."""


def _ms(stub: Px4Stub) -> int:
    return int((stub.t_s - stub.booted_at_s + stub.clock_ahead_s) * 1e3) & 0xFFFFFFFF


def clock_us(stub: Px4Stub) -> int:
    """Return the time on PX4's own clock in us since it booted."""
    return int((stub.t_s - stub.booted_at_s + stub.clock_ahead_s) * 1e6)


def heartbeat(stub: Px4Stub) -> Message:
    """Return HEARTBEAT."""
    state = stub.nav_state
    base = mavlink.MAV_MODE_FLAG_CUSTOM_MODE_ENABLED
    if state not in (NavState.TERMINATION, NavState.MANUAL, NavState.ACRO):
        base |= mavlink.MAV_MODE_FLAG_STABILIZE_ENABLED
    if state.auto:
        base |= mavlink.MAV_MODE_FLAG_AUTO_ENABLED
    if stub.armed:
        base |= mavlink.MAV_MODE_FLAG_SAFETY_ARMED
    return mavlink.MAVLink_heartbeat_message(
        stub.params.integer("MAV_TYPE"), mavlink.MAV_AUTOPILOT_PX4, base, state.custom_mode, system_status(stub), 3
    )


def system_status(stub: Px4Stub) -> int:
    """Return HEARTBEAT.system_status (MAV_STATE), chosen as in HEARTBEAT.hpp of PX4 1.16."""
    if stub.nav_state is NavState.TERMINATION or stub.kill_switch:
        return int(mavlink.MAV_STATE_FLIGHT_TERMINATION)
    if not stub.armed:
        return int(mavlink.MAV_STATE_STANDBY)
    return int(mavlink.MAV_STATE_CRITICAL if stub.commander.failsafe else mavlink.MAV_STATE_ACTIVE)


def sys_status(stub: Px4Stub) -> Message:
    """Return SYS_STATUS, as measured on PX4: PREARM_CHECK never healthy with SYS_HAS_MAG = 0, no position sources."""
    present = (
        mavlink.MAV_SYS_STATUS_SENSOR_3D_GYRO
        | mavlink.MAV_SYS_STATUS_SENSOR_3D_ACCEL
        | mavlink.MAV_SYS_STATUS_AHRS
        | mavlink.MAV_SYS_STATUS_SENSOR_BATTERY
        | mavlink.MAV_SYS_STATUS_PREARM_CHECK
    )
    healthy = mavlink.MAV_SYS_STATUS_SENSOR_3D_GYRO | mavlink.MAV_SYS_STATUS_SENSOR_3D_ACCEL
    healthy |= mavlink.MAV_SYS_STATUS_SENSOR_BATTERY
    if stub.estimate is not None and stub.estimate.attitude_valid:
        healthy |= mavlink.MAV_SYS_STATUS_AHRS
    if stub.params.integer("SYS_HAS_MAG"):
        present |= mavlink.MAV_SYS_STATUS_SENSOR_3D_MAG
        healthy |= mavlink.MAV_SYS_STATUS_SENSOR_3D_MAG
        if stub.arming_problem() is None:
            healthy |= mavlink.MAV_SYS_STATUS_PREARM_CHECK
    battery = stub.battery
    return mavlink.MAVLink_sys_status_message(
        present, present, healthy, 300, _u16(battery.voltage_v * 1e3), _i16(battery.current_a * 1e2),
        _percent(battery.remaining), 0, 0, 0, 0, 0, 0,
    )  # fmt: skip


def extended_sys_state(stub: Px4Stub) -> Message:
    """Return EXTENDED_SYS_STATE."""
    if stub.landed:
        landed = mavlink.MAV_LANDED_STATE_ON_GROUND
    elif stub.nav_state is NavState.TAKEOFF:
        landed = mavlink.MAV_LANDED_STATE_TAKEOFF
    elif stub.nav_state in (NavState.LAND, NavState.DESCEND):
        landed = mavlink.MAV_LANDED_STATE_LANDING
    else:
        landed = mavlink.MAV_LANDED_STATE_IN_AIR
    return mavlink.MAVLink_extended_sys_state_message(mavlink.MAV_VTOL_STATE_UNDEFINED, landed)


def battery_status(stub: Px4Stub) -> Message:
    """Return BATTERY_STATUS for battery 1."""
    battery, cells = stub.battery, max(1, min(10, stub.params.integer("BAT1_N_CELLS")))
    each = _u16(battery.voltage_v / cells * 1e3)
    voltages = [each if i < cells else 65535 for i in range(10)]
    low = battery.remaining < stub.params.real("BAT_LOW_THR")
    charge = mavlink.MAV_BATTERY_CHARGE_STATE_LOW if low else mavlink.MAV_BATTERY_CHARGE_STATE_OK
    return mavlink.MAVLink_battery_status_message(
        0, mavlink.MAV_BATTERY_FUNCTION_ALL, mavlink.MAV_BATTERY_TYPE_LIPO, 32767, voltages, _i16(battery.current_a * 1e2),
        int(battery.consumed_mah), -1, _percent(battery.remaining), 0, charge,
    )  # fmt: skip


def attitude(stub: Px4Stub) -> Message | None:
    """Return ATTITUDE."""
    estimate = _attitude(stub)
    if estimate is None:
        return None
    return mavlink.MAVLink_attitude_message(
        _ms(stub), *euler_zyx_from_quat(estimate.attitude_ned_frd), *estimate.rates_frd_rad_s
    )


def attitude_quaternion(stub: Px4Stub) -> Message | None:
    """Return ATTITUDE_QUATERNION."""
    estimate = _attitude(stub)
    if estimate is None:
        return None
    return mavlink.MAVLink_attitude_quaternion_message(_ms(stub), *estimate.attitude_ned_frd, *estimate.rates_frd_rad_s)


def local_position_ned(stub: Px4Stub) -> Message | None:
    """Return LOCAL_POSITION_NED, which PX4 sends even if invalid: (0, 0, 0) before vision, dead reckoning after its loss."""
    estimate = _attitude(stub)
    if estimate is None:
        return None
    return mavlink.MAVLink_local_position_ned_message(_ms(stub), *estimate.position_ned_m, *estimate.velocity_ned_m_s)


def odometry(stub: Px4Stub) -> Message | None:
    """Return ODOMETRY; in PX4 1.16 the velocity is in NED, as child_frame_id states."""
    estimate = _attitude(stub)
    if estimate is None:
        return None
    x, y, z = estimate.position_ned_m
    frame = mavlink.MAV_FRAME_LOCAL_NED
    return mavlink.MAVLink_odometry_message(
        clock_us(stub), frame, frame, x, y, z, estimate.attitude_ned_frd, *estimate.velocity_ned_m_s, *estimate.rates_frd_rad_s,
        _NO_COVARIANCE, _NO_COVARIANCE, 0, mavlink.MAV_ESTIMATOR_TYPE_AUTOPILOT, 100 if estimate.vision_fused else 0,
    )  # fmt: skip


def highres_imu(stub: Px4Stub) -> Message | None:
    """Return HIGHRES_IMU with specific force (m/s^2) and body rates (rad/s) in FRD; the other sensors have constants."""
    imu = stub.imu
    if imu is None:
        return None
    return mavlink.MAVLink_highres_imu_message(
        clock_us(stub), *imu.accel_frd_m_s2, *imu.gyro_frd_rad_s, 0.0, 0.0, 0.0, _PRESSURE_HPA, 0.0, 0.0, _TEMPERATURE_C, 0x3F
    )  # fmt: skip


def estimator_status(stub: Px4Stub) -> Message | None:
    """Return ESTIMATOR_STATUS as EKF2 of PX4 1.16 sends it: a ratio is NaN while no measurement of its kind is fused, the flag for
    absolute position needs an origin, and the flag for constant position is also set at rest.
    """
    estimate = stub.estimate
    if estimate is None:
        return None
    flags = mavlink.ESTIMATOR_ATTITUDE if estimate.attitude_valid else 0
    if estimate.height_valid:
        flags |= mavlink.ESTIMATOR_VELOCITY_VERT
    if estimate.position_valid:
        flags |= mavlink.ESTIMATOR_VELOCITY_HORIZ | mavlink.ESTIMATOR_POS_HORIZ_REL
        flags |= mavlink.ESTIMATOR_POS_HORIZ_ABS if stub.origin is not None else 0
    if estimate.height_aided:
        flags |= mavlink.ESTIMATOR_POS_VERT_ABS
    if estimate.vision_fused:
        flags |= mavlink.ESTIMATOR_PRED_POS_HORIZ_REL
    if not estimate.vision_fused or (stub.landed and not stub.armed):
        flags |= mavlink.ESTIMATOR_CONST_POS_MODE
    fusion = stub.fusion
    return mavlink.MAVLink_estimator_status_message(
        clock_us(stub), flags, _NAN, fusion.horizontal_ratio, fusion.vertical_ratio, _NAN, _NAN, _NAN,
        fusion.horizontal_accuracy_m, fusion.vertical_accuracy_m,
    )  # fmt: skip


def vfr_hud(stub: Px4Stub) -> Message | None:
    """Return VFR_HUD."""
    estimate = _attitude(stub)
    if estimate is None:
        return None
    north, east, down = estimate.velocity_ned_m_s
    return mavlink.MAVLink_vfr_hud_message(
        0.0,
        math.hypot(north, east),
        _heading_deg(stub),
        _percent(stub.target.thrust),
        _altitude_m(stub, estimate),
        -down,
    )


def altitude(stub: Px4Stub) -> Message | None:
    """Return ALTITUDE."""
    estimate = _position(stub)
    if estimate is None:
        return None
    local = -estimate.position_ned_m[2]
    relative = local + stub.home_ned_m[2] if stub.home_ned_m is not None else _NAN
    absolute = _altitude_m(stub, estimate)
    return mavlink.MAVLink_altitude_message(clock_us(stub), local, absolute, local, relative, _NAN, _NAN)


def attitude_target(stub: Px4Stub) -> Message | None:
    """Return ATTITUDE_TARGET, the setpoint of the attitude loop; None while disarmed."""
    if not stub.armed:
        return None
    target = stub.target
    return mavlink.MAVLink_attitude_target_message(
        _ms(stub), 0, target.attitude_ned_frd, 0.0, 0.0, target.yaw_rate_rad_s, target.thrust
    )


def position_target_local_ned(stub: Px4Stub) -> Message | None:
    """Return POSITION_TARGET_LOCAL_NED, the setpoint of the position controller; None while that does not control the vehicle."""
    if not stub.armed or not stub.position_controlled:
        return None
    target = stub.navigator.target
    axes = (*target.position_ned_m, *target.velocity_ned_m_s, *target.acceleration_ned_m_s2)
    mask = sum(1 << i for i, value in enumerate(axes) if value is None)
    mask |= 1024 if target.yaw_rad is None else 0
    mask |= 2048 if target.yaw_rate_rad_s is None else 0
    values = [_NAN if value is None else value for value in (*axes, target.yaw_rad, target.yaw_rate_rad_s)]
    return mavlink.MAVLink_position_target_local_ned_message(_ms(stub), mavlink.MAV_FRAME_LOCAL_NED, mask, *values)


def global_position_int(stub: Px4Stub) -> Message | None:
    """Return GLOBAL_POSITION_INT; None without an origin or a valid position."""
    estimate, origin = _position(stub), stub.origin
    if estimate is None or origin is None:
        return None
    latitude, longitude, absolute = origin.global_deg_m(estimate.position_ned_m)
    home_down = stub.home_ned_m[2] if stub.home_ned_m is not None else 0.0
    relative = home_down - estimate.position_ned_m[2]
    vx, vy, vz = (_i16(value * 1e2) for value in estimate.velocity_ned_m_s)
    return mavlink.MAVLink_global_position_int_message(
        _ms(stub), round(latitude * 1e7), round(longitude * 1e7), round(absolute * 1e3), round(relative * 1e3), vx, vy, vz,
        _heading_deg(stub) * 100,
    )  # fmt: skip


def gps_global_origin(stub: Px4Stub) -> Message | None:
    """Return GPS_GLOBAL_ORIGIN; None without an origin or a valid position."""
    origin = stub.origin
    if origin is None or _position(stub) is None:
        return None
    return mavlink.MAVLink_gps_global_origin_message(
        round(origin.latitude_deg * 1e7),
        round(origin.longitude_deg * 1e7),
        round(origin.altitude_m * 1e3),
        clock_us(stub),
    )


def home_position(stub: Px4Stub) -> Message | None:
    """Return HOME_POSITION; None without a home position or an origin."""
    home, origin = stub.home_ned_m, stub.origin
    if home is None or origin is None:
        return None
    latitude, longitude, absolute = origin.global_deg_m(home)
    return mavlink.MAVLink_home_position_message(
        round(latitude * 1e7), round(longitude * 1e7), round(absolute * 1e3), *home, [1.0, 0.0, 0.0, 0.0], 0.0, 0.0, 0.0,
        clock_us(stub),
    )  # fmt: skip


def servo_output_raw(stub: Px4Stub) -> Message:
    """Return SERVO_OUTPUT_RAW: 1000 to 2000 us for each of the first eight rotors, or 900 us while disarmed or killed."""
    turns = stub.armed and not stub.kill_switch
    pulses = [round(1000 + 1000 * command) if turns else 900 for command in stub.rotors]
    return mavlink.MAVLink_servo_output_raw_message(clock_us(stub) & 0xFFFFFFFF, 0, *[*pulses, *[0] * 8][:8])


def system_time(stub: Px4Stub) -> Message:
    """Return SYSTEM_TIME; the wall-clock time is 0 without GPS."""
    return mavlink.MAVLink_system_time_message(0, _ms(stub))


def timesync_request(stub: Px4Stub) -> Message:
    """Return a TIMESYNC request from PX4."""
    return mavlink.MAVLink_timesync_message(0, clock_us(stub) * 1000)


def ping(stub: Px4Stub) -> Message:
    """Return a PING request to all systems."""
    return mavlink.MAVLink_ping_message(clock_us(stub), int(stub.t_s) & 0xFFFFFFFF, 0, 0)


def vibration(stub: Px4Stub) -> Message:
    """Return VIBRATION; every value is 0."""
    return mavlink.MAVLink_vibration_message(clock_us(stub), 0.0, 0.0, 0.0, 0, 0, 0)


def autopilot_version(stub: Px4Stub) -> Message:
    """Return AUTOPILOT_VERSION: that of PX4 1.16.1, or of another release."""
    major, minor = stub.params.release
    version = major << 24 | minor << 16 | _PATCH_RELEASE
    capabilities = (
        mavlink.MAV_PROTOCOL_CAPABILITY_MISSION_INT
        | mavlink.MAV_PROTOCOL_CAPABILITY_COMMAND_INT
        | mavlink.MAV_PROTOCOL_CAPABILITY_PARAM_ENCODE_BYTEWISE
        | mavlink.MAV_PROTOCOL_CAPABILITY_SET_ATTITUDE_TARGET
        | mavlink.MAV_PROTOCOL_CAPABILITY_SET_POSITION_TARGET_LOCAL_NED
        | mavlink.MAV_PROTOCOL_CAPABILITY_FLIGHT_TERMINATION
        | mavlink.MAV_PROTOCOL_CAPABILITY_MAVLINK2
    )
    return mavlink.MAVLink_autopilot_version_message(
        capabilities, version, version, 0, 0, [0] * 8, [0] * 8, [0] * 8, 0, 0, stub.params.integer("MAV_SYS_ID")
    )


def _attitude(stub: Px4Stub) -> Estimate | None:
    return stub.estimate if stub.estimate is not None and stub.estimate.attitude_valid else None


def _position(stub: Px4Stub) -> Estimate | None:
    return stub.estimate if stub.estimate is not None and stub.estimate.position_valid else None


def _altitude_m(stub: Px4Stub, estimate: Estimate) -> float:
    return (stub.origin.altitude_m if stub.origin is not None else 0.0) - estimate.position_ned_m[2]


def _heading_deg(stub: Px4Stub) -> int:
    return int(math.degrees(stub.heading_rad)) % 360


def _percent(share: float) -> int:
    return round(100 * min(1.0, max(0.0, share)))


def _u16(value: float) -> int:
    return max(0, min(65535, round(value)))


def _i16(value: float) -> int:
    return max(-32768, min(32767, round(value)))
