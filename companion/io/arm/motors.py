"""Contract of an arm that a plug-in provides. `companion.io.arm.plugin_driver` runs it."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any, ClassVar, Protocol

from companion.config.arm import Joint
from companion.config.devices import ArmDevice


@dataclass(frozen=True, slots=True)
class MotorState:
    """State of one motor at its output shaft, positive in the motor's own direction."""

    angle_rad: float
    """Angle; the companion subtracts `zero_count` and whole turns."""
    velocity_rad_s: float
    torque_nm: float
    """Measured torque, or the torque of the measured current."""
    temperature_c: float | None = None
    """Temperature; None if the motor does not report it, which the preflight then warns of."""
    error: str = ""
    """Fault for which the motor gives no torque, or may soon give none; empty if there is none. It lands the vehicle."""


class ArmMotors(Protocol):
    """Speaks to the motors of an arm; an entry point of the group `companion.arms` names its class.

    The class is called with its options, the settings in `devices.arm` and the joints of the vehicle file from the shoulder outwards;
    `servo_id` of a joint is its motor's id on the bus. One thread makes all calls; each cycle of 5 ms is one `read` and one
    `write_torque`. An exception before the take-off refuses the flight. One in the air counts as a cycle without an answer; without
    joint states for `safety.arm_timeout_s` the vehicle lands.
    """

    options: ClassVar[type[Any]]
    """Subclass of `companion.config.base.Model` that checks `devices.arm.options`; its docstring describes the arm."""
    product_name: str
    """Model and firmware as the motors report them, once they are open."""
    watchdog: str
    """What makes the arm limp when the companion dies; the preflight shows it. An empty text refuses the flight."""
    watchdog_ms: float
    """Time after the last command until it does, once the motors are open. More than `device.watchdog_ms` refuses the flight."""

    def __init__(self, options: Any, device: ArmDevice, joints: Sequence[Joint]) -> None: ...

    def open(self) -> None:
        """Connect, check every motor, set its watchdog to `device.watchdog_ms`, and switch its torque on with torque 0."""

    def read(self) -> Sequence[MotorState]:
        """Return the present state of each joint's motor, in the order of the joints."""

    def write_torque(self, torque_nm: Sequence[float]) -> None:
        """Command the torque at the output shaft of each motor, positive in the motor's own direction, within `torque_max_nm`."""

    def torque_off(self) -> None:
        """Switch all torque off; also called if `open` has failed."""

    def close(self) -> None:
        """Disconnect; also called if `open` has failed."""


METHODS = ("open", "read", "write_torque", "torque_off", "close")


def checked(returned: object, joints: int) -> tuple[MotorState, ...]:
    """Return the states with Python's own numbers.

    Raises:
        TypeError: `read` returned something else, or another number of states.
        ValueError: a value is not finite.
    """
    if not isinstance(returned, Sequence) or not all(isinstance(state, MotorState) for state in returned):
        raise TypeError(f"read() returned {returned!r:.80}, expected a list of MotorState")
    if len(returned) != joints:
        raise TypeError(f"read() returned {len(returned)} states, expected {joints}, one for each joint")
    return tuple([_checked(number, state) for number, state in enumerate(returned, 1)])


def _checked(number: int, state: MotorState) -> MotorState:
    angle, velocity, torque = float(state.angle_rad), float(state.velocity_rad_s), float(state.torque_nm)
    temperature = None if state.temperature_c is None else float(state.temperature_c)
    if not all(map(math.isfinite, (angle, velocity, torque, temperature or 0.0))):
        raise ValueError(f"read() returned {state} for joint {number}, expected finite values")
    return MotorState(angle, velocity, torque, temperature, str(state.error))
