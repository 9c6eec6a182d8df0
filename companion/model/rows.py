"""One row per check: what was read, what was wanted, why, and how to put it right."""

from __future__ import annotations

from collections.abc import Iterable
from enum import Enum
from typing import Any

import msgspec

from companion.model.codec import Record


class Level(Enum):
    """What a row that is not ok means."""

    REFUSE = "refuse"
    """The machine does not lift."""
    WARN = "warn"
    """People are told, and decide."""


class Row(Record, frozen=True, kw_only=True):
    """The result of one check."""

    id: str
    """Dotted, stable: `px4.param.EKF2_EV_CTRL`, `mocap.rate`; scripts tell rows apart by it."""
    title: str
    """For people, a few words."""
    ok: bool
    read: str
    """What was found, with its unit."""
    wanted: str = ""
    """What would be ok; empty where the row only reports."""
    why: str = ""
    """What goes wrong without it, in one sentence."""
    fix: str = ""
    """What to do about it; empty when the row is ok."""
    level: Level = Level.REFUSE

    @property
    def refuses(self) -> bool:
        """This row keeps the machine on the ground."""
        return not self.ok and self.level is Level.REFUSE

    def line(self) -> str:
        """The row as one line, for a refusal."""
        wanted = f", wanted {self.wanted}" if self.wanted else ""
        fix = f"; {self.fix}" if self.fix else ""
        return f"{self.title}: {self.read}{wanted}{fix}"

    def as_json(self) -> dict[str, Any]:
        """For `--json`, the log and the status channel."""
        return {**msgspec.structs.asdict(self), "level": self.level.value}


def refusals(rows: Iterable[Row]) -> list[Row]:
    """The rows that keep the machine on the ground."""
    return [row for row in rows if row.refuses]
