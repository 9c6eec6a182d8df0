"""Key `surfaces` of the simulated world: rigid surfaces that the tool can push against."""

from __future__ import annotations

from typing import Annotated

from pydantic import Field

from companion.config.base import Axis, Model, NonNegative, Positive2, Vector3

TiltError = Annotated[float, Field(ge=-45, le=45)]


class Surface(Model):
    """A rectangular surface with one free side: a wall, a panel, a table."""

    name: Annotated[str, Field(min_length=1)] = "wall"
    point_m: Vector3
    """Centre of the surface as the mission's author knows it, world frame."""
    normal: Axis
    """Direction to the free side, of any length, world frame."""
    size_m: Positive2 = (2.0, 2.0)
    """Width and height. The height is measured along the upward direction in the surface or, if it is horizontal, along world x."""
    stiffness_n_m: Annotated[float, Field(ge=100, le=1e6)] = 1e4
    """Force divided by depth of penetration, tool excluded."""
    damping_ratio: Annotated[float, Field(ge=0, le=2)] = 0.3
    """Damping ratio of a mass of 1 kg on the surface."""
    friction: Annotated[float, Field(ge=0, le=2)] = 0.4
    """Coefficient of friction."""
    gives_way_n: NonNegative = 0.0
    """Normal force above which the surface is gone, as a panel that comes off; 0 for never."""
    place_error_m: Annotated[float, Field(ge=-0.5, le=0.5)] = 0.0
    """True position minus `point_m`, along `normal`."""
    tilt_error_deg: tuple[TiltError, TiltError] = (0.0, 0.0)
    """Angles by which the true surface is turned about its centre: about the direction of its height, then about that of its width."""
