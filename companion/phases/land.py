"""Phase `land`."""

from __future__ import annotations

from typing import Annotated, ClassVar, Literal

from pydantic import Field

from companion.mission.phase import Phase, Planning
from companion.mission.plan import BELOW_GROUND_M
from companion.model.types import PhaseKind


class Land(Phase):
    """Descend vertically until touchdown."""

    place: ClassVar[Literal["first", "last"] | None] = "last"
    kind = PhaseKind.LANDING

    type: Literal["land"]
    speed_m_s: Annotated[float, Field(ge=0.05, le=1.0)]

    def plan(self, p: Planning) -> None:
        """Append the descent to below the floor."""
        p.builder.t_s = p.builder.descend(self.speed_m_s, p.vehicle.airframe.ground_clearance_m - BELOW_GROUND_M)
