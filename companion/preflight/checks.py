"""A check: its identity and its texts, from which its rows are made. Each module lists its checks, so that all of them can be
documented.
"""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass

from companion.model.check_row import Level, Row
from companion.model.negative_zero import without_negative_zero


@dataclass(frozen=True, slots=True)
class Check:
    """Identity and texts of one check."""

    id: str
    title: str
    wanted: str = ""
    """Expected result in general terms, for the table of checks in the docs. The row states the actual limits."""
    why: str = ""
    """Consequence if the check fails."""
    warns: bool = False
    """Whether a failure only warns."""
    settles: bool = False
    """Whether a failed check may pass later, because PX4 has just started."""

    def good(self, read: str, wanted: str = "") -> Row:
        """Return a row that passes."""
        return self._row(True, read, wanted, "", self._level)

    def bad(self, read: str, wanted: str = "", fix: str = "") -> Row:
        """Return a row that fails and forbids take-off, or only warns the operator if `warns` is set."""
        return self._row(False, read, wanted, fix, self._level)

    def doubtful(self, read: str, wanted: str = "", fix: str = "") -> Row:
        """Return a row that warns; the operator decides."""
        return self._row(False, read, wanted, fix, Level.WARN)

    def row(self, ok: bool, read: str, wanted: str, fix: str) -> Row:
        """Return the row of `good` if `ok` is True, else that of `bad`."""
        return self.good(read, wanted) if ok else self.bad(read, wanted, fix)

    def graded(self, ok: bool, tolerable: bool, read: str, wanted: str, fix: str) -> Row:
        """Return the row of `good` if `ok` is True, else that of `doubtful` if `tolerable` is True, else that of `bad`."""
        if ok:
            return self.good(read, wanted)
        return self.doubtful(read, wanted, fix) if tolerable else self.bad(read, wanted, fix)

    def _row(self, ok: bool, read: str, wanted: str, fix: str, level: Level) -> Row:
        plain = without_negative_zero
        return Row(
            id=self.id,
            title=self.title,
            ok=ok,
            read=plain(read),
            wanted=plain(wanted),
            why=self.why,
            fix=plain(fix),
            level=level,
        )

    @property
    def _level(self) -> Level:
        return Level.WARN if self.warns else Level.REFUSE


def longest_unchanged_s(readings: Iterable[tuple[float, object]]) -> float:
    """Return the longest time in which a sensor repeated one value to the last bit, s, given stamps and values in their order."""
    longest_s, since_s, before = 0.0, 0.0, None
    for stamp_s, value in readings:
        if value != before:
            since_s, before = stamp_s, value
        longest_s = max(longest_s, stamp_s - since_s)
    return longest_s
