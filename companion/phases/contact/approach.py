"""Phase `approach`."""

from __future__ import annotations

import math
from typing import Annotated, ClassVar, Literal

from pydantic import Field

from companion.config.phase import PhaseSettings
from companion.model.types import Vec2
from companion.phases.contact.base import Opening


class Approach(Opening):
    """Move in one direction until the tool touches a surface; the arm keeps its pose. A press or a slide must follow."""

    goes_on: ClassVar[bool] = True

    type: Literal["approach"]
    face_m: Annotated[float, Field(ge=0.1, le=0.5)] | None = None
    """Side of a triangle of three light touches, by which the vehicle finds the surface's normal. It then turns to the surface and
    presses along its normal. If it is absent, the force acts along `direction`, and friction must keep the tool from slipping.
    """

    @property
    def points_of_surface_m(self) -> tuple[Vec2, ...]:
        """Points that are touched to find the surface, right and up of the way straight ahead, m."""
        if self.face_m is None:
            return ()
        half, low = 0.5 * self.face_m, self.face_m / math.sqrt(12.0)
        return ((-half, -low), (half, -low), (0.0, 2.0 * low))

    def unfinished(self, after: PhaseSettings) -> str:
        """Return that a press or a slide must follow."""
        return f"a press or a slide must follow the approach, not a {after.type}"
