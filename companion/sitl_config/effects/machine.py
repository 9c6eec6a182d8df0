"""Section `machine` of the simulated world: differences of the real vehicle from the vehicle file."""

from __future__ import annotations

from typing import Annotated

from pydantic import Field

from companion.config.base import Model, RelativeError, Vector3

LengthError = Annotated[float, Field(ge=-0.05, le=0.05)]


class Machine(Model):
    """Geometry, centre of mass and inertia of the real vehicle. `world.mass_error`, `world.link_mass_error` and
    `world.hover_thrust_error` act without this section.
    """

    on: bool = False
    """Whether this effect acts."""
    centre_of_mass_m: tuple[LengthError, LengthError, LengthError] = (0.006, -0.004, 0.005)
    """True centre of mass of the base (without arm and tool) in the body frame. Vehicle file and PX4 assume that it is at the body's
    origin. (e) within 0.01 on each axis: battery and cables are placed by hand, and the mocap pivot according to a drawing.
    """
    inertia_error: tuple[RelativeError, RelativeError, RelativeError] = (0.12, -0.08, 0.1)
    """Relative error of the vehicle file's moments of inertia about the body's x, y, z against the truth. No true moment exceeds the
    sum of the other two. (e) within 0.2: moments from a drawing or from a swing test without battery."""
    shoulder_offset_m: tuple[LengthError, LengthError, LengthError] = (0.002, -0.001, 0.002)
    """True position of the shoulder minus the vehicle file's, body frame. (e) within 0.003."""
    shoulder_rpy_deg: Vector3 = (0.5, -0.5, 0.5)
    """True attitude of the shoulder mount in the body frame, ZYX roll, pitch, yaw; the vehicle file assumes zero. (e) within 1."""
    link_length_error_m: tuple[LengthError, LengthError] = (0.0006, -0.0006)
    """True link lengths minus the vehicle file's. (e) within 0.001."""
    link_com_error_m: tuple[LengthError, LengthError] = (0.005, -0.005)
    """True distances of the links' centres of mass from their joints minus the vehicle file's. (e) within 0.01: cables and screws are
    not in the drawing."""
