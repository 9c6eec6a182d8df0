"""Parameter store of the PX4 stub: PX4's names, types, order, wire encoding and defaults for this vehicle.

Values are stored as PX4 stores them: INT32, or REAL32 rounded to single precision. The defaults are PX4 1.16's own, except for the
ones in `VEHICLE_DEFAULTS`, which an operator sets for flying indoors on motion capture without GPS, magnetometer and barometer.
"""

from __future__ import annotations

import math
import struct
import zlib
from collections.abc import Iterator, Mapping

MAV_PARAM_TYPE_INT32 = 6
MAV_PARAM_TYPE_REAL32 = 9
HASH_CHECK = "_HASH_CHECK"

Value = int | float

PX4_DEFAULTS: Mapping[str, Value] = {
    "BAT1_CAPACITY": -1.0,
    "BAT1_N_CELLS": 4,
    "BAT1_R_INTERNAL": -1.0,
    "BAT1_SOURCE": 0,
    "BAT1_V_CHARGED": 4.05,
    "BAT1_V_EMPTY": 3.6,
    "BAT_CRIT_THR": 0.07,
    "BAT_EMERGEN_THR": 0.05,
    "BAT_LOW_THR": 0.15,
    "CAL_ACC0_ID": 1310988,
    "CAL_GYRO0_ID": 1310988,
    "CBRK_FLIGHTTERM": 121212,
    "CBRK_IO_SAFETY": 22027,
    "CBRK_SUPPLY_CHK": 0,
    "CBRK_USB_CHK": 0,
    "COM_ARM_WO_GPS": 1,
    "COM_DISARM_LAND": 2.0,
    "COM_DISARM_PRFLT": 10.0,
    "COM_DL_LOSS_T": 10,
    "COM_FAIL_ACT_T": 5.0,
    "COM_FLTMODE1": -1,
    "COM_HOME_EN": 1,
    "COM_LOW_BAT_ACT": 0,
    "COM_OBL_RC_ACT": 0,
    "COM_OF_LOSS_T": 1.0,
    "COM_POS_FS_EPH": 5.0,
    "COM_RCL_EXCEPT": 0,
    "COM_RC_IN_MODE": 3,
    "COM_RC_LOSS_T": 0.5,
    "COM_SPOOLUP_TIME": 1.0,
    "COM_TAKEOFF_ACT": 0,
    "EKF2_BARO_CTRL": 1,
    "EKF2_EVA_NOISE": 0.1,
    "EKF2_EVP_NOISE": 0.1,
    "EKF2_EVV_NOISE": 0.1,
    "EKF2_EV_CTRL": 0,
    "EKF2_EV_DELAY": 0.0,
    "EKF2_EV_NOISE_MD": 0,
    "EKF2_EV_POS_X": 0.0,
    "EKF2_EV_POS_Y": 0.0,
    "EKF2_EV_POS_Z": 0.0,
    "EKF2_EV_QMIN": 0,
    "EKF2_GPS_CTRL": 7,
    "EKF2_HGT_REF": 1,
    "EKF2_IMU_CTRL": 7,
    "EKF2_MAG_TYPE": 0,
    "EKF2_NOAID_TOUT": 5000000,
    "IMU_GYRO_CUTOFF": 30.0,
    "IMU_GYRO_RATEMAX": 400,
    "IMU_INTEG_RATE": 200,
    "LNDMC_ROT_MAX": 20.0,
    "LNDMC_TRIG_TIME": 1.0,
    "LNDMC_XY_VEL_MAX": 1.5,
    "LNDMC_Z_VEL_MAX": 0.25,
    "MAV_0_CONFIG": 101,
    "MAV_0_RATE": 1200,
    "MAV_COMP_ID": 1,
    "MAV_PROTO_VER": 0,
    "MAV_SYS_ID": 1,
    "MAV_TYPE": 2,
    "MC_AIRMODE": 0,
    "MC_PITCHRATE_D": 0.003,
    "MC_PITCHRATE_I": 0.2,
    "MC_PITCHRATE_K": 1.0,
    "MC_PITCHRATE_MAX": 220.0,
    "MC_PITCHRATE_P": 0.15,
    "MC_PITCH_P": 6.5,
    "MC_PR_INT_LIM": 0.3,
    "MC_ROLLRATE_D": 0.003,
    "MC_ROLLRATE_I": 0.2,
    "MC_ROLLRATE_K": 1.0,
    "MC_ROLLRATE_MAX": 220.0,
    "MC_ROLLRATE_P": 0.15,
    "MC_ROLL_P": 6.5,
    "MC_RR_INT_LIM": 0.3,
    "MC_YAWRATE_D": 0.0,
    "MC_YAWRATE_I": 0.1,
    "MC_YAWRATE_K": 1.0,
    "MC_YAWRATE_MAX": 200.0,
    "MC_YAWRATE_P": 0.2,
    "MC_YAW_P": 2.8,
    "MC_YAW_WEIGHT": 0.4,
    "MC_YR_INT_LIM": 0.3,
    "MIS_TAKEOFF_ALT": 2.5,
    "MPC_ACC_DOWN_MAX": 3.0,
    "MPC_ACC_HOR": 3.0,
    "MPC_ACC_HOR_MAX": 5.0,
    "MPC_ACC_UP_MAX": 4.0,
    "MPC_LAND_ALT1": 10.0,
    "MPC_LAND_ALT2": 5.0,
    "MPC_LAND_CRWL": 0.3,
    "MPC_LAND_SPEED": 0.7,
    "MPC_MANTHR_MIN": 0.08,
    "MPC_THR_HOVER": 0.5,
    "MPC_THR_MAX": 1.0,
    "MPC_THR_MIN": 0.12,
    "MPC_TILTMAX_AIR": 45.0,
    "MPC_TILTMAX_LND": 12.0,
    "MPC_TKO_RAMP_T": 3.0,
    "MPC_TKO_SPEED": 1.5,
    "MPC_USE_HTE": 1,
    "MPC_XY_CRUISE": 5.0,
    "MPC_XY_P": 0.95,
    "MPC_XY_VEL_D_ACC": 0.2,
    "MPC_XY_VEL_I_ACC": 0.4,
    "MPC_XY_VEL_MAX": 12.0,
    "MPC_XY_VEL_P_ACC": 1.8,
    "MPC_YAWRAUTO_MAX": 60.0,
    "MPC_Z_P": 1.0,
    "MPC_Z_VEL_D_ACC": 0.0,
    "MPC_Z_VEL_I_ACC": 2.0,
    "MPC_Z_VEL_MAX_DN": 1.5,
    "MPC_Z_VEL_MAX_UP": 3.0,
    "MPC_Z_VEL_P_ACC": 4.0,
    "NAV_ACC_RAD": 10.0,
    "NAV_DLL_ACT": 0,
    "NAV_MC_ALT_RAD": 0.8,
    "NAV_RCL_ACT": 2,
    "PWM_MAIN_FUNC1": 101,
    "PWM_MAIN_FUNC2": 102,
    "PWM_MAIN_FUNC3": 103,
    "PWM_MAIN_FUNC4": 104,
    "RTL_DESCEND_ALT": 30.0,
    "RTL_RETURN_ALT": 60.0,
    "SDLOG_MODE": 0,
    "SENS_BOARD_ROT": 0,
    "SENS_BOARD_X_OFF": 0.0,
    "SENS_BOARD_Y_OFF": 0.0,
    "SENS_EN_GPSSIM": 0,
    "SENS_IMU_MODE": 1,
    "SYS_AUTOSTART": 4001,
    "SYS_FAILURE_EN": 0,
    "SYS_HAS_BARO": 1,
    "SYS_HAS_GPS": 1,
    "SYS_HAS_MAG": 1,
    "THR_MDL_FAC": 0.0,
    "UAVCAN_ENABLE": 0,
}

VEHICLE_DEFAULTS: Mapping[str, Value] = {
    "BAT1_CAPACITY": 5200.0,
    "COM_OBL_RC_ACT": 4,
    "COM_OF_LOSS_T": 0.5,
    "COM_RC_IN_MODE": 4,
    "EKF2_BARO_CTRL": 0,
    "EKF2_EVA_NOISE": 0.05,
    "EKF2_EVP_NOISE": 0.01,
    "EKF2_EV_CTRL": 11,
    "EKF2_EV_DELAY": 5.0,
    "EKF2_GPS_CTRL": 0,
    "EKF2_HGT_REF": 3,
    "EKF2_MAG_TYPE": 5,
    "MIS_TAKEOFF_ALT": 1.0,
    "MPC_TILTMAX_AIR": 25.0,
    "MPC_TKO_SPEED": 0.6,
    "MPC_XY_CRUISE": 1.0,
    "MPC_XY_VEL_MAX": 2.0,
    "MPC_Z_VEL_MAX_UP": 1.0,
    "RTL_RETURN_ALT": 1.5,
    "SYS_HAS_GPS": 0,
    "SYS_HAS_MAG": 0,
}


class Params:
    """The autopilot's parameters; index on the wire is the alphabetic one, as in PX4."""

    def __init__(self, overrides: Mapping[str, Value] | None = None) -> None:
        """Defaults of this vehicle, then `overrides`.

        Raises:
            KeyError: if an override names no known parameter.
            ValueError: if an override is not finite, or not whole where PX4 has an INT32.
        """
        self.revision = 0
        """Grows with every change; whoever caches values compares it."""
        self._integer = {name: isinstance(default, int) for name, default in PX4_DEFAULTS.items()}
        self._values: dict[str, Value] = {name: PX4_DEFAULTS[name] for name in sorted(PX4_DEFAULTS)}
        self._names = tuple(self._values)
        self._index = {name: i for i, name in enumerate(self._names)}
        for name, value in {**PX4_DEFAULTS, **VEHICLE_DEFAULTS, **(overrides or {})}.items():
            self.set(name, value)

    def __contains__(self, name: str) -> bool:
        return name in self._values

    def __iter__(self) -> Iterator[str]:
        return iter(self._names)

    def __len__(self) -> int:
        return len(self._names)

    def __getitem__(self, name: str) -> Value:
        return self._values[name]

    def real(self, name: str) -> float:
        """Value as float.

        Raises:
            KeyError: unknown name.
        """
        return float(self._values[name])

    def integer(self, name: str) -> int:
        """Value as int.

        Raises:
            KeyError: unknown name.
        """
        return int(self._values[name])

    def set(self, name: str, value: Value) -> Value:
        """Store a value; returns what was stored.

        Raises:
            KeyError: unknown name.
            ValueError: not finite, or not whole where PX4 has an INT32.
        """
        integer = self._integer[name]
        if not math.isfinite(value):
            raise ValueError(f"{name}: {value} is not finite")
        if integer and value != int(value):
            raise ValueError(f"{name} is INT32, got {value}")
        stored: Value = int(value) if integer else _single(float(value))
        if integer and not -(2**31) <= stored < 2**31:
            raise ValueError(f"{name} is INT32, got {value}")
        self._values[name] = stored
        self.revision += 1
        return stored

    def index(self, name: str) -> int:
        """Index on the wire.

        Raises:
            KeyError: unknown name.
        """
        return self._index[name]

    def name_at(self, index: int) -> str | None:
        """Name at a wire index, or None."""
        return self._names[index] if 0 <= index < len(self._names) else None

    def mav_type(self, name: str) -> int:
        """MAV_PARAM_TYPE of a parameter.

        Raises:
            KeyError: unknown name.
        """
        return MAV_PARAM_TYPE_INT32 if self._integer[name] else MAV_PARAM_TYPE_REAL32

    def wire_value(self, name: str) -> float:
        """PARAM_VALUE.param_value: integers are bit-cast into the float (MAV_PROTOCOL_CAPABILITY_PARAM_ENCODE_BYTEWISE).

        Raises:
            KeyError: unknown name.
        """
        return encode_bytewise(self._values[name])

    def set_from_wire(self, name: str, wire: float, mav_type: int) -> Value:
        """PARAM_SET: PX4 takes the type from its own table and ignores a message whose type disagrees.

        Raises:
            KeyError: unknown name.
            ValueError: the type disagrees or the value is not finite.
        """
        if mav_type != self.mav_type(name):
            raise ValueError(f"{name}: MAV_PARAM_TYPE {mav_type} sent, {self.mav_type(name)} expected")
        return self.set(name, decode_bytewise(wire, mav_type))

    def hash_check(self) -> float:
        """Value of the _HASH_CHECK pseudo parameter, a bit-cast CRC over names and values."""
        crc = 0
        for name, value in self._values.items():
            crc = zlib.crc32(name.encode(), crc)
            crc = zlib.crc32(struct.pack("<i" if self._integer[name] else "<f", value), crc)
        return float(struct.unpack("<f", struct.pack("<I", crc))[0])


def encode_bytewise(value: Value) -> float:
    """The float whose bytes are those of an int32, or the value itself."""
    if isinstance(value, int):
        return float(struct.unpack("<f", struct.pack("<i", value))[0])
    return value


def decode_bytewise(wire: float, mav_type: int) -> Value:
    """Inverse of `encode_bytewise`."""
    if mav_type == MAV_PARAM_TYPE_INT32:
        return int(struct.unpack("<i", struct.pack("<f", wire))[0])
    return wire


def _single(value: float) -> float:
    return float(struct.unpack("<f", struct.pack("<f", value))[0])
