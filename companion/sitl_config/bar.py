"""Key `bar` of the simulated world: the bar that two vehicles carry."""

from __future__ import annotations

from typing import Annotated

from pydantic import Field

from companion.config.base import Model, NonNegative, Vector3


class Bar(Model):
    """What is true of the bar; its length, and where it is put, are the mission's (phase `grip`), with the errors below."""

    mass_kg: Annotated[float, Field(gt=0, le=2)] = 0.3
    centre_offset_m: Annotated[float, Field(ge=-0.3, le=0.3)] = 0.0
    """Centre of mass, from the middle towards the left end."""
    length_error_m: Annotated[float, Field(ge=-0.05, le=0.05)] = 0.0
    """True distance of the handles minus that of the mission."""
    place_error_m: tuple[float, float] = (0.0, 0.0)
    """True place of the standing bar minus that of the mission, world frame."""
    yaw_error_deg: Annotated[float, Field(ge=-10, le=10)] = 0.0
    capture_m: Annotated[float, Field(gt=0, le=0.1)] = 0.05
    """Distance of the clamp's centre from the handle's up to which closing jaws take hold of it: half the mouth of their funnel."""
    pivot_offset_m: Vector3 = (0.0, 0.0, 0.0)
    """Streamed middle minus the true one, in the bar's frame."""
    strength_n: NonNegative = 40.0
    """Pull at which a handle slips out of closed jaws."""
