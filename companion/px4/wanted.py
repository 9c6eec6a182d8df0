"""A PX4 parameter on which a flight depends: the values that a vehicle can fly with, and the consequence of any other."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

from companion.config.vehicle import Vehicle
from companion.model.check_row import Level

_RELATIVE = 1e-6

Value = float | int
Limits = tuple[float, float] | Callable[[Vehicle], tuple[float, float]]
"""Lowest and highest accepted value: the same for every vehicle, or computed from the vehicle file."""


@dataclass(frozen=True, slots=True)
class Wanted:
    """One parameter. The values in `ok` or within `limits` are accepted; if neither is set, only `value` is accepted."""

    name: str
    value: Value | None
    """Value in the parameter file, in PX4's type: int for INT32, float for REAL32. None if it is measured on each vehicle."""
    why: str
    """Consequence of a wrong value, or meaning of the values."""
    level: Level = Level.REFUSE
    reboot: bool = False
    ok: tuple[int, ...] = ()
    limits: Limits | None = None
    limits_text: str = ""
    """Description of the limits, if they depend on the vehicle file."""
    fix: str = ""
    """Remedy, if it is not simply to set the parameter."""
    hardware: bool = False
    """Whether it belongs to the port TELEM2 and is checked on a serial link only, because PX4's simulator lacks some of these."""
    file: bool = True
    """Whether the parameter is in configs/px4/indoor_mocap.params."""
    measured: bool = False
    """Whether the value is measured on each installation. If so, a value within `limits` other than PX4's default is left unchanged."""

    def accepts(self, value: Value, vehicle: Vehicle) -> bool:
        """Return whether this vehicle can fly with the value in PX4."""
        if self.ok:
            return value in self.ok
        limits = self.limits_for(vehicle)
        if limits is None:
            assert self.value is not None
            limits = (float(self.value), float(self.value))
        low, high = limits
        slack = _RELATIVE * max(abs(low), abs(high), _RELATIVE)
        return low - slack <= value <= high + slack

    def limits_for(self, vehicle: Vehicle) -> tuple[float, float] | None:
        """Return the lowest and highest accepted value; None without limits."""
        return self.limits(vehicle) if callable(self.limits) else self.limits

    def text(self, vehicle: Vehicle | None = None) -> str:
        """Return the accepted values for display. Without a vehicle, limits that depend on it are described in words."""
        if self.ok:
            return " or ".join(f"{value}" for value in self.ok)
        if self.limits is None:
            return f"{self.value:g}"
        if not callable(self.limits):
            low, high = self.limits
        elif vehicle is None:
            return self.limits_text
        else:
            low, high = self.limits(vehicle)
        return " to ".join(f"{end:.3f}".rstrip("0").rstrip(".") for end in (low, high))
