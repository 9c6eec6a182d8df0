"""Result of a preflight check: the value found, the value expected, why it matters and how to fix it."""

from __future__ import annotations

from collections.abc import Iterable
from enum import Enum
from typing import Any

import msgspec

from companion.model.codec import Record


class Level(Enum):
    """Consequence of a failed check."""

    REFUSE = "refuse"
    """The vehicle must not take off."""
    WARN = "warn"
    """The operator is warned and decides."""


class Row(Record, frozen=True, kw_only=True):
    """The result of one check."""

    id: str
    """Stable dotted name on which scripts can rely, such as `px4.param.EKF2_EV_CTRL` or `mocap.rate`."""
    title: str
    """Name of the check for the operator, in a few words."""
    ok: bool
    read: str
    """Value that was found, with its unit."""
    wanted: str = ""
    """Value that was expected; empty if the row is for information only."""
    why: str = ""
    """Consequence of a wrong value, in one sentence."""
    fix: str = ""
    """Remedy; empty if the check passed."""
    level: Level = Level.REFUSE

    @property
    def refuses(self) -> bool:
        """Return whether this row forbids take-off."""
        return not self.ok and self.level is Level.REFUSE

    def line(self) -> str:
        """Return the row as one line of text, as it is listed when the preflight check refuses take-off."""
        wanted = f", wanted {self.wanted}" if self.wanted else ""
        fix = f"; {self.fix}" if self.fix else ""
        return f"{self.title}: {self.read}{wanted}{fix}"

    def as_json(self) -> dict[str, Any]:
        """Return the row as plain data for `--json`, the log and the status channel."""
        return {**msgspec.structs.asdict(self), "level": self.level.value}


def refusals(rows: Iterable[Row]) -> list[Row]:
    """Return the rows that forbid take-off."""
    return [row for row in rows if row.refuses]
