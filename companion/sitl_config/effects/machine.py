"""Section `machine` of the simulated world: differences between the real vehicle and the vehicle file."""

from __future__ import annotations

from companion.config.base import RelativeError, Vector3
from companion.sitl_config.effects import Effect
from companion.sitl_config.per_joint import LengthError, LengthErrors


class Machine(Effect):
    """Geometry, centre of mass and inertia of the real vehicle. `world.mass_error`, `world.link_mass_error` and
    `world.hover_thrust_error` also act without this effect.
    """

    centre_of_mass_m: tuple[LengthError, LengthError, LengthError] = (0.006, -0.004, 0.005)
    """True centre of mass of the base (without arm and tool) in the body frame. The vehicle file and PX4 assume the body's origin.
    (e) within 0.01 on each axis: battery and cables are placed by hand, the motion-capture pivot according to a drawing.
    """
    inertia_error: tuple[RelativeError, RelativeError, RelativeError] = (0.12, -0.08, 0.1)
    """Relative deviations, from the vehicle file, of the true moments of inertia about the body's x, y and z axes. No true moment
    exceeds the sum of the other two. (e) within 0.2: moments from a drawing or from a swing test without battery."""
    shoulder_offset_m: tuple[LengthError, LengthError, LengthError] = (0.002, -0.001, 0.002)
    """True position of the shoulder minus its position in the vehicle file, body frame. (e) within 0.003."""
    shoulder_rpy_deg: Vector3 = (0.5, -0.5, 0.5)
    """True attitude of the shoulder mount in the body frame: roll, pitch and yaw (ZYX). The vehicle file assumes zero. (e) within 1."""
    link_length_error_m: LengthErrors = (0.0006, -0.0006)
    """True link lengths minus those in the vehicle file, from the shoulder outwards. The last value also holds for further links, and
    surplus values are ignored. (e) within 0.001."""
    link_com_error_m: LengthErrors = (0.005, -0.005)
    """True distances of the links' centres of mass from their joints minus those in the vehicle file, listed like
    `link_length_error_m`. (e) within 0.01: cables and screws are not in the drawing."""
