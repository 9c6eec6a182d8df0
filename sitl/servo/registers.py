"""Control table of the XM430-W210 as data; other models differ in the values of `sitl.servo.kinds`.

Source: ROBOTIS e-manual, XM430-W210, "Control Table of EEPROM Area" and "Control Table of RAM Area".
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import get_args

from companion.config.devices import ServoBaud

MODEL = 1030
BAUDS: tuple[int, ...] = (9600, *get_args(ServoBaud), 4_500_000)
"""Baud rates in bit/s, indexed by the value of register 8."""
TABLE_SIZE = 662
EEPROM_END = 64
"""Registers below this address survive a reboot and are locked while torque is on."""


@dataclass(frozen=True, slots=True)
class Register:
    """One entry of the control table."""

    address: int
    size: int
    name: str
    writable: bool
    initial: int
    low: int
    high: int

    @property
    def signed(self) -> bool:
        """Whether the value is in two's complement."""
        return self.low < 0

    @property
    def eeprom(self) -> bool:
        """Whether the register survives a reboot and is locked while torque is on."""
        return self.address < EEPROM_END

    def decode(self, raw: bytes | bytearray) -> int:
        """Return the value of the register's bytes."""
        return int.from_bytes(raw, "little", signed=self.signed)

    def encode(self, value: int) -> bytes:
        """Return the bytes of a value, wrapped at the register's size."""
        return (value & ((1 << 8 * self.size) - 1)).to_bytes(self.size, "little")


def _read_only(address: int, size: int, name: str, initial: int = 0, *, signed: bool = False) -> Register:
    span = 1 << 8 * size
    low, high = (-span // 2, span // 2 - 1) if signed else (0, span - 1)
    return Register(address=address, size=size, name=name, writable=False, initial=initial, low=low, high=high)


def _read_write(address: int, size: int, name: str, initial: int, low: int, high: int) -> Register:
    return Register(address=address, size=size, name=name, writable=True, initial=initial, low=low, high=high)


MODEL_NUMBER = _read_only(0, 2, "model number", MODEL)
ID = _read_write(7, 1, "id", 1, 0, 252)
BAUD = _read_write(8, 1, "baud rate", 1, 0, 7)
RETURN_DELAY = _read_write(9, 1, "return delay time", 250, 0, 254)
DRIVE_MODE = _read_write(10, 1, "drive mode", 0, 0, 5)
OPERATING_MODE = _read_write(11, 1, "operating mode", 3, 0, 16)
FIRMWARE = _read_only(6, 1, "firmware version")
HOMING_OFFSET = _read_write(20, 4, "homing offset", 0, -1_044_479, 1_044_479)
MOVING_THRESHOLD = _read_write(24, 4, "moving threshold", 10, 0, 1023)
TEMPERATURE_LIMIT = _read_write(31, 1, "temperature limit", 80, 0, 100)
MAX_VOLTAGE_LIMIT = _read_write(32, 2, "max voltage limit", 160, 31, 300)
MIN_VOLTAGE_LIMIT = _read_write(34, 2, "min voltage limit", 95, 31, 300)
PWM_LIMIT = _read_write(36, 2, "pwm limit", 885, 0, 885)
CURRENT_LIMIT = _read_write(38, 2, "current limit", 1193, 0, 1193)
VELOCITY_LIMIT = _read_write(44, 4, "velocity limit", 330, 0, 1023)
MAX_POSITION_LIMIT = _read_write(48, 4, "max position limit", 4095, 0, 4095)
MIN_POSITION_LIMIT = _read_write(52, 4, "min position limit", 0, 0, 4095)
SECONDARY_ID = _read_write(12, 1, "secondary id", 255, 0, 255)
STARTUP = _read_write(60, 1, "startup configuration", 0, 0, 3)
"""Bit 0: torque on after a restart. Bit 1: restored RAM, which the emulator does not have."""
SHUTDOWN = _read_write(63, 1, "shutdown", 52, 0, 255)
TORQUE_ENABLE = _read_write(64, 1, "torque enable", 0, 0, 1)
LED = _read_write(65, 1, "led", 0, 0, 1)
STATUS_RETURN_LEVEL = _read_write(68, 1, "status return level", 2, 0, 2)
REGISTERED_INSTRUCTION = _read_only(69, 1, "registered instruction")
HARDWARE_ERROR = _read_only(70, 1, "hardware error status")
POSITION_P_GAIN = _read_write(84, 2, "position p gain", 800, 0, 16383)
BUS_WATCHDOG = _read_write(98, 1, "bus watchdog", 0, 0, 127)
GOAL_PWM = _read_write(100, 2, "goal pwm", 885, -885, 885)
GOAL_CURRENT = _read_write(102, 2, "goal current", 1193, -1193, 1193)
GOAL_VELOCITY = _read_write(104, 4, "goal velocity", 0, -1023, 1023)
GOAL_POSITION = _read_write(116, 4, "goal position", 0, -1_048_575, 1_048_575)
REALTIME_TICK = _read_only(120, 2, "realtime tick")
MOVING = _read_only(122, 1, "moving")
PRESENT_CURRENT = _read_only(126, 2, "present current", signed=True)
PRESENT_VELOCITY = _read_only(128, 4, "present velocity", signed=True)
PRESENT_POSITION = _read_only(132, 4, "present position", signed=True)
PRESENT_VOLTAGE = _read_only(144, 2, "present input voltage", 120)
PRESENT_TEMPERATURE = _read_only(146, 1, "present temperature", 30)

GOALS = (GOAL_PWM, GOAL_CURRENT, GOAL_VELOCITY, GOAL_POSITION)
"""Goal registers; read-only after the bus watchdog has tripped."""

INDIRECT_BLOCKS = ((168, 224, 28), (578, 634, 28))
"""(first indirect address register, first indirect data register, number of indirect data bytes) of each block."""
INDIRECT_TARGETS = range(64, 662)

_PLAIN = (
    MODEL_NUMBER,
    _read_only(2, 4, "model information"),
    FIRMWARE,
    ID,
    BAUD,
    RETURN_DELAY,
    DRIVE_MODE,
    OPERATING_MODE,
    SECONDARY_ID,
    _read_write(13, 1, "protocol type", 2, 2, 2),
    HOMING_OFFSET,
    MOVING_THRESHOLD,
    TEMPERATURE_LIMIT,
    MAX_VOLTAGE_LIMIT,
    MIN_VOLTAGE_LIMIT,
    PWM_LIMIT,
    CURRENT_LIMIT,
    VELOCITY_LIMIT,
    MAX_POSITION_LIMIT,
    MIN_POSITION_LIMIT,
    STARTUP,
    SHUTDOWN,
    TORQUE_ENABLE,
    LED,
    STATUS_RETURN_LEVEL,
    REGISTERED_INSTRUCTION,
    HARDWARE_ERROR,
    _read_write(76, 2, "velocity i gain", 1920, 0, 16383),
    _read_write(78, 2, "velocity p gain", 100, 0, 16383),
    _read_write(80, 2, "position d gain", 0, 0, 16383),
    _read_write(82, 2, "position i gain", 0, 0, 16383),
    POSITION_P_GAIN,
    _read_write(88, 2, "feedforward 2nd gain", 0, 0, 16383),
    _read_write(90, 2, "feedforward 1st gain", 0, 0, 16383),
    BUS_WATCHDOG,
    *GOALS[:3],
    _read_write(108, 4, "profile acceleration", 0, 0, 32767),
    _read_write(112, 4, "profile velocity", 0, 0, 32767),
    GOAL_POSITION,
    REALTIME_TICK,
    MOVING,
    _read_only(123, 1, "moving status"),
    _read_only(124, 2, "present pwm", signed=True),
    PRESENT_CURRENT,
    PRESENT_VELOCITY,
    PRESENT_POSITION,
    _read_only(136, 4, "velocity trajectory", signed=True),
    _read_only(140, 4, "position trajectory", signed=True),
    PRESENT_VOLTAGE,
    PRESENT_TEMPERATURE,
    _read_only(147, 1, "backup ready"),
)

_INDIRECT_ADDRESSES = tuple(
    _read_write(first + 2 * i, 2, "indirect address", data + i, INDIRECT_TARGETS.start, INDIRECT_TARGETS.stop - 1)
    for first, data, count in INDIRECT_BLOCKS
    for i in range(count)
)

REGISTERS = _PLAIN + _INDIRECT_ADDRESSES
"""Every register except indirect data, which map to other registers."""

REGISTER_AT: dict[int, Register] = {
    register.address + i: register for register in REGISTERS for i in range(register.size)
}

INDIRECT_POINTER: dict[int, int] = {
    data + i: first + 2 * i for first, data, count in INDIRECT_BLOCKS for i in range(count)
}
