"""The jaws of a clamp and the shaft of the servo that moves them."""

from __future__ import annotations

import math
from typing import Final, Protocol

from companion.config.arm import Jaws as JawsConfig
from companion.model.servos import SERVOS
from sitl.world.state import PHYSICS_DT_S

_INERTIA_KG_M2: Final = 2e-3
"""Inertia of rotor, gears and jaws, referred to the shaft."""
_FRICTION_NM: Final = 0.01
_GRIPPED_SHARE: Final = 0.1
"""Fraction of the way from closed to open up to which the jaws hold a handle."""


class _Drive(Protocol):
    def update(self, t_s: float, shaft_angle_rad: float, shaft_velocity_rad_s: float) -> float:
        """Process the shaft's state and return the motor current in A."""


class Jaws:
    """The jaws with their servo; they start open, and stop at the handle."""

    def __init__(self, config: JawsConfig, drive: _Drive) -> None:
        self._drive = drive
        self._open_rad, self._closed_rad = math.radians(config.open_deg), math.radians(config.closed_deg)
        self._nm_per_a = SERVOS[config.servo].torque_per_amp_nm_a
        self.angle_rad, self.rate_rad_s = self._open_rad, 0.0
        self.closed = False
        """Whether the jaws are closed around a handle."""

    def step(self, t_s: float, handle_near: bool) -> None:
        """Move the shaft by one physics step; a handle between the jaws stops them."""
        torque_nm = self._drive.update(t_s, self.angle_rad, self.rate_rad_s) * self._nm_per_a
        rate = self.rate_rad_s + PHYSICS_DT_S * torque_nm / _INERTIA_KG_M2
        rate -= math.copysign(min(abs(rate), PHYSICS_DT_S * _FRICTION_NM / _INERTIA_KG_M2), rate)
        angle = self.angle_rad + PHYSICS_DT_S * rate
        way_rad = self._closed_rad - self._open_rad
        beyond = (angle - self._closed_rad) / way_rad
        was_open = (self.angle_rad - self._closed_rad) / way_rad < 0.0
        if beyond >= 0.0 and (self.closed or (was_open and handle_near)):
            angle, rate, self.closed = self._closed_rad, 0.0, True
        elif self.closed and beyond < -_GRIPPED_SHARE:
            self.closed = False
        self.angle_rad, self.rate_rad_s = angle, rate
