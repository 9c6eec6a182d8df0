"""Settings of a servo, found and required, and the assignment of servos to joints. Pure functions."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any, Final, NamedTuple

from companion.commissioning.arm import bus
from companion.config.arm import Arm, Joint
from companion.config.devices import ArmDevice
from companion.config.document import ConfigError
from companion.config.vehicle import Vehicle
from companion.io.dynamixel import registers as dxl
from companion.io.dynamixel.registers import Register
from companion.model.servos import COUNTS_PER_TURN, SERVOS, ServoKind, kind_of
from companion.preflight.arm import mode_text

SETTINGS: Final = (
    bus.ID, bus.BAUD, dxl.RETURN_DELAY, dxl.DRIVE_MODE, dxl.OPERATING_MODE, dxl.SECONDARY_ID, dxl.HOMING_OFFSET, dxl.PWM_LIMIT,
    dxl.CURRENT_LIMIT, bus.MAX_POSITION_LIMIT, bus.MIN_POSITION_LIMIT, dxl.STARTUP, dxl.SHUTDOWN, dxl.TORQUE_ENABLE,
    dxl.STATUS_RETURN_LEVEL, dxl.HARDWARE_ERROR, dxl.BUS_WATCHDOG, dxl.PRESENT_POSITION, dxl.PRESENT_VOLTAGE,
    dxl.PRESENT_TEMPERATURE,
)  # fmt: skip
"""Registers that are read from every servo."""
CURRENT_RESERVE: Final = 1.1
_DRIVE_REVERSE: Final = 1


class ClampJoint(Joint):
    """The clamp's servo, which is set up as if it were that of a further joint, but for its operating mode."""


def with_clamp(vehicle: Vehicle) -> Arm:
    """Return the arm, with the clamp's servo as its last joint."""
    arm, jaws = vehicle.arm, vehicle.jaws
    if jaws is None:
        return arm
    kind = SERVOS[jaws.servo]
    clamp = ClampJoint(
        servo=jaws.servo,
        servo_id=jaws.servo_id,
        sign=1,
        zero_count=0,
        angle_deg=(min(jaws.open_deg, jaws.empty_deg), max(jaws.open_deg, jaws.empty_deg)),
        torque_max_nm=min(jaws.current_a, kind.stall_current_a) * kind.torque_per_amp_nm_a,
        torque_per_amp_nm_a=kind.torque_per_amp_nm_a,
    )
    return arm.model_copy(update={"joints": (*arm.joints, clamp)})


@dataclass(frozen=True, slots=True)
class FoundServo:
    """A servo that answered."""

    servo_id: int
    baud: int
    model: int
    firmware: int
    registers: dict[str, int]
    """Register values by name; empty if the servo only answers pings, or its model is not supported."""

    def value(self, register: Register) -> int:
        """Return a register's value.

        Raises:
            KeyError: the register was not read.
        """
        return self.registers[register.name]

    @property
    def kind(self) -> ServoKind:
        """Return the data of the servo's model.

        Raises:
            ValueError: the model is not supported.
        """
        kind = kind_of(self.model)
        if kind is None:
            raise ValueError(f"model {self.model} is not supported")
        return kind

    def fits(self, joint: Joint) -> bool:
        """Return whether the servo is of the joint's model and its registers were read."""
        return self.model == joint.kind.number and bool(self.registers)

    def as_json(self) -> dict[str, Any]:
        """Return the servo's part of the JSON document, with names and units instead of register values."""
        about: dict[str, Any] = {"id": self.servo_id, "baud": self.baud, "model": self.model, "firmware": self.firmware}
        if not self.registers:
            return about
        value = self.value
        return about | {
            "return_delay_us": value(dxl.RETURN_DELAY) * dxl.RETURN_DELAY_UNIT_US,
            "operating_mode": value(dxl.OPERATING_MODE),
            "drive_mode": value(dxl.DRIVE_MODE),
            "shadow_id": None if value(dxl.SECONDARY_ID) > 252 else value(dxl.SECONDARY_ID),
            "homing_offset_counts": value(dxl.HOMING_OFFSET),
            "current_limit_counts": value(dxl.CURRENT_LIMIT),
            "pwm_limit_counts": value(dxl.PWM_LIMIT),
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


def settings(servo: FoundServo, index: int, arm: Arm, device: ArmDevice) -> list[Setting]:
    """Return every setting that the companion needs, in the order of writing: id and baud rate last, as they change the address."""
    joint = arm.joints[index]
    kind = joint.kind
    needed = math.floor(joint.torque_max_nm / (arm.torque_constants_nm_a[index] * kind.current_unit_a) + 1e-9)
    limit = servo.value(dxl.CURRENT_LIMIT)
    wanted_limit = limit if limit >= needed else min(kind.current_limit_max_counts, math.ceil(CURRENT_RESERVE * needed))
    delay, mode = dxl.RETURN_DELAY_UNIT_US, (dxl.MODE_CURRENT, "the companion commands currents")
    if isinstance(joint, ClampJoint):
        mode = dxl.MODE_CURRENT_POSITION, "a clamp holds its angle by itself"
    rows: list[tuple[Register, int, Callable[[int], str], str]] = [
        (dxl.RETURN_DELAY, 0, lambda v: f"{v * delay} us", "the factory setting of 500 us per servo takes a fifth of a control tick"),
        (dxl.OPERATING_MODE, mode[0], mode_text, mode[1]),
        *((register, wanted, _SHOWN.get(register, str), why) for register, wanted, why in dxl.REQUIRED),
        (dxl.CURRENT_LIMIT, wanted_limit, str, f"torque_max_nm {joint.torque_max_nm:g} needs {needed}"),
        (bus.MIN_POSITION_LIMIT, 0, str, "the companion itself enforces the joint limits"),
        (bus.MAX_POSITION_LIMIT, COUNTS_PER_TURN - 1, str, "the companion itself enforces the joint limits"),
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

    joints: tuple[FoundServo | None, ...]
    """Servo of each joint, by id; a single remaining servo is assigned to the joint without one."""
    renamed: int | None
    """Joint whose servo id differs from the vehicle file."""
    others: tuple[FoundServo, ...]
    """Servos that belong to no joint or to an unknown one."""


def assign(servos: Sequence[FoundServo], arm: Arm) -> Assignment:
    """Assign servos of the right model by id. If one joint is left and one servo of its model, assign that servo to this joint."""
    by_joint: list[FoundServo | None] = []
    for joint in arm.joints:
        having = [servo for servo in servos if servo.servo_id == joint.servo_id and servo.fits(joint)]
        by_joint.append(having[0] if len(having) == 1 else None)
    left = [servo for servo in servos if servo not in by_joint]
    renamed = None
    if by_joint.count(None) == 1:
        missing = by_joint.index(None)
        candidates = [servo for servo in left if servo.fits(arm.joints[missing])]
        if len(candidates) == 1:
            renamed = missing
            by_joint[missing] = candidates[0]
            left.remove(candidates[0])
    return Assignment(tuple(by_joint), renamed, tuple(left))


def joint_in(arm: Arm, index: int | None) -> int | None:
    """Return the index of `--joint`, or None if it is absent.

    Raises:
        ConfigError: the arm has no such joint.
    """
    count = len(arm.joints)
    if index is not None and index >= count:
        raise ConfigError(f"--joint {index + 1}: expected 1 to {count}, the arm's joints from the shoulder outwards")
    return index


def expected_models(servo: FoundServo, arm: Arm) -> Sequence[str]:
    """Return the models that the vehicle file permits for this servo: that of the joint with its id, or those of all joints."""
    own = [joint.kind.name for joint in arm.joints if joint.servo_id == servo.servo_id]
    return own or sorted({joint.kind.name for joint in arm.joints})


def is_strange(servo: FoundServo, arm: Arm) -> bool:
    """Return whether the servo is of a model that the vehicle file does not permit, or its registers could not be read."""
    kind = kind_of(servo.model)
    return kind is None or kind.name not in expected_models(servo, arm) or not servo.registers


def baud_text(value: int) -> str:
    """Return a value of register 8 as a rate."""
    return str(bus.BAUDS[value]) if value < len(bus.BAUDS) else f"value {value}"


def _drive_text(mode: int) -> str:
    return f"{mode} ({'reverse' if mode & _DRIVE_REVERSE else 'normal'})"


_SHOWN: Final[dict[Register, Callable[[int], str]]] = {
    dxl.DRIVE_MODE: _drive_text,
    dxl.SECONDARY_ID: lambda value: "none" if value > 252 else str(value),
    dxl.SHUTDOWN: lambda value: f"0x{value:02x}",
}


def _watchdog_text(value: int) -> str:
    if value == dxl.WATCHDOG_TRIPPED:
        return "let go"
    return f"{value * dxl.WATCHDOG_UNIT_MS} ms" if value else "off"
