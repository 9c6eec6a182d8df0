"""The search space: from a point of the unit cube to the settings of a control law."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

from companion.config.controller import ControllerConfig, LawConfig
from companion.config.gains import fitted, six_digits
from companion.config.tuned_gain import EACH, TunedGain
from companion.config.vehicle import Vehicle
from companion.control.scaled_gains import joint_inertia_kg_m2, written_for

Point = tuple[float, ...]
"""Coordinates from 0 (lower bound) to 1 (upper bound), on a logarithmic scale."""
START_MARGIN = 1.25
"""Smallest ratio of the start to a bound: bounds that are nearer, or exclude the start, are moved."""


@dataclass(frozen=True, slots=True)
class Axis:
    """One dimension of the space: a factor on some values of the start."""

    gain: TunedGain
    low: float
    high: float
    name: str
    """Key, with the range of its values if they are not all."""
    start: float

    @property
    def at_start(self) -> float:
        """Return the coordinate of the start."""
        return -math.log(self.low) / math.log(self.high / self.low)

    def factor(self, coordinate: float) -> float:
        """Return the factor at a coordinate."""
        return self.low * math.exp(coordinate * math.log(self.high / self.low))


@dataclass(frozen=True, slots=True)
class Space:
    """The gains of a law that are searched for one machine.

    A point of the space has one coordinate for each axis, and the start is a point of it. The gains of one axis keep the ratios that
    they have at the start. A gain that is 0 at the start stays 0.
    """

    start: ControllerConfig
    axes: tuple[Axis, ...]

    @classmethod
    def of(cls, start: ControllerConfig, vehicle: Vehicle) -> Space:
        """Return the space around a start, whose gains are those that fly on the vehicle (`for_vehicle`)."""
        found = [axis for gain in start.tuned_gains if (axis := _axis(gain, start, vehicle)) is not None]
        return cls(written_for(start, vehicle), tuple(found))

    @property
    def start_point(self) -> Point:
        """Return the start as a point of the space."""
        return tuple([axis.at_start for axis in self.axes])

    def settings(self, point: Point) -> ControllerConfig:
        """Return the settings of the law at a point, with six digits."""
        if point == self.start_point:
            return self.start
        changed: dict[str, Any] = {}
        for axis, coordinate in zip(self.axes, point, strict=True):
            key, factor = axis.gain.key, axis.factor(coordinate)
            value = changed.get(key, getattr(self.start, key))
            if isinstance(value, tuple):
                rows = list(value)
                rows[axis.gain.place] = [six_digits(factor * one) for one in rows[axis.gain.place]]
                changed[key] = tuple(rows)
            else:
                changed[key] = six_digits(factor * value)
        return self.start.with_gains(changed)

    def values(self, point: Point) -> list[float]:
        """Return the first value of each axis at a point."""
        settings = self.settings(point)
        return [_values(axis.gain, settings)[0] for axis in self.axes]


def _axis(gain: TunedGain, start: ControllerConfig, vehicle: Vehicle) -> Axis | None:
    values = _values(gain, start)
    if not any(values) or (gain.only_with and not getattr(start, gain.only_with)):
        return None
    units = _units(gain, start, vehicle, len(values))
    relative = [value / unit for value, unit in zip(values, units, strict=True) if value > 0.0]
    middle = math.exp(math.fsum(map(math.log, relative)) / len(relative))
    low, high = min(gain.low / middle, 1.0 / START_MARGIN), max(gain.high / middle, START_MARGIN)
    return Axis(gain, low, high, _name(gain, start), values[0])


def _values(gain: TunedGain, settings: ControllerConfig) -> Sequence[float]:
    value = getattr(settings, gain.key)
    found: Sequence[float] = value[gain.place] if isinstance(value, tuple) else (value,)
    return found


def _units(gain: TunedGain, settings: ControllerConfig, vehicle: Vehicle, count: int) -> Sequence[float]:
    """Return the mass or inertia to which each value is proportional; 1 for a gain that does not follow the vehicle."""
    key = gain.scaled_as or gain.key
    mass_kg, joints = vehicle.airframe.mass_kg, joint_inertia_kg_m2(vehicle) or (1.0,)
    if isinstance(settings, LawConfig):
        if key in settings.scaled_by_row:
            length = len(getattr(settings, key))
            return (mass_kg, mass_kg, mass_kg, 1.0, 1.0, 1.0, *fitted(joints, length - 6))[gain.place]
        if key in settings.scaled_by_joint:
            return fitted(joints, count)
        if key in settings.scaled_by_mass:
            return (mass_kg,) * count
    return (1.0,) * count


def _name(gain: TunedGain, settings: ControllerConfig) -> str:
    value = getattr(settings, gain.key)
    if not isinstance(value, tuple) or gain.rows == EACH:
        return gain.key
    picked = range(len(value))[gain.place]
    return f"{gain.key}[{picked[0]}]" if len(picked) == 1 else f"{gain.key}[{picked[0]}:{picked[-1] + 1}]"
