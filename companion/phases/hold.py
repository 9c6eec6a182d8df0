"""Phase `hold`."""

from __future__ import annotations

from typing import Literal

from companion.config.phase import Duration
from companion.mission.phase import Phase, Planning


class Hold(Phase):
    """Hover in place."""

    type: Literal["hold"]
    duration_s: Duration

    def plan(self, p: Planning) -> None:
        """Append the time."""
        p.builder.t_s += self.duration_s
