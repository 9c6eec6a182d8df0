"""The Dynamixel models that the simulated world knows, from the ROBOTIS e-manual. The companion has a table of its own
(`companion.model.servos`), so that an error in either of them shows.
"""

from __future__ import annotations

from dataclasses import dataclass

from companion.model.servos import ServoName


@dataclass(frozen=True, slots=True)
class Kind:
    """One model of servo."""

    number: int
    """Model number (register 0)."""
    firmware: int
    amp_per_count: float
    """Unit of registers 38, 102 and 126."""
    current_counts: int
    """Factory setting and upper limit of the current limit (register 38)."""
    nm_per_amp: float
    """Torque constant: stall torque divided by stall current."""
    temperature_c: int
    """Factory setting of the temperature limit (register 31)."""
    volts: tuple[float, float, float]
    """Lowest and highest voltage without an error (registers 34 and 32), and the voltage of the supply."""
    shutdown: int
    """Factory setting of register 63."""


_STRONG = (9.5, 16.0, 12.0)
_SMALL = (3.5, 7.0, 5.0)
_SMALL_11V = (5.5, 14.0, 11.1)
_STRONG_24V = (11.0, 30.0, 24.0)

KINDS: dict[ServoName, Kind] = {
    "XM430-W210": Kind(1030, 48, 2.69e-3, 1193, 1.30, 80, _STRONG, 52),
    "XM430-W350": Kind(1020, 48, 2.69e-3, 1193, 1.78, 80, _STRONG, 52),
    "XM540-W150": Kind(1130, 48, 2.69e-3, 2047, 1.66, 80, _STRONG, 52),
    "XM540-W270": Kind(1120, 48, 2.69e-3, 2047, 2.41, 80, _STRONG, 52),
    "XH430-W210": Kind(1010, 48, 2.69e-3, 648, 1.92, 80, _STRONG, 52),
    "XH430-W350": Kind(1000, 48, 2.69e-3, 648, 2.62, 80, _STRONG, 52),
    "XH430-V210": Kind(1050, 48, 1.34e-3, 689, 3.71, 80, _STRONG_24V, 52),
    "XH430-V350": Kind(1040, 48, 1.34e-3, 689, 4.71, 80, _STRONG_24V, 52),
    "XC330-T181": Kind(1210, 53, 1.0e-3, 910, 0.95, 70, _SMALL_11V, 52),
    "XC330-T288": Kind(1220, 53, 1.0e-3, 910, 1.15, 70, _SMALL_11V, 52),
    "XC330-M181": Kind(1230, 53, 1.0e-3, 2352, 0.333, 70, _SMALL, 52),
    "XC330-M288": Kind(1240, 53, 1.0e-3, 2352, 0.517, 70, _SMALL, 52),
    "XL330-M077": Kind(1190, 53, 1.0e-3, 1750, 0.146, 70, _SMALL, 53),
    "XL330-M288": Kind(1200, 53, 1.0e-3, 1750, 0.354, 70, _SMALL, 53),
}
