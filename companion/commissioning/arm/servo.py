"""Settings of a servo, found and required, and the assignment of servos to joints. Pure functions."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any, Final, NamedTuple

from companion.commissioning.arm import bus
from companion.config.vehicle import Arm, ArmDevice, Joint
from companion.io.dynamixel import registers as dxl
from companion.io.dynamixel.registers import Register
from companion.preflight.arm import MODES

SETTINGS: Final = (
    bus.ID, bus.BAUD, dxl.RETURN_DELAY, bus.DRIVE_MODE, dxl.OPERATING_MODE, bus.SHADOW_ID, bus.HOMING_OFFSET, bus.PWM_LIMIT,
    dxl.CURRENT_LIMIT, bus.MAX_POSITION_LIMIT, bus.MIN_POSITION_LIMIT, bus.STARTUP, bus.SHUTDOWN, dxl.TORQUE_ENABLE,
    dxl.STATUS_RETURN_LEVEL, dxl.HARDWARE_ERROR, dxl.BUS_WATCHDOG, dxl.PRESENT_POSITION, dxl.PRESENT_VOLTAGE,
    dxl.PRESENT_TEMPERATURE,
)  # fmt: skip
"""Registers that are read from every servo."""
CURRENT_LIMIT_MAX: Final = 1193
CURRENT_RESERVE: Final = 1.1
SHUTDOWN_BITS: Final = 0b00110100
"""Overheating, electrical shock, overload: factory value of register 63."""
NO_SHADOW: Final = 255
_DRIVE_REVERSE: Final = 1


@dataclass(frozen=True, slots=True)
class FoundServo:
    """A servo that answered."""

    servo_id: int
    baud: int
    model: int
    firmware: int
    registers: dict[str, int]
    """Register values by name; empty if the servo only answers pings."""

    def value(self, register: Register) -> int:
        """Return a register's value.

        Raises:
            KeyError: the register was not read.
        """
        return self.registers[register.name]

    @property
    def is_xm430(self) -> bool:
        """Whether it is an XM430-W210 and its registers were read."""
        return self.model == dxl.MODEL_NUMBER_XM430_W210 and bool(self.registers)

    def as_json(self) -> dict[str, Any]:
        """Return the servo's part of the JSON document, with names and units instead of register values."""
        about: dict[str, Any] = {"id": self.servo_id, "baud": self.baud, "model": self.model, "firmware": self.firmware}
        if not self.registers:
            return about
        value = self.value
        return about | {
            "return_delay_us": value(dxl.RETURN_DELAY) * dxl.RETURN_DELAY_UNIT_US,
            "operating_mode": value(dxl.OPERATING_MODE),
            "drive_mode": value(bus.DRIVE_MODE),
            "shadow_id": None if value(bus.SHADOW_ID) > 252 else value(bus.SHADOW_ID),
            "homing_offset_counts": value(bus.HOMING_OFFSET),
            "current_limit_counts": value(dxl.CURRENT_LIMIT),
            "pwm_limit_counts": value(bus.PWM_LIMIT),
            "position_limit_counts": [value(bus.MIN_POSITION_LIMIT), value(bus.MAX_POSITION_LIMIT)],
            "watchdog": _watchdog_text(value(dxl.BUS_WATCHDOG)),
            "torque_on": bool(value(dxl.TORQUE_ENABLE)),
            "hardware_error": value(dxl.HARDWARE_ERROR),
            "temperature_c": value(dxl.PRESENT_TEMPERATURE),
            "voltage_v": round(value(dxl.PRESENT_VOLTAGE) * dxl.VOLTAGE_UNIT_V, 1),
            "position_counts": value(dxl.PRESENT_POSITION),
        }


@dataclass(frozen=True, slots=True)
class Scan:
    """All servos that answered."""

    bauds: tuple[int, ...]
    """Baud rates that were tried."""
    servos: tuple[FoundServo, ...]
    garbled_at: tuple[int, ...]
    """Baud rates at which unreadable bytes arrived."""
    latency_ms: int | None
    """Latency timer of the adapter; None if it has none."""


class Setting(NamedTuple):
    """Found and required value of a register."""

    register: Register
    found: int
    wanted: int
    shown: Callable[[int], str]
    """Formats a value for display."""
    why: str

    @property
    def right(self) -> bool:
        """Return whether the found value is correct."""
        return self.found == self.wanted


def settings(servo: FoundServo, joint: Joint, arm: Arm, device: ArmDevice) -> list[Setting]:
    """Return every setting that the companion needs, in the order of writing: id and baud rate come last because they change the
    address.

    Args:
        servo: found servo with its registers.
        joint: joint of this servo.
        arm: provides the torque constant.
        device: provides the bus's baud rate.
    """
    needed = math.floor(joint.torque_max_nm / (arm.torque_per_amp_nm_a * dxl.AMP_PER_COUNT) + 1e-9)
    limit = servo.value(dxl.CURRENT_LIMIT)
    wanted_limit = limit if limit >= needed else min(CURRENT_LIMIT_MAX, math.ceil(CURRENT_RESERVE * needed))
    delay = dxl.RETURN_DELAY_UNIT_US
    rows: list[tuple[Register, int, Callable[[int], str], str]] = [
        (dxl.RETURN_DELAY, 0, lambda v: f"{v * delay} us", "the factory setting of 500 us per servo takes a fifth of a control tick"),
        (dxl.OPERATING_MODE, dxl.MODE_CURRENT, _mode_text, "the companion commands currents"),
        (bus.DRIVE_MODE, 0, _drive_text, "the vehicle file's sign gives the servo's direction"),
        (bus.HOMING_OFFSET, 0, str, "the vehicle file's zero_count gives the zero"),
        (bus.SHADOW_ID, NO_SHADOW, lambda v: "none" if v > 252 else str(v), "it would follow another servo's commands"),
        (dxl.CURRENT_LIMIT, wanted_limit, str, f"torque_max_nm {joint.torque_max_nm:g} needs {needed}"),
        (bus.PWM_LIMIT, 885, str, "a lower limit gives less torque at speed"),
        (bus.MIN_POSITION_LIMIT, 0, str, "the companion itself enforces the joint limits"),
        (bus.MAX_POSITION_LIMIT, dxl.COUNTS_PER_TURN - 1, str, "the companion itself enforces the joint limits"),
        (bus.STARTUP, 0, str, "no torque at power-on"),
        (bus.SHUTDOWN, SHUTDOWN_BITS, lambda v: f"0x{v:02x}", "overheating, shock and overload switch the torque off"),
        (bus.ID, joint.servo_id, str, "the vehicle file's servo_id"),
        (bus.BAUD, bus.BAUDS.index(device.baud), baud_text, "the vehicle file's devices.arm.baud"),
    ]  # fmt: skip
    return [
        Setting(register=register, found=servo.value(register), wanted=wanted, shown=shown, why=why)
        for register, wanted, shown, why in rows
    ]


@dataclass(frozen=True, slots=True)
class Assignment:
    """Assignment of servos to joints."""

    joints: tuple[FoundServo | None, FoundServo | None]
    """Servo of each joint, by id; a single remaining servo is assigned to the joint without one."""
    renamed: int | None
    """Joint whose servo id differs from the vehicle file."""
    others: tuple[FoundServo, ...]
    """Servos that belong to no joint or to an unknown one."""


def assign(servos: Sequence[FoundServo], arm: Arm) -> Assignment:
    """Assign servos by id. If one joint's servo is missing and one XM430 remains, assign it to this joint."""
    by_joint: list[FoundServo | None] = []
    for joint in arm.joints:
        having = [servo for servo in servos if servo.servo_id == joint.servo_id and servo.is_xm430]
        by_joint.append(having[0] if len(having) == 1 else None)
    left = [servo for servo in servos if servo not in by_joint]
    candidates = [servo for servo in left if servo.is_xm430]
    renamed = None
    if by_joint.count(None) == 1 and len(candidates) == 1:
        renamed = by_joint.index(None)
        by_joint[renamed] = candidates[0]
        left.remove(candidates[0])
    return Assignment((by_joint[0], by_joint[1]), renamed, tuple(left))


def baud_text(value: int) -> str:
    """Return a value of register 8 as a rate."""
    return str(bus.BAUDS[value]) if value < len(bus.BAUDS) else f"value {value}"


def _mode_text(mode: int) -> str:
    return f"{mode} ({MODES.get(mode, 'unknown')})"


def _drive_text(mode: int) -> str:
    return f"{mode} ({'reverse' if mode & _DRIVE_REVERSE else 'normal'})"


def _watchdog_text(value: int) -> str:
    if value == dxl.WATCHDOG_TRIPPED:
        return "let go"
    return f"{value * dxl.WATCHDOG_UNIT_MS} ms" if value else "off"
