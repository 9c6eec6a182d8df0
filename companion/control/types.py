"""Records and protocols between the core and a controller."""

from __future__ import annotations

from collections.abc import Callable
from enum import Enum
from typing import Protocol

from companion.config.controller import ControllerConfig
from companion.config.vehicle import Vehicle
from companion.model.codec import Record
from companion.model.outputs import ControlLog
from companion.model.types import Joints, Quat, Reference, Vec3


class Tuning(Enum):
    """What the state of the flight permits the online optimisation of a law to do."""

    FREEZE = "freeze"
    RUN = "run"
    UNDO = "undo"  # return to the mission's gains

    # An enum's own hash is a Python function.
    __hash__ = object.__hash__


class PlantState(Record, frozen=True, kw_only=True):
    """State of the vehicle at one tick as passed to a controller; world ENU, body FLU."""

    position_world_m: Vec3
    velocity_world_m_s: Vec3
    acceleration_world_m_s2: Vec3
    """Acceleration from the IMU, gravity removed."""
    attitude_wxyz: Quat
    angular_rate_body_rad_s: Vec3
    arm_rad: Joints
    arm_rate_rad_s: Joints
    force_ext_world_n: Vec3 | None = None
    """Force on the net, tared, without the net's weight, not filtered; None without a valid sample."""
    airborne: bool = True
    """Whether only the rotors carry the vehicle. While the ground or a surface may carry a part of it, what a law integrates
    to answer a load (adaptive loads, observer, integral of the error) does not change.
    """
    tuning: Tuning = Tuning.FREEZE
    """What a law that optimises its gains in flight may do."""


class Wrench(Record, frozen=True, kw_only=True):
    """Force on the vehicle and joint torques of one tick."""

    attitude_wxyz: Quat
    collective_n: float
    arm_torque_nm: Joints
    log: ControlLog


class Controller(Protocol):
    """Protocol of a control law. It holds its own state and reads no clock."""

    def step(self, dt_s: float, state: PlantState, reference: Reference, vertical_scale: float) -> Wrench:
        """Run one tick of `dt_s`. `vertical_scale` (0 to 1) scales the vertical force while rotors spool up or down on the ground."""


class Law(Controller, Protocol):
    """Protocol of a control law as `VehicleControl` uses it.

    The class of a law is called with its settings, the vehicle and the normalised thrust that carries the vehicle without payload. Its
    attribute `settings` is the class of the settings, a subclass of `companion.config.controller.ControllerConfig`.
    """

    hover_thrust: float
    """Normalised thrust that carries the vehicle without payload, for the log; set before every step."""


MakeLaw = Callable[[ControllerConfig, Vehicle, float], Law]
"""Makes a law from its settings, the vehicle and the normalised hover thrust, as the class of a law does."""
