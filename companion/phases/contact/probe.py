"""Phase `probe`."""

from __future__ import annotations

from typing import Annotated, ClassVar, Literal

from pydantic import Field

from companion.model.types import Vec2
from companion.phases.contact.base import Opening


class Probe(Opening):
    """Touch a grid of points, find the plane through them, and move back to where the probe began; the arm keeps its pose."""

    surveys: ClassVar[bool] = True

    type: Literal["probe"]
    rows: Annotated[int, Field(ge=2, le=10)] = 3
    columns: Annotated[int, Field(ge=2, le=10)] = 3
    spacing_m: Annotated[float, Field(ge=0.05, le=0.5)]
    """Distance between neighbouring points. The middle of the grid is straight ahead in the direction."""

    @property
    def points_of_surface_m(self) -> tuple[Vec2, ...]:
        """Points that are touched to find the surface, right and up of the way straight ahead, m."""
        across = [self.spacing_m * (k - 0.5 * (self.columns - 1)) for k in range(self.columns)]
        rows = [self.spacing_m * (k - 0.5 * (self.rows - 1)) for k in range(self.rows)]
        # Row by row upwards, every other row from right to left.
        return tuple((x, y) for k, y in enumerate(rows) for x in (across if k % 2 == 0 else reversed(across)))
