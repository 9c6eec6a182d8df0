"""The Dynamixel servos that the arm can have: one row per model, and the hardware errors that all of them report.

All of them share the addresses of the control table, 4096 counts per turn, a velocity unit of 0.229 rev/min and operating mode 0
(current control). They differ in the unit of current, the limits, and the firmware from which the addresses are the same.

Sources of the rows: the page of each model in the ROBOTIS e-manual (emanual.robotis.com/docs/en/dxl/x/<model>), "Specifications" at the
recommended voltage and "Control Table of EEPROM Area" (registers 0, 31, 32, 34, 38); of the firmware of the 330 models: the model files
of ROBOTIS-GIT/dynamixel_hardware_interface.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace
from types import MappingProxyType
from typing import Final, Literal

ServoName = Literal[
    "XM430-W210",
    "XM430-W350",
    "XM540-W150",
    "XM540-W270",
    "XH430-W210",
    "XH430-W350",
    "XH430-V210",
    "XH430-V350",
    "XC330-T181",
    "XC330-T288",
    "XC330-M181",
    "XC330-M288",
    "XL330-M077",
    "XL330-M288",
]

COUNTS_PER_TURN: Final = 4096
RPM_PER_COUNT: Final = 0.229


@dataclass(frozen=True, slots=True)
class ServoKind:
    """One model of servo."""

    name: ServoName
    number: int
    """Model number (register 0)."""
    current_unit_a: float
    """Current of one count of registers 38, 102 and 126."""
    current_limit_max_counts: int
    """Upper end of the range of the current limit (register 38), which is also its factory setting."""
    stall_torque_nm: float
    """Stall torque at the recommended voltage."""
    stall_current_a: float
    """Stall current at the recommended voltage."""
    speed_max_rpm: float
    """Speed without load at the highest voltage."""
    voltage_v: tuple[float, float]
    """Lowest and highest permitted supply voltage."""
    temperature_max_c: float
    """Temperature above which the servo switches its torque off (factory setting of register 31)."""
    firmware_min: int
    """Oldest firmware (register 6) whose control table is the one that the companion uses."""
    supply_current: bool = False
    """Whether registers 38, 102 and 126 are the current of the supply instead of the motor's, which is less in proportion to the duty
    cycle: torque and current are then not proportional."""

    @property
    def speed_max_deg_s(self) -> float:
        """Return the speed without load at the highest voltage."""
        return 6.0 * self.speed_max_rpm

    @property
    def torque_per_amp_nm_a(self) -> float:
        """Return the torque constant as stall torque divided by stall current, as the e-manual does. It contains the friction of the
        gears; `companion arm friction` measures the constant itself."""
        return self.stall_torque_nm / self.stall_current_a


_V12 = (10.0, 14.8)
_V5 = (3.7, 6.0)
_V11 = (6.5, 12.0)
_V24 = (11.0, 30.0)
"""The specification states 24 V alone: these are the factory settings of registers 34 and 32, outside which the servo reports an error.
"""

# 38: bus watchdog. 53: the indirect data of the 330 models begin at 224, as those of all others, and no longer at 208.
_BUS_WATCHDOG, _INDIRECT_AT_224 = 38, 53

_ROWS: Final = (
    # name, number, A/count, limit, stall N m, stall A, rpm, V, degC, firmware
    ServoKind("XM430-W210", 1030, 2.69e-3, 1193, 3.0, 2.3, 95.0, _V12, 80.0, _BUS_WATCHDOG),
    ServoKind("XM430-W350", 1020, 2.69e-3, 1193, 4.1, 2.3, 57.0, _V12, 80.0, _BUS_WATCHDOG),
    ServoKind("XM540-W150", 1130, 2.69e-3, 2047, 7.3, 4.4, 66.0, _V12, 80.0, _BUS_WATCHDOG),
    ServoKind("XM540-W270", 1120, 2.69e-3, 2047, 10.6, 4.4, 37.0, _V12, 80.0, _BUS_WATCHDOG),
    ServoKind("XH430-W210", 1010, 2.69e-3, 648, 2.5, 1.3, 62.0, _V12, 80.0, _BUS_WATCHDOG),
    ServoKind("XH430-W350", 1000, 2.69e-3, 648, 3.4, 1.3, 37.0, _V12, 80.0, _BUS_WATCHDOG),
    ServoKind("XH430-V210", 1050, 1.34e-3, 689, 2.6, 0.7, 52.0, _V24, 80.0, _BUS_WATCHDOG),
    ServoKind("XH430-V350", 1040, 1.34e-3, 689, 3.3, 0.7, 31.0, _V24, 80.0, _BUS_WATCHDOG),
    ServoKind("XC330-T181", 1210, 1.0e-3, 910, 0.76, 0.80, 113.0, _V11, 70.0, _INDIRECT_AT_224, True),
    ServoKind("XC330-T288", 1220, 1.0e-3, 910, 0.92, 0.80, 71.0, _V11, 70.0, _INDIRECT_AT_224, True),
    ServoKind("XC330-M181", 1230, 1.0e-3, 2352, 0.60, 1.80, 155.0, _V5, 70.0, _INDIRECT_AT_224, True),
    ServoKind("XC330-M288", 1240, 1.0e-3, 2352, 0.93, 1.80, 97.0, _V5, 70.0, _INDIRECT_AT_224, True),
    ServoKind("XL330-M077", 1190, 1.0e-3, 1750, 0.215, 1.47, 456.0, _V5, 70.0, _INDIRECT_AT_224, True),
    ServoKind("XL330-M288", 1200, 1.0e-3, 1750, 0.52, 1.47, 123.0, _V5, 70.0, _INDIRECT_AT_224, True),
)  # fmt: skip

SERVOS: Final[Mapping[ServoName, ServoKind]] = MappingProxyType({kind.name: kind for kind in _ROWS})
"""Every supported model, by name."""

WITHOUT_CURRENT_CONTROL: Final[Mapping[str, int]] = MappingProxyType(
    {"XL430-W250": 1060, "2XL430-W250": 1090, "XC430-W150": 1070, "XC430-W240": 1080, "2XC430-W250": 1160}
)
"""Model numbers of the X series without operating mode 0: they cannot follow a torque."""

_KINDS: Final[Mapping[int, ServoKind]] = MappingProxyType({kind.number: kind for kind in _ROWS})
_NAMES: Final[Mapping[int, str]] = MappingProxyType(
    {kind.number: kind.name for kind in _ROWS} | {number: name for name, number in WITHOUT_CURRENT_CONTROL.items()}
)


def simulated_kind(torque_max_nm: float, speed_max_rpm: float) -> ServoKind:
    """Return the servo that the simulated world has in place of a motor which a plug-in drives: one with its torque and speed."""
    return replace(SERVOS["XM540-W270"], stall_torque_nm=torque_max_nm, speed_max_rpm=speed_max_rpm)


def kind_of(number: int) -> ServoKind | None:
    """Return the model with this number (register 0), or None if it is not supported."""
    return _KINDS.get(number)


def model_text(number: int) -> str:
    """Return the name and the number of a model, such as "XM430-W350 (model 1020)", or the number of an unknown one."""
    return f"{_NAMES[number]} (model {number})" if number in _NAMES else f"unknown model {number}"


HARDWARE_ERROR_NAMES: Final[Mapping[int, str]] = MappingProxyType(
    {0: "input voltage", 2: "overheating", 3: "motor encoder", 4: "electrical shock", 5: "overload"}
)
"""Bits of register 70, Hardware Error Status."""
MOTOR_ERROR: Final = 0x40
"""Bit that the companion sets in `ArmState.hardware_error` for a fault of a motor that a plug-in drives; unused in register 70."""
WATCHDOG_ERROR: Final = 0x80
"""Bit that the companion sets in `ArmState.hardware_error` after the bus watchdog has tripped; register 70 does not use it."""


def hardware_error_text(error: int) -> str:
    """Return the names of the bits of register 70, of `MOTOR_ERROR` and of `WATCHDOG_ERROR`."""
    names = [HARDWARE_ERROR_NAMES.get(bit, f"bit {bit}") for bit in range(6) if error >> bit & 1]
    if error & MOTOR_ERROR:
        names.append("fault of the motor")
    if error & WATCHDOG_ERROR:
        names.append("bus watchdog")
    return ", ".join(names) if names else "none"
