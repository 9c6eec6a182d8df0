"""The servos' control table, and the block of it that is read in every cycle. Pure.

Source: ROBOTIS e-manual, XM430-W210 control table; every model of `companion.model.servos` has these registers at these addresses.
The supported baud rates are those of `companion.config.devices.ServoBaud`.
"""

from __future__ import annotations

import struct
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Final

MODE_CURRENT: Final = 0
MODE_CURRENT_POSITION: Final = 5
WATCHDOG_UNIT_MS = 20
RETURN_DELAY_UNIT_US = 2
VOLTAGE_UNIT_V = 0.1
WATCHDOG_TRIPPED = 0xFF
"""Value of register 98 after the bus watchdog has tripped."""


@dataclass(frozen=True, slots=True)
class Register:
    """One entry of the control table."""

    address: int
    size: int
    name: str
    signed: bool = False

    def __str__(self) -> str:
        return f"{self.name} (register {self.address})"


MODEL = Register(0, 2, "model number")
FIRMWARE = Register(6, 1, "firmware version")
RETURN_DELAY = Register(9, 1, "return delay time")
DRIVE_MODE = Register(10, 1, "drive mode")
OPERATING_MODE = Register(11, 1, "operating mode")
SECONDARY_ID = Register(12, 1, "secondary id")
HOMING_OFFSET = Register(20, 4, "homing offset", signed=True)
PWM_LIMIT = Register(36, 2, "PWM limit")
CURRENT_LIMIT = Register(38, 2, "current limit")
STARTUP = Register(60, 1, "startup configuration")
SHUTDOWN = Register(63, 1, "shutdown")
TORQUE_ENABLE = Register(64, 1, "torque enable")
STATUS_RETURN_LEVEL = Register(68, 1, "status return level")
HARDWARE_ERROR = Register(70, 1, "hardware error status")
BUS_WATCHDOG = Register(98, 1, "bus watchdog")
GOAL_CURRENT = Register(102, 2, "goal current", signed=True)
GOAL_POSITION = Register(116, 4, "goal position", signed=True)
PRESENT_CURRENT = Register(126, 2, "present current", signed=True)
PRESENT_VELOCITY = Register(128, 4, "present velocity", signed=True)
PRESENT_POSITION = Register(132, 4, "present position", signed=True)
PRESENT_VOLTAGE = Register(144, 2, "present input voltage")
PRESENT_TEMPERATURE = Register(146, 1, "present temperature")
INDIRECT_ADDRESS_1 = 168
INDIRECT_DATA_1 = 224
REQUIRED: Final = (
    (DRIVE_MODE, 0, "the vehicle file's sign gives the servo's direction"),
    (HOMING_OFFSET, 0, "the vehicle file's zero_count gives the zero"),
    (SECONDARY_ID, 255, "it would follow another servo's commands"),
    (PWM_LIMIT, 885, "a lower limit gives less torque at speed"),
    (STARTUP, 0, "after a restart it would switch its torque on by itself, or bring back old settings"),
    (SHUTDOWN, 0b00110100, "overheating, shock and overload switch the torque off"),
)
"""EEPROM settings, with their reason, that `companion arm setup` writes and every start of the arm verifies: other values change what
is read or commanded."""

# The one block that is read in every cycle. A small byte follows every signed value, so that FF FF FD never occurs in an
# answer: once it has removed a stuffed byte, dynamixel-sdk 4.1.0 also removes one from a later FF FD FD, which is data.
BLOCK = (PRESENT_POSITION, HARDWARE_ERROR, PRESENT_VELOCITY, PRESENT_TEMPERATURE, PRESENT_CURRENT, BUS_WATCHDOG)
BLOCK_SIZE = sum(register.size for register in BLOCK)
JAWS_BLOCK = (PRESENT_POSITION, TORQUE_ENABLE, GOAL_POSITION, PRESENT_TEMPERATURE, GOAL_CURRENT, HARDWARE_ERROR)
"""The block of the clamp's servo, in the same format: whether it has taken its last command shows in the next read."""
_BLOCK: Final = struct.Struct("<iBiBhB")


def pointers(block: Sequence[Register]) -> bytes:
    """Return the indirect addresses of a block."""
    return b"".join((one.address + i).to_bytes(2, "little") for one in block for i in range(one.size))


_INSTRUCTION_BYTES, _STATUS_BYTES, _GOAL_BYTES = 14, 11, 3
"""Bytes of a sync read or sync write without its servos, of a status packet without its data, and per servo in the sync write."""


def cycle_bytes(servos: int) -> int:
    """Return the bytes on the bus in one cycle: the sync read with one id per servo, its answers, and the sync write."""
    per_servo = 1 + _STATUS_BYTES + BLOCK_SIZE + _GOAL_BYTES
    return 2 * _INSTRUCTION_BYTES + servos * per_servo


def cycle_s(servos: int, baud: int) -> float:
    """Return the time that one cycle occupies the bus, with ten bits per byte; return delays and the USB adapter come on top."""
    return 10.0 * cycle_bytes(servos) / baud


@dataclass(frozen=True, slots=True)
class Block:
    """One servo's data in the read of a cycle, in register units."""

    position_count: int
    hardware_error: int
    velocity_count: int
    temperature_c: int
    current_count: int
    bus_watchdog: int

    @staticmethod
    def from_bytes(data: bytes) -> Block:
        """Decode `BLOCK_SIZE` bytes of indirect data."""
        return Block(*_BLOCK.unpack(data))

    @property
    def is_unwatched(self) -> bool:
        """Return whether the watchdog is off in a servo that has not restarted, whose block would be zero: its restart was lost."""
        return self.bus_watchdog == 0 and self.temperature_c != 0


@dataclass(frozen=True, slots=True)
class JawsBlock:
    """The data of the clamp's servo in the read of a cycle, in register units."""

    position_count: int
    torque_on: int
    goal_count: int
    temperature_c: int
    goal_current: int
    hardware_error: int

    @staticmethod
    def from_bytes(data: bytes) -> JawsBlock:
        """Decode `BLOCK_SIZE` bytes of indirect data."""
        return JawsBlock(*_BLOCK.unpack(data))
