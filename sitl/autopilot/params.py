"""Parameter store of the PX4 stub: PX4's names, types, order, wire encoding and defaults for this vehicle.

Values are stored as in PX4: INT32, or REAL32 in single precision. The defaults are those of PX4 1.16, except for `VEHICLE_DEFAULTS`:
settings for flying indoors with motion capture as the only position source, and a lower take-off speed for a small room.
"""

from __future__ import annotations

import math
import struct
import zlib
from collections.abc import Iterator, Mapping

from companion.px4.defaults import PX4_DEFAULTS as PX4_DEFAULTS
from companion.px4.params_file import single
from companion.px4.required import simulated_values
from companion.px4.versions import Release, has

MAV_PARAM_TYPE_INT32 = 6
MAV_PARAM_TYPE_REAL32 = 9
HASH_CHECK = "_HASH_CHECK"
VERSION = (1, 16)
"""PX4 version from which the names and defaults come."""

Value = int | float

VEHICLE_DEFAULTS: Mapping[str, Value] = {
    **{name: value for name, value in simulated_values().items() if has(name, VERSION)},
    "BAT1_CAPACITY": 5200.0,
    "MPC_TKO_SPEED": 0.6,
}


_MAV_TYPES = {6: 13, 8: 14}
_MAV_TYPE_QUADROTOR = 2


def mav_type(rotors: int) -> int:
    """Return PX4's MAV_TYPE for a number of rotors; PX4 has no type for 5, 7 and more than 8 and flies them as a quadrotor."""
    return _MAV_TYPES.get(rotors, _MAV_TYPE_QUADROTOR)


class Params:
    """The autopilot's parameters; as in PX4, they are indexed in alphabetical order."""

    def __init__(self, overrides: Mapping[str, Value] | None = None, release: Release = VERSION) -> None:
        """Set the defaults of this vehicle, then `overrides`.

        Args:
            release: version of PX4 that the stub imitates. Names and defaults are those of `VERSION` in any case.

        Raises:
            KeyError: an override names an unknown parameter.
            ValueError: an override is not finite, or is not a whole number in the range of INT32 although the parameter is an INT32.
        """
        self.release = release
        self.revision = 0
        """Counter that increases with every change, so that caches can detect changes."""
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
        """Return a value as float.

        Raises:
            KeyError: the name is unknown.
        """
        return float(self._values[name])

    def integer(self, name: str) -> int:
        """Return a value as int.

        Raises:
            KeyError: the name is unknown.
        """
        return int(self._values[name])

    def set(self, name: str, value: Value) -> Value:
        """Store a value and return it as stored, in the parameter's type.

        Raises:
            KeyError: the name is unknown.
            ValueError: the value is not finite, or is not a whole number in the range of INT32 although the parameter is an INT32.
        """
        integer = self._integer[name]
        if not math.isfinite(value):
            raise ValueError(f"{name}: {value} is not finite")
        if integer and value != int(value):
            raise ValueError(f"{name}: expected a whole number (INT32), got {value}")
        stored: Value = int(value) if integer else single(float(value))
        if integer and not -(2**31) <= stored < 2**31:
            raise ValueError(f"{name}: expected a number in the range of INT32, got {value}")
        self._values[name] = stored
        self.revision += 1
        return stored

    def index(self, name: str) -> int:
        """Return the index of a parameter in the MAVLink parameter protocol.

        Raises:
            KeyError: the name is unknown.
        """
        return self._index[name]

    def name_at(self, index: int) -> str | None:
        """Return the name of the parameter with this index in the MAVLink parameter protocol, or None."""
        return self._names[index] if 0 <= index < len(self._names) else None

    def mav_type(self, name: str) -> int:
        """Return the MAV_PARAM_TYPE of a parameter.

        Raises:
            KeyError: the name is unknown.
        """
        return MAV_PARAM_TYPE_INT32 if self._integer[name] else MAV_PARAM_TYPE_REAL32

    def wire_value(self, name: str) -> float:
        """Return a parameter as PARAM_VALUE.param_value; an integer is bit-cast to float (PARAM_ENCODE_BYTEWISE).

        Raises:
            KeyError: the name is unknown.
        """
        return encode_bytewise(self._values[name])

    def set_from_wire(self, name: str, wire: float, mav_type: int) -> Value:
        """Store and return the value from a PARAM_SET message.

        Raises:
            KeyError: the name is unknown.
            ValueError: the message's type differs from the parameter's, or the value is not finite.
        """
        if mav_type != self.mav_type(name):
            raise ValueError(f"{name}: expected MAV_PARAM_TYPE {self.mav_type(name)}, got {mav_type}")
        return self.set(name, decode_bytewise(wire, mav_type))

    def hash_check(self) -> float:
        """Return the value of the pseudo-parameter _HASH_CHECK: a CRC over names and values, bit-cast to float."""
        crc = 0
        for name, value in self._values.items():
            crc = zlib.crc32(name.encode(), crc)
            crc = zlib.crc32(struct.pack("<i" if self._integer[name] else "<f", value), crc)
        return float(struct.unpack("<f", struct.pack("<I", crc))[0])


def encode_bytewise(value: Value) -> float:
    """Return the float with the same bytes as an int32; return a float unchanged."""
    if isinstance(value, int):
        return float(struct.unpack("<f", struct.pack("<i", value))[0])
    return value


def decode_bytewise(wire: float, mav_type: int) -> Value:
    """Undo `encode_bytewise`."""
    if mav_type == MAV_PARAM_TYPE_INT32:
        return int(struct.unpack("<i", struct.pack("<f", wire))[0])
    return wire
