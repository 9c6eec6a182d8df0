"""Contract of a force-torque sensor that a plug-in provides. `companion.io.force_torque.plugin_driver` runs it."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Any, ClassVar, Protocol

from companion.config.devices import ForceDevice
from companion.model.types import Vec3


@dataclass(frozen=True, slots=True)
class Reading:
    """One reading of a sensor, as measured: the companion removes the bias and the net's weight."""

    force_n: Vec3
    """Force in the sensor's frame."""
    torque_nm: Vec3
    """Torque in the sensor's frame."""
    overload: bool = False
    """Whether the sensor reports an overload or an invalid reading. A force beyond `force_max_n` is one anyway."""


class ForceSensor(Protocol):
    """Reads a sensor; an entry point of the group `companion.force_sensors` names its class.

    The class is called with its options and the settings in `devices.force`. One thread makes all calls, and only `read` may wait
    long. An exception before the take-off refuses the flight. One of `read` in the air ends the readings, and the companion then
    treats the force as lost.
    """

    options: ClassVar[type[Any]]
    """Subclass of `companion.config.base.Model` that checks `devices.force.options`; its docstring describes the sensor."""
    product_name: str
    """Model and firmware as the sensor reports them, once it is open."""

    def __init__(self, options: Any, device: ForceDevice) -> None: ...

    def open(self) -> None:
        """Connect, check the model, and start readings at `device.rate_hz`."""

    def read(self) -> Reading | None:
        """Wait for the next reading and return it at once; None if none has arrived for 0.1 s. Its time stamp is its return."""

    def close(self) -> None:
        """Stop the readings and disconnect; also called if `open` has failed."""


METHODS = ("open", "read", "close")


def checked(returned: object) -> Reading:
    """Return a reading with Python's own numbers.

    Raises:
        TypeError: `read` returned something else.
        ValueError: a value is not finite, or a vector does not have three.
    """
    if not isinstance(returned, Reading):
        raise TypeError(f"read() returned {returned!r:.80}, expected a Reading or None")
    fx, fy, fz = (float(value) for value in returned.force_n)
    tx, ty, tz = (float(value) for value in returned.torque_nm)
    if not all(map(math.isfinite, (fx, fy, fz, tx, ty, tz))):
        raise ValueError(f"force {(fx, fy, fz)} N, torque {(tx, ty, tz)} N m, expected finite values")
    return Reading((fx, fy, fz), (tx, ty, tz), bool(returned.overload))
