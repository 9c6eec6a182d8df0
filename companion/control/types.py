"""Records between the core and a controller."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Protocol

from companion.model.frozen import quick
from companion.model.types import ControlLog, Quat, Reference, Vec2, Vec3


@quick
@dataclass(frozen=True, slots=True)
class PlantState:
    """What a controller may know of the machine at one tick; world ENU, body FLU."""

    position_world_m: Vec3
    velocity_world_m_s: Vec3
    acceleration_world_m_s2: Vec3
    """From the IMU, gravity removed."""
    attitude_wxyz: Quat
    angular_rate_body_rad_s: Vec3
    arm_rad: Vec2
    arm_rate_rad_s: Vec2
    force_ext_world_n: Vec3 | None
    """On the net, tared, net's weight removed, not filtered; None: no sensor to be trusted."""


@quick
@dataclass(frozen=True, slots=True)
class Wrench:
    """What a controller asks of vehicle and arm."""

    attitude_wxyz: Quat
    collective_n: float
    arm_torque_nm: Vec2
    log: ControlLog


class Controller(Protocol):
    """One control law; holds its own state, reads no clock."""

    def step(self, dt_s: float, state: PlantState, reference: Reference, vertical_scale: float) -> Wrench:
        """One tick of `dt_s`. `vertical_scale` (0 to 1) scales the vertical force while rotors spool up or down on the ground."""


class Law(Controller, Protocol):
    """A controller as the pilot owns it."""

    hover_thrust: float
    """For the log: the normalised thrust that is taken to carry the machine without payload; set before every step."""
