"""A check has a fixed identity; what it finds becomes a row. Rooms list their checks, so that people can be told of all of them."""

from __future__ import annotations

from dataclasses import dataclass

from companion.model.negative_zero import without_negative_zero
from companion.model.rows import Level, Row


@dataclass(frozen=True, slots=True)
class Check:
    """One thing that is looked at."""

    id: str
    """Of its row."""
    title: str
    """Of its row."""
    wanted: str
    """What is ok, in words: for the table of all checks. The row itself says it with figures."""
    why: str
    """What goes wrong without it."""
    warns: bool = False
    """It never refuses."""
    settles: bool = False
    """It may come right by waiting: on a PX4 that has just started."""

    def good(self, read: str, wanted: str = "") -> Row:
        """It is as it must be."""
        return self._row(True, read, wanted, "", self._level)

    def bad(self, read: str, wanted: str, fix: str) -> Row:
        """It is not: the machine does not lift (or, of a check that `warns`, people decide)."""
        return self._row(False, read, wanted, fix, self._level)

    def doubtful(self, read: str, wanted: str, fix: str) -> Row:
        """It is not, but one can fly with it: people decide."""
        return self._row(False, read, wanted, fix, Level.WARN)

    def _row(self, ok: bool, read: str, wanted: str, fix: str, level: Level) -> Row:
        plain = without_negative_zero
        return Row(self.id, self.title, ok, plain(read), plain(wanted), self.why, plain(fix), level)

    @property
    def _level(self) -> Level:
        return Level.WARN if self.warns else Level.REFUSE
